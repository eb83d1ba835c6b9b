"""Simulations for workers, over the stand-in: good ones, and one that fails in each way there is."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from tests.qd import stand_in


class Crosser(stand_in.Stub):
    """Crosses by the stand-in."""

    def __init__(self, cfg, num_terrains: int) -> None:
        super().__init__(lambda genes, seeds: stand_in.evaluate(genes, seeds, cfg.replicas))
        self.cfg, self.num_terrains = cfg, num_terrains

    def put(self, terrains):
        super().put(terrains)
        assert sum(map(len, self.lots)) <= self.num_terrains

    def take(self, progress=None):
        if progress is not None:
            progress(0.5)
            progress(1.0)
        return super().take()


class Failing(Crosser):
    """Fails as the policy's name says: ``<how>:<folder>:<times>``, so often in all, counted by files in the folder."""

    def __init__(self, cfg, num_terrains: int) -> None:
        super().__init__(cfg, num_terrains)
        self.how, self.folder, self.times = cfg.policy.split(":")
        if self.how == "build":
            raise ValueError("policy 'x' does not fit:\nuse another")

    def take(self, progress=None):
        result = super().take(progress)
        for number in range(int(self.times)):
            try:
                (Path(self.folder) / str(number)).touch(exist_ok=False)
            except FileExistsError:
                continue
            self.fail(result)
            break
        return result

    def fail(self, result):
        match self.how:
            case "die":
                os.kill(os.getpid(), signal.SIGKILL)
            case "raise":
                raise RuntimeError("the solver is broken")
            case "refuse":
                raise ValueError("terrains of another kind")
            case "sleep":
                time.sleep(60)
        result.penalties[0, 0, 0] = np.nan
