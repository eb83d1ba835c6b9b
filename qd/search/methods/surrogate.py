"""Elites varied for some generations that networks judge before robots cross the best (after DSAGE)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.search.methods.base import Columns, Method, Setup
from qd.search.surrogate.cfg import SurrogateCfg


class SurrogateSearch(Method):
    """One surrogate for all of its emitters, which learns from the terrains of all methods."""

    Cfg = SurrogateCfg
    text = "elites varied for some generations that networks judge (after DSAGE, Bhatt et al. 2022)"

    def __init__(self, cfg: Any, setup: Setup) -> None:
        from qd.search.surrogate.surrogate import Surrogate

        super().__init__(cfg, setup)
        self.archive = setup.archive
        self.surrogate = Surrogate(cfg, setup.cells, setup.space, setup.stream(2 + cfg.emitters))

    def ask(self, emitters: Sequence[int], pending: NDArray[np.float32]) -> NDArray[Any]:
        """What one search by the networks proposes for all of these emitters: no two ask for the same."""
        elites: Any = self.archive.data()
        count = len(emitters) * self.batch_size
        return self.surrogate.propose(count, elites["genes"], elites["index"], elites["objective"], pending)

    def tell(self, evaluation: Any, rows: Columns, added: Columns, batches: dict[int, slice]) -> None:
        """Trains the networks on what became of all terrains."""
        self.surrogate.learn(rows["solution"], evaluation)

    def compute_on(self, device: str) -> None:
        """Moves the networks to a Warp device."""
        self.surrogate.compute_on(device)
