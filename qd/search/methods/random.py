"""Random terrains, which learn nothing: what other methods are compared with."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.search.methods.base import Method, Setup


class UniformRandom(Method):
    """Genes drawn uniformly from [-1, 1], anew each time."""

    text = "genes drawn uniformly, which learns nothing"

    def _make_source(self, cfg: Any, setup: Setup, stream: np.random.SeedSequence) -> Any:
        return np.random.default_rng(stream)

    def ask(self, emitters: Sequence[int], pending: NDArray[np.float32]) -> NDArray[Any]:
        """Random genes."""
        return np.concatenate([self._draw(self.sources[emitter]) for emitter in emitters])

    def _draw(self, rng: np.random.Generator) -> NDArray[np.float32]:
        return self.space.uniform_random(self.batch_size, rng)


class HardRandom(UniformRandom):
    """Terrains drawn anew each time, as hard as the space allows: the paper's baseline."""

    text = "the paper's random terrains, every height at its limit, which learn nothing"

    def _draw(self, rng: np.random.Generator) -> NDArray[np.float32]:
        return self.space.hard_random(self.batch_size, rng)
