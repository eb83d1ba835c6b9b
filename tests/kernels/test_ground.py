"""Maps of friction and softness: from genes to the contacts on their patches."""

import numpy as np
import pytest
import warp as wp

from kernels.ground import (
    FIRM,
    LEAST_FRICTION,
    LEAST_TIME_CONSTANT_S,
    MOST_TIME_CONSTANT_S,
    PATCHES,
    GroundRecords,
    decode_friction,
    decode_softness,
    make_bodies,
    make_ground,
    tell_contacts,
)
from tests.kernels.states import filled
from tests.kernels.test_contact import make_buffer, make_layout


def decoded(decode, genes):
    found = wp.full((len(genes), 4, 8), -1.0, dtype=float)
    decode(wp.array(np.float32(genes)), found)
    return found.numpy()


def test_genes_by_hand():
    # Friction: -1 is 0.15, 0 is 0.575, 1 exactly 1. Softness: -1 is firm, 0 the geometric mean of 0.01 s and 0.06 s.
    genes = np.tile(np.repeat([-1.0, 0.0, 1.0, 5.0], 8), (2, 1))
    np.testing.assert_allclose(decoded(decode_friction, genes)[1, :, 3], [LEAST_FRICTION, 0.575, 1, 1], rtol=1e-6)
    assert (decoded(decode_friction, genes)[:, 2:] == 1.0).all()
    middle = (LEAST_TIME_CONSTANT_S * MOST_TIME_CONSTANT_S) ** 0.5
    expected = [FIRM, middle, MOST_TIME_CONSTANT_S, MOST_TIME_CONSTANT_S]
    np.testing.assert_allclose(decoded(decode_softness, genes)[0, :, 7], expected, rtol=1e-5)


def test_the_first_genes_are_the_row_of_patches_at_low_y():
    genes = np.ones((1, 32))
    genes[0, 8 * 2 + 5] = -1
    assert np.argwhere(decoded(decode_friction, genes)[0] < 1).tolist() == [[2, 5]]


def test_a_map_of_another_shape_is_named():
    with pytest.raises(ValueError, match=r"must have shape \(1, 4, 8\) and 32 genes a terrain"):
        decode_friction(wp.zeros((1, 31), dtype=float), wp.zeros((1, 4, 8), dtype=float))


def test_each_contact_has_the_ground_under_its_point():
    places = [(1, 0, 1), (1, 1, 1), (0, 3, 7), (0, 3, 0)]
    # Two robots of two shapes, the first shape of which is the 3rd of the model; robot 0 stands on terrain 1.
    layout = make_layout(2, first_shape=2)
    ground = make_ground(2, str(wp.get_device()))
    rng = np.random.default_rng(0)
    friction, tau = rng.uniform(0.15, 1, (2, *PATCHES)), rng.uniform(0.02, 0.06, (2, *PATCHES))
    tau[places[0]] = 0.0
    ground.friction.assign(np.float32(friction))
    ground.time_constant.assign(np.float32(tau))
    # invweight 0.5 and impedance 0.9: unit stiffness is divided by 0.05
    bodies = make_bodies(np.full(4, 0.5), np.full(4, 0.9), np.array([0.01, 0.01, 0.01, 0.07]), str(wp.get_device()))
    # Places are terrain, row, column; beyond the edge the ground goes on.
    points = [(3.02, 1.0), (3.06, 2.5), (15.92, 7.9), (-2.0, 9.0), (99.0, 99.0)]
    buffer = make_buffer(5)
    buffer.shape1.assign(np.array([2, 3, 4, 5, 5]))
    buffer.point0.assign(np.float32([[x, y, 0.3] for x, y in points]))
    buffer.count.fill_(4)
    records = filled(GroundRecords, **{name: [-1.0] * 5 for name in GroundRecords.vars})
    tell_contacts(wp.array([1, 0], dtype=int), ground, bodies, layout, buffer, records)
    found = {name: getattr(records, name).numpy() for name in GroundRecords.vars}
    np.testing.assert_allclose(found["friction"][:4], [friction[place] for place in places], rtol=1e-6)
    soft = np.array([tau[place] for place in places])
    # Firm ground, and ground that is no softer than the robot's own contacts, change nothing.
    expected = np.where([False, True, True, False], 1 / (soft**2 * 0.05 + 1e-30), 0.0)
    np.testing.assert_allclose(found["stiffness"][:4], expected, rtol=1e-5)
    np.testing.assert_allclose(found["damping"][:4], 2 * soft * expected, rtol=1e-5)
    assert all(values[4] == -1 for values in found.values())  # past the count
