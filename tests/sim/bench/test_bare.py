"""The bare physics rate."""

import numpy as np

from sim.bench.bare import measure_bare_physics
from sim.crossing import CrossingCfg
from sim.rollout import Rollout
from sim.space import SUPER_GAUSSIAN
from tests.sim.policies import stretch


def test_rates_are_measured_and_leave_nothing_behind(anymal, device):
    cfg = CrossingCfg(max_duration_s=0.6)
    rollout = Rollout(anymal, stretch, num_terrains=2, num_replicas=2, device=device, cfg=cfg)
    genes, seeds = SUPER_GAUSSIAN.hard_random(2, 0), np.array([1, 2], dtype=np.uint32)
    before = rollout.evaluate(genes, seeds)
    rates = measure_bare_physics(rollout, genes, seeds, steps=80)
    assert 100 < rates.walking < 1e9
    assert 100 < rates.standing < 1e9
    after = rollout.evaluate(genes, seeds)
    if device == "cpu":
        np.testing.assert_array_equal(before.penalties, after.penalties)
