"""How far work is that takes time."""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack

from rich.console import Console
from rich.live import Live
from rich.text import Text

_CELLS = 10  # of the bar
_PLAIN_EVERY_S = 30.0


def clock(seconds: float) -> str:
    """A duration as people say it: ``45 s``, ``7 min``, ``3.2 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class Bar(ExitStack):
    """How far work is from ``done`` to ``total``, on stderr: one line of a terminal; elsewhere a line every 30 s."""

    def __init__(self, text: str, total: float = 1.0, done: float = 0.0) -> None:
        super().__init__()
        self._text, self._total, self._first, self._position = text, total, done, done
        self._began = self._moved = self._written = time.monotonic()
        console = Console(stderr=True, highlight=False)
        self._is_live = console.is_terminal and not console.is_dumb_terminal
        if self._is_live:
            captured = sys.stdout.isatty()
            live = Live(get_renderable=self._line, console=console, refresh_per_second=2, redirect_stdout=captured)
            live.start(refresh=True)
            self.callback(live.stop)

    def move_to(self, position: float, text: str | None = None) -> None:
        """Moves to a position; the text stays if there is no other."""
        self._position, self._moved = position, time.monotonic()
        self._text = self._text if text is None else text
        if not self._is_live and self._moved - self._written >= _PLAIN_EVERY_S:
            self._written = self._moved
            print(self._line().plain, file=sys.stderr, flush=True)

    def within(self, begin: float, size: float) -> Callable[[float], None]:
        """A function that moves to a share of a part of the work, which begins at a position and has a size."""
        return lambda share: self.move_to(begin + share * size)

    def _line(self) -> Text:
        """Time left, share, bar and text; what does not fit is cut off at the end."""
        share, left = self._position / self._total, "..."
        if self._position > self._first:
            rate = (self._position - self._first) / max(self._moved - self._began, 1e-9)
            since = time.monotonic() - self._moved
            left = f"{clock(max(0.0, (self._total - self._position) / rate - since))} left"
        filled = round(_CELLS * share)
        bar = ("━" * filled, "cyan"), ("─" * (_CELLS - filled), "dim")
        texts = (f"{left:>11}", "bold"), f" {share:4.0%} ", *bar, f" {self._text}"
        return Text.assemble(*texts, no_wrap=True, overflow="ellipsis")
