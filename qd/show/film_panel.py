"""The lower part of a film: the map with the paths of all episodes, and what the shown one has cost so far."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.show.figures import label_of
from qd.show.shot import Shot

_DPI = 100
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # apart for every kind of colour blindness
_FUTURE = 0.25  # how much is left to see of what has not happened yet


class Panel:
    """The lower part of a film, drawn once: the terrain's map with the paths, and the penalties over time.

    Args:
        shot: What the film shows.
        width: Pixels.
        height: Pixels.
    """

    def __init__(self, shot: Shot, width: int, height: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        self._map, self._curves = figure.subplots(1, 2, width_ratios=(1.0, 1.6))
        _draw_map(self._map, shot)
        _draw_curves(self._curves, shot)
        canvas.draw()
        self._image = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        self._faded = np.rint(255 - _FUTURE * (255.0 - self._image)).astype(np.uint8)
        self._inside = self._curves.get_window_extent()

    def at(self, time_s: float, position: NDArray[np.floating]) -> NDArray[np.uint8]:
        """The panel at a moment.

        Args:
            time_s: Since the start.
            position: Of the base [m], shape (3,).

        Returns:
            RGB, shape (height, width, 3).
        """
        image, height = self._image.copy(), len(self._image)
        now = round(self._curves.transData.transform((time_s, 0.0))[0])
        rows = slice(height - round(self._inside.y1), height - round(self._inside.y0))
        future = slice(now, round(self._inside.x1))
        image[rows, future] = self._faded[rows, future]
        image[rows, now - 1 : now + 1] = 40
        x, y = self._map.transData.transform(position[:2])
        row, column = np.ogrid[: image.shape[0], : image.shape[1]]
        apart = np.hypot(row - (height - y), column - x)
        image[apart < 7.0] = 255
        image[apart < 5.0] = (213, 94, 0)
        return image


def _draw_map(axes: Any, shot: Shot) -> None:
    recording, t = shot.recording, shot.terrain
    heights = recording.heights[t]
    extent = (-0.025, 0.05 * heights.shape[1] - 0.025, -0.025, 0.05 * heights.shape[0] - 0.025)
    axes.imshow(heights, origin="lower", extent=extent, cmap="gray", alpha=0.9)
    for k in range(recording.num_episodes):
        path = recording.base_position[t, k, : recording.num_frames[t, k]]
        style = ("#d55e00", 1.6) if k == shot.episode else ("white", 0.5)
        axes.plot(path[:, 0], path[:, 1], color=style[0], linewidth=style[1], zorder=2 + (k == shot.episode))
    axes.plot(14.0, 4.0, marker="*", color="#009e73", markeredgecolor="black", markersize=13, zorder=4)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _draw_curves(axes: Any, shot: Shot) -> None:
    times = shot.recording.times_s[: shot.num_frames]
    for (name, values), color in zip(shot.penalties.items(), _COLORS, strict=False):
        label = f"{label_of(name)} {values[-1]:.1f}"
        axes.plot(times, values, color=color, linewidth=1.8, label=label)
    axes.set_xlim(0.0, max(float(times[-1]), shot.recording.dt))
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    measured = set(shot.scales.values()) != {1.0}
    axes.set_ylabel(f"penalty so far,\n{'multiples of its scale' if measured else 'raw'}")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
