"""A page of HTML from plain parts: everything that is put in is escaped, everything that is shown is in the file."""

import base64
import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from sim.files.atomic import write_atomically
from sim.files.figures import as_png

MAX_BYTES = 15_000_000
"""Most that a page may weigh."""
_FOLDER = Path(__file__).parent
# Nothing may be fetched, whatever else the page says.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


class Picture(NamedTuple):
    """A figure: it is in the page, and beside it under the same name."""

    name: str
    """Of its file, *.png or *.jpg."""
    content: bytes
    shows: str
    """What it shows, for who cannot see it."""

    @property
    def source(self) -> str:
        """What an image of the page has as its source."""
        kind = "jpeg" if self.name.endswith(".jpg") else "png"
        return f"data:image/{kind};base64,{base64.b64encode(self.content).decode()}"


class Cards(NamedTuple):
    """Pictures side by side, each with a title and a text below, and the anchor that the title leads to."""

    cards: "Sequence[tuple[Picture, str, str, str]]"


class Folded(NamedTuple):
    """Blocks behind a line of text that opens them."""

    summary: str
    blocks: "Sequence[Block]"
    anchor: str = ""
    opened: bool = False
    """Whether they are to be seen at first."""


Block = str | Picture | Cards | Folded
"""A part of a section: HTML, in which what was put in is escaped, or something with figures."""


class Section(NamedTuple):
    """A chapter."""

    title: str
    anchor: str
    blocks: Sequence[Block]


def paragraph(text: str, *, kind: str = "") -> str:
    """A paragraph, of a class of the style if one is named; what stands between backticks in it is a command."""
    words = re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))
    return f'<p class="{kind}">{words}</p>' if kind else f"<p>{words}</p>"


def absent(text: str, command: str = "") -> str:
    """What is not there, and the command that makes it."""
    return f'<p class="absent">{escape(text)}{f" <code>{escape(command)}</code>" if command else ""}</p>'


def at_a_glance(facts: Sequence[tuple[str, str]]) -> str:
    """Numbers in large print: what each counts, and the number."""
    cells = "".join(f"<div><dt>{escape(what)}</dt><dd>{escape(value)}</dd></div>" for what, value in facts)
    return f'<dl class="facts">{cells}</dl>'


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    keys: Sequence[Sequence[str]] | None = None,
    links: Sequence[str] | None = None,
    opens: Sequence[Picture] | None = None,
    words: bool = False,
    folded: str = "",
) -> str:
    """A table, whose first cells name the rows.

    Args:
        head: Of each column.
        rows: Of cells.
        keys: What rows are sorted by at a click, cell by cell; without them they are not.
        links: Anchor that the first cell of each row leads to; empty: none.
        opens: Picture that a click on each row opens below it; these have no files of their own.
        words: Whether cells are sentences and not numbers: they are broken into lines.
        folded: If any, what stands on the fold that hides it at first.
    """
    titles = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    kind = ' class="sortable"' if keys else ' class="words"' if words else ""
    body = "".join(
        _row(row, keys[k] if keys else None, links[k] if links else "", opens[k] if opens else None)
        for k, row in enumerate(rows)
    )
    text = f'<div class="scroll"><table{kind}><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table></div>'
    return f"<details><summary>{escape(folded)}</summary>{text}</details>" if folded else text


def _row(row: Sequence[str], keys: Sequence[str] | None, link: str, opens: Picture | None) -> str:
    name, *cells = map(escape, row)
    if link:
        name = f'<a href="#{escape(link)}">{name}</a>'
    first, *others = [f' data-key="{escape(key)}"' for key in keys] if keys else [""] * len(row)
    data = "".join(f"<td{key}>{cell}</td>" for key, cell in zip(others, cells, strict=True))
    shown = f' data-opens="{opens.source}" data-shows="{escape(opens.shows)}"' if opens else ""
    return f'<tr{shown}><th scope="row"{first}>{name}</th>{data}</tr>'


def render(title: str, lead: str, sections: Sequence[Section]) -> bytes:
    """The whole page."""
    links = "".join(f'<li><a href="#{escape(part.anchor)}">{escape(part.title)}</a></li>' for part in sections)
    body = "".join(
        f'<section id="{escape(anchor)}"><h2>{escape(heading)}</h2>{"".join(map(_html, blocks))}</section>\n'
        for heading, anchor, blocks in sections
    )
    style, script = ((_FOLDER / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    text = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>\n<main>\n"
        f"<nav><ul>{links}</ul></nav>\n<h1>{escape(title)}</h1>\n{paragraph(lead, kind='lead')}\n{body}</main>\n"
        f"<script>{script}</script>\n</body>\n</html>\n"
    )
    return text.encode("utf-8", errors="backslashreplace")  # a file's name may hold bytes that are no text


def picture(name: str, figure: Figure, shows: str) -> Picture:
    """A figure as a part of the page."""
    return Picture(f"{name}.png", as_png(figure), shows)


def percent(share: float) -> str:
    """A share as people read it: 0 and 100 % only of none and all."""
    text = f"{100.0 * share:.1f}" if 0.0 < share < 1.0 and not 0.095 <= share < 0.995 else f"{100.0 * share:.0f}"
    if (text == "0.0" and share > 0.0) or (text == "100.0" and share < 1.0):
        text = "less than 0.1" if share < 0.5 else "over 99.9"
    return f"{text} %"


def counted(number: int, noun: str, many: str = "") -> str:
    """A number with its noun: ``1 elite``, ``459 elites``."""
    return f"{number:,} {noun if number == 1 else many or f'{noun}s'}"


def pictures_of(sections: Sequence[Section]) -> list[Picture]:
    """All figures of a page, in order."""
    return [picture for section in sections for block in section.blocks for picture in _pictures_in(block)]


def _pictures_in(block: Block) -> Iterator[Picture]:
    if isinstance(block, Picture):
        yield block
    elif isinstance(block, Cards):
        yield from (picture for picture, *_ in block.cards)
    elif isinstance(block, Folded):
        yield from (picture for part in block.blocks for picture in _pictures_in(part))


def publish_page(out: Path, title: str, lead: str, sections: Sequence[Section]) -> Path:
    """Writes figures and page, the page last: it is whole or as it was."""
    page, pictures = render(title, lead, sections), pictures_of(sections)
    if len(page) > MAX_BYTES:
        raise ValueError(f"the page must have at most {MAX_BYTES:,} bytes, got {len(page):,}: show fewer --elites")
    figures = out.with_name(f"{out.stem}-figures")
    figures.mkdir(exist_ok=True)
    for picture in pictures:
        write_atomically(figures / picture.name, picture.content)
    write_atomically(out, page)
    print(f"{counted(len(pictures), 'figure')} under {figures}")
    print(f"Report: {out} ({len(page) / 1e6:.1f} MB; opens in a browser, without a network)")
    return out


def origin_table(origin: Mapping[str, Any]) -> list[list[str]]:
    """Rows of a table that says where numbers come from."""
    rows = [[name, str(origin[name])] for name in ("command", "commit", "device", "seed", "date") if name in origin]
    versions = origin.get("versions")
    if isinstance(versions, dict):
        rows.append(["versions", ", ".join(f"{name} {version}" for name, version in versions.items())])
    return rows


def _html(block: Block) -> str:
    if isinstance(block, Picture):
        return f"<figure>{_image(block)}</figure>"
    if isinstance(block, Cards):
        cards = (
            f'<figure>{_image(shown)}<figcaption><a href="#{escape(link)}"><b>{escape(title)}</b></a>{paragraph(text)}'
            "</figcaption></figure>"
            for shown, title, text, link in block.cards
        )
        return f'<div class="cards">{"".join(cards)}</div>'
    if isinstance(block, Folded):
        anchor = f' id="{escape(block.anchor)}"' if block.anchor else ""
        inner = "".join(map(_html, block.blocks))
        return f"<details{anchor}{' open' * block.opened}><summary>{escape(block.summary)}</summary>{inner}</details>"
    return block


def _image(picture: Picture) -> str:
    return f'<img alt="{escape(picture.shows)}" src="{picture.source}">'
