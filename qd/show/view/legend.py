"""What the colours of the page mean, as HTML."""

from collections.abc import Sequence
from html import escape

import numpy as np

from qd.show.crossed import ENDINGS
from qd.show.view.meshes import Color
from qd.show.view.scene import COMMAND_COLOR, FOOT_TOUCH_COLOR, FORCE_COLOR, GHOST_COLOR, TOUCH_COLOR
from sim.maps.picture import SLIPPERY, SOFT
from sim.recording.scene import height_colors


def legend_html(controllers: Sequence[str]) -> str:
    """Heights, paths, what touches, arrows, and whose crossings there are.

    Args:
        controllers: Their names.
    """
    rows = [
        f"<b>Ground</b>: {_heights()}",
        "<b>Paths</b> of all episodes, by how they ended: "
        + " ".join(_swatch(ending.color, ending.words) for ending in ENDINGS.values()),
        "<b>Touching</b>: "
        + _swatch(_hex(TOUCH_COLOR), "base or limb")
        + " "
        + _swatch(_hex(FOOT_TOUCH_COLOR), "foot"),
        "<b>Arrows</b>: "
        + _swatch(_hex(FORCE_COLOR), "force on a foot, 1 m is 1,000 N")
        + " "
        + _swatch(_hex(COMMAND_COLOR), "commanded velocity, 1 m is 1 m/s"),
        f"<b>Controllers</b>: {', '.join(map(escape, controllers)) or 'none'}; robot, paths and curves are those of "
        "the one that is chosen.",
        "<b>Ghost</b>: " + _swatch(_hex(GHOST_COLOR), "a second controller, at the same time from the same start"),
    ]
    return "".join(f'<div style="font-size:0.85em;padding:0.15em 0.6em">{row}</div>' for row in rows)


def _hex(color: Color) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


def _of_shares(color: Sequence[float]) -> str:
    red, green, blue = (round(255 * share) for share in color)
    return _hex((red, green, blue))


def _swatch(color: str, words: str) -> str:
    box = f'<span style="display:inline-block;width:0.8em;height:0.8em;background:{color};border-radius:2px"></span>'
    return f'<span style="white-space:nowrap;margin-right:0.6em">{box} {escape(words)}</span>'


def _heights() -> str:
    """The colours from the lowest to the highest ground."""
    rgb = np.rint(255.0 * height_colors(np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))).astype(int)
    stops = ", ".join(_hex((int(r), int(g), int(b))) for r, g, b in rgb)
    bar = (
        f'<span style="display:inline-block;width:7em;height:0.8em;background:linear-gradient(90deg, {stops})"></span>'
    )
    tints = " ".join(_swatch(_of_shares(color), words) for color, words in ((SLIPPERY, "slippery"), (SOFT, "soft")))
    return f"low {bar} high; grey is the level of the start, and a line stands every metre; {tints}"
