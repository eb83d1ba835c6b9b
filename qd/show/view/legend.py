"""What the colours of the page mean, as HTML."""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from matplotlib.colors import to_hex

from qd.show.crossed import ENDINGS
from qd.show.view.scene import COMMAND_COLOR, FORCE_COLOR
from sim.maps.picture import SLIPPERY, SOFT, height_colors
from sim.recording.scene import FOOT_TOUCH, OTHER_CONTROLLER, TOUCH


def legend_html() -> str:
    """Heights, paths, touches, arrows and the ghost."""
    ramp = ", ".join(map(to_hex, height_colors(np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))))
    bar = f'<span style="display:inline-block;width:7em;height:0.8em;background:linear-gradient(90deg, {ramp})"></span>'
    rows = {
        "Ground": f"low {bar} high; grey is the level of the start, and a line stands every metre; "
        + _swatches({"slippery": SLIPPERY}, "repeating-linear-gradient(-45deg, {} 0 2px, transparent 2px 5px)")
        + _swatches({"soft": SOFT}, "repeating-linear-gradient(90deg, {} 0 2px, transparent 2px 5px)")
        + "the stronger the worse, crossed where ground is both",
        "Paths": "of all episodes, by how they ended: "
        + _swatches({ending.words: ending.color for ending in ENDINGS.values()}),
        "Touching": _swatches({"base or limb": TOUCH, "foot": FOOT_TOUCH}),
        "Arrows": _swatches(
            {"force on a foot, 1 m is 1,000 N": FORCE_COLOR, "commanded velocity, 1 m is 1 m/s": COMMAND_COLOR}
        ),
        "Ghost": _swatches({"a second controller at the same time": OTHER_CONTROLLER}),
    }
    style = "font-size:0.85em;padding:0.15em 0.6em"
    return "".join(f'<div style="{style}"><b>{name}</b>: {words}</div>' for name, words in rows.items())


def _swatches(colors: Mapping[str, Any], fill: str = "{}") -> str:
    """A small square a colour, with its words."""
    box = "display:inline-block;width:0.8em;height:0.8em;border-radius:2px;background:"
    return " ".join(
        f'<span style="white-space:nowrap;margin-right:0.6em"><span style="{box}{fill.format(to_hex(color))}"></span> '
        f"{escape(words)}</span>"
        for words, color in colors.items()
    )
