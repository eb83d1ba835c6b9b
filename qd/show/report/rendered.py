"""A crossing as a rendered picture: the terrain in three dimensions, the ways of all robots, and one where it ended.

By MuJoCo's renderer, on a GPU or in software (:mod:`sim.recording.renderer`).
"""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from qd.show.crossed import Crossed, ending_of
from qd.show.shot import typical_episode
from sim.recording.renderer import Camera, Renderer
from sim.robots.robot import RobotCfg

WIDTH, HEIGHT = 1040, 520
"""Of a picture [pixels]; a page shows it at half of that and more."""
_EVERY_S = 1.5  # from one ghost of the robot to the one before
_GHOSTS = 3
_OPACITY = 0.5  # of a way
_POINT_EVERY = 10  # frames from one point of a way to the next
_QUALITY = 82  # of the JPEG
_DISTANCE = 10.5  # of the camera, in standing heights of the robot
_ELEVATION, _AZIMUTH = -34.0, 62.0
_BEFORE = 0.9  # how far before the end the camera looks at [m]


def rendered(crossed: Crossed, robot: RobotCfg, scales: dict[str, float]) -> bytes:
    """A picture of a terrain where robots end on it, as JPEG.

    The robot stands where the middle one of the episodes ended that end as most do, with ghosts of it on its way there.

    Args:
        crossed: At least one valid crossing of the terrain.
        robot: Who crossed it.
        scales: What each penalty is divided by.
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
            ghosts=[poses[frame] for frame in before if frame >= 0],
            paths=_ways(crossed),
        )
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "JPEG", quality=_QUALITY)
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
