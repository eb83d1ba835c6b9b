"""Reward terms against a float64 oracle and hand-computed numbers."""

from dataclasses import fields

import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome
from kernels.penalties import BASE, FOOT, LIMB
from kernels.rewards import REWARDS, Motion, make_rewards, make_weights, remember_steps, reward_steps
from sim.robots.training import RewardCfg

NUM_JOINTS = 3
ROLES = [BASE, LIMB, LIMB, FOOT, FOOT]
DT = 0.02
FORCE_LIMIT = 500.0
BASE_COM = (0.05, -0.02, 0.1)
LOWER, UPPER = (-0.5, -1e10, 0.2), (0.5, 1e10, 0.8)
DEFAULT_POSE = (0.1, -0.2, 0.3)
STEADY = (1, 0, 1)
FALLS = (Outcome.BASE_COLLISION, Outcome.INVALID)
STANDING = (0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 1.0)


class Step:
    """A batch of control steps as plain arrays; what is not given is at rest."""

    def __init__(self, num_envs: int = 1, **given: np.ndarray) -> None:
        geoms = len(ROLES)
        self.arrays = {
            "joint_q": np.tile(np.float32(STANDING + (0.0,) * NUM_JOINTS), (num_envs, 1)),
            "joint_qd": np.zeros((num_envs, 6 + NUM_JOINTS), np.float32),
            "joint_torque": np.zeros((num_envs, 6 + NUM_JOINTS), np.float32),
            "geom_force": np.zeros((num_envs, geoms, 3), np.float32),
            "command": np.zeros((num_envs, 3), np.float32),
            "action": np.zeros((num_envs, NUM_JOINTS), np.float32),
            "previous_action": np.zeros((num_envs, NUM_JOINTS), np.float32),
            "previous_joint_vel": np.zeros((num_envs, NUM_JOINTS), np.float32),
        }
        for name, value in given.items():
            assert self.arrays[name].shape == np.shape(value)
            self.arrays[name] = np.float32(value)
        self.num_envs = num_envs
        self.min_air_time_s = 0.5
        self.outcome = np.zeros(num_envs, np.int32)
        self.rewards = make_rewards(num_envs, NUM_JOINTS, geoms, str(wp.get_device()))

    def reward(self, *, only_positive: bool = False, **weights: float) -> tuple[np.ndarray, np.ndarray]:
        """Reward (num_envs,) and the terms per second (num_envs, len(REWARDS))."""
        motion = Motion()
        for name, value in self.arrays.items():
            owner = self.rewards if name.startswith("previous") else motion
            setattr(owner, name, wp.array(value, dtype=wp.vec3 if name == "geom_force" else float))
        motion.geom_role = wp.array(ROLES, dtype=int)
        motion.base_com = BASE_COM
        motion.force_limit, motion.dt, motion.min_air_time_s = FORCE_LIMIT, DT, self.min_air_time_s
        motion.joint_lower, motion.joint_upper, motion.default_joint_pos = (
            wp.array(row, dtype=float) for row in (LOWER, UPPER, DEFAULT_POSE)
        )
        motion.joint_is_steady = wp.array(STEADY, dtype=int)
        weights = make_weights(dict.fromkeys(REWARDS, 0.0) | weights, only_positive=only_positive, falls=FALLS)
        self.rewards.running.fill_(1)
        self.rewards.terms.zero_()
        reward_steps(motion, weights, wp.array(self.outcome, dtype=int), self.rewards)
        return self.rewards.step.numpy().copy(), self.rewards.terms.numpy() / DT

    def term(self, name: str) -> float:
        """One unweighted term of the first environment."""
        return float(self.reward(**{name: 1.0})[1][0, REWARDS.index(name)])


def rotate_inverse(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors of the world frame in the body frame, quaternions xyzw."""
    axis, w = -quaternion[:, :3], quaternion[:, 3:]
    across = 2.0 * np.cross(axis, vector)
    return vector + w * across + np.cross(axis, across)


def oracle(step: Step) -> dict[str, np.ndarray]:
    """Every term but the air time in float64, after the formulas of legged_gym, Isaac Lab and the paper."""
    a = {name: value.astype(np.float64) for name, value in step.arrays.items()}
    rotation = a["joint_q"][:, 3:7]
    w = rotate_inverse(rotation, a["joint_qd"][:, 3:6])
    v = rotate_inverse(rotation, a["joint_qd"][:, :3]) - np.cross(w, BASE_COM)
    force = np.linalg.norm(a["geom_force"], axis=2)
    limb, foot = np.equal(ROLES, LIMB), np.equal(ROLES, FOOT)
    foot_force = a["geom_force"][:, foot]
    gravity = rotate_inverse(rotation, np.tile([0.0, 0.0, -1.0], (step.num_envs, 1)))
    angle = a["joint_q"][:, 7:]
    commanded = np.linalg.norm(a["command"][:, :2], axis=1) > 0.1
    return {
        "tracking_lin_vel": np.exp(-((v[:, :2] - a["command"][:, :2]) ** 2).sum(1) / 0.25),
        "tracking_ang_vel": np.exp(-((w[:, 2] - a["command"][:, 2]) ** 2) / 0.25),
        "lin_vel_z": v[:, 2] ** 2,
        "ang_vel_xy": (w[:, :2] ** 2).sum(1),
        "torques": (a["joint_torque"][:, 6:] ** 2).sum(1),
        "dof_acc": (((a["joint_qd"][:, 6:] - a["previous_joint_vel"]) / DT) ** 2).sum(1),
        "collision": (force[:, limb] > 0.1).sum(1),
        "action_rate": ((a["action"] - a["previous_action"]) ** 2).sum(1),
        "stumble": (np.linalg.norm(foot_force[..., :2], axis=2) > 5 * np.abs(foot_force[..., 2])).any(1),
        "feet_contact_forces": np.maximum(0.0, force[:, foot] - FORCE_LIMIT).sum(1),
        "dof_pos_limits": (np.maximum(LOWER - angle, 0.0) + np.maximum(angle - UPPER, 0.0)).sum(1),
        "no_fly": ((foot_force[..., 2] > 0.1).sum(1) == 1) & commanded,
        "orientation": (gravity[:, :2] ** 2).sum(1),
        "joint_deviation": (np.abs(angle - DEFAULT_POSE) * STEADY).sum(1),
        "termination": step.outcome == Outcome.BASE_COLLISION,
    }


def random_step(num_envs: int) -> Step:
    rng = np.random.default_rng(0)
    joint_q = rng.normal(size=(num_envs, 7 + NUM_JOINTS))
    joint_q[:, 3:7] /= np.linalg.norm(joint_q[:, 3:7], axis=1, keepdims=True)
    force = rng.normal(size=(num_envs, len(ROLES), 3)) * rng.choice([0.01, 1.0, 400.0], (num_envs, len(ROLES), 1))
    force[::3, :, 2] *= 0.05  # every third environment stumbles now and then
    step = Step(
        num_envs,
        joint_q=joint_q,
        joint_qd=rng.normal(size=(num_envs, 6 + NUM_JOINTS)),
        joint_torque=rng.normal(size=(num_envs, 6 + NUM_JOINTS)) * 20.0,
        geom_force=force,
        command=rng.uniform(-1, 1, (num_envs, 3)),
        action=rng.normal(size=(num_envs, NUM_JOINTS)),
        previous_action=rng.normal(size=(num_envs, NUM_JOINTS)),
        previous_joint_vel=rng.normal(size=(num_envs, NUM_JOINTS)),
    )
    step.outcome = rng.choice([Outcome.RUNNING, Outcome.BASE_COLLISION, Outcome.TIME_OUT], num_envs).astype(np.int32)
    return step


def test_terms_equal_the_oracle():
    step = random_step(200)
    expected = oracle(step)
    _, terms = step.reward(**dict.fromkeys(REWARDS, 1.0))
    for name, values in expected.items():
        np.testing.assert_allclose(terms[:, REWARDS.index(name)], values, rtol=2e-5, atol=1e-6, err_msg=name)
    for name in ("stumble", "no_fly", "termination"):
        assert 0 < expected[name].sum() < 200, name
    assert set(expected["collision"]) == {0, 1, 2}
    assert set(expected) | {"feet_air_time"} == set(REWARDS)


def test_reward_is_the_weighted_sum_times_the_step():
    step = random_step(50)
    weights = {name: 0.1 * (k - 5) for k, name in enumerate(REWARDS) if name not in ("dof_acc", "feet_air_time")}
    expected = DT * sum(weight * oracle(step)[name] for name, weight in weights.items())
    np.testing.assert_allclose(step.reward(**weights)[0], expected, rtol=2e-5, atol=1e-6)


def test_clipping_at_zero():
    step = random_step(50)
    weights = {"tracking_lin_vel": 1.0, "lin_vel_z": -1.0}
    plain = step.reward(**weights)[0]
    assert (plain < 0).any() and (plain > 0).any()
    np.testing.assert_array_equal(step.reward(only_positive=True, **weights)[0], np.maximum(plain, 0.0))


def test_a_fall_is_paid_for_even_where_rewards_are_clipped():
    # As in legged_gym: max(0, -1 * 2^2) * .02 - 200 * .02 = -4; without a fall 0.
    step = Step(2, joint_qd=np.tile(np.float32([0, 0, 2, 0, 0, 0, 0, 0, 0]), (2, 1)))
    step.outcome = np.array([Outcome.BASE_COLLISION, Outcome.TIME_OUT], np.int32)
    reward, terms = step.reward(only_positive=True, lin_vel_z=-1.0, termination=-200.0)
    np.testing.assert_allclose(reward, [-4.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(terms[:, REWARDS.index("termination")], [-200.0, 0.0], rtol=1e-6)
    assert step.reward(termination=-200.0)[0].tolist() == pytest.approx([-4.0, 0.0])


def test_hand_computed_numbers():
    standing = Step(command=[[0.3, 0.4, 0.5]])
    assert standing.term("tracking_lin_vel") == pytest.approx(np.exp(-1.0))  # (.3^2 + .4^2) / .25 = 1
    assert standing.term("tracking_ang_vel") == pytest.approx(np.exp(-1.0))  # .5^2 / .25 = 1
    joints = Step(
        joint_torque=[[9, 9, 9, 9, 9, 9, 1, 2, 3]],
        joint_qd=[[0, 0, 0, 0, 0, 0, 0.1, 0, 0]],
        action=[[1, 0, 0]],
        previous_action=[[0, 2, 0]],
    )
    assert joints.term("torques") == pytest.approx(14.0)  # 1 + 4 + 9; the base's six columns are no torques
    assert joints.term("dof_acc") == pytest.approx(25.0, rel=1e-5)  # (.1 / .02)^2
    assert joints.term("action_rate") == pytest.approx(5.0)  # 1 + 4
    turning = Step(joint_qd=[[0, 0, 0, 0, 0, 2.0, 0, 0, 0]])
    # The mass centre stands still and the base turns round it at 2 rad/s: its origin moves at -2 z x (.05, -.02).
    assert turning.term("tracking_lin_vel") == pytest.approx(np.exp(-(0.04**2 + 0.1**2) / 0.25), rel=1e-5)


def test_joints_by_hand():
    q = [*STANDING, -0.7, 5.0, 0.9]
    step = Step(joint_q=[q])
    assert step.term("dof_pos_limits") == pytest.approx(0.3)  # .2 below the first's range, .1 above the third's
    assert step.term("joint_deviation") == pytest.approx(1.4)  # |-.7 - .1| + |.9 - .3|; the second is not steady
    assert Step(joint_q=[[*STANDING, -0.5, 0.0, 0.8]]).term("dof_pos_limits") == 0.0


def test_tilt_by_hand():
    rolled = [*STANDING[:3], np.sin(np.pi / 12), 0.0, 0.0, np.cos(np.pi / 12), 0, 0, 0]
    assert Step(joint_q=[rolled]).term("orientation") == pytest.approx(0.25)  # sin(30 degrees)^2
    assert Step().term("orientation") == 0.0


def test_velocity_is_that_of_the_base_frame():
    quarter_turn = [*STANDING[:3], 0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4), 0, 0, 0]
    step = Step(joint_q=[quarter_turn], joint_qd=[[0, 0.8, 0, 0, 0, 0, 0, 0, 0]], command=[[0.8, 0, 0]])
    assert step.term("tracking_lin_vel") == pytest.approx(1.0, abs=1e-5)


def forces(**of_geom: tuple[float, float, float]) -> np.ndarray:
    force = np.zeros((1, len(ROLES), 3), np.float32)
    for name, value in of_geom.items():
        force[0, int(name[1:])] = value
    return force


def test_contacts_count_by_role():
    base_only = Step(geom_force=forces(g0=(0, 0, 50)))
    assert base_only.term("collision") == 0.0
    limbs = Step(geom_force=forces(g1=(0, 0, 0.2), g2=(0, 0, 0.05), g3=(0, 0, 600), g4=(0, 0, 700)))
    assert limbs.term("collision") == 1.0
    assert limbs.term("feet_contact_forces") == pytest.approx(300.0)  # 100 + 200 over the limit
    assert limbs.term("stumble") == 0.0
    assert Step(geom_force=forces(g3=(51, 0, 10))).term("stumble") == 1.0
    assert Step(geom_force=forces(g1=(51, 0, 10))).term("stumble") == 0.0


@pytest.mark.parametrize(
    ("up", "command", "expected"),
    [
        ((200, 0), (1, 0, 0), 1.0),
        ((0, 0.2), (0, -0.2, 0), 1.0),
        ((200, 0.05), (1, 0, 0), 1.0),  # 0.05 N is no contact
        ((200, 300), (1, 0, 0), 0.0),
        ((0, 0), (1, 0, 0), 0.0),
        ((200, 0), (0.06, 0.06, 1), 0.0),  # told to stand: both feet may stay where they are
    ],
)
def test_one_foot_alone_on_the_ground(up, command, expected):
    loaded = forces(g0=(0, 0, 500), g1=(0, 0, 500), g3=(0, 0, up[0]), g4=(0, 0, up[1]))
    assert Step(geom_force=loaded, command=[command]).term("no_fly") == expected


def air_times(
    pattern: list[bool], command: tuple[float, float, float] = (1.0, 0.0, 0.0), least: float = 0.5
) -> list[float]:
    """The air-time term of each step of one foot that touches as told."""
    step = Step(command=[command])
    step.min_air_time_s = least
    found = []
    for touching in pattern:
        step.arrays["geom_force"] = forces(g3=(0, 0, 100.0 if touching else 0.0))
        found.append(step.term("feet_air_time"))
    return found


def test_air_time_counts_from_take_off_to_landing():
    # One step of slack after the last touch, 30 steps in the air, then the landing step: 31 * .02 - .5 = .12.
    found = air_times([True] * 3 + [False] * 31 + [True] * 2)
    assert found[:-2] == [0.0] * 34
    assert found[-2] == pytest.approx(0.12, abs=1e-5)
    assert found[-1] == 0.0


def test_the_air_time_that_pays_is_a_setting():
    # Landing after 31 * .02 = .62 s as above, of which .3 are asked for.
    found = air_times([True] * 3 + [False] * 31 + [True], least=0.3)
    assert found[-1] == pytest.approx(0.32, abs=1e-5)


def test_one_missed_contact_is_no_take_off():
    assert air_times([True, False, True, False, True]) == [0.0] * 5


def test_air_time_does_not_count_when_told_to_stand():
    assert air_times([False] * 40 + [True], command=(0.05, 0.05, 1.0)) == [0.0] * 41


def test_of_an_invalid_state_nothing_but_the_fall_counts():
    step = Step(2, joint_qd=np.full((2, 9), np.nan))
    step.outcome = np.array([Outcome.INVALID, Outcome.RUNNING], np.int32)
    reward, terms = step.reward(tracking_lin_vel=1.0, termination=-200.0)
    assert reward[0] == pytest.approx(-4.0)
    assert terms[0].tolist() == [0.0] * REWARDS.index("termination") + [pytest.approx(-200.0)]
    assert np.isnan(reward[1])
    assert step.rewards.total.numpy()[0] == reward[0]


def test_an_outcome_that_is_no_fall_costs_nothing():
    step = Step(2)
    step.outcome = np.array([Outcome.TILT, Outcome.GOAL], np.int32)
    assert step.reward(termination=-200.0)[0].tolist() == [0.0, 0.0]


def test_a_step_is_paid_if_its_episode_had_not_ended_before():
    # At rest and told so, a step pays .02 * 1: the step that ends the first's episode is paid, those after it are not.
    rewards, outcome = (
        make_rewards(2, NUM_JOINTS, len(ROLES), str(wp.get_device())),
        wp.array([Outcome.OUT, 0], dtype=int),
    )
    step = Step(2)
    step.rewards = rewards
    weights = make_weights(dict.fromkeys(REWARDS, 0.0) | {"tracking_lin_vel": 1.0}, only_positive=True, falls=())
    motion = Motion()
    for name in ("joint_q", "joint_qd", "joint_torque", "geom_force", "command", "action"):
        setattr(motion, name, wp.array(step.arrays[name], dtype=wp.vec3 if name == "geom_force" else float))
    motion.dt = DT
    for _ in range(3):
        reward_steps(motion, weights, outcome, rewards)
    np.testing.assert_allclose(rewards.total.numpy(), [DT, 3 * DT], rtol=1e-6)
    np.testing.assert_allclose(rewards.step.numpy(), [0.0, DT], rtol=1e-6)


def test_every_term_has_a_weight():
    with pytest.raises(KeyError, match="no_fly"):
        make_weights({name: 1.0 for name in REWARDS if name != "no_fly"}, only_positive=False, falls=())
    assert {setting.name for setting in fields(RewardCfg)} == set(REWARDS)


def test_remembering_a_step():
    rewards, counter = make_rewards(2, 2, 1, str(wp.get_device())), wp.array([41], dtype=int)
    action = wp.array(np.float32([[1, 2], [3, 4]]), dtype=float)
    joint_qd = wp.array(np.arange(16, dtype=np.float32).reshape(2, 8), dtype=float)
    remember_steps(action, joint_qd, rewards, counter)
    assert rewards.previous_action.numpy().tolist() == [[1, 2], [3, 4]]
    assert rewards.previous_joint_vel.numpy().tolist() == [[6, 7], [14, 15]]
    assert counter.numpy().tolist() == [42]
