"""Ways by which robots cross what nobody crosses unsteered, and what MuJoCo C says of faults: witness.json.

The published archives are judged by the stages steered and mujoco_c, unless they are. ``control`` are plain crossings
in place of steered ones: how many would pass for witnesses by luck. ``curve`` says how many of some terrains a search
crosses in half of 20 coarse episodes, over the episodes that it spends on each.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from qd.faults.judge import elite_seeds, judge
from qd.faults.steer import SteerCfg, cross_half, find_kinds, find_ways, try_ways
from qd.search.archive import WITNESSES, Archive, read_archive
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from results.make.common import ARCHIVE_FILES, Script, parse
from sim.terrains.terrains import Terrains

ARCHIVES = {"archive": ("steered", "mujoco_c"), "archive_cma_mae": ("steered",)}
"""Stages by which each archive is judged; a fault takes MuJoCo C 20 s of a core."""
GENERATIONS = (1, 2, 4, 8, 12, 16, 24)
CURVE_TERRAINS = 200


def judge_steered(script: Script, name: str) -> Archive:
    """A published archive, judged in a copy of its run, which it replaces, by the stages that are not done."""
    run = script.runs / "witness" / name
    if not run.exists():
        shutil.copytree(script.results / name, run)
    archive = read_archive(run)
    done = {"steered": archive.witnesses, "mujoco_c": archive.mujoco_c}
    for stage in ARCHIVES[name][: 1 if script.small else None]:
        if done[stage] is None:
            few = 2 if script.small else None
            archive = judge(run, stages=(stage,), compute=script.compute, most_steered=few)
            if not script.small:
                script.publish(run, script.results / name, ARCHIVE_FILES)
    return archive


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
    return {"tried": len(rows)} | {word: int((found == kind).sum()) for kind, word in enumerate(WITNESSES) if word}


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


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Judges the archives, or those that ``--parts`` names, and measures if it has judged all."""
    script = parse(__doc__, argv, "witness.json", parts=tuple(ARCHIVES))
    names = script.parts or tuple(ARCHIVES)[: 1 if script.small else None]
    judged = {name: judge_steered(script, name) for name in names}
    if script.parts:
        return {}
    archive = judged["archive"]
    assert archive.witnesses is not None
    tried = np.flatnonzero(archive.witnesses.walker != "")
    some = np.random.default_rng(script.seed).permutation(tried)[: 2 if script.small else CURVE_TERRAINS]
    with Crosser(script.robot, script.compute) as crosser:
        control = measure_control(script, crosser, archive, tried)
        curve = measure_curve(script, crosser, archive, np.sort(some))
    return script.write({"control": control, "curve": curve})


if __name__ == "__main__":
    main()
