"""Errors of what the robot sees, in the parallel simulation and in MuJoCo C: against each other and by hand."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome, make_episodes
from qd.search.loop import start_search
from sim.mujoco_c.crossing import EpisodeStates
from sim.mujoco_c.model import Starts, crossing_model, observations
from sim.rollout import Rollout
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank, make_heights
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, condition_column, condition_texts, nominal_row
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.registry import check_conditions, get_space, load_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd.stand_in import compute_by
from tests.sim.dogs import write_toml

EPISODES, STEPS = 3, 60
STREAMS = np.array([7, 1 << 31, 4_000_000_000], np.uint32)
SCAN = slice(48, 235)
RAMP = np.tile(0.1 * SPACING * np.arange(NUM_COLS, dtype=np.float32), (NUM_ROWS, 1))
CASES = {
    "shift": {"shift_x": 0.12, "shift_y": -0.05, "shift_turn": 0.1},
    "drift": {"drift": 0.1},
    "tilt": {"tilt": 0.05},
    "late": {"map_delay": 0.1, "map_period": 0.06},
    "holes": {"holes": 0.4},
    "grid": {"spacing": 1.2, "grain": 0.03},
    "estimate": {"estimate": 0.6, "wander": 0.4},
}
CASES["all"] = {name: value for case in CASES.values() for name, value in case.items()}


@pytest.fixture(scope="module")
def sim(anymal, device):
    bank = TerrainBank(1, device=device, with_conditions=True)
    return Simulation(anymal, bank, np.zeros(EPISODES, int))


def row_of(**values):
    row = nominal_row()
    for name, value in values.items():
        row[condition_column(name)] = value
    return row


def walk(steps=STEPS, speed=0.8):
    """Poses (steps, EPISODES, 7), quaternion xyzw, of robots that walk, turn and sway; they begin in other places."""
    t, k = np.arange(steps)[:, None] * 0.02, np.arange(EPISODES)
    yaw, roll = 0.3 * np.sin(t + k), 0.1 * np.sin(3 * t + k)
    turned = np.stack([np.cos(yaw / 2) * np.sin(roll / 2), np.sin(yaw / 2) * np.sin(roll / 2)], axis=-1)
    upright = np.stack([np.sin(yaw / 2) * np.cos(roll / 2), np.cos(yaw / 2) * np.cos(roll / 2)], axis=-1)
    place = np.stack([4.03 + 2.0 * k + speed * t, 3.71 + 0.3 * k + 0.1 * t, 0.6 + 0.05 * np.sin(t + k)], axis=-1)
    return np.concatenate([place, turned, upright], axis=-1).astype(np.float32)


def observe(sim, heights, row, poses):
    """Observations (steps, EPISODES, observation_size) at poses, all at a speed of 0.5, -0.2 and 0.1 m/s."""
    sim.bank.set_heights(heights[None])
    sim.bank.conditions.assign(row[None])
    with wp.ScopedDevice(sim.device):
        command, action = wp.zeros((EPISODES, 3), dtype=float), wp.zeros((EPISODES, 12), dtype=float)
        episodes, seed = make_episodes(EPISODES), wp.zeros(1, dtype=int)
        observation = wp.zeros((EPISODES, sim.robot.observation_size), dtype=float)
        episodes.rng.assign(STREAMS)
        episodes.outcome.fill_(int(Outcome.RUNNING))
        sim.begin_conditions(wp.ones(EPISODES, dtype=int))
        seen = []
        for number, at in enumerate(poses):
            sim.disturbed.steps.fill_(number * sim.robot.decimation)
            joint_q, joint_qd = sim.joint_q.numpy(), np.zeros(sim.joint_qd.shape, np.float32)
            joint_q[:, :7], joint_qd[:, :3] = at, (0.5, -0.2, 0.1)
            sim.joint_q.assign(joint_q)
            sim.joint_qd.assign(joint_qd)
            sim.observe(sim.make_step(command, action), episodes, sim.robot.physics_dt, None, seed, observation)
            seen.append(observation.numpy().copy())
    return np.array(seen)


def observe_in_c(sim, heights, row, poses):
    robot, seen = sim.robot, []
    joint_q, joint_qd = sim.joint_q.numpy(), np.zeros(sim.joint_qd.shape, np.float32)
    episodes = None
    joint_qd[:, :3] = 0.5, -0.2, 0.1
    scan = {"default_joint_pos": np.array(robot.default_joint_pos), "scan": np.stack(robot.scan_points(), axis=1)}
    for number, at in enumerate(poses):
        joint_q[:, :7] = at
        state = Starts.of_newton(joint_q, joint_qd, np.array(sim.base_com), STREAMS)
        if episodes is None:
            episodes = EpisodeStates(robot, crossing_model(robot, heights), state, row.astype(float), heights)
        episodes.qpos[:] = state.qpos
        rows = observations(heights, state.qpos, state.qvel, np.zeros((EPISODES, 3)), np.zeros((EPISODES, 12)), **scan)
        seen.append(episodes.disturb(rows, np.arange(EPISODES), number * robot.decimation).copy())
    return np.array(seen)


@pytest.mark.parametrize("case", CASES)
def test_both_simulations_show_the_same(sim, case):
    heights = make_heights(SUPER_GAUSSIAN.hard_random(1, 4), SUPER_GAUSSIAN)[0]
    row, poses = row_of(**CASES[case]), walk()
    ours = observe(sim, heights, row, poses)
    apart = np.abs(ours - observe_in_c(sim, heights, row, poses)) > 1e-4
    edges = {"holes", "grain"} & CASES[case].keys()  # beyond which a point may lie by the rounding of its place
    assert apart.sum() <= (5 if edges else 0)  # of 42,300
    columns = slice(0, 3) if case == "estimate" else SCAN
    changed = np.abs(ours - observe(sim, heights, nominal_row(), poses))
    assert (changed[..., columns].max(axis=(0, 2)) > 0.05).all()  # of each episode
    changed[..., columns] = 0.0
    assert not changed.any() or case == "all"


def still(z=0.6):
    poses = np.zeros((STEPS, EPISODES, 7), np.float32)
    poses[..., 0], poses[..., 1], poses[..., 2], poses[..., 6] = 6.0, 4.0, 0.6 + z, 1.0
    return poses


def errors(sim, heights, poses, **values):
    """Of the heights that scans show [m], (steps, EPISODES, points along x, along y)."""
    seen, true = (observe(sim, heights, row_of(**given), poses)[..., SCAN] for given in (values, {}))
    robot = sim.robot
    return -(seen - true).reshape(*seen.shape[:2], len(robot.scan_x), len(robot.scan_y)) / 5.0


def test_a_map_is_where_it_is_said_to_be(sim):
    """On a ramp of 1 in 10 along x: of a point that is d further along x the height is 0.1 d more."""
    x, y = np.array(sim.robot.scan_x)[:, None], np.array(sim.robot.scan_y)
    for values, further in (
        ({"shift_x": 0.12}, -0.12 + 0 * (x + y)),  # what is at x is shown at x + .12
        ({"shift_y": 0.12}, 0 * (x + y)),
        (
            {"shift_turn": 0.1},
            x * np.cos(0.1) + y * np.sin(0.1) - x,
        ),  # higher on the left: what is ahead is shown there
        ({"spacing": 1.2}, 0.2 * x + 0 * y),
    ):
        np.testing.assert_allclose(errors(sim, RAMP, still(), **values)[0, 0], 0.1 * further, atol=2e-6)
    shown = errors(sim, RAMP, still(), grain=0.05)[0, 0] + 0.1 * (6.0 + x)
    np.testing.assert_allclose(shown, 0.05 * np.round(shown / 0.05), atol=1e-5)
    assert np.unique(np.round(shown / 0.05)).size > 2


def test_a_late_map_is_that_of_a_former_pose(sim):
    poses, values = walk(20), {"map_delay": 0.1, "map_period": 0.06}
    late, true = (observe(sim, RAMP, row_of(**given), poses)[..., SCAN] for given in (values, {}))
    former = [0, 0, 0, 0, 0, 0, 0, 0, 3, 3, 3, 6, 6, 6, 9, 9, 9, 12, 12, 12]  # 5 steps late, every third
    np.testing.assert_allclose(late, true[former], atol=1e-5)


def test_a_map_drifts_by_a_random_walk_of_its_episode(sim):
    walked = errors(sim, 0.0 * RAMP, still(0.0), drift=0.1)
    assert np.ptp(walked, axis=(2, 3)).max() < 1e-5  # level ground stays level
    heights = walked[:, :, 0, 0]
    assert not heights[0].any() and (np.abs(heights[50]) > 0.0).all() and (np.abs(heights[50]) < 0.1).all()
    np.testing.assert_allclose(heights[25], heights[50] / 2, atol=1e-5)  # straight up to the next second
    assert np.abs(np.diff(heights[50])).min() > 1e-3
    slope = errors(sim, 0.0 * RAMP, still(0.0), tilt=0.05)[50]
    x, y = sim.robot.scan_x, sim.robot.scan_y
    along = np.diff(slope, axis=1) / np.diff(x)[:, None]
    across = np.diff(slope, axis=2) / np.diff(y)
    for inclines in (along, across):
        assert np.ptp(inclines, axis=(1, 2)).max() < 1e-3 and np.abs(inclines).max() < 0.05
        assert np.abs(inclines[:, 0, 0]).min() > 1e-3


def test_holes_show_what_was_there_before(sim):
    poses = walk(30, speed=1.0)
    seen, true = (observe(sim, RAMP, row_of(**given), poses)[..., SCAN] for given in ({"holes": 0.4}, {}))
    missing = np.abs(seen - true) > 1e-6
    first = 5.0 * (poses[0, :, 2:3] - 0.1 * poses[0, :, :1] - 0.5)  # the ramp below the base
    np.testing.assert_allclose((seen[0] - first)[missing[0]], 0.0, atol=1e-5)
    later = np.abs(np.diff(seen, axis=0))[missing[1:]]
    assert (later < 1e-6).all()
    assert missing.mean() == pytest.approx(0.4, abs=0.1)
    assert (missing[:, 0] != missing[:, 1]).any()


def test_the_velocity_is_scaled_and_wanders(sim):
    seen = {name: observe(sim, RAMP, row_of(**given), still())[..., :3] for name, given in (
        ("true", {}), ("half", {"estimate": 0.5}), ("absent", {"estimate": 0.0}), ("wanders", {"wander": 0.5}),
    )}  # fmt: skip
    np.testing.assert_allclose(seen["half"], 0.5 * seen["true"], atol=1e-6)
    assert not seen["absent"].any()
    off = (seen["wanders"] - seen["true"]) / 2.0
    assert not off[..., 2].any() and 0.2 < np.abs(off[..., :2]).max() <= 0.5
    np.testing.assert_allclose(off[:51], np.linspace(off[0], off[50], 51), atol=1e-6)


def test_errors_in_words():
    names = (*GROUPS["map"], "estimate")
    texts = condition_texts(row_of(**CASES["all"]), names)
    assert texts == [
        "height map 0.12 m ahead and 0.05 m to the right of where it is, turned by 6 degrees to the left",
        "height map drifting by up to 0.100 m a second and turning and tilting by up to 2.9 degrees a second",
        "height map 100 ms late and new every 60 ms",
        "height map with 40% of it missing",
        "height map at 1.20 times its spacing and in steps of 0.030 m",
        "seen velocity 0.60 times the true one and off by up to 0.40 m/s",
    ]
    assert condition_texts(nominal_row(), names) == [""] * 6
    assert load_space("course+map+estimate").conditions == names and get_space("course+map").conditions == names[:-1]
    assert [gene.name for name in names for gene in CONDITIONS[name].genes if gene.mirrored] == [
        "shift_y",
        "shift_turn",
    ]


def test_what_a_robot_does_not_see_cannot_be_wrong(anymal, tmp_path):
    blind = dataclasses.replace(anymal, scan_x=(), scan_y=())
    with pytest.raises(ValueError, match=r"robot 'anymal' .* scan.*map_shift, \+map_drift.*leave"):
        Rollout(blind, anymal.policy_file, num_terrains=1, replicas=1, device="cpu", space=get_space("course+map"))
    check_conditions(("push", "estimate"), blind)
    check_conditions(GROUPS["map"], anymal, {"scan"})
    with pytest.raises(ValueError, match="lin_vel"):
        check_conditions(("estimate",), anymal, {"scan"})
    with pytest.raises(ValueError, match="scan"):  # before the robot is tried
        start_search(
            str(write_toml(tmp_path / "a")), None, "course+map", size="small", height=None, compute=compute_by(None)
        )
