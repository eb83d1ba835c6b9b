"""A page of HTML from plain parts: everything that is put in is escaped, everything that is shown is in the file."""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from qd.run.progress import clock
from qd.show.figures import as_png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FOLDER = Path(__file__).parent
# Nothing may be fetched, whatever else the page says.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Heading:
    """Of a part of a section."""

    text: str
    anchor: str = ""
    """What a link to it says after ``#``."""


@dataclass(frozen=True)
class Absent:
    """What is not there, and the command that makes it."""

    text: str
    command: str = ""


@dataclass(frozen=True)
class Facts:
    """Numbers at a glance: each with what it counts."""

    facts: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Picture:
    """A figure: its PNG is in the page, and beside it under the same name."""

    name: str
    png: bytes
    shows: str
    """What it shows, for who cannot see it."""


@dataclass(frozen=True)
class Table:
    """Rows of cells; the first of each names the row."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    sortable: bool = False
    keys: Sequence[Sequence[float | str]] | None = None
    """What rows are sorted by, cell by cell, where the text would not do."""
    links: Sequence[str] | None = None
    """Anchor that the first cell of each row leads to; empty: none."""
    words: bool = False
    """Whether cells are sentences and not numbers: they are broken into lines."""
    folded: str = ""
    """If any, what stands on the fold that hides it at first."""


Block = Text | Heading | Absent | Facts | Picture | Table


@dataclass
class Section:
    """A chapter."""

    title: str
    anchor: str
    blocks: list[Block] = field(default_factory=list)


def render(title: str, lead: str, sections: Sequence[Section]) -> bytes:
    """The whole page.

    Args:
        title: Of the page.
        lead: What stands under it.
        sections: In order.
    """
    links = "".join(f'<li><a href="#{escape(one.anchor)}">{escape(one.title)}</a></li>' for one in sections)
    body = "".join(
        f'<section id="{escape(one.anchor)}"><h2>{escape(one.title)}</h2>{"".join(map(_block, one.blocks))}</section>\n'
        for one in sections
    )
    style, script = ((_FOLDER / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    text = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{escape(title)}</h1>\n<p>{escape(lead)}</p>\n<nav><ul>{links}</ul></nav>\n{body}</main>\n"
        f"<script>{script}</script>\n</body>\n</html>\n"
    )
    return text.encode("utf-8", errors="backslashreplace")  # a file's name may hold bytes that are no text


def picture(name: str, figure: "Figure", shows: str) -> Picture:
    """A figure as a part of the page.

    Args:
        name: Of its file, without .png.
        figure: What to draw.
        shows: What it shows, for who cannot see it.
    """
    return Picture(f"{name}.png", as_png(figure), shows)


def percent(share: float) -> str:
    """A share as people read it: 0 and 100 % only of none and all."""
    text = f"{100.0 * share:.1f}" if 0.0 < share < 1.0 and not 0.095 <= share < 0.995 else f"{100.0 * share:.0f}"
    if (text == "0.0" and share > 0.0) or (text == "100.0" and share < 1.0):
        text = "less than 0.1" if share < 0.5 else "over 99.9"
    return f"{text} %"


def hours(seconds: float) -> str:
    """A long duration."""
    return f"{seconds / 3600:,.0f} hours" if seconds > 36_000 else clock(seconds)


def counted(number: int, one: str, many: str = "") -> str:
    """A number with its noun: ``1 elite``, ``459 elites``."""
    return f"{number:,} {one if number == 1 else many or f'{one}s'}"


def pictures_of(sections: Sequence[Section]) -> list[Picture]:
    """All figures of a page, in order."""
    return [block for section in sections for block in section.blocks if isinstance(block, Picture)]


def _block(block: Block) -> str:
    match block:
        case Text(text):
            return f"<p>{_with_commands(text)}</p>"
        case Heading(text, anchor):
            return f'<h3 id="{escape(anchor)}">{escape(text)}</h3>' if anchor else f"<h3>{escape(text)}</h3>"
        case Absent(text, command):
            return f'<p class="absent">{escape(text)}{f" <code>{escape(command)}</code>" if command else ""}</p>'
        case Facts(facts):
            cells = "".join(f"<div><dt>{escape(what)}</dt><dd>{escape(value)}</dd></div>" for what, value in facts)
            return f'<dl class="facts">{cells}</dl>'
        case Picture(_, png, shows):
            data = base64.b64encode(png).decode()
            return f'<figure><img alt="{escape(shows)}" src="data:image/png;base64,{data}"></figure>'
        case Table():
            return _table(block)


def _with_commands(text: str) -> str:
    """Escaped text; what stands between backticks is a command."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.head)
    rows = "".join(_row(table, k) for k in range(len(table.rows)))
    kind = ' class="sortable"' if table.sortable else ' class="words"' if table.words else ""
    text = f'<div class="scroll"><table{kind}><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    return f"<details><summary>{escape(table.folded)}</summary>{text}</details>" if table.folded else text


def _row(table: Table, k: int) -> str:
    cells = [escape(cell) for cell in table.rows[k]]
    if table.links and table.links[k]:
        cells[0] = f'<a href="#{escape(table.links[k])}">{cells[0]}</a>'
    keys = [""] * len(cells) if table.keys is None else [f' data-key="{escape(str(key))}"' for key in table.keys[k]]
    first = f'<th scope="row"{keys[0]}>{cells[0]}</th>'
    return f"<tr>{first}{''.join(f'<td{key}>{cell}</td>' for key, cell in zip(keys[1:], cells[1:], strict=True))}</tr>"
