"""Does the search earn its cost? Methods of search on equally many terrains, three seeds each: search.json.

Each search of preset wide is extended step by step; after each step all elites cross fresh episodes. At the end, those
that fail cross with contact resolved and are crossed by the robot's panel.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from qd.judge import judge
from qd.run.directory import RunDirectory
from qd.search import search
from results.make.common import SEEDS, Script, mean_over_seeds, parse

METHODS = ("uniform_random", "hard_random", "map_elites", "cma_me", "cma_mae", "cma_mae+map_elites", "surrogate")
DEFAULT = "surrogate"
STEPS = (3, 6, 9, 12)
"""Iterations at which elites cross fresh episodes: up to 384,000 episodes."""
COUNTS = ("elites", "corrected_elites", "failing")
JUDGED = ("confirmed", "certified", "faults", "faults_panel", "fault_families")


def follow_search(script: Script, method: str, seed: int) -> list[dict[str, Any]]:
    """The numbers of a run's archive.json after each step."""
    steps, run = (1,) if script.small else STEPS, script.runs / "search" / f"{method}-{seed}"
    rows = []
    for iterations in steps:
        search(script.search_cfg(iterations, seed=seed, method=method), run, script.compute)
        is_last = iterations == steps[-1] and not script.small
        judge(run, stages=("fresh", "resolved", "others") if is_last else ("fresh",), compute=script.compute)
        rows.append(RunDirectory(run).read_summary())
    return rows


def curve_of(rows_of_seeds: Sequence[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Means over seeds after each step."""
    return [
        {name: float(np.mean([row[name] for row in rows])) for name in ("episodes", *COUNTS)}
        for rows in zip(*rows_of_seeds, strict=True)
    ]


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Runs every method with every seed, and writes means with 95 % t intervals over seeds; parts are runs alone."""
    runs = {f"{method}-{seed}": (method, seed) for method in METHODS for seed in SEEDS}
    script = parse(__doc__, argv, "search.json", parts=tuple(runs))
    for part in script.parts:
        follow_search(script, *runs[part])
    if script.parts:
        return {}
    methods, seeds = ((DEFAULT,), SEEDS[:1]) if script.small else (METHODS, SEEDS)
    rows = {name: [follow_search(script, name, seed) for seed in seeds] for name in methods}
    numbers = {}
    for name, rows_of_seeds in rows.items():
        last = [rows_of_seed[-1] for rows_of_seed in rows_of_seeds]
        numbers[name] = {"episodes": last[0]["episodes"], "seeds": len(seeds)}
        for count in (*COUNTS, *JUDGED):
            numbers[name] |= mean_over_seeds(count, [row.get(count) for row in last])
        numbers[name]["curve"] = curve_of(rows_of_seeds)
    return script.write({"methods": numbers, "curve": numbers[DEFAULT]["curve"]})


if __name__ == "__main__":
    main()
