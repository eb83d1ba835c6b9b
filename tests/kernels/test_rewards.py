"""Reward terms, penalties, and what training adds to episodes: numbers by hand, the float64 oracle, properties."""

from dataclasses import fields

import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome, Task, make_episodes
from kernels.penalties import BASE, FOOT, LIMB, PENALTIES, add_penalties, penalty_columns
from kernels.rewards import REWARDS, Motion, make_rewards, make_weights, remember_steps, reward_steps
from kernels.state import RobotStep
from kernels.training import (
    STATISTICS,
    Rules,
    command_episodes,
    make_training,
    promote_episodes,
    record_steps,
    seed_restarts,
)
from sim.crossing import CrossingCfg, make_task
from sim.mujoco_c.model import Starts, step_penalties
from sim.robots.find import get_robot
from sim.robots.training import RewardCfg
from tests.kernels.states import filled, random_states, upright

JOINTS = 3
ROLES = [BASE, LIMB, LIMB, FOOT, FOOT]
DT, PHYSICS_DT = 0.02, 0.005
BASE_COM = (0.05, -0.02, 0.1)
FORCE_LIMIT = 500.0
HALF = np.sqrt(0.5)
PLACE = (0.0, 0.0, 0.6)
STANDING = (*PLACE, 0.0, 0.0, 0.0, 1.0)
ROLLED = (*PLACE, HALF, 0.0, 0.0, HALF)  # by 90 degrees: the base's y is the world's z, its z the world's -y
TURNED = (*PLACE, 0.0, 0.0, HALF, HALF)  # to the left by 90 degrees
REST = (0.0,) * JOINTS


class Robots:
    """Robots at rest, but for the arrays that are given; what they are paid."""

    def __init__(self, num_envs=1, *, least_air_time=0.5, **arrays):
        self.rewards = make_rewards(num_envs, JOINTS, len(ROLES), str(wp.get_device()))
        self.num_envs = num_envs
        self.motion = filled(
            Motion, dt=DT, min_air_time_s=least_air_time, joint_lower=(-0.5, -1e10, 0.2), joint_upper=(0.5, 1e10, 0.8),
            default_joint_pos=(0.1, -0.2, 0.3), joint_is_steady=[1, 0, 1],
        )  # fmt: skip
        self.motion.step = filled(RobotStep, geom_role=ROLES, base_com=BASE_COM, force_limit=FORCE_LIMIT)
        widths = {"joint_qd": 6 + JOINTS, "joint_torque": 6 + JOINTS, "command": 3, "action": JOINTS}
        self.set(joint_q=(*STANDING, *REST), geom_force=np.zeros((5, 3)), **{n: np.zeros(w) for n, w in widths.items()})
        self.set(**arrays)

    def set(self, **arrays):
        for name, rows in arrays.items():
            shape = (self.num_envs, 5, 3) if name == "geom_force" else (self.num_envs, np.shape(rows)[-1])
            owner = self.rewards if name.startswith("previous") else self.motion.step
            values = wp.array(np.broadcast_to(np.float32(rows), shape), dtype=float if len(shape) == 2 else wp.vec3)
            setattr(owner, name, values)

    def pay(self, weights, *, outcome=Outcome.RUNNING, only_positive=False):
        """Reward of the step, and its terms a second, one row an environment."""
        falls = (Outcome.BASE_COLLISION, Outcome.INVALID)
        packed = make_weights(dict.fromkeys(REWARDS, 0.0) | weights, only_positive=only_positive, falls=falls)
        self.rewards.terms.zero_()
        outcomes = np.broadcast_to(np.int32(outcome), self.num_envs)
        reward_steps(self.motion, packed, wp.array(outcomes, dtype=int), self.rewards)
        return self.rewards.step.numpy().copy(), self.rewards.terms.numpy() / DT


def forces(**force_of_geom):
    """Forces [N] by the number of the geom, as in ``g3=(0, 0, 100)``."""
    rows = np.zeros((5, 3))
    for name, force in force_of_geom.items():
        rows[int(name[1:])] = force
    return rows


def feet(first, second):
    """Forces that push the feet up, and the base and a limb harder."""
    return forces(g0=(0, 0, 500), g1=(0, 0, 500), g3=(0, 0, first), g4=(0, 0, second))


WALK, CREEP = (1.0, 0.0, 0.0), (0.06, 0.06, 1.0)  # slower than 0.1 m/s is told to stand
ON_THE_GROUND = forces(g1=(0, 0, 0.2), g2=(0, 0, 0.05), g3=(0, 0, 600), g4=(0, 0, 700))


@pytest.mark.parametrize(
    ("name", "arrays", "expected"),
    [
        ("tracking_lin_vel", {"command": (0.3, 0.4, 0.5)}, np.exp(-1.0)),  # (.3^2 + .4^2) / .25 = 1
        ("tracking_lin_vel", {"joint_q": (*TURNED, *REST), "joint_qd": (0, 0.8, *[0] * 7), "command": (0.8, 0, 0)}, 1),
        # The mass centre stands still, the base turns round it at 2 rad/s: its origin moves at -2 z x (.05, -.02).
        ("tracking_lin_vel", {"joint_qd": (*[0] * 5, 2, *REST)}, np.exp(-(0.04**2 + 0.1**2) / 0.25)),
        ("tracking_ang_vel", {"command": (0.3, 0.4, 0.5)}, np.exp(-1.0)),  # .5^2 / .25 = 1
        ("lin_vel_z", {"joint_q": (*ROLLED, *REST), "joint_qd": (0, 0.5, 9, *[0] * 6)}, 0.25),
        ("ang_vel_xy", {"joint_q": (*ROLLED, *REST), "joint_qd": (0, 0, 0, 1, 2, 3, *REST)}, 10.0),  # 1 + 3^2
        ("torques", {"joint_torque": (*[9] * 6, 1, 2, 3)}, 14.0),  # 1 + 4 + 9; the base has no torques
        ("dof_acc", {"joint_qd": (*[9] * 6, 0.1, 0, 0.3), "previous_joint_vel": (0, 0, 0.3)}, 25.0),  # (.1 / .02)^2
        ("action_rate", {"action": (1, 0, 0), "previous_action": (0, 2, 0)}, 5.0),
        ("collision", {"geom_force": forces(g0=(0, 0, 50))}, 0.0),
        ("collision", {"geom_force": ON_THE_GROUND}, 1.0),
        ("feet_contact_forces", {"geom_force": ON_THE_GROUND}, 300.0),  # 100 + 200 over the limit
        ("stumble", {"geom_force": forces(g3=(51, 0, 10))}, 1.0),
        # .2 below the first's range, .1 above the third's; |-.7 - .1| + |.9 - .3|, the second is not steady.
        ("dof_pos_limits", {"joint_q": (*STANDING, -0.7, 5.0, 0.9)}, 0.3),
        ("dof_pos_limits", {"joint_q": (*STANDING, -0.5, 0.0, 0.8)}, 0.0),
        ("joint_deviation", {"joint_q": (*STANDING, -0.7, 5.0, 0.9)}, 1.4),
        ("no_fly", {"geom_force": feet(200, 0.05), "command": WALK}, 1.0),  # 0.05 N is no contact
        ("no_fly", {"geom_force": feet(0, 0.2), "command": (0, -0.2, 0)}, 1.0),
        ("no_fly", {"geom_force": feet(200, 300), "command": WALK}, 0.0),
        ("no_fly", {"geom_force": feet(0, 0), "command": WALK}, 0.0),
        ("no_fly", {"geom_force": feet(200, 0), "command": CREEP}, 0.0),
        ("orientation", {"joint_q": (*PLACE, np.sin(np.pi / 12), 0, 0, np.cos(np.pi / 12), *REST)}, 0.25),  # 30 degrees
        ("orientation", {}, 0.0),
    ],
)
def test_terms_by_hand(name, arrays, expected):
    reward, terms = Robots(**arrays).pay({name: -2.0})
    assert terms[0, REWARDS.index(name)] == pytest.approx(-2.0 * expected, rel=2e-5, abs=1e-6)
    assert reward[0] == pytest.approx(-2.0 * DT * expected, rel=2e-5, abs=1e-6)


def test_terms_are_added_and_their_sum_is_clipped_at_zero():
    # At 2 m/s upward, told to stand: 1 for the velocity along the ground, 2^2 for that upward.
    upward = Robots(joint_qd=(0, 0, 2, *[0] * 6))
    assert upward.pay({"tracking_lin_vel": 6.0, "lin_vel_z": -1.0}, only_positive=True)[0][0] == pytest.approx(2 * DT)
    assert upward.pay({"tracking_lin_vel": 1.0, "lin_vel_z": -1.0})[0][0] == pytest.approx(-3 * DT)
    assert upward.pay({"tracking_lin_vel": 1.0, "lin_vel_z": -1.0}, only_positive=True)[0][0] == 0.0


def test_a_fall_costs_its_price_even_where_rewards_are_clipped():
    # As in legged_gym: max(0, -1 * 2^2) * .02 - 200 * .02 = -4; without a fall 0. No other end costs anything.
    robots, ends = Robots(3, joint_qd=(0, 0, 2, *[0] * 6)), [Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.TILT]
    reward, terms = robots.pay({"lin_vel_z": -1.0, "termination": -200.0}, only_positive=True, outcome=ends)
    np.testing.assert_allclose(reward, [-4.0, 0.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(terms[:, REWARDS.index("termination")], [-200.0, 0.0, 0.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("touches", "command", "least", "landings"),
    [
        # One step of slack after the last touch, 30 steps in the air, then the landing: 31 * .02 - .5 = .12.
        ([True] * 3 + [False] * 31 + [True] * 2, WALK, 0.5, {34: 0.12}),
        ([True] * 3 + [False] * 31 + [True], WALK, 0.3, {34: 0.32}),
        ([True, False, True, False, True], WALK, 0.5, {}),  # one missed contact is no take-off
        ([False] * 40 + [True], CREEP, 0.5, {}),
    ],
)
def test_air_time_counts_from_take_off_to_landing(touches, command, least, landings):
    robots, terms = Robots(least_air_time=least, command=command), []
    for touching in touches:
        robots.set(geom_force=forces(g3=(0, 0, 100.0 if touching else 0.0)))
        terms.append(robots.pay({"feet_air_time": 1.0})[1][0, REWARDS.index("feet_air_time")])
    expected = [landings.get(step, 0.0) for step in range(len(touches))]
    np.testing.assert_allclose(terms, expected, atol=1e-5)


def test_of_an_invalid_state_nothing_but_the_fall_counts():
    robots = Robots(2, joint_qd=np.full(9, np.nan))
    weights = {"tracking_lin_vel": 1.0, "termination": -200.0}
    reward, terms = robots.pay(weights, outcome=[Outcome.INVALID, Outcome.RUNNING])
    assert reward[0] == robots.rewards.total.numpy()[0] == pytest.approx(-4.0) and np.isnan(reward[1])
    assert not terms[0, : REWARDS.index("termination")].any()


def test_a_step_is_paid_if_its_episode_had_not_ended_before():
    # At rest and told to rest, a step pays .02 * 1: the one that ends the first's episode too, those after it do not.
    robots = Robots(2)
    for _ in range(3):
        step, _ = robots.pay({"tracking_lin_vel": 1.0}, outcome=[Outcome.OUT, Outcome.RUNNING])
    np.testing.assert_allclose(robots.rewards.total.numpy(), [DT, 3 * DT], rtol=1e-6)
    np.testing.assert_allclose(step, [0.0, DT], rtol=1e-6)


def test_every_term_has_a_weight():
    with pytest.raises(KeyError, match="no_fly"):
        make_weights({name: 1.0 for name in REWARDS if name != "no_fly"}, only_positive=False, falls=())
    assert {setting.name for setting in fields(RewardCfg)} == set(REWARDS)


def test_a_step_is_remembered():
    rewards, counter = make_rewards(2, 2, 1, str(wp.get_device())), wp.array([41], dtype=int)
    joint_qd = wp.array(np.arange(16, dtype=np.float32).reshape(2, 8), dtype=float)
    remember_steps(wp.array(np.float32([[1, 2], [3, 4]]), dtype=float), joint_qd, rewards, counter)
    assert rewards.previous_action.numpy().tolist() == [[1, 2], [3, 4]]
    assert rewards.previous_joint_vel.numpy().tolist() == [[6, 7], [14, 15]]
    assert counter.numpy().tolist() == [42]


def sums_after(states, command, forces, *, counted=None, sums=None):
    """Penalty sums after adding a physics step."""
    num_envs = len(command)
    step = filled(
        RobotStep, joint_q=states[0], joint_qd=states[1], base_com=BASE_COM, command=np.float32(command),
        geom_force=np.float32(forces), geom_role=ROLES, force_limit=FORCE_LIMIT,
    )  # fmt: skip
    out = wp.array(np.zeros((num_envs, len(PENALTIES)), np.float32) if sums is None else sums)
    counted = wp.array(np.ones(num_envs, int) if counted is None else counted, dtype=int)
    add_penalties(step, PHYSICS_DT, counted, out)
    return out.numpy()


def random_forces(num_envs, num_geoms, seed=0):
    """Forces from none through 0.1 N touches to beyond the limit, some nearly horizontal."""
    rng = np.random.default_rng(seed)
    forces = rng.normal(size=(num_envs, num_geoms, 3)) * 10 ** rng.uniform(-2, 3, (num_envs, num_geoms, 1))
    forces[..., 2] *= rng.choice([1.0, 0.05], (num_envs, num_geoms))
    return np.float32(forces * rng.choice([0.0, 1.0], (num_envs, num_geoms, 1)))


def test_penalties_equal_the_oracle():
    states, forces = random_states(200, 3), random_forces(200, 5)
    command = np.float32(np.random.default_rng(1).uniform(-1, 1, (200, 3)))
    plain, feet = Starts.of_newton(*states, np.array(BASE_COM)), np.array(ROLES) == FOOT
    exact = (np.float64(command), np.float64(forces))
    expected = step_penalties(plain.qpos, plain.qvel, *exact, feet=feet, force_limit=FORCE_LIMIT)
    np.testing.assert_allclose(sums_after(states, command, forces), PHYSICS_DT * expected, rtol=1e-5, atol=1e-7)


def test_contact_penalties_by_hand():
    steps = [  # forces, and what they cost: contact_force, stumble, collision
        # Feet of 600 N and 500.5 N against a limit of 500: (100 + 0.5) * 0.005 = 0.5025. Norms, in any direction.
        (forces(g3=(0, 0, 600), g4=(300.3, 0, 400.4)), (0.5025, 0, 0)),
        # Sideways 5.1 to 1: stumble, once for both feet. 5 to 1 exactly and below is none.
        (forces(g3=(51, 0, 10), g4=(0, -51, -10)), (0, 0.005, 0)),
        (forces(g3=(50, 0, 10), g4=(30, 39.9, 10)), (0, 0, 0)),
        # Base and one limb touch harder than 0.1 N, the other limb with 0.09 N: 2 * 0.005.
        (forces(g0=(0, 0, 0.2), g1=(0.11, 0, 0), g2=(0, 0, 0.09)), (0, 0, 0.01)),
        # A foot never collides; base and limbs have no force limit and do not stumble.
        (forces(g0=(900, 0, 0), g3=(0, 0, 400)), (0, 0, 0.005)),
        (forces(), (0, 0, 0)),
    ]
    force, expected = zip(*steps, strict=True)
    sums = sums_after(upright(len(steps), 3), np.zeros((len(steps), 3)), force)
    columns = penalty_columns(["contact_force", "stumble", "collision"])
    np.testing.assert_allclose(sums[:, columns], expected, atol=1e-6)


def test_steps_that_do_not_count_add_nothing():
    states, forces = random_states(4, 3), random_forces(4, 5)
    before = np.random.default_rng(0).random((4, len(PENALTIES))).astype(np.float32)
    after = sums_after(states, np.zeros((4, 3)), forces, counted=[0, 1, 0, 1], sums=before)
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    velocities = penalty_columns(["yaw_rate", "vel_x", "vel_y"])
    assert (after[[1, 3]] > before[[1, 3]])[:, velocities].all()


NUM_LEVELS, NUM_COLUMNS = 4, 3
UPRIGHT = (0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 1.0, 0.1)


def make_rules(**changes):
    values = {
        "num_levels": NUM_LEVELS, "num_columns": NUM_COLUMNS, "promotion_distance": 4.0, "demotion_time_s": 10.0,
        "command_steps": 500, "lin_vel_x": (-1.0, 1.0), "lin_vel_y": (-0.5, 0.5), "min_speed": 0.2, "push_steps": 0,
        "push_speed": 1.0, "overflow_mask": ~(512 | 1024),
    }  # fmt: skip
    return filled(Rules, **values | changes)


def make_batch(num_envs, *, outcome=Outcome.TIME_OUT, level=0, column=0, count=0):
    """Episodes and what training keeps beside them."""
    full = np.full(num_envs, 1, np.int32)
    sizes = {"num_joints": JOINTS, "observation_size": 4, "first_count": count, "device": str(wp.get_device())}
    training, episodes = make_training(full * column, full * level, **sizes), make_episodes(num_envs)
    episodes.outcome.assign(np.broadcast_to(np.int32(outcome), num_envs))
    return episodes, training


def promoted(walked, speed, *, level=1, outcome=Outcome.TIME_OUT, count=0):
    """Level and terrain of one environment after an episode."""
    num_envs = len(np.atleast_1d(walked))
    episodes, training = make_batch(num_envs, outcome=outcome, level=level, column=2, count=count)
    episodes.start.assign(np.full((num_envs, 2), 5.0, np.float32))
    joint_q = np.full((num_envs, 7 + JOINTS), 5.0, np.float32)
    joint_q[:, 1] += walked
    command = np.zeros((num_envs, 3), np.float32)
    command[:, 0] = speed
    training.command.assign(command)
    terrain = wp.full(num_envs, 99, dtype=int)
    promote_episodes(wp.array(joint_q, dtype=float), episodes, make_rules(), terrain, training)
    return training.level.numpy(), terrain.numpy()


def test_level_goes_up_down_or_stays():
    # Commanded .3 m/s: 3 m are due.
    levels, terrain = promoted([4.1, 3.9, 3.1, 2.9, 0.0], 0.3)
    assert levels.tolist() == [2, 1, 1, 0, 0]
    assert terrain.tolist() == [level * NUM_COLUMNS + 2 for level in levels]
    assert promoted(0.0, 0.0)[0] == [1]  # told to stand
    assert promoted(4.1, 1.0)[0] == [2]  # far, though less than is due
    assert promoted(0.0, 1.0, level=0)[0] == [0]
    levels, terrain = promoted([9.0, 9.0], 0.3, outcome=[Outcome.RUNNING, Outcome.INVALID])
    assert levels.tolist() == [1, 1]  # both keep their level
    assert terrain.tolist() == [99, NUM_COLUMNS + 2]


def test_past_the_last_level_any_level_follows():
    counts = np.bincount(promoted(np.full(400, 5.0), 1.0, level=NUM_LEVELS - 1)[0], minlength=NUM_LEVELS)
    assert counts.shape == (NUM_LEVELS,) and (counts > 60).all()  # 100 expected, standard deviation 8.7


def test_starts_are_drawn_from_counter_and_environment_alone():
    seeds = []
    for count in (7, 7, 8):
        episodes, training = make_batch(4, count=count)
        training.ended.fill_(int(Outcome.TIME_OUT))
        seed_restarts(training, episodes)
        seeds.append(episodes.rng.numpy().tolist())
    assert seeds[0] == seeds[1] and len({*seeds[1], *seeds[2]}) == 8


def command(num_envs=1, *, steps=0, yaw=0.0, heading=None, count=0, position=(0.0, 0.0), task=None, **rules):
    """Commands, joint velocities and headings after the launch."""
    task = task or filled(Task, yaw_gain=0.5, max_yaw_rate=1.0)
    episodes, training = make_batch(num_envs, outcome=Outcome.RUNNING, count=count)
    episodes.steps.assign(np.broadcast_to(np.int32(steps), num_envs))
    if heading is not None:
        training.heading.fill_(heading)
    joint_q = np.zeros((num_envs, 7 + JOINTS), np.float32)
    joint_q[:, :2] = position
    joint_q[:, 5], joint_q[:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    joint_qd = wp.full((num_envs, 6 + JOINTS), 9.0, dtype=float)
    command_episodes(wp.array(joint_q, dtype=float), episodes, make_rules(**rules), task, joint_qd, training)
    return training.command.numpy(), joint_qd.numpy(), training.heading.numpy()


def test_commands_fill_their_ranges_and_slow_ones_are_zero():
    commands, _, headings = command(4000)
    speed = np.linalg.norm(commands[:, :2], axis=1)
    assert (speed[speed > 0] > 0.2).all()
    # A disc of radius .2 in the rectangle of 2 x 1: pi * .04 / 2 = 6.3 %, standard deviation .4 %.
    assert abs((speed == 0).mean() - 0.0628) < 0.015
    for values, bound in ((commands[:, 0], 1.0), (commands[:, 1], 0.5), (headings, np.pi)):
        assert -bound <= values.min() < -0.99 * bound and 0.99 * bound < values.max() <= bound


@pytest.mark.parametrize(
    ("heading", "yaw", "rate"),
    [(0.6, 0.2, 0.2), (0.2, 0.6, -0.2), (3.0, -3.0, -0.14159), (2.5, 0.0, 1.0), (-2.5, 0.0, -1.0)],
)
def test_heading_becomes_a_yaw_rate_the_short_way_round(heading, yaw, rate):
    commands, _, _ = command(steps=1, heading=heading, yaw=yaw)
    assert commands[0, 2] == pytest.approx(rate, abs=1e-4)


def test_a_crossing_robot_is_commanded_to_its_goal():
    # The goal lies to the left of a robot that looks along x: turn left by half of 90 degrees a second.
    task = make_task(CrossingCfg(), get_robot("anymal"))
    commands, _, headings = command(steps=0, heading=0.3, position=(14.0, 0.0), crosses=1, task=task)
    np.testing.assert_allclose(commands[0], (0.0, 0.75, 0.5 * np.pi / 2), atol=1e-6)
    assert headings.tolist() == [np.float32(0.3)]  # nothing is drawn


def test_each_environment_is_pushed_once_an_interval():
    interval, num_envs = 20, 30
    pushed = np.zeros((interval, num_envs), bool)
    for count in range(interval):
        _, joint_qd, _ = command(num_envs, steps=1, count=count, push_steps=interval)
        pushed[count] = (joint_qd[:, :2] != 9.0).all(axis=1)
        assert (np.abs(joint_qd[pushed[count], :2]) <= 1.0).all()
        assert (joint_qd[:, 2:] == 9.0).all() and (joint_qd[~pushed[count]] == 9.0).all()
    assert (pushed.sum(axis=0) == 1).all()
    assert pushed.sum(axis=1).max() < num_envs / 2  # not all at once
    assert (command(5, steps=1, push_steps=0)[1] == 9.0).all()


def test_statistics_add_up():
    outcome = [Outcome.RUNNING, Outcome.TIME_OUT, Outcome.TILT, Outcome.INVALID]
    episodes, training = make_batch(4, outcome=outcome)
    rewards = make_rewards(4, JOINTS, 1, str(wp.get_device()))
    episodes.steps.assign(np.array([5, 1000, 20, 30], np.int32))
    rewards.total.assign(np.float32([11, 22, 33, 44]))
    training.command.assign(np.float32([[0.3, 0.4, 0.2]] * 4))
    step = filled(
        RobotStep, joint_q=[UPRIGHT] * 3 + [(*UPRIGHT[:7], np.nan)], joint_qd=np.zeros((4, 7)), base_com=(0, 0, 0),
        overflow=[1, 512 | 1024, 0, 2 | 512],
    )  # fmt: skip
    record_steps(step, make_rules(), episodes, rewards, training)
    assert training.ended.numpy().tolist() == outcome
    sums = dict(zip(STATISTICS, training.statistics.numpy().sum(0), strict=True))
    expected = {
        "steps": 4, "episodes": 3, "time_out": 1, "base_collision": 0, "tilt": 1, "invalid": 1, "goal": 0,
        "out": 0, "overflow": 2,
        "episode_steps": 1050, "episode_reward": 99,
        "lin_vel_error": 3 * 0.5,  # hypot(.3, .4), of the three that are valid
        "yaw_rate_error": 3 * 0.2,
    }  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(sums[name], value, rtol=1e-6, err_msg=name)
