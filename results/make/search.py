"""Does the search earn its cost? Methods of search in equally many episodes: search.json.

Each search of preset wide is extended step by step; after each step all elites cross fresh episodes. At the end, those
that fail cross with contact resolved and are crossed by the robot's panel. The default is searched with three seeds,
others with two. It crosses 14,400 episodes less: at first there is nothing to cross again. Methods that learn from one
iteration to the next have many of the paper's size, too, in place of a few of preset wide. These searches were added
when all others were done.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from results.make.common import CURVE_FILE, ONCE, PAPER_SIZE, Script, file_name, follow_search, mean_over_seeds, parse

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
COUNTS = ("elites", "elites_same_cell", "corrected_elites", "failing", "families")
JUDGED = ("confirmed", "certified", "faults", "faults_panel", "fault_families")


def follow(script: Script, method: str, seed: int) -> list[dict[str, Any]]:
    """Counts of a search after each step; the last ones with the origin of the search."""
    cfg = script.search_cfg(seed=seed, **({} if script.small else METHODS[method]))
    run, counts = script.runs / "search" / file_name(f"{method}, seed {seed}"), ("episodes", *COUNTS, *JUDGED)
    *rows, last = follow_search(
        script, run, cfg, script.count_iterations(cfg, *STEPS), counts, ("fresh", "resolved", "others")
    )  # fmt: skip
    origin = script.read_so_far(run / CURVE_FILE)
    named = {"method": method, "search_seed": seed, **{key: origin[key] for key in ("commit", "device", "date")}}
    return [*rows, named | last]


def seeds_of(method: str) -> tuple[int, ...]:
    """Seeds that a method is searched with."""
    return SEEDS if method == DEFAULT else SEEDS[:2]


def curve_of(rows_of_seeds: Sequence[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Means over seeds after each step."""
    return [
        {name: float(np.mean([row[name] for row in rows])) for name in ("episodes", *COUNTS)}
        for rows in zip(*rows_of_seeds, strict=True)
    ]


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Runs every method with every seed, and writes means with 95 % t intervals over seeds; parts are runs alone."""
    runs = {f"{method}, seed {seed}": (method, seed) for method in METHODS for seed in seeds_of(method)}
    script = parse(__doc__, argv, "search.json", parts=tuple(runs))
    for part in script.parts:
        follow(script, *runs[part])
    if script.parts:
        return {}
    methods = [(DEFAULT, SEEDS[:1])] if script.small else [(name, seeds_of(name)) for name in METHODS]
    rows = {name: [follow(script, name, seed) for seed in seeds] for name, seeds in methods}
    numbers, searches = {}, list[dict[str, Any]]()
    for name, rows_of_seeds in rows.items():
        last = [rows_of_seed[-1] for rows_of_seed in rows_of_seeds]
        numbers[name] = {"episodes": last[0]["episodes"], "seeds": len(last)}
        for count in (*COUNTS, *JUDGED):
            numbers[name] |= mean_over_seeds(count, [row.get(count) for row in last])
        numbers[name]["curve"] = curve_of(rows_of_seeds)
        searches += last
    return script.write({"methods": numbers, "curve": numbers[DEFAULT]["curve"], "searches": searches})


if __name__ == "__main__":
    main()
