"""Figures that need no screen: an empty one, and one as PNG."""

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of a size in inches that needs no screen and no global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def as_png(figure: "Figure") -> bytes:
    """A figure as PNG, as fine as print needs; names in it are shown as they are, whatever signs they hold."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)  # a file may be called $x$.npz, or something that is no formula
        text.set_text(text.get_text().encode(errors="backslashreplace").decode())  # or hold bytes that are no text
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return buffer.getvalue()
