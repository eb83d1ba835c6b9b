"""Searches under noise by design, and how much of what each finds is there again: search_noise.json.

Each design searches in about 400,000 episodes with three seeds, and some in a million with one. Then all elites cross
two lots of 40 fresh episodes. The share that both put into one cell (``two_lots_agree``) is about what an archive has
whose elites are as well known as by 40 episodes.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from qd.faults.families import find_families
from qd.faults.judge import elite_seeds, fresh_values, judge
from qd.faults.numbers import FRESH_EPISODES
from qd.search.directory import RunDirectory
from qd.search.loop import search
from qd.search.pool import chance_to_stay
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from results.make.common import FRESH_COUNTS, ONCE, Script, file_name, parse
from sim.terrains.terrains import Terrains

SEEDS, EPISODES = (0, 1, 2), 400_000
LONG_EPISODES = 1_000_000
THREES = {"replicas": 3, "batch_size": 67, "again": 66, "candidates": 12}
PAIRS = {"replicas": 2, "batch_size": 110, "again": 90, "candidates": 12}
SINGLES = {"replicas": 1, "batch_size": 220, "again": 180, "candidates": 6}
DESIGNS: dict[str, dict[str, Any]] = {
    "once": ONCE,
    "threes, half again": THREES,
    "pairs, half again": PAIRS,
    "pairs, half again, settled": {**PAIRS, "settling": 1},
    "singles, half again": SINGLES,
}
"""Settings of preset wide that each design changes."""
LONG = ("threes, half again", "pairs, half again", "singles, half again")
SEARCHES = {f"{name}, seed {seed}": (name, seed, EPISODES) for seed in SEEDS for name in DESIGNS} | {
    f"{name}, a million": (name, 0, LONG_EPISODES) for name in LONG
}
"""Design, seed and episodes of each search."""


def row_of(script: Script, name: str) -> dict[str, Any]:
    """The row of one search."""
    design_name, seed, episodes = SEARCHES[name]
    design = {} if script.small else DESIGNS[design_name]
    cfg = script.search_cfg(episodes=episodes, seed=seed, crossed=0.0, **design)
    run = script.runs / "search_noise" / file_name(name)
    search(cfg, run, script.compute)
    archive = judge(run, stages=("fresh",), compute=script.compute)
    assert archive.fresh is not None
    with Crosser(script.robot, script.compute, cache=run / "crossings") as crosser:
        seeds = elite_seeds(archive, cfg.seed, stream=Stream.FRESH_AGAIN)
        terrains = Terrains(genes=archive.genes, seeds=seeds, space=archive.terrain_space)
        again = crosser.cross(script.policy, terrains, replicas=FRESH_EPISODES, label="once more", invalid_ok=True)
    second = fresh_values(archive, again, cfg.fitness)
    both = archive.fresh.valid & second.valid
    numbers = RunDirectory(run).read_summary()
    corrected = archive.fresh.corrected_elites()
    counts = ("wall_s", "corrected_qd_score", *FRESH_COUNTS)
    return {
        "search": name,
        "design": design_name,
        "seed": seed,
        "settings": {**asdict(cfg.scheduler), "replicas": cfg.replicas, "iterations": cfg.iterations},
        **{count: numbers[count] for count in counts},
        "expected_same_cell": float(chance_to_stay(archive, archive.cells).sum()),
        "two_lots_agree": float((archive.fresh.cell == second.cell)[both].mean()) if both.any() else None,
        "failing_corrected": int(archive.failing[corrected].sum()),
        "families_corrected": len(np.unique(find_families(archive.genes[corrected], archive.terrain_space))),
        "episodes_of_an_elite": float(np.median(archive.episodes)) if len(archive) else None,
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Makes the rows that are missing, and writes the file after each."""
    script = parse(__doc__, argv, "search_noise.json", parts=tuple(SEARCHES))
    report: dict[str, Any] = {}
    for name in script.parts or list(SEARCHES)[: 1 if script.small else None]:
        report = script.read_so_far(script.out)
        if name not in [row["search"] for row in report.get("rows", [])]:
            row = row_of(script, name) | {key: script.origin[key] for key in ("commit", "device", "date")}
            rows = [*script.read_so_far(script.out).get("rows", []), row]  # others may have been written meanwhile
            report = script.add(script.origin, {"rows": rows})
    return report


if __name__ == "__main__":
    main()
