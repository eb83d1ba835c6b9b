"""An episode's command and the latch that ends it: oracle, properties, hand-computed numbers."""

import numpy as np
import pytest
import warp as wp

from kernels.episode import (
    Invalidity,
    Outcome,
    begin_episodes,
    command_goal,
    latch_outcomes,
    make_episodes,
    note_base_forces,
)
from kernels.penalties import BASE, FOOT, LIMB
from kernels.state import RobotStep
from sim.crossing import CrossingCfg, make_task
from sim.mujoco_c.model import goal_commands, to_mujoco
from sim.robots.find import get_robot
from tests.kernels.states import filled, random_states, upright

ROLES = [LIMB, BASE, FOOT, BASE]
MAX_STEPS = 4000


def create_task(**settings):
    return make_task(CrossingCfg(**settings), get_robot("anymal"))


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
    assert set(outcomes) == set(Outcome) - {Outcome.TILT}


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
    outcomes = latch((q, qd), state, action=action, overflow=overflow)
    assert outcomes == [Outcome.INVALID] * 7 + [Outcome.RUNNING]
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
    expected = goal_commands(to_mujoco(q, qd, np.zeros(3)).qpos, 0.75)
    np.testing.assert_allclose(commands(q), expected, atol=2e-5)
    # At (2, 4) facing the goal: 0.75 m/s straight ahead. At (14, 0), facing along x, the goal lies 90 degrees left:
    # 0.75 m/s to the left, yaw rate 0.5 * pi / 2 = 0.785398. Ended: nothing.
    q, _ = upright(3, 3)
    q[1, :2] = 14, 0
    by_hand = [[0.75, 0, 0], [0, 0.75, 0.785398], [0, 0, 0]]
    np.testing.assert_allclose(commands(q, [0, 0, Outcome.TIME_OUT]), by_hand, atol=1e-5)
