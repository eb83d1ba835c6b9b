"""What the colours of the page mean, as HTML."""

from html import escape

import numpy as np
from matplotlib.colors import to_hex

from qd.show.crossed import ENDINGS
from qd.show.view.scene import COMMAND_COLOR, FOOT_TOUCH_COLOR, FORCE_COLOR, GHOST_COLOR, TOUCH_COLOR
from sim.maps.picture import SLIPPERY, SOFT, height_colors


def legend_html() -> str:
    """Heights, paths, touches, arrows and the ghost."""
    ramp = ", ".join(map(to_hex, height_colors(np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))))
    bar = f'<span style="display:inline-block;width:7em;height:0.8em;background:linear-gradient(90deg, {ramp})"></span>'
    rows = {
        "Ground": f"low {bar} high; grey is the level of the start, and a line stands every metre; "
        + _swatches({"slippery": _lines(SLIPPERY, -45), "soft": _lines(SOFT, 90)})
        + "the stronger the worse, crossed where ground is both",
        "Paths": "of all episodes, by how they ended: "
        + _swatches({ending.words: ending.color for ending in ENDINGS.values()}),
        "Touching": _swatches({"base or limb": _hex(TOUCH_COLOR), "foot": _hex(FOOT_TOUCH_COLOR)}),
        "Arrows": _swatches(
            {
                "force on a foot, 1 m is 1,000 N": _hex(FORCE_COLOR),
                "commanded velocity, 1 m is 1 m/s": _hex(COMMAND_COLOR),
            }
        ),
        "Ghost": _swatches({"a second controller at the same time": _hex(GHOST_COLOR)}),
    }
    style = "font-size:0.85em;padding:0.15em 0.6em"
    return "".join(f'<div style="{style}"><b>{name}</b>: {words}</div>' for name, words in rows.items())


def _hex(color: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


def _lines(color: tuple[float, float, float], degrees: int) -> str:
    return f"repeating-linear-gradient({degrees}deg, {to_hex(color)} 0 2px, transparent 2px 5px)"


def _swatches(colors: dict[str, str]) -> str:
    box = "display:inline-block;width:0.8em;height:0.8em;border-radius:2px"
    return " ".join(
        f'<span style="white-space:nowrap;margin-right:0.6em"><span style="{box};background:{color}"></span> '
        f"{escape(words)}</span>"
        for words, color in colors.items()
    )
