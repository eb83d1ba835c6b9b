"""The kernels that measure a device: they do the work they are credited with."""

import numpy as np
import warp as wp

from sim.bench.ceiling import FLOPS_PER_STEP, SPECIALS_PER_STEP, do_nothing, exponentials, launch, multiply_add


def test_multiply_adds_are_all_done(device):
    # Eight chains a thread start at i, i + 1 ... i + 7 and take 16 times x -> 0.999 x + 0.001 a step.
    out = wp.zeros(3, dtype=float, device=device)
    launch(multiply_add, out, 2, 0.999, 0.001)
    chains = np.arange(3)[:, None] + np.arange(8.0)
    for _ in range(2 * 16):
        chains = chains * 0.999 + 0.001
    np.testing.assert_allclose(out.numpy(), chains.sum(1), rtol=1e-5)
    assert FLOPS_PER_STEP == 16 * 8 * 2


def test_exponentials_are_all_computed(device):
    # Four chains a thread start at i * 1e-6 + (0, 0.1, 0.2, 0.3) and take 4 times x -> exp(-x) a step.
    out = wp.zeros(3, dtype=float, device=device)
    launch(exponentials, out, 2)
    chains = np.arange(3)[:, None] * 1e-6 + np.array([0, 0.1, 0.2, 0.3])
    for _ in range(2 * 4):
        chains = np.exp(-chains)
    np.testing.assert_allclose(out.numpy(), chains.sum(1), rtol=1e-5)
    assert SPECIALS_PER_STEP == 4 * 4


def test_doing_nothing_touches_one_number(device):
    out = wp.full(2, 7.0, dtype=float, device=device)
    launch(do_nothing, out[:1])
    assert out.numpy().tolist() == [0.0, 7.0]
