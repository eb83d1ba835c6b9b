"""When a search ends: at its last iteration, or once its last tenth brought too little."""

from qd.search.archive import Archive
from qd.search.directory import Metrics
from qd.search.pool import chance_to_stay
from qd.search.settings import SearchCfg

UNTIL_FROM = 20
"""Iterations that must have crossed anything new before a search is judged by the last tenth of them."""


def find_last_iteration(cfg: SearchCfg, metrics: Metrics, until: float | None) -> int:
    """The iteration that ends a search, by the metrics alone: so a search that goes on ends where it would have.

    Behind the one whose last tenth brought too little, robots cross what it asked for, and then all settles. A search
    that went on past that end is judged anew.
    """
    ends = (
        row["iteration"] + 1 + cfg.scheduler.settling
        for row in metrics
        if until is not None and row["last_tenth"] is not None and row["last_tenth"] < until
    )
    return min(cfg.iterations, next((end for end in ends if end >= len(metrics)), cfg.iterations))


def compute_last_tenth(archive: Archive, metrics: Metrics) -> float | None:
    """Share of the elites to stay that were found in the last tenth of the iterations which crossed anything new.

    Elites count by their chance to stay in their cells (:func:`qd.search.pool.chance_to_stay`). None without elites,
    and of fewer than 20 such iterations.
    """
    exploring = [row["iteration"] for row in metrics if row["terrains"]]
    if len(exploring) < UNTIL_FROM or not len(archive):
        return None
    chance = chance_to_stay(archive, archive.cells)
    late = archive.iteration >= exploring[-(len(exploring) // 10)]
    return float(chance[late].sum() / chance.sum())
