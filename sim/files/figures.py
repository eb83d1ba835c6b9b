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
    """A figure drawn as fine as print needs; names in it are shown as they are, whatever signs they hold."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)  # a file may be called $x$.npz, or something that is no formula
        text.set_text(text.get_text().encode(errors="backslashreplace").decode())  # or hold bytes that are no text
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=_DPI, pil_kwargs={"compress_level": 1})
    return Image.open(content).convert("RGB")


def as_png(figure: Figure) -> bytes:
    """A figure as PNG, with 256 colours, a quarter of the size, where 256 are enough: not for a coloured map."""
    image, content = as_image(figure), io.BytesIO()
    if not figure.findobj(AxesImage) or image.getcolors(_SHADES) is not None:
        image = image.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    image.save(content, "PNG", optimize=True, dpi=(_DPI, _DPI))
    return content.getvalue()
