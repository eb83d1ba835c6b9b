"""Episodes: their queue, start, command and end, by an oracle, properties and hand-computed numbers."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from kernels.episode import (
    SEGMENTS,
    Invalidity,
    Kind,
    Outcome,
    begin_episodes,
    command_goal,
    command_steered,
    latch_outcomes,
    make_episodes,
    note_base_forces,
)
from kernels.observation import Sensors
from kernels.penalties import BASE, FOOT, LIMB
from kernels.queue import clear_rows, make_queue, make_ready, restart_episodes, turn_over
from kernels.rewards import Rewards, make_rewards
from kernels.state import RobotStep
from sim.crossing import CrossingCfg, find_highest_command, make_start_ranges, make_task
from sim.mujoco_c.model import Starts, goal_commands, steered_commands
from sim.robots.find import get_robot
from tests.kernels import oracle
from tests.kernels.states import filled, make_terrain, random_states, rough, upright

ROLES = [LIMB, BASE, FOOT, BASE]
MAX_STEPS = 4000
BASE_COM = (-0.02, 0.01, 0.03)


def create_task(speed=0.75, **settings):
    return make_task(CrossingCfg(**settings), replace(get_robot("anymal"), speed=speed))


def make_state(num_envs, outcome=0, steps=0):
    state = make_episodes(num_envs)
    state.outcome.assign(np.broadcast_to(np.int32(outcome), num_envs))
    state.steps.assign(np.broadcast_to(np.int32(steps), num_envs))
    state.counted.fill_(9)
    return state


def latch(states, state, *, action=0.0, force=0.0, overflow=0, task=None, **limits):
    """One judged step; ``force`` [N] acts on the second base geom of every environment, ``action`` is of one joint."""
    num_envs = len(states[0])
    task = task or create_task()
    forces = np.zeros((num_envs, len(ROLES), 3), np.float32)
    forces[:, 0] = forces[:, 2] = 500.0  # limbs and feet may touch as they like
    forces[:, 3, 1] = force
    for name, value in limits.items():
        setattr(task, name, value)
    step = filled(
        RobotStep, joint_q=states[0], joint_qd=states[1], geom_force=forces, geom_role=ROLES,
        action=np.broadcast_to(np.float32(action), num_envs)[:, None], overflow=np.broadcast_to(overflow, num_envs),
    )  # fmt: skip
    latch_outcomes(step, task, state)
    return [Outcome(k) for k in state.outcome.numpy()]


def expected_outcome(q, qd, base_force, overflow, steps):
    """Name of how an episode stands after a step (definitions: a crossing)."""
    if not np.isfinite([*q, *qd]).all() or np.abs(qd).max() > 100 or overflow & ~(512 | 1024):
        return "INVALID"
    if base_force > 1:
        return "BASE_COLLISION"
    if np.hypot(14 - q[0], 4 - q[1]) < 0.5:
        return "GOAL"
    if abs(q[1] - 4) > 6 or q[0] < -2 or q[0] > 18:
        return "OUT"
    return "TIME_OUT" if steps >= MAX_STEPS else "RUNNING"


def test_outcomes_equal_the_oracle():
    rng, num_envs = np.random.default_rng(0), 600
    q, qd = random_states(num_envs, 3)
    q[:, 0] = rng.choice([-2.1, -1.9, 8.0, 13.6, 14.4, 17.9, 18.1], num_envs)
    q[:, 1] = rng.choice([-2.1, -1.9, 4.2, 9.9, 10.1], num_envs)
    qd[:, rng.integers(0, 9)] = rng.choice([0.0, 99.0, -101.0], num_envs, p=[0.6, 0.2, 0.2])
    q[rng.random(num_envs) < 0.05, 8] = np.nan
    force, steps = rng.choice([0.0, 0.9, 1.1], num_envs), rng.choice([5, MAX_STEPS - 2, MAX_STEPS - 1], num_envs)
    overflow = rng.choice([0, 512, 1024, 512 | 1024, 4], num_envs)
    outcomes = latch((q, qd), make_state(num_envs, steps=steps), force=force, overflow=overflow)
    expected = [expected_outcome(*row) for row in zip(q, qd, force, overflow, steps + 1, strict=True)]
    assert [outcome.name for outcome in outcomes] == expected
    assert set(outcomes) == set(Outcome) - {Outcome.TILT, Outcome.STRAYED}


def test_an_ended_episode_stays_ended():
    # Ended episodes keep outcome, steps and pose whatever happens to their robots after.
    q, qd = upright(4, 3)
    state = make_state(4, outcome=[0, Outcome.GOAL, Outcome.TIME_OUT, 0], steps=[7, 8, 9, 10])
    q[3, 0] = 14.0
    q[1:3] = np.nan
    assert latch((q, qd), state) == [Outcome.RUNNING, Outcome.GOAL, Outcome.TIME_OUT, Outcome.GOAL]
    assert state.steps.numpy().tolist() == [8, 8, 9, 11]
    assert state.counted.numpy().tolist() == [1, 0, 0, 1]
    np.testing.assert_array_equal(state.final_pose.numpy()[3], np.float32([14, 4, 0.6, 0, 0, 0, 1]))
    assert not state.final_pose.numpy()[:3].any()
    q[:] = np.nan
    latch((q, qd), state)
    assert state.outcome.numpy().tolist() == [Outcome.INVALID, Outcome.GOAL, Outcome.TIME_OUT, Outcome.GOAL]
    assert not state.counted.numpy().any()


def test_an_invalid_episode_says_why_and_a_cause_goes_before_what_comes_of_it():
    # Five robots with one fault each, two with several, of which the first of ACTION, OVERFLOW, STATE, SPEED is named;
    # the last one walks.
    q, qd = upright(8, 3)
    action, overflow = np.zeros(8), np.zeros(8, int)
    action[0], overflow[1], q[2, 8], qd[3, 0], qd[4, 1] = np.nan, 4, np.nan, -101.0, np.inf
    action[5] = q[5, 0] = qd[5, 0] = qd[6, 0] = np.nan
    overflow[5] = overflow[6] = 4
    state = make_state(8)
    assert latch((q, qd), state, action=action, overflow=overflow) == [Outcome.INVALID] * 7 + [Outcome.RUNNING]
    expected = ["ACTION", "OVERFLOW", "STATE", "SPEED", "STATE", "ACTION", "OVERFLOW"]
    assert [Invalidity(k).name for k in state.invalidity.numpy()[:7]] == expected
    # An episode that ends otherwise has no reason, whatever the one before it had.
    begin_episodes(wp.ones(8, dtype=int), state)
    assert latch(upright(8, 3, x=14.0), state) == [Outcome.GOAL] * 8
    assert not state.invalidity.numpy().any()


def test_penalties_may_count_from_a_later_step():
    # From 0.02 s on: the first four steps of 0.005 s do not count, the fifth does.
    state, counted = make_state(1), []
    for _ in range(6):
        latch(upright(1, 3), state, task=create_task(penalties_from_s=0.02))
        counted.append(int(state.counted.numpy()[0]))
    assert counted == [0, 0, 0, 0, 1, 1]


@pytest.mark.parametrize(
    ("degrees", "changes", "outcome"),
    [
        # The projected gravity's z is -cos(tilt): -0.1 at 84.3 degrees.
        (84.0, {"max_gravity_z": -0.1}, Outcome.GOAL),
        (84.6, {"max_gravity_z": -0.1}, Outcome.TILT),
        (180.0, {}, Outcome.GOAL),
        (180.0, {"max_gravity_z": -0.1, "force": 5.0}, Outcome.BASE_COLLISION),
        (180.0, {"max_gravity_z": -0.1, "force": 5.0, "overflow": 4}, Outcome.INVALID),
    ],
)
def test_the_gravest_end_wins(degrees, changes, outcome):
    q, qd = upright(1, 3, x=14.0)
    q[:, 3], q[:, 6] = np.sin(np.deg2rad(degrees) / 2), np.cos(np.deg2rad(degrees) / 2)
    assert latch((q, qd), make_state(1, steps=MAX_STEPS - 1), **changes) == [outcome]


def test_without_a_goal_and_borders_neither_ends_an_episode():
    q, qd = upright(3, 3)
    q[:, 0] = 14.0, -1e6, 1e6
    endless = {"goal_radius": 0.0, "lower": (-np.inf, -np.inf), "upper": (np.inf, np.inf)}
    assert latch((q, qd), make_state(3), **endless) == [Outcome.RUNNING] * 3


def test_a_touch_noted_between_ends_the_episode_and_is_then_forgotten():
    state = make_state(2)
    still = np.zeros((2, 4, 3), np.float32)
    touched = still.copy()
    touched[1, 1, 2] = 40.0  # on the base
    touched[0, 2, 2] = 500.0  # on a foot
    for force in (touched, still):
        note_base_forces(filled(RobotStep, geom_force=force, geom_role=ROLES), state)
    assert state.base_force.numpy().tolist() == [0.0, 40.0]
    assert latch(upright(2, 3), state) == [Outcome.RUNNING, Outcome.BASE_COLLISION]
    assert state.base_force.numpy().tolist() == [0.0, 0.0]


def commands(q, outcome=0):
    out = wp.zeros((len(q), 3), dtype=float)
    command_goal(wp.array(q), wp.array(np.broadcast_to(outcome, len(q)), dtype=int), create_task(), out)
    return out.numpy()


def test_commands_lead_to_the_goal():
    q, qd = random_states(300, 3)
    expected = goal_commands(Starts.of_newton(q, qd, np.zeros(3)).qpos, 0.75)
    np.testing.assert_allclose(commands(q), expected, atol=2e-5)
    # At (2, 4) facing the goal: 0.75 m/s straight ahead. At (14, 0), facing along x, the goal lies 90 degrees left:
    # 0.75 m/s to the left, yaw rate 0.5 * pi / 2 = 0.785398. Ended: nothing.
    q, _ = upright(3, 3)
    q[1, :2] = 14, 0
    by_hand = [[0.75, 0, 0], [0, 0.75, 0.785398], [0, 0, 0]]
    np.testing.assert_allclose(commands(q, [0, 0, Outcome.TIME_OUT]), by_hand, atol=1e-5)


def steered(q, steering, episode_of_env, outcome=0, **settings):
    out = wp.full((len(q), 3), 9.0, dtype=float)
    over = wp.array(np.broadcast_to(outcome, len(q)), dtype=int)
    ways = wp.array(np.float32(steering), dtype=float)
    command_steered(wp.array(q), over, ways, wp.array(episode_of_env, dtype=int), create_task(**settings), out)
    return out.numpy()


@pytest.mark.parametrize("speed", [0.75, 1.5])
def test_steered_commands_follow_the_way_of_the_episode(speed):
    q, qd = random_states(300, 3)
    rng = np.random.default_rng(4)
    ways = rng.normal([speed, 0.0, 0.0], [0.5, 0.5, 0.5], (300, SEGMENTS, 3)).astype(np.float32)
    order = rng.permutation(300)
    highest = find_highest_command(CrossingCfg(), replace(get_robot("anymal"), speed=speed))
    expected = steered_commands(Starts.of_newton(q, qd, np.zeros(3)).qpos, ways[order], highest)
    np.testing.assert_allclose(steered(q, ways, order, speed=speed), expected, atol=2e-5)
    assert expected[:, 0].max() == max(speed, 1.0)  # as fast as unsteered, or 1 m/s


def test_steered_commands_by_hand():
    # Segments are 1 m. At (5.5, 4), in segment 3, facing the goal; the place ahead is (6.5, 4 + offset).
    q, _ = upright(6, 3)
    q[:, :2] = 5.5, 4.0
    ways = np.zeros((6, SEGMENTS, 3), np.float32)
    ways[:, 3] = [[0.4, 0, 0], [2.0, 0, 0], [0.6, 1.0, 0], [0.4, 0, 0.6], [np.nan, 0, 0], [0.4, 0, 0]]
    ways[4, 0, 0] = np.nan
    # 0.4 m/s ahead. At most 1 m/s. The place lies 45 degrees to the left: 0.6 / sqrt(2) both, yaw rate 0.5 * pi / 4.
    # 0.6 rad to the left of the way: yaw rate 0.3. Not steered, and ended: what was there stays.
    by_hand = [[0.4, 0, 0], [1, 0, 0], [0.424264, 0.424264, 0.392699], [0.4, 0, 0.3], [9, 9, 9], [9, 9, 9]]
    outcome = [0, 0, 0, 0, 0, Outcome.GOAL]
    np.testing.assert_allclose(steered(q, ways, np.arange(6), outcome), by_hand, atol=1e-5)
    # Within 1 m of the goal's side of the way the goal itself is the place, whatever the offset; no robot, no command.
    q[:, :2] = 13.2, 4.0
    ways[:, -1] = 0.5, 2.0, 0.0
    np.testing.assert_allclose(steered(q[:1], ways, [0]), [[0.5, 0, 0]], atol=1e-5)
    np.testing.assert_array_equal(steered(q[:1], ways, [-1]), [[9, 9, 9]])


def test_the_largest_distance_from_the_straight_line_is_kept():
    state = make_state(2)
    for y in ([4.3, 4.0], [3.4, 4.1], [4.2, 4.0]):
        q, qd = upright(2, 3)
        q[:, 1] = y
        latch((q, qd), state)
    np.testing.assert_allclose(state.deviation.numpy(), [0.6, 0.1], atol=1e-6)


SLOTS, REPLICAS = 3, 4


class Robots:
    """Robots without physics: what a test says of their episodes is what happened."""

    def __init__(self, num_envs):
        how = {"rewarded": False, "steered": False, "device": str(wp.get_device())}
        self.queue = make_queue(num_envs, SLOTS, REPLICAS, 1, **how)
        self.episodes = make_episodes(num_envs)
        self.queue.seed.assign(np.arange(7, 7 + SLOTS, dtype=np.uint32))
        self.sums, self.terrain = wp.zeros((num_envs, 1)), wp.zeros(num_envs, dtype=int)

    def turn(self):
        turn_over(self.episodes.outcome, Rewards(), self.episodes, self.sums, self.terrain, self.queue)
        running = self.queue.episode_of_env.numpy() >= 0
        self.episodes.outcome.assign(np.where(running, Outcome.RUNNING, Outcome.TIME_OUT).astype(np.int32))
        return self.queue.episode_of_env.numpy().copy()

    def end(self, envs):
        now = self.episodes.outcome.numpy().copy()
        now[envs] = Outcome.GOAL
        self.episodes.outcome.assign(now)


@pytest.mark.parametrize("num_envs", [1, 5, 12])
def test_every_episode_is_run_once(num_envs):
    robots, taken, starts, rng = Robots(num_envs), [], {}, np.random.default_rng(num_envs)
    make_ready(SLOTS * REPLICAS, robots.queue)
    for _ in range(200):
        rows = robots.turn()
        starts |= dict(zip(rows.tolist(), robots.episodes.rng.numpy().tolist(), strict=True))
        taken += rows[robots.queue.begins.numpy() != 0].tolist()
        running = np.flatnonzero(rows >= 0)
        if len(running) == 0:
            break
        robots.end(rng.choice(running, rng.integers(1, len(running) + 1), replace=False))
    assert sorted(taken) == list(range(12))
    assert len({starts[row] for row in taken}) == 12  # each start is drawn from another state
    assert robots.queue.num_ended.numpy().tolist() == [4, 4, 4]
    assert (robots.queue.outcome.numpy() == Outcome.GOAL).all()


def test_rows_are_taken_round_the_ring():
    robots = Robots(5)
    for lot in range(7):  # five at a time of twelve rows: 0-4, 5-9, 10-2, 3-7, ...
        make_ready(5, robots.queue)
        assert sorted(robots.turn()) == sorted((5 * lot + k) % 12 for k in range(5))
        robots.end(range(5))
    robots.turn()
    # 35 episodes on 3 terrains of 4: rows 0 to 10 were run three times, row 11 twice.
    assert robots.queue.num_ended.numpy().tolist() == [12, 12, 11]
    # The numbers do not grow for ever: of 30 taken before the last five, two whole rounds of 12 are taken off.
    assert robots.queue.ready.numpy()[0] == 11


def start(grids, replicas, anymal, outcome=None, rewards=None):
    """Joint coordinates and velocities and the episodes after a restart; all have ended unless ``outcome`` is given."""
    num_envs, joints = len(grids) * replicas, anymal.num_joints
    widths = {"joint_q": 7 + joints, "joint_qd": 6 + joints, "action": joints}
    step = filled(RobotStep, base_com=BASE_COM, **{n: np.full((num_envs, width), 3.0) for n, width in widths.items()})
    state = make_episodes(num_envs)
    state.steps.fill_(77)
    ended = np.full(num_envs, 1) if outcome is None else np.int32(outcome) != Outcome.RUNNING
    terrain_of_env = np.repeat(np.arange(len(grids)), replicas)
    mask, on = (wp.array(numbers, dtype=int) for numbers in (ended, terrain_of_env))
    sensors = filled(Sensors, default_joint_pos=anymal.default_joint_pos)
    ranges = make_start_ranges(CrossingCfg(), anymal)
    state.rng.assign(np.random.default_rng(0).integers(2**32, size=num_envs, dtype=np.uint32))
    restart_episodes(mask, on, make_terrain(grids), ranges, sensors, step, state, rewards or Rewards())
    q, qd, action = (getattr(step, name).numpy() for name in widths)
    assert (action == np.where(q[:, :1] == 3.0, 3.0, 0.0)).all()
    return q, qd, state


def test_running_episodes_are_left_alone(anymal):
    rewards = make_rewards(3, 12, 2)
    for array in (rewards.running, rewards.total, rewards.air_time, rewards.touched, rewards.terms):
        array.fill_(5)
    outcome = [Outcome.TILT, Outcome.RUNNING, Outcome.TIME_OUT]
    q, qd, state = start(np.zeros((1, 161, 321)), 3, anymal, outcome=outcome, rewards=rewards)
    assert (q[1] == 3.0).all() and (qd[1] == 3.0).all()
    assert (q[[0, 2], 0] != 3.0).all() and not qd[[0, 2], 6:].any()
    assert state.steps.numpy().tolist() == [0, 77, 0]
    assert rewards.running.numpy().tolist() == [1, 5, 1]
    for array in (rewards.total, rewards.air_time, rewards.touched):
        values = array.numpy().reshape(3, -1)
        assert (values[1] == 5).all() and (values[[0, 2]] == 0).all()
    assert (rewards.terms.numpy() == 5).all()  # sums over episodes


def test_starts_fill_their_ranges(anymal):
    q, qd, state = start(np.zeros((1, 161, 321)), 800, anymal)
    default = np.array(anymal.default_joint_pos)
    moving = default != 0
    turns = oracle.rotation_matrix(q[:, 3:7])
    origin_velocity = qd[:, :3] - np.cross(qd[:, 3:6], turns @ BASE_COM)
    columns = {  # drawn quantity, middle, half width (definitions: a crossing)
        "x": (q[:, :1], 2, 0.1),
        "y": (q[:, 1:2], 4, 0.1),
        "yaw": (np.arctan2(turns[:, 1, :1], turns[:, 0, :1]), 0, 0.2),
        "joints": (q[:, 7:][:, moving] / default[moving], 1, 0.2),
        "velocity": (origin_velocity, 0, 0.2),
        "angular velocity": (qd[:, 3:6], 0, 0.2),
    }
    for name, (drawn, middle, half) in columns.items():
        off = (drawn - middle) / half
        assert np.abs(off).max() < 1 + 1e-4, name
        assert off.max(axis=0).min() > 0.97, name  # 800 draws all below 0.97: chance 5e-6
        assert off.min(axis=0).max() < -0.97, name
        # The mean of 800 uniform draws is 0 +- 0.02; the draws of one column tell nothing of the next.
        assert np.abs(off.mean(axis=0)).max() < 0.1, name
    drawn = np.column_stack([values for values, _, _ in columns.values()])
    assert np.abs(np.corrcoef(drawn.T) - np.eye(drawn.shape[1])).max() < 0.2
    assert not q[:, 7:][:, ~moving].any() and not qd[:, 6:].any()
    np.testing.assert_allclose(np.linalg.norm(q[:, 3:7], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(q[:, 2], anymal.default_base_height, atol=1e-6)
    assert (state.outcome.numpy() == Outcome.RUNNING).all() and not state.steps.numpy().any()
    np.testing.assert_array_equal(state.start.numpy(), q[:, :2])


def test_the_start_stands_on_the_highest_ground_under_the_robot(anymal):
    grids = np.stack([rough(161, 321, 0.3, seed=k) for k in range(2)])
    half = np.array(anymal.footprint)
    for env, row in enumerate(np.float64(start(grids, 8, anymal)[0])):
        low, high = np.floor((row[:2] - half) / 0.05).astype(int), np.ceil((row[:2] + half) / 0.05).astype(int)
        ground = grids[env // 8, low[1] : high[1] + 1, low[0] : high[0] + 1].max()
        assert row[2] == pytest.approx(ground + anymal.default_base_height, abs=1e-6)


@pytest.mark.parametrize("columns", [2, 64, 1801])
def test_masked_rows_are_cleared_whole(columns):
    rows = wp.array(np.full((3, columns), np.nan, np.float32))
    clear_rows(wp.array([1, 0, 7], dtype=int), rows)
    assert not rows.numpy()[[0, 2]].any() and np.isnan(rows.numpy()[1]).all()


@pytest.mark.parametrize(
    ("kind", "changes", "outcome"),
    [
        (Kind.ROUTE, {}, Outcome.RUNNING),
        (Kind.ROUTE, {"ends": True}, Outcome.GOAL),
        (Kind.ROUTE, {"x": 14.0}, Outcome.RUNNING),  # the goal of crossings
        (Kind.ROUTE, {"x": 18.5}, Outcome.GOAL),
        (Kind.ROUTE, {"strayed": 50}, Outcome.STRAYED),
        (Kind.ROUTE, {"strayed": 49}, Outcome.RUNNING),
        (Kind.ROUTE, {"tilt": 1.1, "ends": True}, Outcome.TILT),
        (Kind.STAND, {"ends": True}, Outcome.GOAL),
        (Kind.STAND, {"x": 2.6, "ends": True}, Outcome.STRAYED),
        (Kind.STAND, {"x": 2.6}, Outcome.RUNNING),
        (Kind.STAND, {"strayed": 50}, Outcome.RUNNING),
        (Kind.CROSS, {"x": 14.0}, Outcome.GOAL),
        (Kind.CROSS, {"tilt": 1.1, "strayed": 50}, Outcome.RUNNING),
    ],
)
def test_how_an_episode_ends_depends_on_what_was_asked_for(kind, changes, outcome):
    joint_q, joint_qd = upright(1, 1, x=changes.get("x", 2.0))
    tilt = changes.get("tilt", 0.0)
    joint_q[:, 3:7] = np.sin(tilt / 2), 0.0, 0.0, np.cos(tilt / 2)
    state = make_state(1, steps=MAX_STEPS - 1 if changes.get("ends") else 10)
    state.kind.fill_(int(kind))
    state.strayed.fill_(changes.get("strayed", 0))
    state.start.assign(np.array([[2.0, 4.0]], np.float32))
    assert latch((joint_q, joint_qd), state) == [outcome]
