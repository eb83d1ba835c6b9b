"""The bare physics rate."""

import numpy as np
import pytest

from sim.bare import measure_bare_physics, stand_on_terrain
from sim.terrain import hard_random_genes
from tests.sim.scenes import positions


def test_robots_stand_on_the_highest_ground_under_them(eight, anymal):
    grids = np.zeros((8, 161, 321), np.float32)
    grids[3, 80, 105] = 0.2  # (5.25, 4): ahead of x = 5, under the stance
    grids[4, 80, 115] = 0.2  # (5.75, 4): beyond it
    eight.bank.set_heights(grids)
    stand_on_terrain(eight, np.full(8, 5.0))
    q = positions(eight)
    np.testing.assert_allclose(q[:, :2], [[5, 4]] * 8)
    np.testing.assert_allclose(q[:, 2], anymal.default_base_height + np.where(np.arange(8) == 3, 0.2, 0.0), atol=1e-6)
    np.testing.assert_allclose(q[:, 7:], [anymal.default_joint_pos] * 8, atol=1e-6)
    np.testing.assert_array_equal(eight.targets.numpy()[:, 7:], np.float32(q[:, 7:]))


def test_rate_is_measured_on_genes_and_heights(anymal, device):
    genes = hard_random_genes(2, 0)
    for terrains in (genes, np.zeros((2, 161, 321), np.float32)):
        rate = measure_bare_physics(anymal, terrains, 4, device=device, steps=20, warmup_steps=4)
        assert 100 < rate < 1e9


def test_environments_must_be_shared_evenly(anymal, device):
    with pytest.raises(ValueError, match="multiple of the 2 terrains, got 5"):
        measure_bare_physics(anymal, np.zeros((2, 64)), 5, device=device)
