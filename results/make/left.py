"""How many failures and faults searches have not seen yet: left.json.

Five searches of the default, four of them those of crossed.json, differ in their seeds alone. Their failing elites are
put into groups, and so are their faults by the panel: distinct terrains lead a group each, in order of fitness, and the
others belong to the nearest of these. By how many searches see each group, Chao2 says how many there are at least that
such a search can find. Searches hardly ever find the same distinct terrains, so that this says little; groups of
terrains up to two and three times as far apart are counted, too.
"""

from collections.abc import Sequence
from math import comb, exp, log, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.families import best_values, kin_distances, pick_distinct
from qd.search.archive import Archive, read_archive
from results.make import crossed
from results.make.common import parse

SEEDS = (crossed.CHOOSING, *crossed.SEEDS, 24)
DISTANCES = (1.0, 2.0, 3.0)
"""Least distances of leaders; terrains that are nearer than 1 are kin."""
_Z = 1.959963984540054  # the normal distribution's 97.5 % quantile


def find_groups(distances: NDArray[np.float64], least: float) -> NDArray[np.int64]:
    """Group of each of N terrains in order of fitness, numbered from 0, shape (N,), by their distances, (N, N).

    Leaders are ``least`` apart, and the others nearer to one.
    """
    leaders = np.flatnonzero(pick_distinct(distances, least))
    return distances[:, leaders].argmin(axis=1) if len(leaders) else np.zeros(0, np.int64)


def estimate_groups(counts: NDArray[np.int64], searches: int) -> dict[str, Any]:
    """How many groups there are, by the number of searches that see each one seen, shape (num_groups,).

    ``by_searches`` says how many groups exactly one search sees, exactly two, and so on; ``growth`` how many one search
    sees, two see, and so on, as the mean over all choices of them. ``chao2`` has the bias-corrected form and a
    log-normal interval (Chao 1987), which is None where it adds nothing: of at most one group that one search sees.
    """
    groups = len(counts)
    by_searches = np.bincount(counts, minlength=searches + 1)[1:].tolist()
    once, twice = by_searches[:2]
    share = (searches - 1) / searches
    unseen = share * once * (once - 1) / (2 * (twice + 1))
    interval = None
    if unseen:
        variance = unseen + share**2 * once * (2 * once - 1) ** 2 / (4 * (twice + 1) ** 2)
        variance += share**2 * once**2 * twice * (once - 1) ** 2 / (4 * (twice + 1) ** 4)
        factor = exp(_Z * sqrt(log(1.0 + variance / unseen**2)))
        interval = [groups + unseen / factor, groups + unseen * factor]
    missed = [
        sum(comb(searches - seen, chosen) for seen in counts.tolist()) / comb(searches, chosen)
        for chosen in range(1, searches + 1)
    ]
    return {
        "groups": groups,
        "by_searches": by_searches,
        "growth": [groups - count for count in missed],
        "chao2": groups + unseen,
        "chao2_interval": interval,
    }


def count_left(archives: Sequence[Archive], rows: Sequence[NDArray[np.bool_]]) -> dict[str, Any]:
    """The number of some elites of each search in all, and the estimate by each of the :data:`DISTANCES`."""
    chosen = [archive.rows(of_archive) for archive, of_archive in zip(archives, rows, strict=True)]
    genes = np.concatenate([archive.genes for archive in chosen])
    fitness = np.concatenate([best_values(archive)[0]["fitness"] for archive in chosen])
    order = np.argsort(-fitness, kind="stable")
    of_search = np.repeat(np.arange(len(chosen)), [len(archive) for archive in chosen])[order]
    distances = kin_distances(genes[order], archives[0].terrain_space)
    numbers = dict[str, Any]()
    for least in DISTANCES:
        pairs = np.unique(np.stack([find_groups(distances, least), of_search]), axis=1)
        numbers[f"{least:g}"] = estimate_groups(np.bincount(pairs[0]), len(archives))
    return {"elites": len(genes), "distances": numbers}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Counts, and searches where today's sources have not."""
    script = parse(__doc__, argv, "left.json")
    seeds = SEEDS[: 2 if script.small else None]
    searches = [crossed.follow(script, crossed.CHOSEN, seed) for seed in seeds]
    archives = [read_archive(crossed.run_of(script, crossed.CHOSEN, seed)) for seed in seeds]
    rows = {"failing": [archive.failing for archive in archives], "faults": [each.is_fault for each in archives]}
    numbers = {name: count_left(archives, chosen) for name, chosen in rows.items()}
    return script.write({**numbers, "searches": searches})


if __name__ == "__main__":
    main()
