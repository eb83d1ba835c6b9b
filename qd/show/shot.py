"""The pictures of a film: the robot on its terrain, where it is on the map, and what it has cost so far."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as Images
from PIL import ImageDraw, ImageFont

from qd.show.crossed import ARRIVED, crossed_of, ending_of
from qd.show.figures import label_of, look_of
from sim.crossing import CrossingCfg
from sim.files.intervals import rate_words
from sim.mujoco_c.model import surface_heights
from sim.policy.spec import ControllerSpec
from sim.recording.recorder import Recording
from sim.recording.renderer import Camera, Ghost, Renderer

WIDTH, VIEW_HEIGHT, PANEL_HEIGHT = 1280, 480, 240
"""Pixels of a film; the panel stands below the view."""
_BAR = 56  # height of the caption [pixels]
_SMOOTH_S = 0.8  # over which the camera follows the base
_HOLD_S = 1.0  # of the last frame
_ELEVATIONS = (-22.0, -32.0, -45.0, -60.0)
_CLEARANCE = 0.05  # of the line of sight over the ground [m]
_DPI = 100
_FUTURE = 0.25  # how much is left to see of what has not happened yet

Image = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Shot:
    """What a film shows: one episode of a recording, and others of the same terrain as ghosts."""

    recording: Recording
    """Of one terrain."""
    episode: int
    """Index of the episode."""
    ghosts: tuple[int, ...] = ()
    """Indices of the others."""
    scales: dict[str, float]
    """What each penalty is divided by, so that they compare; those not named are not drawn. All 1 where scales were
    never measured."""

    @property
    def num_frames(self) -> int:
        """Frames of the episode."""
        return int(self.recording.num_frames[0, self.episode])

    @property
    def penalties(self) -> dict[str, NDArray[np.float64]]:
        """Scaled penalty sums so far by name, shape (frames,) each."""
        sums = self.recording.penalties[0, self.episode, : self.num_frames].astype(np.float64)
        names = self.recording.penalty_names
        return {name: sums[:, names.index(name)] / scale for name, scale in self.scales.items() if name in names}


def caption(shot: Shot) -> tuple[str, str]:
    """Two lines: what is shown, and how all recorded episodes of the terrain ended, with 95 % intervals (Wilson)."""
    recording, k = shot.recording, shot.episode
    first = (
        f"{recording.robot} on {recording.labels[0]}: episode {recording.replicas[k]}, "
        f"{ending_of(recording.outcome[0, k]).words} after {recording.duration_s[0, k]:.1f} s"
    )
    crossed = crossed_of(recording, (), ())
    shown = {"goal": ARRIVED, "base collision": "base collision", "fallen": "fallen"}
    rates = [f"{name} {rate_words(*crossed.rates[words], short=True)}" for name, words in shown.items()]
    count, valid = recording.num_episodes, len(crossed.chosen)
    rates = rates if valid else ["none valid"]
    of = f"{count} episode{'s' * (count != 1)}" + f", {count - valid} invalid" * (valid < count)
    if policy := recording.origin.get("policy"):
        of += f" with {ControllerSpec.parse(str(policy)).label}"
    return first, f"{of}: {', '.join(rates)}; in brackets 95 % intervals"


def follow(shot: Shot, distance: float) -> list[Camera]:
    """A camera a frame, ``distance`` [m] from the base: it follows smoothly, as low as the ground never hides it."""
    recording = shot.recording
    base = recording.base_position[0, shot.episode, : shot.num_frames].astype(np.float64)
    width = max(1, round(_SMOOTH_S / recording.dt)) | 1
    padded = np.pad(base, ((width // 2, width // 2), (0, 0)), mode="edge")
    sums = np.cumsum(np.vstack([np.zeros(3), padded]), axis=0)
    targets = (sums[width:] - sums[:-width]) / width
    along = np.linspace(0.1, 1.0, 19)[:, None]
    for elevation in _ELEVATIONS:
        camera = Camera(target=(0.0, 0.0, 0.0), distance=distance, elevation=elevation)
        azimuth, tilt = np.deg2rad(camera.azimuth), np.deg2rad(elevation)
        back = -distance * np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
        sight = targets[:, None] + along * back
        ground = surface_heights(recording.heights[0].astype(np.float64), sight[..., 0], sight[..., 1])
        if (sight[..., 2] > ground + _CLEARANCE).all() or elevation == _ELEVATIONS[-1]:
            break
    return [Camera(target=(x, y, z), distance=distance, elevation=elevation) for x, y, z in targets.tolist()]


def frames_of(shot: Shot, renderer: Renderer, cameras: Sequence[Camera], fps: int) -> Iterator[Image]:
    """The pictures of a film, RGB of shape (720, 1280, 3), the last one held for a second.

    There is a camera for each frame of the recording; the renderer's images have 1280 x 480 pixels.
    """
    panel, lines = Panel(shot, WIDTH, PANEL_HEIGHT), caption(shot)
    recording = shot.recording
    poses = recording.qpos(0, shot.episode)
    others = [recording.qpos(0, k) for k in shot.ghosts]
    picture = np.zeros(0, np.uint8)
    for frame in shown_frames(shot, fps):
        ghosts = [Ghost(other[min(frame, len(other) - 1)]) for other in others]
        marks = {name: getattr(recording, name)[0, shot.episode, frame] for name in ("touching", "foot_force")}
        view = renderer.render(poses[frame], cameras[frame], ghosts=ghosts, **marks)
        time_s = frame * recording.dt
        lettered = _lettered(view, lines, f"{time_s:.1f} s")
        picture = np.concatenate([lettered, panel.at(time_s, poses[frame, :3])])
        yield picture
    for _ in range(round(_HOLD_S * fps)):
        yield picture


def shown_frames(shot: Shot, fps: int) -> list[int]:
    """Frames of the recording that a film shows, real time at ``fps``; its first and its last are among them."""
    last = shot.num_frames - 1
    times = np.arange(0.0, last * shot.recording.dt, 1.0 / fps)
    return [*np.rint(times / shot.recording.dt).astype(int).tolist(), last] if last else [0]


def num_pictures(shot: Shot, fps: int) -> int:
    """How many pictures :func:`frames_of` gives."""
    return len(shown_frames(shot, fps)) + round(_HOLD_S * fps)


def _lettered(view: Image, lines: tuple[str, str], clock: str) -> Image:
    """A view with the caption on a dark bar at its top, and the time at its bottom."""
    view[:_BAR] = (0.35 * view[:_BAR]).astype(np.uint8)
    image = Images.fromarray(view)
    draw = ImageDraw.Draw(image)
    for row, (line, size) in enumerate(zip(lines, (20, 17), strict=True)):
        draw.text((12, 4 + 27 * row), line, fill="white", font=ImageFont.load_default(size))
    place = (view.shape[1] - 12, view.shape[0] - 10)
    draw.text(place, clock, fill="black", font=ImageFont.load_default(22), anchor="rs")
    return np.asarray(image)


class Panel:
    """The lower part of a film, drawn once: the terrain's map with the paths, and the penalties over time."""

    def __init__(self, shot: Shot, width: int, height: int) -> None:
        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        figure.set_layout_engine("constrained")
        canvas = FigureCanvasAgg(figure)
        self._map, self._curves = figure.subplots(1, 2, width_ratios=(1.0, 1.6))
        _draw_map(self._map, shot)
        _draw_curves(self._curves, shot)
        canvas.draw()
        self._image = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        self._faded = np.rint(255 - _FUTURE * (255.0 - self._image)).astype(np.uint8)
        self._inside = self._curves.get_window_extent()

    def at(self, time_s: float, position: NDArray[np.floating]) -> NDArray[np.uint8]:
        """The panel at a moment, RGB of shape (height, width, 3); ``position`` of the base [m] has shape (3,)."""
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
    recording = shot.recording
    heights = recording.heights[0]
    extent = (-0.025, 0.05 * heights.shape[1] - 0.025, -0.025, 0.05 * heights.shape[0] - 0.025)
    axes.imshow(heights, origin="lower", extent=extent, cmap="gray", alpha=0.9)
    for k in range(recording.num_episodes):
        path = recording.base_position[0, k, : recording.num_frames[0, k]]
        style = ("#d55e00", 1.6) if k == shot.episode else ("white", 0.5)
        axes.plot(path[:, 0], path[:, 1], color=style[0], linewidth=style[1], zorder=2 + (k == shot.episode))
    axes.plot(*CrossingCfg.goal, marker="*", color="#009e73", markeredgecolor="black", markersize=13, zorder=4)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _draw_curves(axes: Any, shot: Shot) -> None:
    times = shot.recording.times_s[: shot.num_frames]
    for name, values in shot.penalties.items():
        axes.plot(times, values, color=look_of(name).color, linewidth=1.8, label=label_of(name))
    axes.set_xlim(0.0, max(float(times[-1]), shot.recording.dt))
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    measured = set(shot.scales.values()) != {1.0}
    axes.set_ylabel(f"penalty so far,\n{'multiples of its scale' if measured else 'raw'}")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
