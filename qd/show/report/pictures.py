"""Pictures of terrains: small ones from above, and crossings in three dimensions by MuJoCo's renderer."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from qd.show.crossed import Crossed, ending_of, typical_episode
from sim.bank import terrains_of
from sim.crossing import CrossingCfg
from sim.ground import GroundMaps
from sim.maps.picture import height_colors, tinted
from sim.recording.renderer import Camera, Ghost, Renderer
from sim.robots.robot import RobotCfg
from sim.spaces.base import TerrainSpace
from sim.terrain import SPACING

_AT_ONCE = 50  # height maps that are made at once
_FEW = 1_000  # terrains, up to which pictures are large
_WIDTHS = (256, 160)  # of pictures of few terrains and of many [pixels]
_QUALITY = 72  # of the JPEG
_SUN = np.array([-0.45, 0.35])  # where the light comes from: how much slopes along x and y gain by it
_MARK = 3  # half side of the marks of start and goal [nodes]
_START, _GOAL = (240, 200, 60), (0, 158, 115)


def reliefs_of(genes: NDArray[np.float32], space: TerrainSpace) -> list[bytes]:
    """A picture of each terrain, as JPEG: blue below the start's level, brown above, slopes lit from one side.

    Slippery and soft patches are tinted.
    """
    width = _WIDTHS[len(genes) > _FEW]
    lots = (genes[first : first + _AT_ONCE] for first in range(0, len(genes), _AT_ONCE))
    pictures = []
    for lot in lots:
        grids, maps = terrains_of(lot, space)
        grounds = [None if maps is None else maps[place : place + 1] for place in range(len(lot))]
        pictures += [relief(heights, width, ground) for heights, ground in zip(grids, grounds, strict=True)]
    return pictures


def relief(heights: NDArray[np.floating], width: int = _WIDTHS[0], ground: GroundMaps | None = None) -> bytes:
    """A picture of a terrain of heights [m], shape (nrow, ncol), with the start yellow and the goal green."""
    rise_y, rise_x = np.gradient(heights, SPACING)
    light = np.clip(1.0 + _SUN[0] * rise_x + _SUN[1] * rise_y, 0.45, 1.25)
    colors = height_colors(heights) if ground is None else tinted(height_colors(heights), ground)
    pixels = np.clip(255.0 * colors * light[..., None], 0.0, 255.0).astype(np.uint8)
    for (x, y), color in ((CrossingCfg.start, _START), (CrossingCfg.goal, _GOAL)):
        row, column = round(y / SPACING), round(x / SPACING)
        pixels[row - _MARK : row + _MARK + 1, column - _MARK : column + _MARK + 1] = color
    nrow, ncol = heights.shape
    image = Image.fromarray(pixels[::-1]).resize((width, round(width * nrow / ncol)), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    image.save(content, "JPEG", quality=_QUALITY)
    return content.getvalue()


WIDTH, HEIGHT = 1040, 520
"""Of a picture [pixels]; a page shows it at half of that and more."""
_EVERY_S = 1.5  # from one ghost of the robot to the one before
_GHOSTS = 3
_OPACITY = 0.5  # of a way
_POINT_EVERY = 10  # frames from one point of a way to the next
_RENDERED_QUALITY = 82  # of the JPEG
_DISTANCE = 10.5  # of the camera, in standing heights of the robot
_ELEVATION, _AZIMUTH = -34.0, 62.0
_BEFORE = 0.9  # how far before the end the camera looks at [m]


def rendered(crossed: Crossed, robot: RobotCfg, scales: dict[str, float]) -> bytes:
    """A picture of a terrain where robots end on it, as JPEG; at least one crossing is valid.

    The robot stands where the middle one of the episodes ended that end as most do, with ghosts of it on its way there.
    """
    recording = crossed.recording
    episode = typical_episode(recording, scales)
    poses = recording.qpos(0, episode)
    before = [len(poses) - 1 - round(k * _EVERY_S / recording.dt) for k in range(1, _GHOSTS + 1)]
    look = {"width": WIDTH, "height": HEIGHT, "shadows": False, "ground": recording.ground}
    with Renderer(robot, recording.heights[0], **look) as renderer:
        pixels = renderer.render(
            poses[-1],
            _camera(poses[-1, :3], robot.default_base_height),
            ghosts=[Ghost(poses[frame]) for frame in before if frame >= 0],
            touching=recording.touching[0, episode, len(poses) - 1],
            paths=_ways(crossed),
        )
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "JPEG", quality=_RENDERED_QUALITY)
    return content.getvalue()


def _camera(end: NDArray[np.float64], stands: float) -> Camera:
    """Behind and beside where the robot ended, high enough to see over what stopped it."""
    target = (float(end[0]) - _BEFORE, float(end[1]), float(end[2]) - 0.3 * stands)
    return Camera(target=target, distance=_DISTANCE * stands, azimuth=_AZIMUTH, elevation=_ELEVATION)


def _ways(crossed: Crossed) -> list[tuple[NDArray[np.float64], tuple[float, float, float, float]]]:
    """The way of every base, in the colour of how it ended."""
    ways = []
    for k, outcome in enumerate(crossed.outcome.tolist()):
        path = crossed.path(k)
        red, green, blue = (value / 255.0 for value in ImageColor.getrgb(ending_of(outcome).color)[:3])
        ways.append((np.vstack([path[::_POINT_EVERY], path[-1:]]), (red, green, blue, _OPACITY)))
    return ways
