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
    """A search whose elites are judged, other controllers by name, and the service that crosses terrains."""

    search: Search
    certifiers: Mapping[str, str]
    crosser: Crosser

    def cross(
        self, archive: Archive, rows: NDArray[np.int64], policy: str, engine: Engine, *, stream: Stream, label: str
    ) -> NDArray[np.int64]:
        """Outcomes of 20 episodes of a controller on some elites, shape (len(rows), 4)."""
        seeds = elite_seeds(archive, self.search.cfg.seed, stream=stream)[rows]
        terrains = Terrains(genes=archive.genes[rows], seeds=seeds, space=self.search.space)
        result = self.crosser.cross(policy, terrains, replicas=EPISODES, engine=engine, label=label, invalid_ok=True)
        return count_outcomes(result)


class Stage(ABC):
    """A step of judging: it crosses elites, and fills a group of the archive's columns."""

    name: ClassVar[str]
    calls: ClassVar[tuple[int, int]] = (1, 0)
    """How often the controller that was searched crosses a set of terrains, and each certifier."""

    def check(self, archive: Archive, judging: Judging, before: Collection[str]) -> None:
        """Refuses, before anything is crossed, what cannot be judged; ``before`` are the stages that come first."""
        if archive.fresh is None and "fresh" not in before:
            raise ValueError(f"stages must begin with fresh, got none: {judging.search.run} has no fresh episodes")

    @abstractmethod
    def run(self, archive: Archive, judging: Judging) -> Archive:
        """The archive with the stage's columns filled anew."""


def elite_seeds(archive: Archive, seed: int, times: int = 1, *, stream: int) -> NDArray[np.uint32]:
    """Seeds of episodes on N elites, ``times`` in succession for each, shape (N * times,).

    They follow from the seed of the search and from what names an elite, its cell and the iteration that found it.
    """
    names = zip(archive.iteration.tolist(), archive.cell.tolist(), strict=True)
    rows = [np.random.SeedSequence([seed, *name], spawn_key=(stream,)).generate_state(times) for name in names]
    return np.concatenate([np.zeros(0, np.uint32), *rows]).astype(np.uint32)


def count_outcomes(result: RolloutResult) -> NDArray[np.int64]:
    """Episodes of each terrain by :data:`qd.search.archive.OUTCOMES`, shape (num_terrains, 4)."""
    flags = (result.reached_goal, result.base_collision, result.invalid)
    goal, collided, invalid = (flag.sum(axis=1) for flag in flags)
    return np.stack([goal, collided, result.invalid.shape[1] - goal - collided - invalid, invalid], axis=1)
