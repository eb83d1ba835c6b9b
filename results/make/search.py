"""Does the search earn its cost? Methods of search in equally many episodes: search.json.

Each search of preset wide is extended step by step; after each step all elites cross fresh episodes. At the end, those
that fail cross with contact resolved and are crossed by the robot's panel. The default is searched with three seeds,
others with two. It crosses 14,400 episodes less: at first there is nothing to cross again. Methods that learn from one
iteration to the next have many of the paper's size, too, in place of a few of preset wide. These searches were added
when all others were done.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from results.make import common
from results.make.common import COUNTS, ONCE, PAPER_SIZE, Script, file_name, follow_search, parse

DEFAULT = "surrogate"
LEARNING = ("cma_mae+map_elites", "cma_mae", "map_elites")
"""Others than the default that learn from one iteration to the next."""
METHODS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    **{name: {"method": name, **ONCE} for name in ("hard_random", *LEARNING)},
    **{f"{name}, 10 emitters": {"method": name, **PAPER_SIZE} for name in LEARNING},
}
"""What each method changes in preset wide; as in the paper, others than the default cross each terrain once."""
SEEDS = (10, 11, 12)
"""Others than those by which the default was chosen."""
STEPS = (96_000, 192_000, 384_000)
"""Episodes after which elites cross fresh ones."""


def run_of(script: Script, method: str, seed: int) -> Path:
    """The run of a search."""
    return script.runs / "search" / file_name(f"{method}, seed {seed}")


def follow(script: Script, method: str, seed: int) -> list[dict[str, Any]]:
    """Counts of a search after each step; the last ones with the origin of the search."""
    cfg = script.search_cfg(seed=seed, **({} if script.small else METHODS[method]))
    run = run_of(script, method, seed)
    points, stages = script.count_iterations(cfg, *STEPS), ("fresh", "resolved", "others")
    *rows, last = follow_search(script, run, cfg, points, COUNTS, stages)
    return [*rows, {"method": method, "search_seed": seed, **common.origin_of(script, run), **last}]


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Runs every method with every seed, and writes means with 95 % t intervals over seeds; parts are runs alone."""
    seeds_by_method = {method: SEEDS if method == DEFAULT else SEEDS[:2] for method in METHODS}
    runs = {f"{method}, seed {seed}": (method, seed) for method, seeds in seeds_by_method.items() for seed in seeds}
    script = parse(__doc__, argv, "search.json", parts=tuple(runs))
    for part in script.parts:
        follow(script, *runs[part])
    if script.parts:
        return {}
    methods = {DEFAULT: SEEDS[:1]} if script.small else seeds_by_method
    rows = {name: [follow(script, name, seed) for seed in seeds] for name, seeds in methods.items()}
    numbers, searches = {}, list[dict[str, Any]]()
    for name, rows_of_seeds in rows.items():
        last = [rows_of_seed[-1] for rows_of_seed in rows_of_seeds]
        numbers[name] = {"episodes": last[0]["episodes"], "seeds": len(last)} | common.mean_counts(last, COUNTS[1:])
        numbers[name]["curve"] = [
            {count: float(np.mean([row[count] for row in rows_of_step])) for count in common.FRESH_COUNTS}
            for rows_of_step in zip(*rows_of_seeds, strict=True)
        ]
        searches += last
    return script.write({"methods": numbers, "curve": numbers[DEFAULT]["curve"], "searches": searches})


if __name__ == "__main__":
    main()
