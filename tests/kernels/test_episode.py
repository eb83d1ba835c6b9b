"""A crossing's start, goal command and latch: oracle, properties, hand-computed numbers."""

import numpy as np
import pytest
import warp as wp

from kernels.episode import (
    PARKING_HEIGHT,
    EpisodeState,
    Outcome,
    command_goal,
    latch_outcomes,
    park_ended,
    start_episodes,
)
from kernels.penalties import BASE, FOOT, LIMB
from sim.bench import oracle
from sim.crossing import CrossingCfg, make_start_ranges, make_task
from tests.kernels.states import random_states, upright
from tests.kernels.test_heightfield import make_terrain, rough

ROLES = [LIMB, BASE, FOOT, BASE]
BASE_COM = (-0.02, 0.01, 0.03)
MAX_STEPS = 4000
GOAL = (14.0, 4.0)


def make_state(num_envs, device, outcome=0, steps=0):
    state = EpisodeState()
    state.outcome = wp.array(np.broadcast_to(outcome, num_envs), dtype=int, device=device)
    state.steps = wp.array(np.broadcast_to(steps, num_envs), dtype=int, device=device)
    state.counted = wp.full(num_envs, 9, dtype=int, device=device)
    state.final_pose = wp.zeros(num_envs, dtype=wp.transform, device=device)
    running = np.count_nonzero(np.broadcast_to(outcome, num_envs) == Outcome.RUNNING)
    state.num_running = wp.array([running], dtype=int, device=device)
    return state


def latch(states, device, anymal, state, *, force=0.0, overflow=0, contacts=(0, 10), cfg=None):
    """One judged step; ``force`` [N] acts on the second base geom of every environment."""
    num_envs = len(states[0])
    forces = np.zeros((num_envs, len(ROLES), 3))
    forces[:, 0] = forces[:, 2] = 500.0  # limbs and feet may touch as they like
    forces[:, 3, 1] = force
    latch_outcomes(
        *(wp.array(np.float32(array), device=device) for array in states),
        wp.array(np.float32(forces), dtype=wp.vec3, device=device),
        wp.array(ROLES, dtype=int, device=device),
        wp.array(np.broadcast_to(overflow, num_envs), dtype=int, device=device),
        wp.array([contacts[0]], dtype=int, device=device),
        contacts[1],
        make_task(cfg or CrossingCfg(), anymal),
        state,
    )
    return [Outcome(k) for k in state.outcome.numpy()]


def test_latch_parity_with_the_oracle(device, anymal):
    rng = np.random.default_rng(0)
    num_envs = 600
    q, qd = random_states(num_envs, 3)
    q[:, 0] = rng.choice([-2.1, -1.9, 8.0, 13.6, 14.4, 17.9, 18.1], num_envs)
    q[:, 1] = rng.choice([-2.1, -1.9, 4.2, 9.9, 10.1], num_envs)
    qd[:, rng.integers(0, 9)] = rng.choice([0.0, 99.0, -101.0], num_envs, p=[0.6, 0.2, 0.2])
    q[rng.random(num_envs) < 0.05, 8] = np.nan
    force, steps = rng.choice([0.0, 0.9, 1.1], num_envs), rng.choice([5, MAX_STEPS - 2, MAX_STEPS - 1], num_envs)
    overflow = rng.choice([0, 512, 1024, 512 | 1024, 4], num_envs)
    got = latch((q, qd), device, anymal, make_state(num_envs, device, steps=steps), force=force, overflow=overflow)
    expected = [oracle.outcome(*row, MAX_STEPS) for row in zip(q, qd, force, overflow, steps + 1, strict=True)]
    assert [outcome.name for outcome in got] == expected
    assert {outcome.name for outcome in got} == {outcome.name for outcome in Outcome}


def test_an_ended_episode_stays_ended(device, anymal):
    # Ended episodes keep outcome, steps and pose whatever happens to their robots after; the count runs down once each.
    q, qd = upright(4, 3)
    state = make_state(4, device, outcome=[0, Outcome.GOAL, Outcome.TIME_OUT, 0], steps=[7, 8, 9, 10])
    q[3, 0] = 14.0
    q[1:3] = np.nan
    assert latch((q, qd), device, anymal, state) == [Outcome.RUNNING, Outcome.GOAL, Outcome.TIME_OUT, Outcome.GOAL]
    assert state.steps.numpy().tolist() == [8, 8, 9, 11]
    assert state.counted.numpy().tolist() == [1, 0, 0, 1]
    assert state.num_running.numpy()[0] == 1
    np.testing.assert_array_equal(state.final_pose.numpy()[3], np.float32([14, 4, 0.6, 0, 0, 0, 1]))
    assert not state.final_pose.numpy()[:3].any()
    q[:] = np.nan
    latch((q, qd), device, anymal, state)
    assert state.outcome.numpy().tolist() == [Outcome.INVALID, Outcome.GOAL, Outcome.TIME_OUT, Outcome.GOAL]
    assert state.counted.numpy().tolist() == [0, 0, 0, 0]
    assert state.num_running.numpy()[0] == 0


def test_robots_whose_episode_ended_are_parked_and_the_others_left_alone(device):
    rng = np.random.default_rng(8)
    outcome = np.array([Outcome.RUNNING, Outcome.GOAL, Outcome.INVALID])
    before = [np.float32(rng.normal(size=size)) for size in ((3, 9), (3, 8), (3, 9), (3, 2, 7))]
    before[0][2, 0] = before[1][2, 3] = np.nan  # what made it invalid must not stay
    arrays = [wp.array(values, device=device) for values in before[:3]]
    bodies = wp.array(before[3], dtype=wp.transform, device=device)
    pose = wp.array([0.3, -0.4], dtype=float, device=device)
    park_ended(wp.array(outcome, dtype=int, device=device), pose, *arrays, bodies)
    q, qd, targets = (array.numpy() for array in arrays)
    for values, now in zip(before, (q, qd, targets, bodies.numpy()), strict=True):
        np.testing.assert_array_equal(now[0], values[0])
    height = float(PARKING_HEIGHT)
    for env in (1, 2):
        np.testing.assert_array_equal(q[env, 2:], np.float32([height, 0, 0, 0, 1, 0.3, -0.4]))
        np.testing.assert_array_equal(targets[env, 7:], np.float32([0.3, -0.4]))
        assert not qd[env].any()
        np.testing.assert_array_equal(bodies.numpy()[env], np.tile(np.float32([0, 0, height, 0, 0, 0, 1]), (2, 1)))
    assert np.isfinite(q).all()


def test_the_episode_lasts_twenty_seconds(device, anymal):
    # 20 s of 0.005 s are 4,000 steps: the 3,999th leaves it running, the 4,000th ends it.
    state = make_state(1, device, steps=3998)
    assert latch(upright(1, 3), device, anymal, state) == [Outcome.RUNNING]
    assert latch(upright(1, 3), device, anymal, state) == [Outcome.TIME_OUT]
    assert state.steps.numpy()[0] == 4000


def test_dropped_contacts_make_every_running_episode_invalid(device, anymal):
    state = make_state(3, device, outcome=[0, Outcome.GOAL, 0])
    outcomes = latch(upright(3, 3), device, anymal, state, contacts=(11, 10))
    assert outcomes == [Outcome.INVALID, Outcome.GOAL, Outcome.INVALID]
    assert latch(upright(1, 3), device, anymal, make_state(1, device), contacts=(10, 10)) == [Outcome.RUNNING]


def test_penalties_may_count_from_a_later_step(device, anymal):
    # From 0.02 s on: the first four steps do not count, the fifth does.
    state, counted = make_state(1, device), []
    for _ in range(6):
        latch(upright(1, 3), device, anymal, state, cfg=CrossingCfg(penalties_from_s=0.02))
        counted.append(int(state.counted.numpy()[0]))
    assert counted == [0, 0, 0, 0, 1, 1]


def command(states, device, anymal, outcome=0):
    num_envs = len(states[0])
    out = wp.zeros((num_envs, 3), dtype=float, device=device)
    outcomes = wp.array(np.broadcast_to(outcome, num_envs), dtype=int, device=device)
    command_goal(wp.array(states[0], device=device), outcomes, make_task(CrossingCfg(), anymal), out)
    return out.numpy()


def test_command_parity_with_the_oracle(device, anymal):
    q, qd = random_states(300, 3)
    expected = [oracle.goal_command(row[:2], oracle.yaw_of(row[3:7]), GOAL) for row in np.float64(q)]
    np.testing.assert_allclose(command((q, qd), device, anymal), expected, atol=2e-5)


def test_command_by_hand(device, anymal):
    # At (2, 4) facing the goal: 0.75 m/s straight ahead. At (14, 0), facing along x, the goal lies 90 degrees left:
    # 0.75 m/s to the left, yaw rate 0.5 * pi / 2 = 0.785398. Facing away (yaw -90 degrees): error pi, so back at
    # 0.75 m/s and 0.5 * pi clipped to 1 (either sign). Ended: nothing.
    q, qd = upright(4, 3)
    q[1, :2] = q[2, :2] = 14, 0
    q[2, 3:7] = 0, 0, -np.sqrt(0.5), np.sqrt(0.5)
    got = command((q, qd), device, anymal, outcome=[0, 0, 0, Outcome.TIME_OUT])
    np.testing.assert_allclose(got[[0, 1, 3]], [[0.75, 0, 0], [0, 0.75, 0.785398], [0, 0, 0]], atol=1e-5)
    np.testing.assert_allclose([got[2, 0], abs(got[2, 2])], [-0.75, 1], atol=1e-5)


def start(seeds, replicas, grids, device, anymal, terrain_of_env=None):
    num_envs = len(seeds) * replicas
    joints = np.float32(anymal.default_joint_pos)
    q = wp.zeros((num_envs, 19), dtype=float, device=device)
    qd = wp.zeros((num_envs, 18), dtype=float, device=device)
    state = make_state(num_envs, device, outcome=Outcome.GOAL, steps=77)
    if terrain_of_env is None:
        terrain_of_env = np.repeat(np.arange(len(seeds)), replicas)
    start_episodes(
        wp.array(np.uint32(seeds), device=device),
        wp.array(terrain_of_env, dtype=int, device=device),
        replicas,
        make_terrain(grids, device),
        make_start_ranges(CrossingCfg(), anymal),
        wp.vec3(*BASE_COM),
        wp.array(joints, device=device),
        q,
        qd,
        state,
    )
    return q.numpy(), qd.numpy(), state


def test_starts_fill_their_ranges(device, anymal):
    q, qd, state = start(range(40), 20, np.zeros((40, 161, 321)), device, anymal)
    default = np.array(anymal.default_joint_pos)
    moving = default != 0
    com_arm = np.array([oracle.rotation_matrix(row[3:7]) @ BASE_COM for row in q])
    origin_velocity = qd[:, :3] - np.cross(qd[:, 3:6], com_arm)
    columns = {  # drawn quantity, middle, half width (definitions: a crossing)
        "x": (q[:, :1], 2, 0.1),
        "y": (q[:, 1:2], 4, 0.1),
        "yaw": (np.array([[oracle.yaw_of(row[3:7])] for row in q]), 0, 0.2),
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
    assert not q[:, 7:][:, ~moving].any()
    assert not qd[:, 6:].any()
    np.testing.assert_allclose(np.linalg.norm(q[:, 3:7], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(q[:, 2], anymal.default_base_height, atol=1e-6)
    assert (state.outcome.numpy() == Outcome.RUNNING).all()
    assert not state.steps.numpy().any()
    assert state.num_running.numpy()[0] == 800


def test_the_start_stands_on_the_highest_ground_under_the_robot(device, anymal):
    grids = np.stack([rough(161, 321, 0.3, seed=k) for k in range(2)])
    q, _, _ = start([1, 2], 8, grids, device, anymal)
    for env, row in enumerate(np.float64(q)):
        half = np.array(anymal.footprint)
        low, high = np.floor((row[:2] - half) / 0.05).astype(int), np.ceil((row[:2] + half) / 0.05).astype(int)
        ground = grids[env // 8, low[1] : high[1] + 1, low[0] : high[0] + 1].max()
        assert row[2] == pytest.approx(ground + anymal.default_base_height, abs=1e-6)


def test_a_start_depends_on_its_seed_and_replica_alone(device, anymal):
    grids = np.stack([rough(161, 321, 0.3, seed=k) for k in range(4)])
    seeds, order = np.array([5, 2**32 - 1, 5, 0]), [3, 1, 0, 2]
    q, qd, _ = start(seeds, 3, grids, device, anymal)
    by_terrain = q.reshape(4, 3, 19)
    again, _, _ = start(seeds[order], 3, grids[order], device, anymal)
    np.testing.assert_array_equal(again.reshape(4, 3, 19), by_terrain[order])
    alone, _, _ = start(seeds[1:2], 3, grids[1:2], device, anymal)
    np.testing.assert_array_equal(alone, by_terrain[1])
    # Seed 5 twice: the same draws on other ground. Seeds and replicas differ from each other.
    np.testing.assert_array_equal(by_terrain[0, :, 7:], by_terrain[2, :, 7:])
    assert len(np.unique(qd[:, 0])) == 9


def test_cpu_is_deterministic(anymal):
    grids = rough(161, 321)[None]
    one, other = start([3], 10, grids, "cpu", anymal), start([3], 10, grids, "cpu", anymal)
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])
