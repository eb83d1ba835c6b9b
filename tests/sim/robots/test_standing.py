"""Robots put down: momentum and weight; level ground, slopes and hills against MuJoCo C.

ANYmal stands by itself. Cassie does not: it lands on its toes and goes over, which is looked at while it lasts.
"""

import numpy as np
import pytest

from sim.mujoco_c.model import crossing_model
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import SPACING
from tests.kernels import oracle
from tests.sim import plain_mujoco
from tests.sim.scenes import ONLY_ANYMAL, PHYSICS_DT, Stepper, lying, positions, put, slope

SETTLE_S = 2.0
GRAVITY = 9.81
NEARLY_HARD = (0.99, 0.999, 0.001)


def standing(robot, num=8, x=8.0, y=4.0):
    """The default pose over flat ground, shape (num, 7 + num_joints)."""
    return np.column_stack([lying(num, x, y, robot.default_base_height), np.tile(robot.default_joint_pos, (num, 1))])


def tilt_between(*rows):
    """Angle [deg] between the base's up vectors of two rows of joint coordinates."""
    up = [oracle.rotation_matrix(row[3:7])[:, 2] for row in rows]
    return np.degrees(np.arccos(np.clip(up[0] @ up[1], -1, 1)))


def inclines():
    """Level ground, and slopes of 5, 8 and 9.4 degrees to several sides."""
    return np.stack([slope(np.radians(a), np.radians(b)) for a in (0, 5) for b in (0, -8, 5, 8)])


@pytest.fixture(scope="module")
def eight_single_stepper(eight):
    """Steps the eight robots by one physics step at a time."""
    return Stepper(eight, steps=1)


def test_contact_forces_are_what_changes_the_momentum(eight, eight_single_stepper, robot):
    # Whatever a robot does, landing, sliding or going over: the ground's impulse less that of its weight is the change
    # of its momentum. Forces are those at the beginning of a step, so it is not exact.
    eight.bank.set_heights(inclines())
    q, qd = standing(robot), np.zeros(eight.joint_qd.shape)
    q[:, 2] += 0.08
    qd[:, :3] = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 3))
    put(eight, q, qd)
    masses = np.array(eight.model.body_mass.numpy()).reshape(8, -1, 1)

    def momentum():
        eight.refresh()
        return (masses * np.array(eight._state.body_qd.numpy()).reshape(8, -1, 6)[:, :, :3]).sum(1)

    before, impulse, duration_s = momentum(), np.zeros((8, 3)), 1.0
    eight_single_stepper.run(
        duration_s, lambda: np.add(impulse, PHYSICS_DT * np.array(eight.geom_force.numpy()).sum(1), out=impulse)
    )
    weight = masses.sum(1) * GRAVITY * duration_s
    np.testing.assert_allclose(momentum() - before, impulse - weight * [0, 0, 1], atol=2e-3 * float(weight[0, 0]))
    assert (impulse[:, 2] > 0.5 * weight[:, 0]).all()


@pytest.mark.parametrize(
    ("robot", "mass", "at_rest"),
    [("anymal", 52.13, slice(None)), ("cassie", 30.468, slice(0, 1))],  # on a slope Cassie's round pelvis rolls away
    indirect=["robot"],
)
def test_contact_forces_carry_the_weight(eight, eight_stepper, robot, mass, at_rest):
    # ANYmal standing on level ground and slopes, Cassie lying on its pelvis and toes: the ground carries what rests.
    eight.bank.set_heights(inclines())
    q = standing(robot)
    q[:, 2] += 0.08
    put(eight, q)
    eight_stepper.run(6.0)
    forces = np.zeros((8, 3))
    eight_stepper.run(0.4, lambda: np.add(forces, np.array(eight.geom_force.numpy()).sum(1) / 20, out=forces))
    weight = mass * GRAVITY
    np.testing.assert_allclose(forces[at_rest, 2], weight, rtol=0.01)
    assert (np.linalg.norm(forces[at_rest, :2], axis=1) < 0.01 * weight).all()
    # Standing, nothing but feet touches.
    touched = np.array(eight.geom_force.numpy())[at_rest].any(axis=(0, 2))
    feet = np.array([name in robot.foot_geoms for name in eight.geom_names])
    np.testing.assert_array_equal(touched, feet if robot.name == "anymal" else True)


@pytest.mark.parametrize(
    ("robot", "duration_s", "metres", "degrees", "radians"),
    [("anymal", 4.0, 1e-3, 0.02, 3e-3), ("cassie", 0.5, 2e-3, 0.15, 1e-2)],
    indirect=["robot"],
)
def test_slopes_equal_mujocos_tilted_plane(eight, eight_stepper, robot, duration_s, metres, degrees, radians):
    # The same contacts (one a foot), so the same motion for four seconds. With caps of 8 Newton iterations the two
    # agree to 1e-4; at the shipped 5 a hard landing stops a little short of the solution, and not at the same point.
    # Cassie lands on two capsules and begins to fall, which lets every difference grow.
    angles = np.radians([0, 3, 6, 9])
    eight.bank.set_heights(np.stack([slope(a) for a in angles] + [slope(0, a) for a in angles]))
    q = standing(robot)
    for env, (axis, angle) in enumerate([((0, -1, 0), a) for a in angles] + [((1, 0, 0), a) for a in angles]):
        q[env, :7] = lying(1, 8, 4, 0, axis, angle)
        q[env, :3] += robot.default_base_height * oracle.rotation_matrix(q[env, 3:7])[:, 2]
    put(eight, q)
    eight_stepper.run(duration_s)
    for start, row in zip(q, positions(eight), strict=True):
        expected = plain_mujoco.run(plain_mujoco.on_plane(robot, plain_mujoco.to_c(start)[3:7]), start, duration_s)
        assert np.linalg.norm(expected[7:] - start[7:]) > 0.05  # it is no free fall
        assert np.linalg.norm(row[:3] - expected[:3]) < metres
        assert tilt_between(row, expected) < degrees
        np.testing.assert_allclose(row[7:], expected[7:], atol=radians)


def stand_on_hill(robot, model, grid, rng):
    """The default pose, level with a hillside of 3 to 8 degrees that is uneven by 12 mm at most (rms), just off it."""
    y, x = np.mgrid[-8:9, -10:11] * SPACING
    basis = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    places = []
    for row, col in np.ndindex(17, 21):
        row, col = 40 + 5 * row, 110 + 5 * col
        patch = np.float64(grid[row - 8 : row + 9, col - 10 : col + 11]).ravel()
        plane, residual, *_ = np.linalg.lstsq(basis, patch)
        if 3 < np.degrees(np.arctan(np.hypot(*plane[:2]))) < 8 and np.sqrt(residual[0] / patch.size) < 0.012:
            places.append((col * SPACING, row * SPACING, *plane))
    x, y, slope_x, slope_y, height = places[rng.integers(len(places))]
    normal = np.array([-slope_x, -slope_y, 1]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    axis = np.cross([0, 0, 1], normal)
    pose = lying(1, x, y, height, axis / np.linalg.norm(axis), np.arcsin(np.linalg.norm(axis)))[0]
    q = np.concatenate([pose, robot.default_joint_pos])
    q[:3] += robot.default_base_height * normal
    feet = plain_mujoco.geom_positions(model, q, robot.foot_geoms)
    clearance = min(oracle.nearest_on_surface(grid, SPACING, foot, 0.5)[0] - 0.03 for foot in feet)
    q[2] -= clearance - 0.003
    return q


@pytest.fixture
def nearly_hard(eight):
    """Contacts of impedance 0.99 to 0.999 for a while."""
    solimp = eight.solver.mjw_model.geom_solimp
    before = np.array(solimp.numpy())
    solimp.assign(np.concatenate([np.broadcast_to(NEARLY_HARD, (*before.shape[:-1], 3)), before[..., 3:]], axis=-1))
    yield
    solimp.assign(before)


@ONLY_ANYMAL
@pytest.mark.usefixtures("nearly_hard")
def test_hills_equal_mujocos_heightfield(eight, eight_stepper, anymal):
    # MuJoCo C makes up to four contacts where a foot touches one spot, one for each prism of its heightfield near by.
    # With soft contacts their number sets how fast loaded feet creep sideways, so that on flat ground already its
    # heightfield and its plane differ by 8 mm after 2 s. Nearly hard contacts (both engines) take that away and leave
    # the shape of the ground; MuJoCo C needs 1 ms steps to stay calm with them.
    eight.bank.set_genes(SUPER_GAUSSIAN.uniform_random(8, 11))
    grids = np.array(eight.bank.heights.numpy())
    models = [crossing_model(anymal, grid) for grid in grids]
    rng = np.random.default_rng(1)
    q = np.array([stand_on_hill(anymal, model, grid, rng) for model, grid in zip(models, grids, strict=True)])
    put(eight, q)
    eight_stepper.run(SETTLE_S)
    for model, start, row in zip(models, q, positions(eight), strict=True):
        model.opt.timestep = 0.001
        model.geom_solimp[:, :3] = NEARLY_HARD
        expected = plain_mujoco.run(model, start, SETTLE_S)
        assert abs(row[2] - expected[2]) < 0.005
        assert tilt_between(row, expected) < 1.0
