"""What a stage of judging is, and what it works with."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from qd.faults.numbers import EPISODES
from qd.faults.searches import Search
from qd.search.archive import Archive
from qd.workers.crosser import Crosser
from qd.workers.pipeline import Engine
from qd.workers.seeds import Stream
from sim.rollout import RolloutResult
from sim.terrains.terrains import Terrains


@dataclass(frozen=True, kw_only=True)
class Judging:
    """A search whose elites are judged, by whom, and the service that lets controllers cross terrains."""

    search: Search
    certifiers: Mapping[str, str]
    """Other controllers by name."""
    crosser: Crosser

    def cross(
        self, archive: Archive, rows: NDArray[np.int64], policy: str, *, stream: Stream, label: str,
        engine: Engine = "search",
    ) -> NDArray[np.int64]:  # fmt: skip
        """Outcomes of 20 episodes of a controller on some elites, shape (len(rows), 4)."""
        seeds = elite_seeds(archive, self.search.cfg.seed, stream=stream)[rows]
        terrains = Terrains(genes=archive.genes[rows], seeds=seeds, space=self.search.space)
        result = self.crosser.cross(
            policy, terrains, replicas=EPISODES, engine=engine, label=label, invalid_ok=True
        )
        return count_outcomes(result)


class Stage(ABC):
    """A step of judging: it crosses elites, and fills a group of the archive's columns."""

    name: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ()
    """Stages that come before. To do one of them again undoes this one."""
    with_certifiers: ClassVar[bool] = False
    """Whether other controllers cross."""

    @abstractmethod
    def is_done(self, archive: Archive) -> bool:
        """Whether the columns of an archive are filled."""

    @abstractmethod
    def run(self, archive: Archive, judging: Judging) -> Archive:
        """The archive with the columns filled anew."""

    def count_crossings(self, certifiers: Mapping[str, str]) -> int:
        """How many times a controller crosses a set of terrains."""
        return 1

    def check(self, archive: Archive, judging: Judging, before: Collection[str]) -> None:  # noqa: B027 - most need none
        """Refuses, before anything is crossed, what cannot be judged; ``before`` are the stages that come first."""


def elite_seeds(archive: Archive, seed: int, times: int = 1, *, stream: int) -> NDArray[np.uint32]:
    """Seeds of episodes on N elites, ``times`` in succession for each, shape (N * times,).

    They follow from the seed of the search and from what names an elite, its cell and the iteration that found it.
    """
    names = zip(archive.iteration.tolist(), archive.cell.tolist(), strict=True)
    rows = [np.random.SeedSequence([seed, *name], spawn_key=(stream,)).generate_state(times) for name in names]
    return np.concatenate([np.zeros(0, np.uint32), *rows]).astype(np.uint32)


def count_outcomes(result: RolloutResult) -> NDArray[np.int64]:
    """Episodes of each terrain by :data:`qd.search.archive.OUTCOMES`, shape (num_terrains, 4)."""
    goal, collided, invalid = (
        flags.sum(axis=1) for flags in (result.reached_goal, result.base_collision, result.invalid)
    )
    return np.stack([goal, collided, result.invalid.shape[1] - goal - collided - invalid, invalid], axis=1)


def put_rows(counts: NDArray[np.int64], rows: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Counts with other values in some rows."""
    counts = counts.copy()
    counts[rows] = values
    return counts
