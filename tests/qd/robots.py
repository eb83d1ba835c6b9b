"""Robots that arrive or fail by a rule, for tests that look at what is crossed."""

from collections.abc import Callable
from contextlib import contextmanager

import numpy as np

from qd.workers.evaluator import EvaluatorCfg
from sim.rollout import RolloutResult
from tests.qd.stand_in import Stub, make_result


class Robots:
    """Opened like the real evaluator.

    ``rule(cfg, genes, seeds)`` says of each terrain whether all robots collide, or gives a result. ``crossed`` notes
    (cfg, seed, genes) of each terrain. After ``stop_after`` terrains it is as if somebody pressed Ctrl-C.
    """

    def __init__(self, rule: Callable[..., np.ndarray | RolloutResult], stop_after: int | None = None) -> None:
        self.rule, self.stop_after, self.crossed, self.opened = rule, stop_after, [], 0

    @property
    def seeds(self) -> list[int]:
        """Seeds of what was crossed."""
        return [seed for _, seed, _ in self.crossed]

    @contextmanager
    def __call__(self, cfg: EvaluatorCfg):
        self.opened += 1

        def evaluate(genes, seeds):
            if self.stop_after is not None and len(self.crossed) >= self.stop_after:
                raise KeyboardInterrupt
            self.crossed += [(cfg, *row) for row in zip(seeds.tolist(), map(tuple, genes.tolist()), strict=True)]
            result = self.rule(cfg, genes, seeds)
            if isinstance(result, RolloutResult):
                return result
            collided = np.repeat(result[:, None], cfg.num_replicas, axis=1)
            return make_result(np.ones((*collided.shape, 6)), base_collision=collided)

        yield Stub(evaluate)
