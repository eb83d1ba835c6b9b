"""What a search says: what it will do, how long that should take, and how far it is."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from qd.run.settings import SearchCfg
from qd.workers.invalid import WARNED_SHARE, reason_words

_FORMAT = "{percentage:3.0f}%|{bar:12}| {desc} [{elapsed}, ETA {remaining}]"


def clock(seconds: float) -> str:
    """A duration as people say it: ``45 s``, ``7 min``, ``3.2 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def describe_search(cfg: SearchCfg, path: Path, done: int, device: str, workers: int) -> str:
    """What a search is about to do after ``done`` iterations, by so many processes or GPUs."""
    left = cfg.iterations - done
    return (
        f"{path}: {left:,} of {cfg.iterations:,} iterations to go, each of {cfg.scheduler.num_terrains} terrains x "
        f"{cfg.replicas} episodes of {cfg.robot} with the {cfg.policy} controller on {cfg.space}\n"
        f"  {left * cfg.episodes_per_iteration:,} episodes by {workers} on {device}; preset {cfg.preset}, seed "
        f"{cfg.seed}, {cfg.cells.num_cells:,} reachable cells"
    )


@contextmanager
def share_bar(what: str) -> Iterator[Callable[[float], None]]:
    """A bar over one piece of work; yields a function that moves it to the share that is done."""
    with tqdm(total=1.0, desc=what, file=sys.stderr, dynamic_ncols=True, mininterval=0.5, bar_format=_FORMAT) as bar:

        def move_to(share: float) -> None:
            bar.update(share - bar.n)

        yield move_to


class ProgressBar(tqdm):
    """A bar over iterations, some of them done before, that moves within them; closes on leaving its context."""

    def __init__(self, iterations: int, done: int) -> None:
        self._iterations, self._first = iterations, done
        super().__init__(
            total=iterations, initial=done, file=sys.stderr, dynamic_ncols=True, mininterval=0.5, bar_format=_FORMAT
        )
        self._describe(done, "compiling and evaluating")

    def within(self, iteration: int, part: int = 0, parts: int = 1) -> Callable[[float], None]:
        """A function that moves the bar to a share of an iteration, counted from 1, or of one of its equal parts."""
        return lambda share: self._move_to(iteration - 1 + (part + share) / parts)

    def show(self, row: dict[str, Any], workers: object = None) -> None:
        """Shows where the search stands after an iteration, and how its workers fare if there are any."""
        self._move_to(row["iteration"])
        if row["iteration"] == self._first + 1:
            left = (self._iterations - row["iteration"]) * row["wall_s"]
            self.write(f"First iteration: {row['wall_s']:.1f} s; about {clock(left)} to go.", file=sys.stderr)
        invalid = row["invalid_episodes"] / row["episodes"]
        why = reason_words(row["invalid_reasons"]) if invalid > WARNED_SHARE else ""
        self._describe(
            row["iteration"],
            f"{row['elites']} elites ({row['reachable_coverage']:.1%} of reachable), QD {row['qd_score']:.0f}, "
            f"mean fitness {row['mean_fitness']:.2f}, {row['episodes_per_s']:.1f} episodes/s"
            + (f" by {workers}" if workers else "")
            + (f", {invalid:.0%} invalid ({why})" if why else ""),
        )

    def _describe(self, done: int, state: str) -> None:
        self.set_description_str(f"iteration {min(done + 1, self._iterations)}/{self._iterations}: {state}")

    def _move_to(self, position: float) -> None:
        self.update(position - self.n)
