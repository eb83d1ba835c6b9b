"""Figures of a search: its curves, its archive, and minimal terrains."""

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kernels.penalties import PENALTIES
from qd.faults.numbers import FRESH_EPISODES
from qd.search.archive import Archive
from sim.files.atomic import write_atomically
from sim.files.figures import as_png, new_figure
from sim.files.intervals import format_value
from sim.terrains.bank import make_terrains
from sim.terrains.maps.picture import LENGTH, WIDTH, height_colors, places, tinted
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.terrains import GroundMaps, asked_of

_BLUE = "#0072b2"
_SUN = (-0.45, 0.35)  # light that slopes along x and y of a relief gain
_MARK_M = 0.3  # half side of the marks of start and goal
_COLORS = {"start": (240, 200, 60), "goal": (0, 158, 115)}
_MAX_MINIMAL = 12
_COLUMNS = 3


def relief(heights: NDArray[np.floating], ground: GroundMaps | None = None) -> NDArray[np.uint8]:
    """A terrain of heights [m], shape (nrow, ncol), from above: blue below the start's level, brown above, lit.

    The nodes may be several cells apart; only with all of them the ground can be tinted. The start is yellow and the
    goal, if there is one, green. RGB, shape (nrow, ncol, 3), row along y.
    """
    spacing = LENGTH / (heights.shape[1] - 1)
    rise_y, rise_x = (np.asarray(rise) for rise in np.gradient(heights, spacing))
    light = np.clip(1.0 + _SUN[0] * rise_x + _SUN[1] * rise_y, 0.45, 1.25)
    colors = height_colors(heights) if ground is None else tinted(height_colors(heights), ground)
    pixels = np.clip(255.0 * colors * light[..., None], 0.0, 255.0).astype(np.uint8)
    half = round(_MARK_M / spacing)
    for name, (x, y) in places(asked_of(ground)).items():
        row, column = round(y / spacing), round(x / spacing)
        pixels[row - half : row + half + 1, column - half : column + half + 1] = _COLORS[name]
    return pixels


def write_figures(folder: Path, archive: Archive, metrics: Sequence[dict[str, Any]]) -> list[Path]:
    """Draws the figures of a search: its curves, and its archive on parallel axes."""
    figures = {folder / "curves.png": draw_curves(archive, metrics), folder / "archive.png": draw_archive(archive)}
    for path, figure in figures.items():
        save_figure(path, figure)
    return [*figures]


def save_figure(path: Path, figure: Figure) -> None:
    """Writes a figure, atomically."""
    write_atomically(path, as_png(figure))


def _title(archive: Archive) -> str:
    return f"{archive.robot}, {archive.iterations:,} iteration{'s' * (archive.iterations != 1)}"


def draw_curves(archive: Archive, metrics: Sequence[dict[str, Any]]) -> Figure:
    """QD score, archive size with reachable coverage, and mean fitness over the iterations."""
    figure = new_figure(10.5, 3.4)
    figure.suptitle(f"{_title(archive)}: {len(archive):,} elites")
    panels = (("qd_score", "QD score"), ("elites", "elites"), ("mean_fitness", "mean fitness"))
    iterations = [row["iteration"] for row in metrics]
    percent = 100.0 / archive.cells.num_cells
    as_share = (lambda count: percent * count, lambda share: share / percent)
    for axes, (key, label) in zip(figure.subplots(1, len(panels), sharex=True), panels, strict=True):
        axes.plot(iterations, [row[key] for row in metrics], color=_BLUE, marker="." if len(metrics) < 30 else "")
        axes.set(xlabel="iteration", ylabel=label)
        if key != "mean_fitness":
            axes.set_ylim(bottom=0)
        if key == "elites":
            axes.secondary_yaxis("right", functions=as_share).set_ylabel("reachable coverage [%]")
        axes.grid(alpha=0.3)
        axes.xaxis.get_major_locator().set_params(integer=True)
    return figure


def draw_archive(archive: Archive) -> Figure:
    """Every elite as a line over one vertical axis a ratio, coloured by its fitness (the paper's archive figure)."""
    count = len(archive.penalties)
    figure = new_figure(1.6 * count + 1.4, 4.6)
    axes = figure.subplots()
    coverage = f"{archive.reachable_coverage:.1%} of {archive.cells.num_cells:,} reachable cells"
    title = f"{_title(archive)}: {len(archive):,} elites, {coverage}"
    fitness, ratios = archive.fitness, archive.ratios
    if (fresh := archive.fresh) is not None:
        fitness, ratios = fresh.fitness[fresh.valid], fresh.ratios[fresh.valid]
        title += f",\ncorrected by {FRESH_EPISODES} fresh episodes each: {fresh.reproduced.sum():,} reproduced"
    axes.set_title(title)
    order = np.argsort(fitness)  # the fittest on top
    points = np.stack([np.broadcast_to(np.arange(count), ratios.shape), ratios], axis=2)[order]
    low, high = np.quantile(fitness, (0.02, 0.98)).tolist() if len(fitness) else (0.0, 1.0)
    lines = LineCollection([*points], cmap="viridis", norm=Normalize(low, high), linewidths=0.8, alpha=0.6)
    lines.set_array(fitness[order])
    axes.add_collection(lines)
    for x in range(count):
        axes.axvline(x, color="0.25", linewidth=1.0)
    axes.set_xticks(range(count), [textwrap.fill(PENALTIES[name].label, 14) for name in archive.penalties])
    axes.set_yticks(np.linspace(0, 1, 11))
    axes.set(xlim=(-0.15, count - 0.85), ylim=(-0.02, 1.02), ylabel="share of the penalties")
    axes.grid(axis="y", alpha=0.25)
    axes.spines[:].set_visible(False)
    figure.colorbar(lines, ax=axes, label="fitness", pad=0.02, extend="both")
    return figure


def draw_minimal(
    robot: str, numbers: dict[str, Any], genes: Mapping[int, NDArray[np.float32]], space: TerrainSpace
) -> Figure:
    """How many minimal terrains there are of each cause, and some from above, one of each cause first.

    ``numbers`` has at least one terrain, as ``minimal.json`` has them; ``genes`` of each, shape (num_genes,), by the
    number of the elite.
    """
    entries = numbers["elites"]
    causes = [entry["cause"]["kind"] if entry["cause"] else "unclear" for entry in entries]
    turns = [causes[:k].count(cause) for k, cause in enumerate(causes)]
    shown = np.argsort(turns, kind="stable")[:_MAX_MINIMAL].tolist()
    rows = -(-len(shown) // _COLUMNS)
    counts = dict(Counter(causes).most_common())
    heights = (1.0 + 0.25 * len(counts), 2.1 * rows)
    figure = new_figure(13.0, sum(heights))
    marks = "start yellow" + ", goal green" * ("goal" in places(space.asks))
    figure.suptitle(f"{robot}: {len(entries):,} minimal terrains; {marks}, blue low, brown high")
    subfigures: Any = figure.subfigures(2, 1, height_ratios=heights)
    axes = subfigures[0].subplots()
    axes.bar_label(axes.barh([*counts], [*counts.values()], color="#d55e00"), padding=3)
    axes.invert_yaxis()
    axes.set(xlabel="terrains by their cause", xmargin=0.08)
    axes.spines[["top", "right"]].set_visible(False)
    panels = subfigures[1].subplots(rows, _COLUMNS, squeeze=False).ravel()
    grids, grounds = make_terrains(np.array([genes[entries[index]["elite"]] for index in shown]), space)
    for panel in panels[len(shown) :]:
        panel.set_axis_off()
    for k, index in enumerate(shown):
        panel, entry = panels[k], entries[index]
        ground = None if grounds is None else grounds[k : k + 1]
        panel.imshow(relief(grids[k], ground), origin="lower", extent=(0.0, LENGTH, 0.0, WIDTH))
        title = f"elite {entry['elite']}: {causes[index]}, {len(entry['bumps'])} of {entry['of']} parts"
        panel.set_title(f"{title}, {format_value(entry['goal_rate'], None, '.0%')} pass", fontsize=9)
    return figure
