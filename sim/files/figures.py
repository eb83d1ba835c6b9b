"""Figures that need no screen: an empty one, and one as PNG."""

import io

from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.text import Text
from PIL import Image

_DPI = 150
_SHADES = 400  # colours of a map in shades of grey, with those of its marks and their edges


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches that needs no screen and no global state."""
    return Figure(figsize=(width, height), layout="constrained")


def as_image(figure: Figure) -> Image.Image:
    """A figure in the resolution of print; texts in it are shown as they are, not as formulas."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)  # a file may be called $x$.npz
        text.set_text(text.get_text().encode(errors="backslashreplace").decode())  # or have bytes
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=_DPI, pil_kwargs={"compress_level": 1})
    return Image.open(content).convert("RGB")


def as_png(figure: Figure) -> bytes:
    """A figure as PNG. Unless it has a coloured map, 256 colours suffice, which take a quarter of the size."""
    image = as_image(figure)
    content = io.BytesIO()
    if not figure.findobj(AxesImage) or image.getcolors(_SHADES) is not None:
        image = image.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    image.save(content, "PNG", optimize=True, dpi=(_DPI, _DPI))
    return content.getvalue()
