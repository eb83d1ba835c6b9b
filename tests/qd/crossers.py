"""Simulations for Ray workers, over the stand-in: good ones, and one that fails once in each way there is."""

import dataclasses
import os
import signal
from pathlib import Path

import numpy as np

from tests.qd import stand_in


class Crosser:
    """Evaluates by the stand-in."""

    def __init__(self, cfg, num_terrains: int) -> None:
        self.cfg, self.num_terrains = cfg, num_terrains
        self.lots = []

    def put(self, terrains, seeds):
        self.lots.append((terrains, seeds))
        assert sum(len(lot) for lot, _ in self.lots) <= self.num_terrains

    def clear(self):
        self.lots.clear()

    def take(self, progress=None):
        return self.evaluate(*self.lots.pop(0), progress=progress)

    def evaluate(self, terrains, seeds, *, progress=None):
        assert len(terrains) == len(seeds) <= self.num_terrains
        if progress is not None:
            progress(0.5)
            progress(1.0)
        return stand_in.evaluate(terrains, seeds, self.cfg.num_replicas)


class Identified(Crosser):
    """Notes its process in the positions of its results."""

    def evaluate(self, terrains, seeds, *, progress=None):
        result = super().evaluate(terrains, seeds, progress=progress)
        result.final_position[:] = os.getpid()
        return result


class Failing(Crosser):
    """Fails as the policy's name says: ``<how>:<folder>:<times>``, so often in all, counted by files in the folder."""

    def evaluate(self, terrains, seeds, *, progress=None):
        how, folder, times = self.cfg.policy.split(":")
        for number in range(int(times)):
            try:
                (Path(folder) / str(number)).touch(exist_ok=False)
            except FileExistsError:
                continue
            return self._fail(how, terrains, seeds)
        return super().evaluate(terrains, seeds, progress=progress)

    def _fail(self, how, terrains, seeds):
        if how == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if how == "raise":
            raise RuntimeError("the solver is broken")
        if how == "refuse":
            raise ValueError("terrains of another kind")
        result = stand_in.evaluate(terrains, seeds, self.cfg.num_replicas)
        if how == "nan":
            result.penalties[0, 0, 0] = np.nan
        if how == "short":
            return dataclasses.replace(result, penalties=result.penalties[:-1])
        if how == "nonsense":
            return "all went well"
        return result


class Refusing(Crosser):
    """Cannot be built."""

    def __init__(self, cfg, num_terrains: int) -> None:
        raise ValueError("policy 'x' does not fit:\nuse another")
