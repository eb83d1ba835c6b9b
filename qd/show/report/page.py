"""Pages of HTML by Jinja templates, each one file with all that it shows, and the pictures on them."""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from qd.evaluate.labels import FATES, MEASURES, SETS
from qd.search.progress import clock
from qd.show.crossed import find_failure_time, find_ghost_episode, find_typical_episode
from qd.show.figures import relief
from qd.show.film import clear_elevation
from qd.show.replay import save
from sim.files.atomic import prepare_output
from sim.files.figures import as_image
from sim.files.intervals import format_value
from sim.files.templates import open_templates
from sim.recording.recorder import Recording
from sim.recording.renderer import Camera, Renderer
from sim.robots.robot import RobotCfg
from sim.terrains.bank import make_heights, make_terrains
from sim.terrains.spaces.base import TerrainSpace

TILE = (96, 48)  # width and height of a small picture [pixels]
_LOT = 50  # terrains that are drawn together
_EVERY = 2  # every other node is enough for a small picture
_SIZE = (960, 600)  # of a close picture [pixels], which a page shows at half of that
_DISTANCE = 3.0  # of the camera [m]


class Table(NamedTuple):
    """Rows of text; the first cell names the row."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def encode_picture(picture: Image.Image | Figure, quality: int = 80) -> str:
    """Source of an ``img`` element, a WebP."""
    content = io.BytesIO()
    image = as_image(picture) if isinstance(picture, Figure) else picture
    image.save(content, "WEBP", quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"


def percent(share: float) -> str:
    """A share in percent: 0 and 100 % only for none and all."""
    text = f"{100.0 * share:.1f}" if 0.0 < share < 1.0 and not 0.095 <= share < 0.995 else f"{100.0 * share:.0f}"
    if (text == "0.0" and share > 0.0) or (text == "100.0" and share < 1.0):
        text = "less than 0.1" if share < 0.5 else "over 99.9"
    return f"{text} %"


def counted(number: int, noun: str) -> str:
    """A number with its noun: ``1 elite``, ``459 elites``."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def check_page(out: Path) -> None:
    """Refuses a page that cannot be written."""
    if out.suffix != ".html":
        example = out / "report.html" if out.is_dir() or not out.suffix else out.with_suffix(".html")
        raise ValueError(f"out must be a file named *.html, got {out}: name for example {example}")
    prepare_output(out)


def open_pages() -> Environment:
    """The templates of pages, with what they need to write numbers and names."""
    pages = open_templates(Path(__file__).parent / "templates")
    pages.filters |= {"percent": percent, "counted": counted, "clock": clock, "with_limits": format_value}
    pages.globals |= {"sets": SETS, "measures": MEASURES, "fates": FATES}
    return pages


def publish_page(out: Path, template: str, **content: object) -> Path:
    """Writes a page from its template, atomically."""
    text = open_pages().get_template(template).render(content)
    save(out, text.encode(errors="backslashreplace"), "Report")  # a file's name may hold bytes that are no text
    return out


def origin_rows(origin: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Command, commit, device, seed, date and versions, as far as they are known."""
    rows = [(name, str(origin[name])) for name in ("command", "commit", "device", "seed", "date") if name in origin]
    versions = origin.get("versions")
    if isinstance(versions, dict):
        rows.append(("versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    return rows


def draw_sheet(genes: NDArray[np.float32], space: TerrainSpace) -> dict[str, Any]:
    """At least one terrain, genes (T, num_genes), from above in one image; ``offsets`` are pixels from left and top."""
    columns = math.ceil(math.sqrt(len(genes) / 2))  # about a square, as a tile is twice as wide as high
    image = Image.new("RGB", (columns * TILE[0], -(-len(genes) // columns) * TILE[1]))
    offsets = [(k % columns * TILE[0], k // columns * TILE[1]) for k in range(len(genes))]
    for first in range(0, len(genes), _LOT):
        lot = genes[first : first + _LOT]
        plain = not (space.ground or space.has_conditions)
        grids, grounds = (make_heights(lot, space, every=_EVERY), None) if plain else make_terrains(lot, space)
        for k, heights in enumerate(grids):
            pixels = relief(heights, None if grounds is None else grounds[k : k + 1])[::-1]  # y up
            image.paste(Image.fromarray(pixels).resize(TILE, Image.Resampling.BOX), offsets[first + k])
    return {"source": encode_picture(image, quality=70), "offsets": offsets}


Moment = tuple[Recording, int, float]
"""Recording of one terrain, episode, and time since the episode began [s]."""


def choose_moments(recording: Recording, ghost: Recording | None, scales: dict[str, float]) -> list[Moment]:
    """When the typical episode goes wrong, or ends, and that time of another controller's episode beside it."""
    episode = find_typical_episode(recording, scales)
    moments = [(recording, episode, find_failure_time(recording, episode))]
    if ghost is not None:
        beside = find_ghost_episode(ghost, episode, scales)
        moments.append((ghost, beside, min(moments[0][2], ghost.dt * (int(ghost.num_frames[0, beside]) - 1))))
    return moments


def render_close_pictures(robot: RobotCfg, moments: Sequence[Moment]) -> list[str]:
    """Pictures of moments on one terrain, each from 3 m away; they need OpenGL."""
    sources = []
    first = moments[0][0]
    heights = first.heights[0]
    with Renderer(robot, heights, width=_SIZE[0], height=_SIZE[1], ground=first.ground) as renderer:
        for recording, episode, time_s in moments:
            frame = round(time_s / recording.dt)
            pose = recording.qpos(0, episode)[frame]
            elevation = clear_elevation(heights, pose[None, :3], _DISTANCE)
            camera = Camera(target=tuple(pose[:3].tolist()), distance=_DISTANCE, elevation=elevation)
            pixels = renderer.render(pose, camera, touching=recording.touching[0, episode, frame])
            sources.append(encode_picture(Image.fromarray(pixels)))
    return sources
