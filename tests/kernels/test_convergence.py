"""Who has converged, against the same test in NumPy."""

import numpy as np
import warp as wp

from kernels.convergence import stop_converged

NUM_DOFS = 5


def test_robots_stop_where_they_gain_nothing(device):
    rng = np.random.default_rng(0)
    # By column: a large gradient, a small one, no step, a small gain, a gain below 0, and one who stopped before.
    force = rng.uniform(1.0, 2.0, (6, NUM_DOFS + 3)).astype(np.float32)
    smooth, constraint = 0.25 * force, 0.75 * force
    smooth[[0, 2, 3, 4, 5], :NUM_DOFS] -= 1.0
    alpha = np.array([1, 1, 0, 1, 1, 1], np.float32)
    improvement = np.array([1, 1, 1, 1e-9, -1, 1], np.float32)
    iterations, solving = np.full(6, 2), np.array([5])
    done = np.array([False] * 5 + [True])

    def array(values, dtype=float):
        return wp.array(values, dtype=dtype, device=device)

    outputs = [array(iterations, int), array(solving, int), array(done, bool)]
    stop_converged(
        NUM_DOFS, array([1e-6]), array(np.full(6, 0.1)), array(force), array(smooth), array(constraint), array(alpha),
        array(improvement), *outputs,
    )  # fmt: skip
    stopped = [False, True, True, True, False, False]
    np.testing.assert_array_equal(outputs[0].numpy(), 2 + np.array(stopped))
    assert outputs[1].numpy() == [2]
    np.testing.assert_array_equal(outputs[2].numpy(), np.array(stopped) | done)
