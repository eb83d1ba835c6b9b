"""The surrogate over a stand-in whose penalties follow from heights, as a robot's do."""

import numpy as np
import pytest
import torch

from qd import surrogate as module
from qd.descriptors import Cells
from qd.fitness import Evaluation, FitnessCfg, evaluation_of
from qd.run.checkpoint import load_checkpoint, save_checkpoint
from qd.run.settings import SchedulerCfg
from qd.scheduler import Scheduler
from qd.surrogate import Surrogate
from sim.corridor import corridor_heights
from sim.space import SUPER_GAUSSIAN
from sim.spaces.course import COURSE
from tests.qd import stand_in

CELLS = Cells(6, 5)
FITNESS = FitnessCfg(penalties=stand_in.PENALTIES, scales=stand_in.SCALES)
CFG = SchedulerCfg(emitters=2, batch_size=16, method="surrogate", training_steps=20, candidates=8, generations=2)


def crossed(genes, seed: int, space=SUPER_GAUSSIAN) -> Evaluation:
    """Six penalties that follow from slopes and heights of six parts of the way; the same mirrored."""
    heights = corridor_heights(genes, space, device="cpu").numpy().astype(float)
    parts = np.array_split(heights[:, 10:31, 30:91], 6, axis=2)
    steep = np.stack([np.abs(np.diff(part, axis=2)).mean(axis=(1, 2)) for part in parts], axis=1)
    high = np.stack([np.abs(part).mean(axis=(1, 2)) for part in parts], axis=1)
    noise = np.random.default_rng(seed).uniform(0.9, 1.1, (len(genes), 4, 6))
    result = stand_in.make_result((0.02 + 4.0 * (30.0 * steep + 4.0 * high) ** 2)[:, None] * noise * stand_in.SCALES)
    return evaluation_of(result, CELLS, FITNESS)


def advance(search: Scheduler, first: int, last: int, space=SUPER_GAUSSIAN) -> None:
    for iteration in range(first, last + 1):
        search.tell(crossed(search.ask(), iteration, space), iteration)


def make_surrogate(cfg: SchedulerCfg = CFG, seed: int = 0) -> Surrogate:
    return Surrogate(cfg, CELLS, SUPER_GAUSSIAN, np.random.SeedSequence(seed))
