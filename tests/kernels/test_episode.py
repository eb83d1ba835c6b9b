"""An episode's command and the latch that ends it: oracle, properties, hand-computed numbers."""

import numpy as np
import warp as wp

from kernels.episode import (
    PARKING_HEIGHT,
    Invalidity,
    Outcome,
    begin_episodes,
    command_goal,
    latch_outcomes,
    make_episodes,
    note_base_forces,
    park_ended,
)
from kernels.penalties import BASE, FOOT, LIMB
from sim.crossing import CrossingCfg, make_task
from sim.mujoco_c.model import goal_commands, to_mujoco
from tests.kernels.states import random_states, upright

ROLES = [LIMB, BASE, FOOT, BASE]
MAX_STEPS = 4000
GOAL = (14.0, 4.0)


def expected_outcome(q, qd, base_force, overflow, steps, max_steps, goal=(14.0, 4.0)):
    """Name of how an episode stands after a step (definitions: a crossing)."""
    state = np.concatenate([q, qd])
    if not np.isfinite(state).all() or np.abs(qd).max() > 100 or overflow & ~(512 | 1024):
        return "INVALID"
    if base_force > 1:
        return "BASE_COLLISION"
    if np.hypot(*(np.asarray(goal) - q[:2])) < 0.5:
        return "GOAL"
    if abs(q[1] - 4) > 6 or q[0] < -2 or q[0] > 18:
        return "OUT"
    return "TIME_OUT" if steps >= max_steps else "RUNNING"


def make_state(num_envs, device, outcome=0, steps=0):
    state = make_episodes(num_envs, device)
    state.outcome.assign(np.broadcast_to(np.int32(outcome), num_envs))
    state.steps.assign(np.broadcast_to(np.int32(steps), num_envs))
    state.counted.fill_(9)
    return state


def latch(states, device, anymal, state, *, action=0.0, force=0.0, overflow=0, contacts=(0, 10), cfg=None, **limits):
    """One judged step; ``force`` [N] acts on the second base geom of every environment, ``action`` is of one joint."""
    num_envs = len(states[0])
    forces = np.zeros((num_envs, len(ROLES), 3))
    forces[:, 0] = forces[:, 2] = 500.0  # limbs and feet may touch as they like
    forces[:, 3, 1] = force
    task = make_task(cfg or CrossingCfg(), anymal)
    for name, value in limits.items():
        setattr(task, name, value)
    latch_outcomes(
        *(wp.array(np.float32(array), device=device) for array in states),
        wp.array(np.broadcast_to(np.float32(action), num_envs)[:, None], device=device),
        wp.array(np.float32(forces), dtype=wp.vec3, device=device),
        wp.array(ROLES, dtype=int, device=device),
        wp.array(np.broadcast_to(overflow, num_envs), dtype=int, device=device),
        wp.array([contacts[0]], dtype=int, device=device),
        contacts[1],
        task,
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
    expected = [expected_outcome(*row, MAX_STEPS) for row in zip(q, qd, force, overflow, steps + 1, strict=True)]
    assert [outcome.name for outcome in got] == expected
    assert {outcome.name for outcome in got} == {outcome.name for outcome in Outcome if outcome != Outcome.TILT}


def test_an_ended_episode_stays_ended(device, anymal):
    # Ended episodes keep outcome, steps and pose whatever happens to their robots after.
    q, qd = upright(4, 3)
    state = make_state(4, device, outcome=[0, Outcome.GOAL, Outcome.TIME_OUT, 0], steps=[7, 8, 9, 10])
    q[3, 0] = 14.0
    q[1:3] = np.nan
    assert latch((q, qd), device, anymal, state) == [Outcome.RUNNING, Outcome.GOAL, Outcome.TIME_OUT, Outcome.GOAL]
    assert state.steps.numpy().tolist() == [8, 8, 9, 11]
    assert state.counted.numpy().tolist() == [1, 0, 0, 1]
    np.testing.assert_array_equal(state.final_pose.numpy()[3], np.float32([14, 4, 0.6, 0, 0, 0, 1]))
    assert not state.final_pose.numpy()[:3].any()
    q[:] = np.nan
    latch((q, qd), device, anymal, state)
    assert state.outcome.numpy().tolist() == [Outcome.INVALID, Outcome.GOAL, Outcome.TIME_OUT, Outcome.GOAL]
    assert state.counted.numpy().tolist() == [0, 0, 0, 0]


def test_robots_whose_episode_ended_are_parked_and_the_others_left_alone(device):
    rng = np.random.default_rng(8)
    outcome = np.array([Outcome.RUNNING, Outcome.GOAL, Outcome.INVALID])
    before = [np.float32(rng.normal(size=size)) for size in ((3, 9), (3, 8), (3, 9))]
    before[0][2, 0] = before[1][2, 3] = np.nan  # what made it invalid must not stay
    arrays = [wp.array(values, device=device) for values in before]
    pose = wp.array([0.3, -0.4], dtype=float, device=device)
    park_ended(wp.array(outcome, dtype=int, device=device), pose, *arrays)
    q, qd, targets = (array.numpy() for array in arrays)
    for values, now in zip(before, (q, qd, targets), strict=True):
        np.testing.assert_array_equal(now[0], values[0])
    height = float(PARKING_HEIGHT)
    for env in (1, 2):
        np.testing.assert_array_equal(q[env, 2:], np.float32([height, 0, 0, 0, 1, 0.3, -0.4]))
        np.testing.assert_array_equal(targets[env, 7:], np.float32([0.3, -0.4]))
        assert not qd[env].any()
    assert np.isfinite(q).all()


def test_an_invalid_episode_says_why_and_a_cause_goes_before_what_comes_of_it(device, anymal):
    # Seven robots: one fault each, then two that have several, of which the first in the order ACTION, OVERFLOW, STATE,
    # SPEED is named; the last one walks.
    q, qd = upright(8, 3)
    action, overflow = np.zeros(8), np.zeros(8, int)
    action[0], overflow[1], q[2, 8], qd[3, 0], qd[4, 1] = np.nan, 4, np.nan, -101.0, np.inf
    action[5] = q[5, 0] = qd[5, 0] = qd[6, 0] = np.nan
    overflow[5] = overflow[6] = 4
    state = make_state(8, device)
    outcomes = latch((q, qd), device, anymal, state, action=action, overflow=overflow)
    assert outcomes == [Outcome.INVALID] * 7 + [Outcome.RUNNING]
    expected = ["ACTION", "OVERFLOW", "STATE", "SPEED", "STATE", "ACTION", "OVERFLOW"]
    assert [Invalidity(k).name for k in state.invalidity.numpy()[:7]] == expected
    # An episode that ends otherwise has no reason, whatever the one before it had.
    q, qd = upright(8, 3, x=14.0)
    begin_episodes(wp.ones(8, dtype=int, device=device), state)
    assert latch((q, qd), device, anymal, state) == [Outcome.GOAL] * 8
    assert not state.invalidity.numpy().any()


def test_dropped_contacts_make_every_running_episode_invalid(device, anymal):
    state = make_state(3, device, outcome=[0, Outcome.GOAL, 0])
    outcomes = latch(upright(3, 3), device, anymal, state, contacts=(11, 10))
    assert outcomes == [Outcome.INVALID, Outcome.GOAL, Outcome.INVALID]
    assert state.invalidity.numpy()[[0, 2]].tolist() == [Invalidity.OVERFLOW] * 2
    assert latch(upright(1, 3), device, anymal, make_state(1, device), contacts=(10, 10)) == [Outcome.RUNNING]


def test_penalties_may_count_from_a_later_step(device, anymal):
    # From 0.02 s on: the first four steps do not count, the fifth does.
    state, counted = make_state(1, device), []
    for _ in range(6):
        latch(upright(1, 3), device, anymal, state, cfg=CrossingCfg(penalties_from_s=0.02))
        counted.append(int(state.counted.numpy()[0]))
    assert counted == [0, 0, 0, 0, 1, 1]


def tilted(*degrees):
    q, qd = upright(len(degrees), 3)
    half = np.deg2rad(degrees) / 2
    q[:, 3], q[:, 6] = np.sin(half), np.cos(half)
    return q, qd


def test_tilt_ends_an_episode_where_it_is_told_to(device, anymal):
    # The projected gravity's z is -cos(tilt): -0.1 at 84.3 degrees.
    states = tilted(84.0, 84.6, 180.0)
    found = latch(states, device, anymal, make_state(3, device), max_gravity_z=-0.1)
    assert found == [Outcome.RUNNING, Outcome.TILT, Outcome.TILT]
    assert latch(states, device, anymal, make_state(3, device)) == [Outcome.RUNNING] * 3  # no crossing does


def test_the_gravest_end_wins(device, anymal):
    def found(**changes):
        q, qd = tilted(180.0)
        q[0, 0] = 14.0
        state = make_state(1, device, steps=MAX_STEPS - 1)
        return latch((q, qd), device, anymal, state, **{"max_gravity_z": -0.1, **changes})

    assert found() == [Outcome.TILT]
    assert found(max_gravity_z=2.0) == [Outcome.GOAL]
    assert found(force=5.0) == [Outcome.BASE_COLLISION]
    assert found(force=5.0, overflow=4) == [Outcome.INVALID]


def test_without_a_goal_and_borders_neither_ends_an_episode(device, anymal):
    endless = {"goal_radius": 0.0, "lower": (-np.inf, -np.inf), "upper": (np.inf, np.inf)}
    q, qd = upright(3, 3)
    q[:, 0] = 14.0, -1e6, 1e6
    q[0, 1] = 4.0
    assert latch((q, qd), device, anymal, make_state(3, device), **endless) == [Outcome.RUNNING] * 3
    ended = [Outcome.GOAL, Outcome.OUT, Outcome.OUT]
    assert latch((q, qd), device, anymal, make_state(3, device)) == ended


def test_a_touch_noted_between_ends_the_episode_and_is_then_forgotten(device, anymal):
    state, roles = make_state(2, device), wp.array(ROLES, dtype=int, device=device)
    still, touched = np.zeros((2, 4, 3), np.float32), np.zeros((2, 4, 3), np.float32)
    touched[1, 1, 2] = 40.0  # on the base
    touched[0, 2, 2] = 500.0  # on a foot
    for force in (touched, still):
        note_base_forces(wp.array(force, dtype=wp.vec3, device=device), roles, state)
    assert state.base_force.numpy().tolist() == [0.0, 40.0]
    assert latch(upright(2, 3), device, anymal, state) == [Outcome.RUNNING, Outcome.BASE_COLLISION]
    assert state.base_force.numpy().tolist() == [0.0, 0.0]


def test_masked_episodes_begin(device, anymal):
    state = make_state(3, device, outcome=[Outcome.GOAL, Outcome.GOAL, Outcome.RUNNING], steps=[7, 8, 9])
    state.base_force.fill_(5.0)
    begin_episodes(wp.array([1, 0, 1], dtype=int, device=device), state)
    assert state.outcome.numpy().tolist() == [Outcome.RUNNING, Outcome.GOAL, Outcome.RUNNING]
    assert state.steps.numpy().tolist() == [0, 8, 0]
    assert state.counted.numpy().tolist() == [0, 9, 0]
    assert state.base_force.numpy().tolist() == [0.0, 5.0, 0.0]
    # What touched the base before is forgotten: the episode that began goes on, the one left alone stays ended.
    assert latch(upright(3, 3), device, anymal, state) == [Outcome.RUNNING, Outcome.GOAL, Outcome.RUNNING]


def command(states, device, anymal, outcome=0):
    num_envs = len(states[0])
    out = wp.zeros((num_envs, 3), dtype=float, device=device)
    outcomes = wp.array(np.broadcast_to(outcome, num_envs), dtype=int, device=device)
    command_goal(wp.array(states[0], device=device), outcomes, make_task(CrossingCfg(), anymal), out)
    return out.numpy()


def test_command_parity_with_the_oracle(device, anymal):
    q, qd = random_states(300, 3)
    expected = goal_commands(to_mujoco(q, qd, np.zeros(3)).qpos, CrossingCfg(goal=GOAL))
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
