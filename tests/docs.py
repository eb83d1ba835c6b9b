"""What README and the pages of docs/ say that can be held to the project: commands, code, links, numbers."""

import importlib
import json
import os
import re
import shlex
import subprocess
import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = {str(path.relative_to(ROOT)): path for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]}
"""The pages by name, such as ``docs/faults.md``."""
_NUMBER = re.compile(r"(?<![\w.])(?:\d+(?:,\d{3})*(?:\.\d+)?|\.\d+)(?!\w)")
_NO_PROSE = (
    r"<!-- table:.*?<!-- end -->", r"<!--.*?-->", r"^```.*?^```$", r"`[^`\n]*`", r"\]\([^)\s]*\)", r"https?://\S+",
)  # fmt: skip
_LISTS = ("docs/controllers.md", "docs/reference.md", "docs/terrains.md")
"""Pages whose tables say what files and genes hold; of these, elements and conditions are compared with the code."""
_FUNCTIONS = {"__builtins__": {}, "len": len, "max": max, "min": min, "round": round, "sum": sum}
"""What an expression may call."""
_KINDS = (
    r"arXiv \d+\.\d+", r"Python 3\.\d+", "95 %", r"Apache-2\.0", r"exit status is \d+", r"seed \d",
    r"\d GB of disk", "RTX 3070", r"legged_gym's grid is 0\.1 m",
)  # fmt: skip
"""Numbers that no file has: of others' papers and code, of versions, the level of all intervals, exit statuses."""


def text_of(page: str) -> str:
    """The whole of a page."""
    return PAGES[page].read_text(encoding="utf-8")


def code_of(page: str, language: str = "") -> list[str]:
    """Code blocks of a page in a language; without one those of a shell."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text_of(page), re.MULTILINE | re.DOTALL)
    return [code for name, code in blocks if name == language]


def table_of(*head: str) -> list[list[str]]:
    """Cells of the rows of the only table of any page whose head begins with these columns."""
    tables = [table for page in PAGES for table in re.findall(r"^((?:\|.*\n)+)", text_of(page), re.MULTILINE)]
    rows = [[[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()] for table in tables]
    (found,) = [body for first, _, *body in rows if first[: len(head)] == [*head]]
    return found


def commands_of(page: str) -> list[str]:
    """Command lines in the code blocks of a page that call ``faultline`` or ``make``, through torchrun too."""
    lines = []
    for line in "\n".join(code_of(page)).replace("&&", "\n").replace(".venv/bin/", "").splitlines():
        words = [word for word in shlex.split(line, comments=True) if not re.fullmatch(r"[A-Z]+_[A-Z_]+=.*", word)]
        if words and words[0] == "torchrun":
            words = words[words.index("-m") + 1 :]
        if words and words[0] in ("faultline", "make"):
            lines.append(shlex.join(words))
    return lines


def run_by_make(words: Sequence[str]) -> list[str]:
    """The last command that ``make`` would run, word by word; nothing runs.

    ``make`` runs without the environment: one that runs the tests would hand on its own flags.
    """
    how = {"env": {"PATH": os.environ["PATH"]}, "cwd": ROOT, "capture_output": True, "text": True, "check": True}
    return shlex.split(subprocess.run([*words, "--dry-run"], **how).stdout.splitlines()[-1])


def prose_of(page: str) -> str:
    """A page without code, tables that scripts write, comments and targets of links, each white space as one blank."""
    text = text_of(page)
    for pattern in (*_NO_PROSE, *[r"^\|.*?$"] * (page in _LISTS)):
        text = re.sub(pattern, " ", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"\s+", " ", text)


class Number(NamedTuple):
    """A number in a text of a page, and the source and expression that say what it is."""

    page: str
    text: str
    number: str
    source: str
    expression: str

    @property
    def value(self) -> float:
        """What the source says."""
        return float(eval(self.expression, {**_FUNCTIONS, **_content(self.source)}))

    def is_rounded(self, value: float) -> bool:
        """Whether the number is a value, to as many digits as it has."""
        plain = self.number.replace(",", "")
        return abs(value - float(plain)) <= 0.5 * 10.0 ** -len(plain.partition(".")[2]) + 1e-9


def numbers() -> list[Number]:
    """All of docs/numbers.toml."""
    rows, pages = [], tomllib.loads((ROOT / "docs/numbers.toml").read_text(encoding="utf-8"))
    for page, text, sources in ((page, *pair) for page, texts in pages.items() for pair in texts.items()):
        parts = [part.split(": ", 1) for part in sources.split(" | ")]
        expressions = [(source, expression) for source, several in parts for expression in several.split("; ")]
        columns = (_NUMBER.findall(text), *zip(*expressions, strict=True))
        rows += [Number(page, text, *row) for row in zip(*columns, strict=True)]
    return rows


def unknown_numbers(page: str) -> list[str]:
    """Numbers of a page's prose that docs/numbers.toml does not have, of no such kind, with the words about them."""
    prose = prose_of(page)
    known = {re.escape(row.text) for row in numbers() if row.page in (page, "constants")}
    spans = [match.span() for pattern in (*known, *_KINDS) for match in re.finditer(pattern, prose)]
    return [
        prose[max(match.start() - 30, 0) : match.end() + 20]
        for match in _NUMBER.finditer(prose)
        if not any(start <= match.start() and match.end() <= end for start, end in spans)
    ]


class _Keys(dict):
    """A JSON object whose keys are attributes too."""

    __getattr__ = dict.__getitem__


@cache
def _content(source: str) -> dict[str, Any]:
    if "/" not in source:
        return vars(importlib.import_module(source))
    return json.loads((ROOT / source).read_text(encoding="utf-8"), object_hook=_Keys)
