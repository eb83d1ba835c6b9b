"""A method of search in one file: it moves what it asked for first by more and more."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.search.methods import METHODS, Columns, Method, MethodCfg, Setup


@dataclass(frozen=True, kw_only=True)
class ToyCfg(MethodCfg):
    toy_step: float = 0.001
    """Toy: by how much genes move for each terrain that was crossed."""


class Toy(Method):
    Cfg = ToyCfg
    text = "a toy of the tests"

    def __init__(self, cfg: Any, setup: Setup) -> None:
        super().__init__(cfg, setup)
        self.step, self.num_crossed = cfg.toy_step, 0
        self.first = setup.space.uniform_random(len(setup.emitters) * self.batch_size, 0) * 0.1

    def ask(self, emitters: Sequence[int], pending: NDArray[np.float32]) -> NDArray[Any]:
        rows = [self.first[self.emitters.index(emitter) * self.batch_size :][: self.batch_size] for emitter in emitters]
        return np.concatenate(rows) + np.float32(self.step * self.num_crossed)

    def tell(self, evaluation: Any, rows: Columns, added: Columns, batches: dict[int, slice]) -> None:
        self.num_crossed += len(evaluation.fitness)


METHODS["toy"] = Toy
