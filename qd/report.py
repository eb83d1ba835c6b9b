"""What a search leaves to look at: its curves, its archive, and its numbers."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qd.archive import Archive
from sim.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVES_FILE = "curves.png"
ARCHIVE_FIGURE_FILE = "archive.png"

PENALTY_LABELS = {
    "yaw_rate": "yaw-rate error",
    "vel_x": "forward-\nvelocity error",
    "vel_y": "sideways-\nvelocity error",
    "contact_force": "high contact\nforce",
    "stumble": "stumble",
    "collision": "collisions of\nbase and legs",
}
"""Penalties as axis labels."""

_BLUE = "#0072b2"


def write_figures(folder: Path, archive: Archive, metrics: Sequence[dict[str, Any]]) -> list[Path]:
    """Draws the paper's two figures of a search: its curves, and its archive on parallel axes.

    Args:
        folder: Where to write.
        archive: What was found.
        metrics: One row an iteration.

    Returns:
        The files.
    """
    figures = {CURVES_FILE: draw_curves(archive, metrics), ARCHIVE_FIGURE_FILE: draw_archive(archive)}
    for name, figure in figures.items():
        save_figure(folder / name, figure)
    return [folder / name for name in figures]


def save_figure(path: Path, figure: "Figure") -> None:
    """Writes a figure, atomically."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    write_atomically(path, buffer.getvalue())


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of a size in inches that needs no screen and no global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _title(archive: Archive) -> str:
    return f"{archive.robot}, {archive.iterations:,} iteration{'s' * (archive.iterations != 1)}"


def draw_curves(archive: Archive, metrics: Sequence[dict[str, Any]]) -> "Figure":
    """QD score, archive size with reachable coverage, and mean fitness over the iterations.

    Args:
        archive: The archive at the end.
        metrics: One row an iteration.
    """
    figure = new_figure(10.5, 3.4)
    figure.suptitle(f"{_title(archive)}: {len(archive):,} elites")
    panels = (("qd_score", "QD score"), ("elites", "elites"), ("mean_fitness", "mean fitness"))
    iterations = [row["iteration"] for row in metrics]
    for axes, (key, label) in zip(figure.subplots(1, 3), panels, strict=True):
        axes.plot(iterations, [row[key] for row in metrics], color=_BLUE, marker="." if len(metrics) < 30 else "")
        axes.set_xlabel("iteration")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.xaxis.get_major_locator().set_params(integer=True)
        if key != "mean_fitness":
            axes.set_ylim(bottom=0)
        if key == "elites":
            _add_coverage_axis(axes, archive.cells.num_cells)
    return figure


def _add_coverage_axis(axes: "Axes", num_cells: int) -> None:
    """A second scale on the right: elites as a share of the reachable cells."""
    right = axes.twinx()
    right.set_ylim(*(100.0 * limit / num_cells for limit in axes.get_ylim()))
    right.set_ylabel("reachable coverage [%]")


def draw_archive(archive: Archive) -> "Figure":
    """Every elite as a line over one vertical axis a ratio, coloured by its fitness (the paper's archive figure).

    Args:
        archive: What to draw.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize

    count = len(archive.penalties)
    figure = new_figure(1.6 * count + 1.4, 4.6)
    axes = figure.subplots()
    axes.set_title(
        f"{_title(archive)}: {len(archive):,} elites, "
        f"{archive.reachable_coverage:.1%} of {archive.cells.num_cells:,} reachable cells"
    )
    positions = np.arange(count)
    order = np.argsort(archive.fitness)  # the worst terrains on top
    points = np.stack([np.broadcast_to(positions, archive.ratios.shape), archive.ratios], axis=2)[order]
    lines = LineCollection(
        [*points], cmap="viridis", norm=Normalize(*_range(archive.fitness)), linewidths=0.8, alpha=0.6
    )
    lines.set_array(archive.fitness[order])
    axes.add_collection(lines)
    for position in range(count):
        axes.axvline(position, color="0.25", linewidth=1.0)
    axes.set_xticks(positions, [PENALTY_LABELS.get(name, name) for name in archive.penalties])
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


def summary(
    archive: Archive,
    metrics: Sequence[dict[str, Any]],
    *,
    gpus: int,
    num_reproduced: int | None,
    origin: dict[str, Any],
) -> dict[str, Any]:
    """The numbers of a search, as ``archive.json`` has them.

    Args:
        archive: The result archive.
        metrics: One row an iteration.
        gpus: GPUs used.
        num_reproduced: Elites that were reproduced; None if nobody looked.
        origin: Provenance.
    """
    return {
        **origin,
        "robot": archive.robot,
        "iterations": archive.iterations,
        "terrains_evaluated": sum(row["terrains"] for row in metrics),
        "episodes": sum(row["episodes"] for row in metrics),
        "elites": len(archive),
        "elites_reproduced": num_reproduced,
        "reachable_cells": archive.cells.num_cells,
        "reachable_coverage": archive.reachable_coverage,
        "qd_score": archive.qd_score,
        "mean_fitness": archive.mean_fitness,
        "wall_s": sum(row["wall_s"] for row in metrics),
        "gpus": gpus,
        "invalid_episodes": sum(row["invalid_episodes"] for row in metrics),
    }
