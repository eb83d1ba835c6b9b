"""Figures of recorded crossings: height map, paths, where they ended, and where the penalties were incurred."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from qd.show.crossed import ENDINGS, Crossed, penalties_by_place
from qd.show.figures import look_of
from sim.files.figures import new_figure
from sim.maps.picture import GOAL, LENGTH, SLIPPERY, SOFT, START, draw_heights

_PLACE = 0.5  # length of the places that penalties are summed over [m]


def draw_crossing(crossed: Crossed, penalties: tuple[str, ...], title: str) -> Figure:
    """One terrain: its height map with the paths, its profile, and the penalties by place and by kind."""
    figure = new_figure(12.0, 7.2)
    figure.suptitle(title)
    grid = figure.add_gridspec(3, 2, width_ratios=(2.6, 1.0), height_ratios=(3.2, 0.9, 1.1))
    top = figure.add_subplot(grid[0, 0])
    profile, places = (figure.add_subplot(grid[row, 0], sharex=top) for row in (1, 2))
    image = draw_map(top, crossed)
    figure.colorbar(image, ax=top, label="height [m]", shrink=0.85, pad=0.01)
    _draw_profile(profile, crossed)
    _draw_places(places, crossed, penalties)
    _draw_penalties(figure.add_subplot(grid[1:, 1]), crossed, penalties)
    legend = figure.add_subplot(grid[0, 1])
    legend.set_axis_off()
    handles = _legend(crossed)
    legend.legend(
        handles=handles, loc="center left", frameon=False, title="crossings", alignment="left", handlelength=3
    )
    for axes in (top, profile):
        axes.tick_params(labelbottom=False)
    top.set_xlim(*_x_limits(crossed))
    return figure


def draw_paths(crossed: Crossed, title: str) -> Figure:
    """One terrain from above with the robots' paths, and marks where they ended, by how."""
    figure = new_figure(11.0, 6.2)
    axes = figure.subplots()
    figure.colorbar(draw_map(axes, crossed), ax=axes, label="height [m]", shrink=0.7)
    axes.set_title(title)
    axes.set_xlabel("x [m]")
    axes.set_xlim(*_x_limits(crossed))
    figure.legend(handles=_legend(crossed), loc="outside lower center", ncols=6, frameon=False, handlelength=3)
    return figure


def draw_map(axes: Axes, crossed: Crossed) -> Any:
    """The height map with every path, its end marked by how it ended; returns the image."""
    image = draw_heights(axes, crossed.recording.heights[0], None, crossed.recording.ground)
    for outcome, end in ENDINGS.items():
        chosen = np.flatnonzero(crossed.outcome == outcome)
        for k in chosen:
            axes.plot(*crossed.path(int(k))[:, :2].T, color=end.color, linestyle=end.line, linewidth=0.9, alpha=0.7)
        if len(chosen):
            places = crossed.ends[chosen]
            axes.scatter(*places[:, :2].T, color=end.color, marker=end.marker, s=55, edgecolors="white", zorder=3)
    return image


def _legend(crossed: Crossed) -> list[Any]:
    """Marks of the ends there are and how many, with the lines of the paths to them, of start and goal."""
    handles: list[Any] = []
    for outcome, end in ENDINGS.items():
        if count := int((crossed.outcome == outcome).sum()):
            looks: dict[str, Any] = {"color": end.color, "marker": end.marker, "linestyle": end.line}
            label = f"{end.words} ({count})"
            handles.append(Line2D([], [], **looks, label=label, markeredgecolor="white", markersize=9))
    handles += [Line2D([], [], **look) for look in (START, GOAL)]
    ground = crossed.recording.ground
    if ground is not None and (ground.friction < 1.0).any():
        handles.append(Patch(color=SLIPPERY, alpha=0.5, label="slippery"))
    if ground is not None and ground.time_constant_s.any():
        handles.append(Patch(color=SOFT, alpha=0.5, label="soft"))
    return handles


def _x_limits(crossed: Crossed) -> tuple[float, float]:
    """The terrain, and what robots left it for."""
    xs = np.concatenate([[0.0, LENGTH], crossed.ends[:, 0]])
    return float(xs.min()), float(xs.max())


def _draw_profile(axes: Axes, crossed: Crossed) -> None:
    """Heights along the straight line from start to goal."""
    heights = crossed.recording.heights[0]
    row = heights[heights.shape[0] // 2]
    x = np.linspace(0.0, LENGTH, len(row))
    axes.fill_between(x, row, min(float(row.min()), 0.0) - 0.1, color="0.75")
    axes.plot(x, row, color="0.2", linewidth=1.0)
    axes.set_ylabel("height at\ny = 4 m [m]", fontsize=9)
    axes.grid(alpha=0.3)


def _draw_places(axes: Axes, crossed: Crossed, penalties: tuple[str, ...]) -> None:
    """Scaled penalties of an episode by where they were incurred."""
    edges = np.arange(0.0, LENGTH + _PLACE / 2, _PLACE)
    amounts = penalties_by_place(crossed, penalties, edges)
    bottom = np.zeros(len(amounts))
    for penalty, amount in zip(penalties, amounts.T, strict=True):
        axes.bar(edges[:-1], amount, width=_PLACE, align="edge", bottom=bottom, **look_of(penalty).bar)
        bottom += amount
    axes.set_xlabel("x [m]")
    axes.set_ylabel(f"penalties per\n{_PLACE} m (scaled)", fontsize=9)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def _draw_penalties(axes: Axes, crossed: Crossed, penalties: tuple[str, ...]) -> None:
    """Mean of each scaled penalty with its standard deviation over the episodes."""
    places = np.arange(len(penalties))
    means, stds = crossed.scaled.mean(axis=0), crossed.scaled.std(axis=0)
    for place, penalty in zip(places, penalties, strict=True):
        axes.barh(place, means[place], **look_of(penalty).bar)
    axes.errorbar(means, places, xerr=stds, linestyle="", color="0.3", capsize=3)
    axes.set_yticks(places, [look_of(name).label for name in penalties], fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("penalty an episode (scaled),\nmean and standard deviation", fontsize=9)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
