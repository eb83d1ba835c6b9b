"""Standing robots: flat ground against the solver's own plane, weight, slopes and hills against MuJoCo C."""

import newton
import numpy as np
import pytest
import warp as wp

from kernels import oracle
from sim.robot import build_robot
from sim.simulation import GROUND_FRICTION, SolverCfg
from sim.terrain import SPACING, uniform_random_genes
from tests.sim import mujoco_c
from tests.sim.scenes import lying, positions, put, slope

SETTLE_S = 2.0
NEARLY_HARD = (0.99, 0.999, 0.001)


def standing(robot, num=8, x=8.0, y=4.0):
    """The default pose over flat ground, shape (num, 7 + num_joints)."""
    return np.column_stack([lying(num, x, y, robot.default_base_height), np.tile(robot.default_joint_pos, (num, 1))])


def tilt_between(one, other):
    """Angle [deg] between the base's up vectors of two rows of joint coordinates."""
    up = [oracle.rotation_matrix(row[3:7])[:, 2] for row in (one, other)]
    return np.degrees(np.arccos(np.clip(up[0] @ up[1], -1, 1)))


def settle_on_own_plane(robot, joint_q, device):
    """The same robot and solver, but with the plane collided by the solver itself."""
    scene = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
    scene.rigid_gap = 0.0
    scene.default_shape_cfg.mu = GROUND_FRICTION
    plane = {"plane": (0.0, 0.0, 1.0, 0.0), "width": 0.0, "length": 0.0}
    scene.add_shape_plane(**plane, custom_attributes={"mujoco:geom_solmix": 0.0})
    scene.replicate(build_robot(robot), 1)
    model = scene.finalize(device=device)
    solver = newton.solvers.SolverMuJoCo(
        model,
        njmax=robot.njmax,
        nconmax=robot.nconmax,
        iterations=SolverCfg().iterations,
        ls_iterations=SolverCfg().ls_iterations,
        cone="elliptic",
        integrator="implicitfast",
        use_mujoco_contacts=True,
        kinematic_switchable_roots=False,
    )
    state, control = model.state(), model.control()

    def place():
        state.joint_q.assign(np.float32(joint_q))
        state.joint_qd.zero_()
        solver.mjw_data.qacc_warmstart.zero_()
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)

    def step():
        for _ in range(4):
            solver.step(state, state, control, None, robot.physics_dt)

    control.joint_target_q.assign(np.float32(joint_q))
    with wp.ScopedDevice(device):
        place()
        step()
        with wp.ScopedCapture() as capture:
            step()
        place()
        for _ in range(round(SETTLE_S / (4 * robot.physics_dt))):
            wp.capture_launch(capture.graph)
    return state.joint_q.numpy()


def test_flat_ground_equals_the_solvers_own_plane(eight, eight_stepper, anymal, device):
    eight.bank.set_heights(np.zeros((8, 161, 321), np.float32))
    q = standing(anymal)
    put(eight, q)
    eight_stepper.run(SETTLE_S)
    expected = settle_on_own_plane(anymal, q[0], device)
    for row in positions(eight):
        np.testing.assert_allclose(row[7:], expected[7:], atol=1e-4)
        np.testing.assert_allclose(row[:7], expected[:7], atol=1e-4)


def test_contact_forces_carry_the_weight(eight, eight_stepper, anymal):
    # On flat ground, and on slopes of 5 and 8 degrees: once the robot rests, the ground carries its 52.13 kg.
    eight.bank.set_heights(np.stack([slope(np.radians(a), np.radians(b)) for a in (0, 5) for b in (0, -8, 5, 8)]))
    q = standing(anymal)
    q[:, 2] += 0.08
    put(eight, q)
    eight_stepper.run(6.0)
    forces = np.zeros((8, 3))
    eight_stepper.run(0.4, lambda: np.add(forces, np.array(eight.geom_force.numpy()).sum(1) / 20, out=forces))
    weight = 52.13 * 9.81
    np.testing.assert_allclose(forces[:, 2], weight, rtol=0.01)
    assert (np.linalg.norm(forces[:, :2], axis=1) < 0.01 * weight).all()
    # Standing, nothing but feet touches.
    feet = [name in anymal.foot_geoms for name in eight.geom_names]
    assert not np.array(eight.geom_force.numpy())[:, ~np.array(feet)].any()


def test_slopes_equal_mujocos_tilted_plane(eight, eight_stepper, anymal):
    # The same contacts (one a foot), so the same motion for four seconds. With caps of 8 Newton iterations the two
    # agree to 1e-4; at the shipped 5 a hard landing stops a little short of the solution, and not at the same point.
    angles = np.radians([0, 3, 6, 9])
    eight.bank.set_heights(np.stack([slope(a) for a in angles] + [slope(0, a) for a in angles]))
    q = standing(anymal)
    for env, (axis, angle) in enumerate([((0, -1, 0), a) for a in angles] + [((1, 0, 0), a) for a in angles]):
        q[env, :7] = lying(1, 8, 4, 0, axis, angle)
        q[env, :3] += anymal.default_base_height * oracle.rotation_matrix(q[env, 3:7])[:, 2]
    put(eight, q)
    eight_stepper.run(4.0)
    for start, row in zip(q, positions(eight), strict=True):
        expected = mujoco_c.run(mujoco_c.on_plane(anymal, mujoco_c.to_c(start)[3:7]), start, 4.0)
        assert np.linalg.norm(row[:3] - expected[:3]) < 1e-3
        assert tilt_between(row, expected) < 0.02
        np.testing.assert_allclose(row[7:], expected[7:], atol=3e-3)


def hillsides(grid, rng):
    """A place where the ground under the robot leans by 3 to 8 degrees and is uneven by 12 mm at most (rms)."""
    y, x = np.mgrid[-8:9, -10:11] * SPACING
    basis = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    found = []
    for row, col in np.ndindex(17, 21):
        row, col = 40 + 5 * row, 110 + 5 * col
        patch = np.float64(grid[row - 8 : row + 9, col - 10 : col + 11]).ravel()
        plane, residual, *_ = np.linalg.lstsq(basis, patch)
        if 3 < np.degrees(np.arctan(np.hypot(*plane[:2]))) < 8 and np.sqrt(residual[0] / patch.size) < 0.012:
            found.append((col * SPACING, row * SPACING, *plane))
    return found[rng.integers(len(found))]


def stand_on_hill(robot, model, grid, rng):
    """The default pose, level with the hillside, its nearest foot just off the ground."""
    x, y, slope_x, slope_y, height = hillsides(grid, rng)
    normal = np.array([-slope_x, -slope_y, 1]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    axis = np.cross([0, 0, 1], normal)
    pose = lying(1, x, y, height, axis / np.linalg.norm(axis), np.arcsin(np.linalg.norm(axis)))[0]
    q = np.concatenate([pose, robot.default_joint_pos])
    q[:3] += robot.default_base_height * normal
    feet = mujoco_c.geom_positions(model, q, robot.foot_geoms)
    clearance = min(oracle.nearest_on_surface(grid, SPACING, foot, 0.5)[0] - 0.03 for foot in feet)
    q[2] -= clearance - 0.003
    return q


@pytest.fixture
def nearly_hard(eight):
    """Contacts of impedance 0.99 to 0.999 for a while."""
    solimp = eight.solver.mjw_model.geom_solimp
    before = np.array(solimp.numpy())
    hard = before.copy()
    hard[..., :3] = NEARLY_HARD
    solimp.assign(hard)
    yield
    solimp.assign(before)


@pytest.mark.usefixtures("nearly_hard")
def test_hills_equal_mujocos_heightfield(eight, eight_stepper, anymal):
    # MuJoCo C makes up to four contacts where a foot touches one spot, one for each prism of its heightfield near by.
    # With soft contacts their number sets how fast loaded feet creep sideways, so that on flat ground already its
    # heightfield and its plane differ by 8 mm after 2 s. Nearly hard contacts (both engines) take that away and leave
    # the shape of the ground; MuJoCo C needs 1 ms steps to stay calm with them.
    eight.bank.set_genes(uniform_random_genes(8, 11))
    grids = np.array(eight.bank.heights.numpy())
    models = [mujoco_c.on_heights(anymal, grid) for grid in grids]
    rng = np.random.default_rng(1)
    q = np.array([stand_on_hill(anymal, model, grid, rng) for model, grid in zip(models, grids, strict=True)])
    put(eight, q)
    eight_stepper.run(SETTLE_S)
    for model, start, row in zip(models, q, positions(eight), strict=True):
        model.opt.timestep, model.opt.iterations, model.opt.ls_iterations = 0.001, 100, 50
        model.geom_solimp[:, :3] = NEARLY_HARD
        expected = mujoco_c.run(model, start, SETTLE_S)
        assert abs(row[2] - expected[2]) < 0.005
        assert tilt_between(row, expected) < 1.0
