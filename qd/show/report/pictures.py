"""Pictures of terrains: many small ones from above in one sheet, and robots close up by MuJoCo's renderer."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kernels.episode import Outcome
from qd.show.crossed import find_failure_time, find_ghost_episode, find_typical_episode
from qd.show.figures import relief
from qd.show.film import clear_elevation
from qd.show.report.page import encode_picture
from sim.recording.recorder import Recording
from sim.recording.renderer import Camera, Renderer, open_context
from sim.robots.robot import RobotCfg
from sim.terrains.bank import make_heights, make_terrains
from sim.terrains.spaces.base import TerrainSpace

TILE = (96, 48)
"""Width and height of a small picture [pixels]."""
_LOT = 50  # terrains that are drawn together
_EVERY = 2  # every other node is enough for a small picture
_SHEET_QUALITY = 70  # of WebP
_SIZE = (960, 600)  # of a close picture [pixels], which a page shows at half of that
_DISTANCE = 3.0  # of the camera [m]


def draw_sheet(genes: NDArray[np.float32], space: TerrainSpace) -> dict[str, Any]:
    """Terrains of genes, shape (T, num_genes), at least one, from above in one image, so that large pages are light.

    ``source`` is the image; ``offsets`` are pixels from its left and top to each terrain. Blue is low, brown high.
    """
    columns = math.ceil(math.sqrt(len(genes) / 2))  # about a square, as a tile is twice as wide as high
    image = Image.new("RGB", (columns * TILE[0], -(-len(genes) // columns) * TILE[1]))
    offsets = [(k % columns * TILE[0], k // columns * TILE[1]) for k in range(len(genes))]
    for first in range(0, len(genes), _LOT):
        lot = genes[first : first + _LOT]
        grids, grounds = make_terrains(lot, space) if space.ground else (make_heights(lot, space, every=_EVERY), None)
        for k, heights in enumerate(grids):
            pixels = relief(heights, None if grounds is None else grounds[k : k + 1])[::-1]  # y up
            image.paste(Image.fromarray(pixels).resize(TILE, Image.Resampling.BOX), offsets[first + k])
    return {"source": encode_picture(image, _SHEET_QUALITY), "offsets": offsets}


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


def find_failure(recording: Recording, scales: dict[str, float]) -> Moment | None:
    """The moment at which the typical episode goes wrong, or its end; None if all episodes are invalid."""
    if (recording.outcome[0] == Outcome.INVALID).all():
        return None
    episode = find_typical_episode(recording, scales)
    return Moment(recording, episode, round(find_failure_time(recording, episode) / recording.dt))


def find_same_moment(moment: Moment, ghost: Recording, scales: dict[str, float]) -> Moment:
    """Another controller on the same terrain at that time, from the same start if it reaches the goal from it."""
    episode = find_ghost_episode(ghost, moment.episode, scales)
    return Moment(ghost, episode, min(moment.frame, int(ghost.num_frames[0, episode]) - 1))


def explain_missing_pictures() -> str:
    """Why this machine cannot take close pictures, in a sentence; empty if it can."""
    try:
        open_context(8, 8).free()
    except ValueError as error:
        return f"Close pictures are left out: {error}."
    return ""


def render_close_pictures(robot: RobotCfg, moments: Sequence[Moment]) -> list[str]:
    """Pictures of moments on one terrain, each from 3 m away; they need OpenGL."""
    sources = []
    heights = moments[0].recording.heights[0]
    ground = moments[0].recording.ground
    with Renderer(robot, heights, width=_SIZE[0], height=_SIZE[1], ground=ground) as renderer:
        for recording, episode, frame in moments:
            pose = recording.qpos(0, episode)[frame]
            elevation = clear_elevation(heights, pose[None, :3], _DISTANCE)
            camera = Camera(target=tuple(pose[:3].tolist()), distance=_DISTANCE, elevation=elevation)
            pixels = renderer.render(pose, camera, touching=recording.touching[0, episode, frame])
            sources.append(encode_picture(Image.fromarray(pixels)))
    return sources
