"""The second simulator: written from the definitions, it must say what the kernels say about the same state."""

import dataclasses

import mujoco
import numpy as np
import pytest
import warp as wp

from kernels.episode import Invalidity, Outcome
from kernels.penalties import penalty_columns
from sim.controllers.described import read_row
from sim.controllers.loaders import load_policy
from sim.crossing import GROUND_FRICTION, SolverCfg, resolved
from sim.mujoco_c.crossing import EpisodeStates, MujocoC, cross_in_mujoco_c, draw_starts
from sim.mujoco_c.model import GROUND, Starts, crossing_model, surface_heights
from sim.robots.find import get_robot
from sim.rollout import Rollout
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.sim.dogs import GAINS, KINDS, urdf, with_mesh, write_dog
from tests.sim.plain_mujoco import cross_and_keep, rays_from_above
from tests.sim.policies import Remembers, stand
from tests.sim.scenes import FLAT, put, simulate, standing

EPISODES = 3


def test_starts_are_those_of_the_rollout(robot):
    rollout = Rollout(robot, robot.policy_file, num_terrains=1, replicas=EPISODES, device="cpu")
    rollout.put(Terrains(genes=SUPER_GAUSSIAN.hard_random(1, 5), seeds=np.array([77], np.uint32)))
    sim = rollout.sim
    expected = Starts.of_newton(sim.joint_q.numpy(), sim.joint_qd.numpy(), np.array(sim.base_com))
    # Asking for more episodes does not change the first.
    starts = draw_starts(robot, sim.bank.heights.numpy()[0], 77, EPISODES + 4)
    np.testing.assert_array_equal(starts.qpos[:EPISODES], expected.qpos)
    np.testing.assert_array_equal(starts.qvel[:EPISODES], expected.qvel)


def test_model_takes_stiffness_and_friction_from_the_robot_and_lets_the_solver_converge(robot):
    heights = np.random.default_rng(6).uniform(-0.2, 0.2, FLAT.shape).astype(np.float32)
    model = crossing_model(robot, heights)
    ground = model.geom(GROUND).id
    assert model.geom_solmix[ground] == 0.0
    assert model.geom_friction[ground, 0] == GROUND_FRICTION
    assert model.opt.iterations == 100
    assert model.opt.timestep == robot.physics_dt
    fine = crossing_model(robot, heights, time_constant_s=0.003)
    assert (fine.geom_solref == [0.003, 1.0]).all() and (model.geom_solref[:, 0] > 0.003).all()
    # The surface, between the nodes too, edge heights continued beyond it: what a ray from above meets.
    points = [(3.03, 2.2), (8.0, 4.0), (12.31, 7.9), (17.5, 9.5), (-1.5, -1.5), (5.025, 3.025), (6.01, 4.04)]
    far = [0, 0, 50, 1, *np.zeros(3 + robot.num_joints)]
    met, geoms = rays_from_above(model, points, far)
    assert (geoms == ground).all()
    np.testing.assert_allclose(met, surface_heights(heights, *np.transpose(points)), atol=1e-5)


def test_plain_mujoco_takes_any_robot_that_the_search_takes(tmp_path):
    model = crossing_model(get_robot(str(with_mesh(tmp_path / "mesh", "mjcf"))), FLAT)
    assert (model.nu, model.nq) == (8, 15)
    assert model.geom("trunk").type[0] == mujoco.mjtGeom.mjGEOM_MESH
    assert model.geom("trunk").conaffinity[0] == 0 and model.geom(GROUND).conaffinity[0] == 1
    # A URDF says nothing of contact: friction 1, the time constant of the shipped robots.
    given = KINDS["urdf"] | {"more": f"{GAINS}\n    friction=0.6,\n    contact_time_constant_s=0.02,"}
    for number, (kind, contact) in enumerate((({}, [0.8, 0.01]), (KINDS["urdf"], [1.0, 0.01]), (given, [0.6, 0.02]))):
        model = crossing_model(get_robot(str(write_dog(tmp_path / str(number), **kind))), FLAT)
        of_robot = model.geom_bodyid > 0
        assert model.nu == 8 and of_robot.sum() == 13
        of_geoms = np.column_stack([model.geom_friction[of_robot, 0], model.geom_solref[of_robot, 0]])
        np.testing.assert_allclose(of_geoms, [contact] * 13)


FINE = {"physics_dt": 0.001, "decimation": 20}
DRIVES = {"saturation_effort": (90.0,) * 12, "velocity_limit": (6.0,) * 12, "drive_delay_steps": 3}


@pytest.mark.parametrize(
    ("changes", "time_constant_s"),
    [({}, None), (FINE, 0.003), (FINE, 0.02), (DRIVES, None)],
    ids=["shipped", "stiff", "soft", "motors and delay"],
)
def test_moving_on_a_plane_is_the_same_motion_in_both(robot, changes, time_constant_s):
    # Level ground is a plane in MuJoCo.
    # ANYmal walks for 0.2 s. Cassie needs 0.15 s to come down, and swings on its legs for 0.25 s, since to balance it
    # lets every difference grow. The softer a contact, the more of a toe lies on the ground, where MuJoCo has the two
    # ends alone.
    by_robot = {"anymal": (0.2, 2e-4, 6e-3, 1e-4), "cassie": (0.4, 3e-3, 0.04, 0.15)}
    seconds, metres, radians, share = by_robot[robot.name]
    if robot.name == "cassie" and time_constant_s == 0.003:
        metres, radians = 5e-4, 0.01
    policy = robot.policy_file if robot.name == "anymal" else "tests.sim.policies:sway"
    shipped, robot, solver = robot, dataclasses.replace(robot, **changes), SolverCfg(time_constant_s=time_constant_s)
    rollout = Rollout(robot, policy, num_terrains=1, replicas=EPISODES, device="cpu", solver=solver)
    rollout.put(Terrains(heights=FLAT[None], seeds=np.array([1000], np.uint32)))
    starts = draw_starts(robot, FLAT, 1000, EPISODES)
    plain, result = cross_and_keep(robot, policy, FLAT, starts, seconds, time_constant_s=time_constant_s)
    for _ in range(round(seconds / robot.control_dt)):
        rollout.control_step()
    joint_q = rollout.sim.joint_q.numpy()
    assert rollout.sim.contacts.count.numpy().any()
    assert np.abs(plain.qpos[:, 7:] - robot.default_joint_pos).max() > 0.1  # it moves
    assert (np.abs(plain.forces[:, :, 2]).sum(axis=1) > 50.0).all()  # and the ground has a part in it
    np.testing.assert_allclose(joint_q[:, :3], plain.qpos[:, :3], atol=metres)
    np.testing.assert_allclose(joint_q[:, 7:], plain.qpos[:, 7:], atol=radians)
    sums = rollout.penalty_sums.numpy()[:, penalty_columns(robot.penalties)]
    np.testing.assert_allclose(sums, result.penalties[0], rtol=share, atol=1e-6)
    if changes is DRIVES:
        ideal, _ = cross_and_keep(shipped, policy, FLAT, starts, seconds)
        assert np.abs(ideal.qpos[:, 7:] - plain.qpos[:, 7:]).max() > 0.2


def test_a_robot_senses_the_same_in_both(anymal):
    """The pose, contacts and torques of ANYmal, which walks for 0.2 s: rows of the same numbers, after the scan."""
    robot = dataclasses.replace(anymal, senses=("torques", "pose", "contacts"), max_duration_s=0.2)
    walk, rows = load_policy(anymal.policy_file, anymal, "cpu"), []
    keep = lambda row: rows.append(row.clone()) or walk(row[:, : anymal.observation_size])  # noqa: E731
    rollout = Rollout(robot, keep, num_terrains=1, replicas=EPISODES, device="cpu")
    for _ in range(2):  # robots that begin anew feel nothing of the episode before
        rows.clear()
        rollout.evaluate(Terrains(heights=FLAT[None], seeds=np.array([1000], np.uint32)))
    ours, starts = [read_row(row, robot) for row in rows[:10]], draw_starts(robot, FLAT, 1000, EPISODES)
    rows.clear()
    cross_in_mujoco_c(robot, keep, FLAT, starts)
    plain = [read_row(row, robot) for row in rows[:10]]
    np.testing.assert_allclose(plain[0].quat, starts.qpos[:, 3:7], atol=1e-6)
    for ours_now, plain_now in zip(ours, plain, strict=True):
        for name, tolerance in (("base_pos", 1e-5), ("quat", 1e-5), ("contacts", 0.1), ("torques", 0.01)):
            np.testing.assert_allclose(getattr(ours_now, name), getattr(plain_now, name), atol=tolerance)
    assert not plain[0].contacts.any() and not plain[0].torques.any() and float(plain[9].torques.abs().max()) > 20.0
    assert 300.0 < float(plain[9].contacts.sum(dim=1).mean()) < 800.0  # 52 kg weigh 511 N


SPEEDS = [0.0, 5.0, 10.0, 13.0, 25.0, -5.0]  # [rad/s]
TORQUES = [20.0, 15.0, 0.0, -9.0, -20.0, 20.0]
"""Of a motor of 30 N m and 10 rad/s with a limit of 20 N m that is asked for more: 30 (1 - v / 10), within 20 N m."""
MIMIC = {"model": urdf().replace('<joint name="FL_knee" type="revolute">', '<joint name="FL_knee" type="revolute">'
                                 '<mimic joint="FL_hip" multiplier="-2.0"/>'), "suffix": "urdf"}  # fmt: skip


@pytest.mark.parametrize("kind", [{}, MIMIC], ids=["mjcf", "with a joint that has no motor"])
def test_a_motor_gives_what_its_speed_leaves_it_in_both(tmp_path, device, kind):
    gains = GAINS.replace("30.0", "20.0") + "saturation_effort=(30.0,) * 8, velocity_limit=(9.0, *(10.0,) * 7),"
    robot = get_robot(str(write_dog(tmp_path, **kind, more=gains)))
    pose, joint = standing(robot, len(SPEEDS), z=5.0), 7  # the last one
    joint_qd = np.zeros((len(SPEEDS), 6 + 8))
    joint_qd[:, 6 + joint] = SPEEDS
    sim = simulate(robot, np.repeat(FLAT[None], len(SPEEDS), axis=0), device)
    put(sim, pose, joint_qd)
    pose[:, 7 + joint] += 5.0  # by a gain of 60 N m/rad
    sim.targets.assign(np.float32(pose))
    sim.physics_step()
    np.testing.assert_allclose(sim.joint_torque.numpy()[:, 6 + joint], TORQUES, atol=1e-4)
    everyone = np.arange(len(SPEEDS))
    starts = Starts.of_newton(standing(robot, len(SPEEDS), z=5.0), joint_qd, np.zeros(3))
    plain = EpisodeStates(robot, crossing_model(robot, FLAT), starts)
    plain.targets[:] = pose[:, 7:]
    plain.step(everyone)
    np.testing.assert_allclose([data.qfrc_actuator[6 + joint] for data in plain.data], TORQUES, atol=1e-9)


def test_a_target_counts_after_the_delay_in_both(tmp_path, device):
    robot = get_robot(str(write_dog(tmp_path, more="\n    drive_delay_steps=3,")))
    assert resolved(robot)[0].drive_delay_steps == 15  # of 1 ms
    pose, everyone = standing(robot, 2, z=5.0), np.arange(2)
    sim = simulate(robot, np.repeat(FLAT[None], 2, axis=0), device)
    put(sim, pose)
    plain = EpisodeStates(robot, crossing_model(robot, FLAT), Starts.of_newton(pose, np.zeros((2, 14)), np.zeros(3)))
    pose[:, 7] += 0.1  # 6 N m
    sim.targets.assign(np.float32(pose))
    plain.targets[:] = pose[:, 7:]
    torques = []
    for step in range(5):
        sim.physics_step()
        plain.step(everyone)
        torques.append([*sim.joint_torque.numpy()[:, 6], plain.data[0].qfrc_actuator[6]])
        if step == 1:  # an episode begins anew
            sim.clear_solver(wp.array([0, 1], dtype=int, device=device))
    np.testing.assert_allclose(torques[:4], [[0.0] * 3] * 3 + [[6.0, 0.0, 6.0]], atol=0.1)
    assert torques[4] == [pytest.approx(torques[4][2], rel=1e-3), pytest.approx(0.0, abs=0.1), torques[4][2]]


def test_what_ends_a_crossing(robot):
    heights = FLAT.copy()
    heights[0, 0] = 0.01  # or the ground were a plane, which would push off legs that are half a metre deep in it
    starts = draw_starts(robot, FLAT, 5, 4)
    starts.qpos[0, :2] = 13.7, 4.0  # at the goal
    starts.qpos[1, 1] = 10.5  # outside
    starts.qpos[2, 2] = 0.05  # its belly in the ground
    starts.qvel[3, 8] = 5000.0  # a joint far too fast
    policy = load_policy(robot.policy_file, robot, "cpu")
    result = cross_in_mujoco_c(dataclasses.replace(robot, max_duration_s=0.1), policy, heights, starts)
    assert result.outcome.tolist() == [[Outcome.GOAL, Outcome.OUT, Outcome.BASE_COLLISION, Outcome.INVALID]]
    assert result.invalidity.tolist() == [[0, 0, 0, Invalidity.STATE]]
    assert result.penalty_names == robot.penalties
    assert np.isnan(result.penalties[0, 3]).all() and np.isfinite(result.penalties[0, :3]).all()
    np.testing.assert_allclose(result.duration_s, 0.005)


@pytest.mark.slow
def test_terrains_come_back_in_order_and_each_episode_is_what_its_start_alone_makes(cassie):
    grids = np.stack([FLAT, FLAT + np.float32(0.2)])
    simulator = MujocoC(cassie, "tests.sim.policies:stand", replicas=26)
    simulator.put(Terrains(heights=grids, seeds=np.array([3, 4])))
    result = simulator.take()
    assert result.outcome.shape == (2, 26) and result.penalties.shape == (2, 26, len(cassie.penalties))
    for index, heights in enumerate(grids):
        expected = cross_in_mujoco_c(cassie, stand, heights, draw_starts(cassie, heights, 3 + index, 26)[25:])
        np.testing.assert_array_equal(result.duration_s[index, 25:], expected.duration_s[0])
        np.testing.assert_array_equal(result.penalties[index, 25:], expected.penalties[0])


def test_a_controller_with_a_memory_is_always_asked_for_all_robots(anymal):
    starts = draw_starts(anymal, FLAT, 5, 3)
    starts.qpos[0, :2] = 13.7, 4.0  # at the goal: it ends at once
    policy, robot = Remembers(), dataclasses.replace(anymal, max_duration_s=0.1)
    result = cross_in_mujoco_c(robot, policy, FLAT, starts)
    assert (policy.resets, policy.asked) == (1, [3] * 5)
    expected = cross_in_mujoco_c(robot, stand, FLAT, starts)
    np.testing.assert_array_equal(result.outcome, expected.outcome)
    np.testing.assert_array_equal(result.penalties, expected.penalties)
