"""Robots that arrive or fail by a rule, for tests that look at what is crossed."""

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from qd.workers.pipeline import PipelineCfg
from sim.robots.find import get_robot
from sim.rollout import RolloutResult
from tests.qd import stand_in

OTHER = {"C-G": str(get_robot("anymal").panel / "C-G.pt")}
"""A controller that certifies."""


def by_stand_in(cfg, genes, seeds):
    return stand_in.evaluate(genes, seeds, cfg.replicas)


def bump_stops(cfg, genes, seeds):
    """Nobody crosses bump 4 where it is higher than .1 m; C-G crosses everything."""
    return (np.abs(genes[:, 4 * 8 + 7]) > 0.4) & ("C-G" not in cfg.policy)


class Robots:
    """Opened like the real evaluator.

    ``rule(cfg, genes, seeds)`` says of each terrain whether all robots collide, or gives a result. ``opened`` notes the
    settings of each simulation, the last of which is ``pipeline``, ``crossed`` (cfg, seed) of each terrain. After
    ``stop_after`` terrains it is as if somebody pressed Ctrl-C.
    """

    def __init__(
        self, rule: Callable[..., np.ndarray | RolloutResult] = by_stand_in, stop_after: int | None = None
    ) -> None:
        self.rule, self.stop_after, self.crossed, self.opened = rule, stop_after, [], []

    @property
    def seeds(self) -> list[int]:
        """Seeds of what was crossed."""
        return [seed for _, seed in self.crossed]

    @contextmanager
    def __call__(self, cfg: PipelineCfg):
        self.opened.append(cfg)

        def evaluate(genes, seeds):
            if self.stop_after is not None and len(self.crossed) >= self.stop_after:
                raise KeyboardInterrupt
            self.crossed += [(cfg, seed) for seed in seeds.tolist()]
            result = self.rule(cfg, genes, seeds)
            if not isinstance(result, RolloutResult):
                collided = np.repeat(result[:, None], cfg.replicas, axis=1)
                result = stand_in.make_result(np.ones((*collided.shape, 6)), base_collision=collided)
            return replace(result, reward=np.full(result.outcome.shape, 9.0)) if cfg.reward else result

        self.pipeline = stand_in.Stub(evaluate)
        yield self.pipeline
