"""Emitter that drives a search along directions of the ratios, to where the controller has not yet failed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from ribs.archives import GridArchive
from ribs.emitters.opt import CMAEvolutionStrategy, SeparableCMAEvolutionStrategy

from qd.fitness import FITNESS_FLOOR
from sim.terrain import hard_random_genes

_STRATEGIES = {"cma_es": CMAEvolutionStrategy, "sep_cma_es": SeparableCMAEvolutionStrategy}
_CONTENDERS = 8  # elites of which the one furthest along the direction is the start
_LAST = -1.0  # below the projection of any ratios: those lie within sqrt(1 - 1 / P) of equal ones, whose is 0
_NO_SPREAD = 1e-9  # ratios are means of numbers in [0, 1], off by about 1e-16


class DirectionEmitter:
    """Evolution strategy that maximises the terrains' ratios along a random direction, a new one at each restart.

    The random direction emitter of CMA-ME (Fontaine et al. 2020), but for three things: the direction is scaled by the
    spread of the elites' ratios, so that rare penalties count as much as common ones; what ranks is the projection
    alone; and a restart begins at the furthest of a few elites, as the edge of the archive is what is to be moved.

    Args:
        archive: The elites; their ``ratios`` are a field.
        num_ratios: Number of ratios P.
        es: ``cma_es`` or ``sep_cma_es``.
        sigma0: First step size.
        restart_every: Iterations along one direction.
        batch_size: Terrains asked for at once.
        stream: Seed.
    """

    def __init__(
        self,
        archive: GridArchive,
        *,
        num_ratios: int,
        es: str,
        sigma0: float,
        restart_every: int,
        batch_size: int,
        stream: np.random.SeedSequence,
    ) -> None:
        own, of_strategy = stream.spawn(2)
        self.archive, self.batch_size, self.restart_every = archive, batch_size, restart_every
        self.itrs = self.restarts = 0
        self._rng = np.random.default_rng(own)
        self._strategy = _STRATEGIES[es](
            sigma0=sigma0,
            solution_dim=archive.solution_dim,
            batch_size=batch_size,
            seed=of_strategy,
            dtype=np.float32,
        )
        self._strategy.reset(hard_random_genes(1, self._rng)[0])
        self.direction = _unit(self._rng.standard_normal(num_ratios))

    def ask(self) -> NDArray[np.float32]:
        """Genes, unclipped, shape (batch_size, 64)."""
        return self._strategy.ask()

    def tell(self, *, ratios: NDArray[np.float64], objective: NDArray[np.float64], **told: Any) -> None:
        """What became of the terrains last asked for.

        Args:
            ratios: Shape (batch_size, P).
            objective: Fitness, shape (batch_size,); what is no elite, as an invalid terrain, ranks last.
            told: Their other fields, which have no say here.
        """
        self.itrs += 1
        along = np.where(objective > FITNESS_FLOOR, ratios @ self.direction, _LAST)
        order = np.argsort(-along, kind="stable")
        self._strategy.tell(order, along, self.batch_size // 2)
        if self.itrs % self.restart_every == 0 or self._strategy.check_stop(along[order]):
            self._restart()

    def _restart(self) -> None:
        elites: Any = self.archive.data(["solution", "ratios"])
        spread = elites["ratios"].std(axis=0)
        # A ratio that all elites share has no scale to go by.
        self.direction = _unit(self._rng.standard_normal(len(spread)) / np.where(spread > _NO_SPREAD, spread, np.inf))
        drawn = self._rng.integers(len(elites["ratios"]), size=_CONTENDERS)
        start = drawn[np.argmax(elites["ratios"][drawn] @ self.direction)]
        self._strategy.reset(elites["solution"][start])
        self.restarts += 1


def _unit(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """A direction of ratios, which sum to 1: without the part that no terrain can follow, of length 1."""
    direction = direction - direction.mean()
    length = np.linalg.norm(direction)
    return direction / length if length > 0.0 else direction
