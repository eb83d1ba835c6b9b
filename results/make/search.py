"""Does the search earn its cost? Methods of search in equally many episodes: search.json.

Each is searched by five seeds, with every terrain crossed once, and where it can with terrains crossed again, as the
default does. After each step all elites cross fresh episodes. At the end, those that fail cross with contact resolved,
and are crossed by the robot's panel and by the specialists of both published archives: whatever found a terrain, the
same controllers certify it. Methods of evolution have ten emitters, the paper's, with which they find more.
The default's specialist and CMA-MAE's are among the certifiers, one of MAP-Elites or of random terrains is not.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qd.faults.numbers import SPECIALIST
from qd.faults.searches import CERTIFIERS_FOLDER, controllers_in
from results.make import common
from results.make.common import COUNTS, ONCE, PAPER_SIZE, Script, file_name, follow_search, parse

DEFAULT = "surrogate"
TEN: dict[str, Any] = {"emitters": PAPER_SIZE["emitters"], "groups": PAPER_SIZE["groups"]}
METHODS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    f"{DEFAULT}, without labels": {"crossed": 0.0},
    f"{DEFAULT}, once": ONCE,
    **{name: {"method": name, **TEN} for name in ("cma_mae", "map_elites")},
    **{f"{name}, once": {"method": name, **PAPER_SIZE} for name in ("cma_mae", "map_elites")},
    "hard_random": {"method": "hard_random"},
    "hard_random, once": {"method": "hard_random", **ONCE},
}
"""What each method changes in preset wide. Without labels, what nobody crosses is worth as much as all else."""
SEEDS = (10, 11, 12, 13, 14)
"""Others than those by which the default was chosen."""
STEPS = (96_000, 192_000, 384_000)
"""Episodes after which elites cross fresh ones."""


def run_of(script: Script, method: str, seed: int) -> Path:
    """The run of a search."""
    return script.runs / "search" / file_name(f"{method}, seed {seed}")


def certifiers_of(script: Script) -> dict[str, str]:
    """The robot's panel, and the specialists of its published archives."""
    archives = {SPECIALIST: "archive", f"{SPECIALIST} of cma_mae": "archive_cma_mae"}
    files = {name: script.results / of / CERTIFIERS_FOLDER / f"{SPECIALIST}.pt" for name, of in archives.items()}
    missing = [str(file) for file in files.values() if not file.exists()]
    if missing and not script.small:
        raise ValueError(f"{', '.join(missing)} must be there: run results.make.archive first")
    return controllers_in(script.robot.panel) | {name: str(file) for name, file in files.items() if file.exists()}


def follow(script: Script, method: str, seed: int) -> list[dict[str, Any]]:
    """Counts of a search after each step; the last ones with the origin of the search."""
    cfg = script.search_cfg(seed=seed, **({} if script.small else METHODS[method]))
    run = run_of(script, method, seed)
    points, stages = script.count_iterations(cfg, *STEPS), ("fresh", "resolved", "others")
    *rows, last = follow_search(script, run, cfg, points, COUNTS, stages, certifiers_of(script))
    return [*rows, {"method": method, "search_seed": seed, **common.origin_of(script, run), **last}]


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Runs every method with every seed, and writes means with 95 % t intervals over seeds; parts are runs alone."""
    runs = {f"{method}, seed {seed}": (method, seed) for method in METHODS for seed in SEEDS}
    script = parse(__doc__, argv, "search.json", parts=tuple(runs))
    for part in script.parts:
        follow(script, *runs[part])
    if script.parts:
        return {}
    methods, seeds = ((DEFAULT,), SEEDS[:1]) if script.small else (tuple(METHODS), SEEDS)
    numbers, searches = {}, list[dict[str, Any]]()
    for name in methods:
        rows_of_seeds = [follow(script, name, seed) for seed in seeds]
        last = [rows_of_seed[-1] for rows_of_seed in rows_of_seeds]
        numbers[name] = {"episodes": last[0]["episodes"], "seeds": len(last)} | common.mean_counts(last, COUNTS[1:])
        numbers[name]["curve"] = [
            {count: float(np.mean([row[count] for row in rows_of_step])) for count in common.FRESH_COUNTS}
            for rows_of_step in zip(*rows_of_seeds, strict=True)
        ]
        searches += last
    return script.write({"methods": numbers, "searches": searches})


if __name__ == "__main__":
    main()
