"""What a search says: what it will do, and how far it is; and the bar of all work that takes time."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from qd.search.settings import SearchCfg
from qd.workers.invalid import WARNED_SHARE, format_reasons
from sim.controllers.spec import SHIPPED

_CELLS = 10  # of the bar
_PLAIN_EVERY_S = 30.0


def clock(seconds: float) -> str:
    """A duration as people say it: ``45 s``, ``7 min``, ``3.2 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def describe_search(cfg: SearchCfg, path: Path, done: int, device: str, workers: int) -> str:
    """What a search is about to do after ``done`` iterations, by so many processes or GPUs."""
    left, controller = cfg.iterations - done, "its own controller" if cfg.policy == SHIPPED else cfg.policy
    return (
        f"{path}: {left:,} of {cfg.iterations:,} iterations to go, each of {cfg.scheduler.num_terrains} terrains x "
        f"{cfg.replicas} episodes of {cfg.robot} with {controller} on {cfg.space}; in all "
        f"{left * cfg.episodes_per_iteration:,} episodes by {workers} on {device}; preset {cfg.preset}, seed "
        f"{cfg.seed}, {cfg.cells.num_cells:,} reachable cells"
    )


class Bar:
    """How far work is, on stderr: one line of a terminal, with the time left first; elsewhere a line every 30 s.

    The work begins at position ``done`` and ends at ``total``.
    """

    def __init__(self, text: str, total: float = 1.0, done: float = 0.0) -> None:
        self._text, self._total, self._first, self._position = text, total, done, done
        self._began = self._moved = self._written = time.monotonic()
        console = Console(stderr=True, highlight=False)
        self._live = None
        if console.is_terminal and not console.is_dumb_terminal:
            self._live = Live(
                get_renderable=self._line, console=console, refresh_per_second=2, redirect_stdout=sys.stdout.isatty()
            )

    def __enter__(self) -> Self:
        if self._live:
            self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def move_to(self, position: float, text: str | None = None) -> None:
        """Moves to a position; the text stays if there is no other."""
        self._position, self._moved = position, time.monotonic()
        self._text = self._text if text is None else text
        if self._live is None and self._moved - self._written >= _PLAIN_EVERY_S:
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
        return Text.assemble(
            (f"{left:>11}", "bold"), f" {share:4.0%} ", ("━" * filled, "cyan"), ("─" * (_CELLS - filled), "dim"),
            f" {self._text}", no_wrap=True, overflow="ellipsis",
        )  # fmt: skip


def describe_iteration(row: dict[str, Any], iterations: int, workers: object = None) -> str:
    """Where a search stands after an iteration, and how its workers fare if there are any."""
    invalid = row["invalid_episodes"] / row["episodes"]
    why = format_reasons(row["invalid_reasons"]) if invalid > WARNED_SHARE else ""
    return (
        f"iteration {min(row['iteration'] + 1, iterations)}/{iterations}: {row['elites']:,} elites "
        f"({row['expected_same_cell']:,.0f} to stay), "
        + (f"{invalid:.0%} invalid ({why}), " if why else "")
        + f"{row['episodes_per_s']:.0f} episodes/s"
        + (f" by {workers}" if workers else "")
        + f", fitness {row['mean_fitness']:.2f}"
    )
