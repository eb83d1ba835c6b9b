"""What a search leaves to look at: its curves, its archive, and its numbers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from qd.archive import Archive
from qd.faults import FRESH_EPISODES, fault_numbers, fresh_numbers
from qd.groups import Mode
from sim.files.atomic import write_atomically
from sim.files.figures import as_png, bar_lengths, new_figure

CURVES_FILE = "curves.png"
ARCHIVE_FIGURE_FILE = "archive.png"
SPREAD_FILE = "spread.png"

_BLUE, _RED = "#0072b2", "#d55e00"  # apart for every kind of colour blindness


class PenaltyLook(NamedTuple):
    """How a penalty is written and drawn."""

    label: str
    """Of an axis, broken into lines."""
    unit: str = ""
    """Of its raw sum."""
    color: str = "#999999"
    """One of Okabe and Ito's."""
    hatch: str = ""
    """Tells it apart in grey."""

    @property
    def bar(self) -> dict[str, Any]:
        """Style of its bars."""
        return {"color": self.color, "hatch": self.hatch, "edgecolor": "white", "linewidth": 0.0}


_PENALTY_LOOKS = {
    "yaw_rate": PenaltyLook("yaw-rate error", "(rad/s)^2 s", "#cc79a7", "//"),
    "vel_x": PenaltyLook("forward-\nvelocity error", "(m/s)^2 s", "#0072b2"),
    "vel_y": PenaltyLook("sideways-\nvelocity error", "(m/s)^2 s", "#56b4e9", "\\\\"),
    "contact_force": PenaltyLook("high contact\nforce", "N s", "#000000"),
    "stumble": PenaltyLook("stumble", "s", "#e69f00", ".."),
    "collision": PenaltyLook("collisions of\nbase and legs", "s", "#d55e00"),
}


def look_of(penalty: str) -> PenaltyLook:
    """How a penalty is shown; one that the figures do not know by its name, in grey."""
    return _PENALTY_LOOKS.get(penalty, PenaltyLook(penalty))


def label_of(penalty: str) -> str:
    """A penalty in words, on one line; a word broken at a hyphen stays one."""
    return look_of(penalty).label.replace("-\n", "-").replace("\n", " ")


def mode_words(mode: Mode) -> str:
    """A failure mode in a few words: how its crossings end, and the penalty that stands out."""
    return f"{mode.ending} · {label_of(mode.marked_by)}"


def write_figures(folder: Path, archive: Archive, metrics: Sequence[dict[str, Any]]) -> list[Path]:
    """Draws the figures of a search: its curves, its archive on parallel axes, and the spread of its elites."""
    figures = {
        CURVES_FILE: draw_curves(archive, metrics),
        ARCHIVE_FIGURE_FILE: draw_archive(archive),
        SPREAD_FILE: draw_spread(archive),
    }
    for name, figure in figures.items():
        save_figure(folder / name, figure)
    return [folder / name for name in figures]


def save_figure(path: Path, figure: Figure) -> None:
    """Writes a figure, atomically."""
    write_atomically(path, as_png(figure))


def _title(archive: Archive) -> str:
    return f"{archive.robot}, {archive.iterations:,} iteration{'s' * (archive.iterations != 1)}"


def draw_curves(archive: Archive, metrics: Sequence[dict[str, Any]]) -> Figure:
    """QD score, archive size with reachable coverage, mean fitness, and mean STD if looked at, over the iterations."""
    looks = [row for row in metrics if row.get("mean_std") is not None]
    num_panels = 4 if looks else 3
    figure = new_figure(3.5 * num_panels, 3.4)
    figure.suptitle(f"{_title(archive)}: {len(archive):,} elites")
    panels = (("qd_score", "QD score"), ("elites", "elites"), ("mean_fitness", "mean fitness"))
    iterations = [row["iteration"] for row in metrics]
    drawn = figure.subplots(1, num_panels, sharex=True)
    for axes, (key, label) in zip(drawn[:3], panels, strict=True):
        axes.plot(iterations, [row[key] for row in metrics], color=_BLUE, marker="." if len(metrics) < 30 else "")
        axes.set_ylabel(label)
        if key != "mean_fitness":
            axes.set_ylim(bottom=0)
        if key == "elites":
            _add_coverage_axis(axes, archive.cells.num_cells)
    if looks:
        _draw_std(drawn[3], looks)
    for axes in drawn:
        axes.set_xlabel("iteration")
        axes.grid(alpha=0.3)
        axes.xaxis.get_major_locator().set_params(integer=True)
    return figure


def _draw_std(axes: Axes, looks: Sequence[dict[str, Any]]) -> None:
    """The paper's mean STD with its 95 % intervals, where elites were looked at again."""
    means = [row["mean_std"] for row in looks]
    lengths = bar_lengths(means, [row["mean_std_interval"] for row in looks])
    axes.errorbar([row["iteration"] for row in looks], means, lengths, color=_BLUE, marker=".", capsize=3)
    axes.set_ylabel(f"mean STD of elites\n({FRESH_EPISODES} fresh episodes)")
    axes.set_ylim(bottom=0)


def _add_coverage_axis(axes: Axes, num_cells: int) -> None:
    """A second scale on the right: elites as a share of the reachable cells."""
    right = axes.twinx()
    right.set_ylim(*(100.0 * limit / num_cells for limit in axes.get_ylim()))
    right.set_ylabel("reachable coverage [%]")


def draw_archive(archive: Archive) -> Figure:
    """Every elite as a line over one vertical axis a ratio, coloured by its fitness (the paper's archive figure)."""
    count = len(archive.penalties)
    figure = new_figure(1.6 * count + 1.4, 4.6)
    axes = figure.subplots()
    title = (
        f"{_title(archive)}: {len(archive):,} elites, "
        f"{archive.reachable_coverage:.1%} of {archive.cells.num_cells:,} reachable cells"
    )
    fitness, ratios = archive.fitness, archive.ratios
    if (fresh := archive.fresh) is not None:
        fitness, ratios = fresh.fitness[fresh.valid], fresh.ratios[fresh.valid]
        title += f",\ncorrected by {FRESH_EPISODES} fresh episodes each: {fresh.reproduced.sum():,} reproduced"
    axes.set_title(title)
    places, order = np.arange(count), np.argsort(fitness)  # the fittest on top
    points = np.stack([np.broadcast_to(places, ratios.shape), ratios], axis=2)[order]
    lines = LineCollection([*points], cmap="viridis", norm=Normalize(*_range(fitness)), linewidths=0.8, alpha=0.6)
    lines.set_array(fitness[order])
    axes.add_collection(lines)
    for place in places:
        axes.axvline(float(place), color="0.25", linewidth=1.0)
    axes.set_xticks(places, [look_of(name).label for name in archive.penalties])
    axes.set_yticks(np.linspace(0, 1, 11))
    axes.set_xlim(-0.15, count - 0.85)
    axes.set_ylim(-0.02, 1.02)
    axes.set_ylabel("share of the penalties")
    axes.grid(axis="y", alpha=0.25)
    axes.spines[:].set_visible(False)
    figure.colorbar(lines, ax=axes, label="fitness", pad=0.02, extend="both")
    return figure


def _range(fitness: np.ndarray) -> tuple[float, float]:
    """Colour limits that a few outliers do not stretch."""
    return (float(np.quantile(fitness, 0.02)), float(np.quantile(fitness, 0.98))) if len(fitness) else (0.0, 1.0)


def spread(archive: Archive) -> np.ndarray:
    """How many elites were found in each interval of each ratio, shape (P, intervals, 2): without, with collision."""
    tuples = archive.cells.tuples[archive.cell % len(archive.cells.tuples)]
    counts = np.zeros((len(archive.penalties), archive.intervals, 2), dtype=np.int64)
    np.add.at(counts, (np.arange(len(archive.penalties)), tuples, archive.collided[:, None].astype(int)), 1)
    return counts


def draw_spread(archive: Archive) -> Figure:
    """How the elites spread over the intervals of each ratio, with and without base collisions."""
    counts = spread(archive)
    figure = new_figure(1.9 * len(counts) + 0.8, 3.2)
    collided = int(archive.collided.sum())
    figure.suptitle(
        f"{_title(archive)}: {collided:,} of {len(archive):,} elites had a base collision when they were found"
    )
    width, lows = 1.0 / archive.intervals, np.arange(archive.intervals) / archive.intervals
    panels = figure.subplots(1, len(counts), sharey=True)
    for axes, name, (without, collides) in zip(panels, archive.penalties, counts.swapaxes(1, 2), strict=True):
        style = {"width": width, "align": "edge", "edgecolor": "white", "linewidth": 0.5}
        axes.bar(lows, without, color=_BLUE, label="without base collision", **style)
        axes.bar(lows, collides, bottom=without, color=_RED, label="with base collision", **style)
        axes.set_xlim(0, 1)
        axes.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        axes.set_xlabel(f"share of\n{look_of(name).label}")
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
    panels[0].set_ylabel("elites")
    panels[0].yaxis.get_major_locator().set_params(integer=True)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


_CORRECTED = (
    "elites_same_cell", "elites_reproduced", "reevaluated", "corrected_qd_score", "corrected_coverage",
    "corrected_elites", "mean_fitness_corrected",
    "mean_std", "mean_std_interval",
)  # fmt: skip


def summary(
    archive: Archive, metrics: Sequence[dict[str, Any]], *, gpus: int, origin: dict[str, Any]
) -> dict[str, Any]:
    """The numbers of a search, as ``archive.json`` has them."""
    corrected = {} if archive.fresh is None else fresh_numbers(archive, archive.fresh)
    with_collision = int(archive.collided.sum())
    return {
        **origin,
        **archive.named(),
        "space": archive.space,
        "space_sha256": archive.space_sha256,
        "iterations": archive.iterations,
        "terrains_evaluated": sum(row["terrains"] for row in metrics),
        "episodes": sum(row["episodes"] for row in metrics),
        "elites": len(archive),
        "reachable_cells": archive.cells.num_cells,
        "reachable_coverage": archive.reachable_coverage,
        "qd_score": archive.qd_score,
        "mean_fitness": archive.mean_fitness,
        **{name: corrected.get(name) for name in _CORRECTED},
        **fault_numbers(archive),
        "with_collision": with_collision,
        "without_collision": len(archive) - with_collision,
        "spread": dict(zip(archive.penalties, spread(archive).sum(axis=2).tolist(), strict=True)),
        "wall_s": sum(row["wall_s"] for row in metrics),
        "gpus": gpus,
        "invalid_episodes": sum(row["invalid_episodes"] for row in metrics),
    }
