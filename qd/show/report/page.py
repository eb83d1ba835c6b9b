"""Pages of HTML by Jinja templates. A page is one file with all that it shows."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

from qd.search.progress import clock
from qd.show.replay import save
from sim.files.atomic import prepare_output
from sim.files.figures import as_image
from sim.files.templates import open_templates

_FIGURE_QUALITY = 80  # of WebP


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text; the first cell names the row."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def encode_picture(image: Image.Image, quality: int = _FIGURE_QUALITY) -> str:
    """Source of an ``img`` element."""
    content = io.BytesIO()
    image.save(content, "WEBP", quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"


def encode_figure(figure: Figure) -> str:
    """Source of an ``img`` element."""
    return encode_picture(as_image(figure))


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


def publish_page(out: Path, template: str, **content: object) -> Path:
    """Writes a page from its template, atomically."""
    environment = open_templates(Path(__file__).parent / "templates")
    environment.filters |= {"percent": percent, "counted": counted, "clock": clock}
    text = environment.get_template(template).render(content)
    page = text.encode("utf-8", errors="backslashreplace")  # a file's name may hold bytes that are no text
    save(out, page, "Report")
    return out


def origin_rows(origin: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Command, commit, device, seed, date and versions, as far as they are known."""
    rows = [(name, str(origin[name])) for name in ("command", "commit", "device", "seed", "date") if name in origin]
    versions = origin.get("versions")
    if isinstance(versions, dict):
        rows.append(("versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    return rows
