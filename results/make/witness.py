"""Witnesses of the published archives, and what MuJoCo C says of faults: results/<robot>/witness.json.

The archives are judged on by the stage steered, whose time is ``wall_s``, and that of the default search by mujoco_c,
too. Each is a part of its own, which is not done again; the part ``measure`` follows them.

``control`` are plain crossings in place of steered ones: how many would pass for witnesses by luck. ``curve`` says how
many of some terrains a search crosses in half of 20 coarse episodes, over the episodes that it spends on each.
"""

import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from qd.faults.judge import elite_seeds, judge
from qd.faults.steer import SteerCfg, cross_half, find_kinds, find_ways, try_ways
from qd.search.archive import WITNESSES, Archive, read_archive
from qd.search.directory import RunDirectory
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from results.make.common import ARCHIVE_FILES, Script, measure_once, parse
from sim.terrains.terrains import Terrains

ARCHIVES = ("archive", "archive_cma_mae")
_KINDS = [(kind, word) for kind, word in enumerate(WITNESSES) if word]
GENERATIONS = (1, 2, 4, 8, 12, 16, 24)
CURVE_TERRAINS = 200
_COUNTS = (
    "failing", "confirmed", "certified", "faults", "faults_panel", "faults_controllers", "faults_witness",
    "fault_families", "faults_distinct", "failing_families", "failing_distinct", "witnesses", "faults_mujoco_c",
)  # fmt: skip


def judge_steered(script: Script, name: str) -> dict[str, Any]:
    """Numbers of an archive with its witnesses, judged in a copy of the published run, which it replaces."""
    run = script.runs / "witness" / name

    def steer() -> dict[str, float]:
        if not run.exists():
            shutil.copytree(script.results / name, run)
        began = time.perf_counter()
        judge(run, stages=("steered",), compute=script.compute, most_steered=2 if script.small else None)
        return {"wall_s": time.perf_counter() - began}

    made = measure_once(script, script.runs / "witness" / f"{name}.json", steer)
    archive, by_walker = read_archive(run), {}
    if not script.small:
        script.publish(run, script.results / name, (*ARCHIVE_FILES, "*.png"))
        if archive.mujoco_c is None and name == ARCHIVES[0]:  # a fault takes 20 s of a core
            archive = judge(run, stages=("mujoco_c",), compute=script.compute)
            script.publish(run, script.results / name, (*ARCHIVE_FILES, "*.png"))
    summary, witnesses = RunDirectory(run).read_summary(), archive.witnesses
    assert witnesses is not None and archive.family is not None
    for walker in np.unique(witnesses.walker[witnesses.kind > 0]).tolist():
        kinds = witnesses.kind[witnesses.walker == walker]
        by_walker[walker] = {word: int((kinds == kind).sum()) for kind, word in _KINDS}
    families = np.unique(archive.family[archive.is_fault & archive.certified_by_controllers])
    counts = {count: summary.get(count) for count in _COUNTS}
    return counts | {"fault_families_controllers": len(families), "by_walker": by_walker} | made


def measure_control(script: Script, crosser: Crosser, archive: Archive, rows: np.ndarray) -> dict[str, Any]:
    """How many of the terrains have a witness by luck, where other plain episodes stand for steered ones."""
    terrains, seeds = elites_to_steer(archive, rows, script.seed, 4)
    assert archive.witnesses is not None
    way = np.full_like(archive.witnesses.way[rows], np.nan)
    limit_m = archive.witnesses.limit_m
    counts = np.zeros((len(rows), 2, 2, 4), np.int64)
    for kind, engine in enumerate(("search", "resolved")):
        for side in range(2):
            drawn = seeds[:, 2 * kind + side]
            how: Any = {"label": "control", "engine": engine}
            counts[:, kind, side] = try_ways(crosser, script.policy, terrains, way, drawn, limit_m, **how)
    found = find_kinds(counts)
    return {"tried": len(rows)} | {word: int((found == kind).sum()) for kind, word in _KINDS}


def measure_curve(script: Script, crosser: Crosser, archive: Archive, rows: np.ndarray) -> list[dict[str, Any]]:
    """Shares of some terrains that a search crosses in half of 20 coarse episodes: on the line, beside it, around."""
    assert archive.witnesses is not None
    limit_m, points = archive.witnesses.limit_m, []
    for generations in GENERATIONS[:1] if script.small else GENERATIONS:
        cfg = replace(SteerCfg(), generations=generations)
        for limit in (limit_m, None):
            terrains, seeds = elites_to_steer(archive, rows, script.seed + 1, generations + 1)
            how: Any = {"rng": np.random.default_rng(script.seed), "label": "curve", "cfg": cfg}
            ways = find_ways(crosser, script.policy, terrains, seeds[:, :-1], limit_m=limit, **how)
            counts = try_ways(crosser, script.policy, terrains, ways, seeds[:, -1], limit_m, label="curve")
            crossed = cross_half(counts)
            words = dict(zip(("line", "beside", "around"), crossed.mean(axis=0).tolist(), strict=True))
            points.append({"episodes": generations * cfg.samples, "limit_m": limit, "terrains": len(rows), **words})
    return points


def elites_to_steer(archive: Archive, rows: np.ndarray, seed: int, times: int) -> tuple[Terrains, np.ndarray]:
    """Some elites as terrains, and seeds of so many evaluations of each, (N, times)."""
    seeds = elite_seeds(archive, seed, times, stream=Stream.STEERED).reshape(-1, times)[rows]
    return Terrains(genes=archive.genes[rows], seeds=seeds[:, 0], space=archive.terrain_space), seeds


def measure(script: Script) -> dict[str, Any]:
    """What luck finds among the terrains of the published archive that were steered, and how much search pays."""
    archive = read_archive(script.runs / "witness" / ARCHIVES[0])
    assert archive.witnesses is not None
    tried = np.flatnonzero(archive.witnesses.walker != "")
    some = np.random.default_rng(script.seed).permutation(tried)[: 2 if script.small else CURVE_TERRAINS]
    with Crosser(script.robot, script.compute) as crosser:
        control = measure_control(script, crosser, archive, tried)
        return {"control": control, "curve": measure_curve(script, crosser, archive, np.sort(some))}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Judges, and measures; parts are archives alone, and ``measure``, which needs the first of them steered."""
    script = parse(__doc__, argv, "witness.json", parts=(*ARCHIVES, "measure"))
    parts = script.parts or (*ARCHIVES[: 1 if script.small else None], "measure")
    judged = {name: judge_steered(script, name) for name in parts if name in ARCHIVES}
    measured: dict[str, Any] = {}
    if "measure" in parts:
        measured = measure_once(script, script.runs / "witness" / "measure.json", partial(measure, script))
    return judged | measured if script.parts else script.write({"archives": judged, **measured})


if __name__ == "__main__":
    main()
