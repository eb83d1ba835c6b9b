"""Maps of friction and softness: from genes to the contacts on their patches."""

import numpy as np
import warp as wp

from kernels.ground import (
    FIRM,
    MAX_TIME_CONSTANT_S,
    MIN_FRICTION,
    MIN_TIME_CONSTANT_S,
    PATCHES,
    decode_friction,
    decode_softness,
    make_ground,
)
from tests.kernels.test_contact import collide


def decoded(decode, genes):
    found = wp.full((len(genes), 4, 8), -1.0, dtype=float)
    decode(wp.array(np.float32(genes)), found)
    return found.numpy()


def test_genes_by_hand():
    # Friction: -1 is 0.15, 0 is 0.575, 1 exactly 1. Softness: -1 is firm, 0 the geometric mean of 0.01 s and 0.06 s.
    genes = np.tile(np.repeat([-1.0, 0.0, 1.0, 5.0], 8), (2, 1))
    np.testing.assert_allclose(decoded(decode_friction, genes)[1, :, 3], [MIN_FRICTION, 0.575, 1, 1], rtol=1e-6)
    assert (decoded(decode_friction, genes)[:, 2:] == 1.0).all()
    middle = (MIN_TIME_CONSTANT_S * MAX_TIME_CONSTANT_S) ** 0.5
    expected = [FIRM, middle, MAX_TIME_CONSTANT_S, MAX_TIME_CONSTANT_S]
    np.testing.assert_allclose(decoded(decode_softness, genes)[0, :, 7], expected, rtol=1e-5)


def test_each_contact_has_the_ground_under_its_point():
    # Of two robots of two spheres the first stands on terrain 1. Places are terrain, row, column; beyond the edge the
    # ground goes on.
    places = [(1, 0, 1), (1, 1, 1), (0, 3, 7), (0, 3, 0)]
    points = [(3.02, 1.0), (3.06, 2.5), (15.92, 7.9), (-2.0, 9.0)]
    ground = make_ground(2, str(wp.get_device()))
    rng = np.random.default_rng(0)
    friction, tau = rng.uniform(0.15, 1, (2, *PATCHES)), rng.uniform(0.02, 0.06, (2, *PATCHES))
    tau[places[0]] = FIRM
    ground.friction.assign(np.float32(friction))
    ground.time_constant.assign(np.float32(tau))
    poses = [[x, y, 0.05, 0, 0, 0, 1] for x, y in points]
    found = collide(poses, [1, 0], np.zeros((2, 161, 321)), [(np.zeros(3), 0.1)] * 2, ground=ground)
    order = np.argsort(2 * found["env"] + found["shape"])
    np.testing.assert_allclose(found["friction"][order], [friction[place] for place in places], rtol=1e-6)
    np.testing.assert_allclose(found["time_constant"][order], [tau[place] for place in places], rtol=1e-6)
