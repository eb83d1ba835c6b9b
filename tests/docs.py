"""What README and the pages of docs/ say that can be held to the project: commands, code, links, numbers."""

import json
import os
import re
import shlex
import subprocess
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).parents[1]
PAGES = {str(path.relative_to(ROOT)): path for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]}
"""The pages by name, such as ``docs/search.md``."""
_PROGRAMS = ("faultline", "make")


def text_of(page: str) -> str:
    """The whole of a page."""
    return PAGES[page].read_text(encoding="utf-8")


def code_of(page: str, language: str = "") -> list[str]:
    """Code blocks of a page in a language; without one those of a shell."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text_of(page), re.MULTILINE | re.DOTALL)
    return [code for name, code in blocks if name == language]


def commands_of(page: str) -> list[str]:
    """Command lines in the code blocks of a page that call ``faultline`` or ``make``, through torchrun too."""
    lines = []
    for line in "\n".join(code_of(page)).splitlines():
        try:
            words = shlex.split(line, comments=True)
        except ValueError:  # a drawing
            continue
        while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
            words.pop(0)
        if words and words[0].endswith("torchrun"):
            words = words[words.index("-m") + 1 :]
        if words and words[0] in _PROGRAMS:
            lines.append(shlex.join(words))
    return lines


def run_by_make(words: Sequence[str]) -> list[str]:
    """The last command that ``make`` would run, word by word; nothing runs.

    ``make`` runs without the environment: one that runs the tests would hand on its own flags.
    """
    done = subprocess.run(
        [*words, "--dry-run"], env={"PATH": os.environ["PATH"]}, cwd=ROOT, capture_output=True, text=True, check=True,
        timeout=60,
    )  # fmt: skip
    return shlex.split(done.stdout.splitlines()[-1])


class Number(NamedTuple):
    """A number of a page with what it must be."""

    page: str
    file: str
    text: str
    expression: str
    found: bool
    """Whether it stands in the block above its comment, after the number before it."""

    def __str__(self) -> str:
        return f"{self.page}: {self.text} = {self.expression} of {self.file}"

    @property
    def value(self) -> float:
        """What the file says."""
        content = _content(self.file)
        names = {"this": content, "abs": abs, "len": len, "max": np.max, "round": round}
        names |= {"sum": np.sum, "mean": np.mean, "median": np.median}
        keys = content if isinstance(content, dict) else {}
        return float(eval(self.expression, {"__builtins__": {}}, {**names, **keys}))

    @property
    def agrees(self) -> bool:
        """Whether the file says the same, to as many digits as the text has."""
        plain = self.text.replace(",", "")
        return abs(self.value - float(plain)) <= 0.5 * 10.0 ** -len(plain.partition(".")[2]) + 1e-9


def numbers_of(page: str) -> Iterator[Number]:
    """Numbers of a page that say where they come from.

    A comment after a block of text names a file and has entries ``number = expression``, each on a line or behind a
    semicolon.
    """
    text = text_of(page)
    comment = re.compile(r"^<!-- (results/\S+|sim/robots/\w+/\S+)\n(.*?)^-->$", re.MULTILINE | re.DOTALL)
    for match in comment.finditer(re.sub(r"^```text.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)):
        before = comment.sub("", match.string[: match.start()]).rstrip()
        block, at = before.split("\n\n")[-1], 0
        for entry in filter(None, (entry.strip() for entry in re.split(r"[;\n]", match[2]))):
            number, _, expression = entry.partition(" = ")
            place = re.compile(rf"(?<![\d.,]){re.escape(number)}(?!\d|[.,]\d)").search(block, at)
            at = place.end() if place else at
            yield Number(page, match[1], number, expression, place is not None)


class _Keys(dict):
    """A JSON object whose keys are attributes too."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None


@cache
def _content(file: str) -> Any:
    path = ROOT / file
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".jsonl":
        return [json.loads(line, object_hook=_Keys) for line in text.splitlines()]
    return json.loads(text, object_hook=_Keys)
