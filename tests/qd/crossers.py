"""Simulations for workers, over the stand-in: good ones, and one that fails in each way there is."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from tests.qd import stand_in


class Crosser:
    """Crosses by the stand-in."""

    def __init__(self, cfg, num_terrains: int) -> None:
        self.cfg, self.num_terrains = cfg, num_terrains
        self.lots = []

    def put(self, terrains):
        self.lots.append(terrains)
        assert sum(map(len, self.lots)) <= self.num_terrains

    def clear(self):
        self.lots.clear()

    def take(self, progress=None):
        return self.evaluate(self.lots.pop(0), progress=progress)

    def evaluate(self, terrains, *, progress=None):
        assert len(terrains) <= self.num_terrains
        if progress is not None:
            progress(0.5)
            progress(1.0)
        return stand_in.evaluate(terrains.values, terrains.seeds, self.cfg.replicas)


class Failing(Crosser):
    """Fails as the policy's name says: ``<how>:<folder>:<times>``, so often in all, counted by files in the folder."""

    def __init__(self, cfg, num_terrains: int) -> None:
        super().__init__(cfg, num_terrains)
        self.how, self.folder, self.times = cfg.policy.split(":")
        if self.how == "build":
            raise ValueError("policy 'x' does not fit:\nuse another")

    def evaluate(self, terrains, *, progress=None):
        result = super().evaluate(terrains, progress=progress)
        for number in range(int(self.times)):
            try:
                (Path(self.folder) / str(number)).touch(exist_ok=False)
            except FileExistsError:
                continue
            return self.fail(result)
        return result

    def fail(self, result):
        if self.how == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "raise":
            raise RuntimeError("the solver is broken")
        if self.how == "refuse":
            raise ValueError("terrains of another kind")
        if self.how == "sleep":
            time.sleep(60)
        result.penalties[0, 0, 0] = np.nan
        return result
