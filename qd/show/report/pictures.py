"""Pictures of terrains: many small ones from above in one sheet, and robots close up by MuJoCo's renderer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kernels.episode import Outcome
from qd.show.crossed import moment_of_failure, typical_episode
from qd.show.figures import relief
from qd.show.report.page import picture_source
from sim.bank import heights_of, terrains_of
from sim.mujoco_c.model import surface_heights
from sim.recording.recorder import Recording
from sim.recording.renderer import Camera, Renderer, open_context
from sim.robots.robot import RobotCfg
from sim.spaces.base import TerrainSpace

TILE = (96, 48)
"""Width and height of a small picture [pixels]."""
_AT_ONCE = 50  # height maps that are made at once
_EVERY = 2  # nodes, which are enough for a small picture
_SHEET_QUALITY = 70  # of WebP
_SIZE = (960, 600)  # of a close picture [pixels], which a page shows at half of that
_DISTANCE = 3.0  # of the camera [m]
_ELEVATIONS = (-16.0, -26.0, -38.0, -52.0)
_CLEARANCE = 0.08  # of the line of sight over the ground [m]


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """Small pictures of terrains in one image, so that a page of a thousand is light."""

    source: str
    """Of the image."""
    columns: int
    """Of small pictures."""

    def offset(self, place: int) -> tuple[int, int]:
        """Where a small picture begins: pixels from the left and from the top."""
        return place % self.columns * TILE[0], place // self.columns * TILE[1]


def sheet_of(genes: NDArray[np.float32], space: TerrainSpace) -> Sheet:
    """The terrains of genes, shape (T, num_genes), at least one, from above: blue is low, brown high."""
    columns = math.ceil(math.sqrt(len(genes) / 2))  # about a square, as a tile is twice as wide as high
    image = Image.new("RGB", (columns * TILE[0], -(-len(genes) // columns) * TILE[1]))
    sheet = Sheet(source="", columns=columns)
    for first in range(0, len(genes), _AT_ONCE):
        lot = genes[first : first + _AT_ONCE]
        grids, grounds = terrains_of(lot, space) if space.ground else (heights_of(lot, space, every=_EVERY), None)
        for place, heights in enumerate(grids):
            pixels = relief(heights, None if grounds is None else grounds[place : place + 1])[::-1]  # y up
            image.paste(Image.fromarray(pixels).resize(TILE, Image.Resampling.BOX), sheet.offset(first + place))
    return Sheet(source=picture_source(image, _SHEET_QUALITY), columns=columns)


class Moment(NamedTuple):
    """One frame of a recorded episode."""

    recording: Recording
    """Of one terrain."""
    episode: int
    frame: int

    @property
    def time_s(self) -> float:
        """Since the episode began [s]."""
        return self.frame * self.recording.dt


def failure_of(recording: Recording, scales: dict[str, float]) -> Moment | None:
    """The moment at which the typical episode goes wrong, or its end; None if all episodes are invalid."""
    if (recording.outcome[0] == Outcome.INVALID).all():
        return None
    episode = typical_episode(recording, scales)
    return Moment(recording, episode, round(moment_of_failure(recording, episode) / recording.dt))


def same_moment(moment: Moment, other: Recording, scales: dict[str, float]) -> Moment:
    """Another controller on the same terrain at that time, from the same start if it reaches the goal from there."""
    reaches = other.outcome[0, moment.episode] == Outcome.GOAL
    episode = moment.episode if reaches else typical_episode(other, scales)
    return Moment(other, episode, min(moment.frame, int(other.num_frames[0, episode]) - 1))


def why_no_pictures() -> str:
    """Why close pictures cannot be taken here, in a sentence; empty if they can."""
    try:
        open_context(8, 8).free()
    except ValueError as error:
        return f"Close pictures are left out: {error}."
    return ""


def close_pictures(robot: RobotCfg, moments: Sequence[Moment]) -> list[str]:
    """Pictures of moments on one terrain, each from 3 m away; they need OpenGL."""
    recording, (width, height) = moments[0].recording, _SIZE
    heights = recording.heights[0]
    with Renderer(robot, heights, width=width, height=height, ground=recording.ground) as renderer:
        return [picture_source(Image.fromarray(_rendered(renderer, moment, heights))) for moment in moments]


def _rendered(renderer: Renderer, moment: Moment, heights: NDArray[np.float32]) -> NDArray[np.uint8]:
    recording, episode, frame = moment
    pose = recording.qpos(0, episode)[frame]
    touching = recording.touching[0, episode, frame]
    return renderer.render(pose, _camera(heights, pose[:3]), touching=touching)


def _camera(heights: NDArray[np.float32], target: NDArray[np.float64]) -> Camera:
    """As low as the ground does not hide the robot."""
    x, y, z = target.tolist()
    cameras = [Camera(target=(x, y, z), distance=_DISTANCE, elevation=elevation) for elevation in _ELEVATIONS]
    for camera in cameras:
        azimuth, tilt = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
        back = -np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
        sight = target + np.linspace(0.1, 1.0, 19)[:, None] * _DISTANCE * back
        ground = surface_heights(heights.astype(np.float64), sight[:, 0], sight[:, 1])
        if (sight[:, 2] > ground + _CLEARANCE).all():
            return camera
    return cameras[-1]
