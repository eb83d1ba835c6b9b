"""The numbers of a comparison of search methods: means over seeds with intervals, as a report and as a figure."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from qd.run.directory import Metrics
from qd.show.figures import new_figure
from sim.files.intervals import t_interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CURVES = ("qd_score", "reachable_coverage", "elites", "mean_fitness")
AGAIN = (
    "corrected_qd_score",
    "corrected_coverage",
    "corrected_elites",
    "corrected_mean_fitness",
    "reproduced",
    "mean_std",
)
"""What the rows have in which the elites were evaluated again."""
_BATCH = ("batch_fitness", "batch_collision_rate", "batch_goal_rate")

LABELS = {
    "uniform_random": ("uniform random", "#999999", ":"),
    "hard_random": ("hard-random", "#000000", "--"),
    "map_elites": ("MAP-Elites (iso+line)", "#009e73", "-"),
    "cma_me": ("CMA-ME", "#56b4e9", "-."),
    "cma_mae": ("CMA-MAE", "#0072b2", "-"),
    "cma_mae_sep": ("CMA-MAE, sep-CMA", "#cc79a7", "--"),
    "cma_mae_narrow": ("CMA-MAE, first step .5", "#e69f00", ":"),
    "mixed": ("CMA-MAE and iso+line", "#d55e00", "-"),
    "directions": ("directions", "#000000", "-."),
    "trio": ("CMA-MAE, iso+line, directions", "#d55e00", "--"),
}
"""Name, colour and line of each method."""
_OTHER_STYLES = ((0, (6, 2, 1, 2)), (0, (1, 3)))
_OTHER_LOOKS = [(color, style) for style in _OTHER_STYLES for color in ("#009e73", "#0072b2", "#cc79a7")]


def report_of(runs: dict[str, list[Metrics]], settings: dict[str, Any]) -> dict[str, Any]:
    """The numbers of a comparison.

    Args:
        runs: Metrics of every seed, by method; equally many rows.
        settings: Settings of each method's scheduler.

    Returns:
        ``iterations``, ``terrains_evaluated`` (cumulative, one an iteration), and ``methods``: of each its settings,
        the curves found (``CURVES``, every iteration) and corrected (``AGAIN``, at ``corrected_at`` terrains) as mean
        and 95 % t interval over seeds, what its terrains did to the robots on average, and its episodes.
    """
    first = next(iter(runs.values()))[0]
    terrains = np.cumsum([row["terrains"] for row in first])
    every = [rows for seeds in runs.values() for rows in seeds]
    # The last iteration of a comparison that was stopped in it and then extended has them in some runs only.
    at = [k for k in range(len(first)) if all("corrected_qd_score" in rows[k] for rows in every)]
    methods = {}
    for name, seeds in runs.items():
        methods[name] = {
            "settings": settings[name],
            **{key: [_over_seeds([rows[k][key] for rows in seeds]) for k in range(len(first))] for key in CURVES},
            **{key: [_over_seeds([rows[k][key] for rows in seeds]) for k in at] for key in AGAIN},
            **{key: _over_seeds([float(np.mean([row[key] for row in rows])) for rows in seeds]) for key in _BATCH},
            "episodes": sum(row["episodes"] for rows in seeds for row in rows),
            "invalid_episodes": sum(row["invalid_episodes"] for rows in seeds for row in rows),
            "wall_s": sum(row["wall_s"] for rows in seeds for row in rows),
        }
    return {
        "iterations": len(first),
        "terrains_evaluated": terrains.tolist(),
        "corrected_at": terrains[at].tolist(),
        "methods": methods,
    }


def _over_seeds(values: Sequence[float | None]) -> dict[str, Any]:
    """Mean over seeds and its interval; None where a seed has no value, or there is one seed only."""
    if any(value is None for value in values):
        return {"mean": None, "interval": None, "seeds": list(values)}
    numbers = np.asarray(values, dtype=float)
    return {"mean": float(numbers.mean()), "interval": t_interval(numbers), "seeds": numbers.tolist()}


def draw_comparison(report: dict[str, Any]) -> "Figure":
    """QD score, reachable coverage and corrected QD score over terrains evaluated; bands are 95 % t intervals.

    Args:
        report: As of :func:`report_of`, with ``robot`` and ``seeds``.
    """
    figure, seeds = new_figure(12.0, 4.6), len(report["seeds"])
    figure.suptitle(
        f"{report['robot']}: {report['terrains_evaluated'][-1]:,} terrains a run, "
        + (f"{seeds} seeds a method, mean and 95 % interval over them" if seeds > 1 else "one seed")
    )
    panels = (
        ("qd_score", "QD score, as found", 1.0, "terrains_evaluated"),
        ("reachable_coverage", "reachable coverage, as found [%]", 100.0, "terrains_evaluated"),
        ("corrected_qd_score", "QD score, corrected by fresh episodes", 1.0, "corrected_at"),
    )
    lines: dict[str, Any] = {}
    for axes, (key, label, factor, along) in zip(figure.subplots(1, 3), panels, strict=True):
        others = iter(_OTHER_LOOKS * len(report["methods"]))
        for name, method in report["methods"].items():
            title, color, style = LABELS.get(name) or (name.replace(":", ": "), *next(others))
            points = [point for point in zip(report[along], method[key], strict=True) if point[1]["mean"] is not None]
            x = [terrains for terrains, _ in points]
            mean = [factor * point["mean"] for _, point in points]
            marker = "o" if along == "corrected_at" else ""
            lines[title] = axes.plot(x, mean, color=color, linestyle=style, marker=marker, markersize=4)[0]
            bounds = [point["interval"] or (math.nan, math.nan) for _, point in points]
            low, high = ([factor * bound[side] for bound in bounds] for side in (0, 1))
            axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
        axes.set_xlabel("terrains evaluated")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.legend(list(lines.values()), list(lines), loc="outside lower center", ncols=4, frameon=False)
    return figure
