"""Arms that are held elsewhere, swing or are loaded: against plain MuJoCo C, and against torques by hand."""

import dataclasses

import numpy as np
import pytest

from sim.robots.compiled import number_arm_ends, robot_spec
from sim.robots.find import get_robot
from sim.robots.user import describe_inferred
from sim.rollout import Rollout
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, condition_texts, nominal_row
from sim.terrains.spaces.registry import check_conditions, get_space, load_space
from tests.sim.dogs import JOINTS, mjcf, write_toml
from tests.sim.scenes import (
    FLAT,
    fall,
    mean_velocity,
    positions,
    put,
    rows_of,
    simulate,
    simulate_under,
    standing,
    velocities,
)

ARMS = ("left_shoulder", "left_elbow", "right_shoulder", "right_elbow")
KP, KD, LIMIT = 20.0, 1.0, 5.0
"""Gains of the arms [N m/rad, N m s/rad], and the limit of their torques [N m]."""
CASES = {
    "hold": {"arms_hold": 0.6, "arms_pattern": 0.3},
    "wander": {"arms_wander": 0.3, "arms_period": 0.7},
    "load": {"arms_load": 0.04},
    "all": {"arms_hold": 0.2, "arms_wander": 0.2, "arms_load": 0.02, "strength": 0.5, "payload": 0.2, "delay": 0.02},
}


@pytest.fixture(scope="module")
def armed(tmp_path_factory):
    """The dog with an arm of two links on each side, which its controller does not move."""
    arms = "".join(
        f"""
      <body name="{side}_upper" pos="0.25 {y} 0.05">
        <inertial mass="0.5" pos="0.05 0 0" diaginertia="0.0005 0.001 0.001"/>
        <joint name="{side}_shoulder" axis="0 1 0" range="-2 2"/>
        <body name="{side}_lower" pos="0.1 0 0">
          <inertial mass="0.3" pos="0.05 0 0.01" diaginertia="0.0003 0.0006 0.0006"/>
          <joint name="{side}_elbow" axis="0 0 1" range="-2 2"/>
          <geom name="{side}_hand" type="sphere" size="0.02" pos="0.1 0 0"/>
        </body>
      </body>"""
        for side, y in (("left", 0.1), ("right", -0.1))
    )
    drive = '<position name="{0}" joint="{0}" kp="{1}" kv="{2}" forcerange="-{3} {3}"/>'
    drives = "".join(drive.format(joint, KP, KD, LIMIT) for joint in ARMS)
    model = mjcf().replace("\n    </body>\n  </worldbody>", f"{arms}\n    </body>\n  </worldbody>")
    model = model.replace("</actuator>", f"{drives}</actuator>")
    pose = 'default_joint_pos = {".*_hip" = 0.6, ".*_knee" = -1.2, ".*(shoulder|elbow)" = 0.0}'
    file = write_toml(tmp_path_factory.mktemp("armed") / "dog", pose, model)
    moved = ", ".join(f'"{name}"' for name in JOINTS)
    file.with_name("controller.toml").write_text(f"joints = [{moved}]\n")
    return get_robot(str(file))


def shifts(size, periods):
    """What the targets of the four joints are off by [rad]."""
    return size * np.sin(2 * np.pi * (periods + 0.618 * np.arange(4)))


def test_joints_that_the_controller_beside_it_does_not_move_are_those_of_arms(armed, tmp_path):
    assert armed.arm_joints == ARMS and f"arm_joints = {list(ARMS)}".replace("'", '"') in describe_inferred(armed)
    names = [robot_spec(armed).compile().body(body).name for body in number_arm_ends(armed)]
    assert names == ["left_lower", "right_lower"]
    shoulders = dataclasses.replace(armed, arm_joints=ARMS[::2])
    names = [robot_spec(armed).compile().body(body).name for body in number_arm_ends(shoulders)]
    assert names == ["left_upper", "right_upper"]
    assert get_robot(str(write_toml(tmp_path / "dog"))).arm_joints == ()
    with pytest.raises(ValueError, match="arm_joints: no joint named wing"):
        get_robot(str(write_toml(tmp_path / "bird", 'arm_joints = ["FL_hip", "wing"]')))


@pytest.mark.slow
def test_arms_move_as_in_mujoco_c(armed, device):
    rows = rows_of({}, *CASES.values())
    for ours, plain in fall(armed, rows, (60, 300), device):  # while a shift grows, and after
        np.testing.assert_allclose(ours.qpos[:, 7:], plain.qpos[:, 7:], atol=5e-6)
        np.testing.assert_allclose(ours.qvel[:, 6:], plain.qvel[:, 6:], atol=1e-4)
        arms = plain.qpos[:, -4:]
        apart = np.abs(arms[:, None] - arms).max(axis=2) + np.eye(len(rows))
        assert apart.min() > 0.005  # each case is another one


def test_the_torque_of_a_shift_is_that_of_its_drive_up_to_its_limit(armed, device):
    held, swung = {"arms_hold": 0.4, "arms_pattern": 0.1}, {"arms_wander": 0.2, "arms_period": 0.8}
    sim = simulate_under(armed, rows_of({}, held, held | {"strength": 0.5}, swung, held | swung), device)
    for step, grown in ((0, 0.0), (100, 0.5), (300, 1.0)):  # of 5 ms: it grows in the first second
        put(sim, standing(armed, 5, z=2.0))
        sim.disturbed.steps.fill_(step)
        sim.physics_step()
        off = [shifts(0.0, 0.0), shifts(0.4, 0.1), shifts(0.4, 0.1), shifts(0.2, 0.005 * step / 0.8)]
        torques = np.clip(KP * grown * np.array([*off, off[1] + off[3]]), -LIMIT, LIMIT)
        torques[2] *= 0.5
        by_actuator = sim.joint_torque.numpy()[:, 6:]
        np.testing.assert_allclose(by_actuator[:, -4:], torques, atol=1e-4)
        np.testing.assert_allclose(by_actuator[:, :-4], 0.0, atol=1e-4)
    assert (np.abs(torques) == LIMIT).any()  # or no limit was met


def test_a_load_on_two_arms_pulls_the_whole_robot_down(armed):
    rows, steps = rows_of({}, {"arms_load": 0.05}), 50
    for both in fall(armed, rows, (steps,)):
        for moved in (mean_velocity(armed, states) for states in both):
            fallen = 2 * 0.05 * 9.81 * steps * armed.physics_dt
            np.testing.assert_allclose(moved[1] - moved[0], [0.0, 0.0, -fallen], atol=2e-3)


def test_nominal_conditions_change_no_bit(armed):
    plain = simulate(armed, FLAT[None], "cpu")
    nominal = simulate_under(armed, nominal_row()[None])
    for sim in (plain, nominal):
        put(sim, standing(armed, 1))
        for _ in range(100):
            sim.physics_step()
    np.testing.assert_array_equal(positions(plain), positions(nominal))
    np.testing.assert_array_equal(velocities(plain), velocities(nominal))


def test_robots_without_arms_are_refused(robot, armed):
    check_conditions(GROUPS["arms"], armed)
    with pytest.raises(ValueError, match=rf"robot '{robot.name}' must have arm_joints.*\+arms_wander, \+arms_load"):
        check_conditions(("payload", "arms_wander", "arms_load"), robot)
    sizes = {"num_terrains": 1, "replicas": 1, "device": "cpu"}
    with pytest.raises(ValueError, match=r"\+arms_hold"):
        Rollout(robot, robot.policy_file, **sizes, space=get_space("super_gaussian+arms_hold"))


def test_arms_are_parts_of_a_terrain():
    space = load_space("course+arms")
    assert space.conditions == GROUPS["arms"] == ("arms_hold", "arms_wander", "arms_load")
    row = rows_of({"arms_hold": 0.4, "arms_pattern": 0.25, "arms_wander": 0.2, "arms_period": 1.5, "arms_load": 0.031})
    assert condition_texts(row[0], GROUPS["arms"]) == [
        "arms held up to 0.40 rad elsewhere in pattern 0.25",
        "arms swinging by 0.20 rad every 1.5 s",
        "3.1% of the robot's weight on each arm",
    ]
    genes = np.zeros((1, space.num_genes), np.float32)
    genes[0, -5:-3] = CONDITIONS["arms_hold"].to_genes({"arms_hold": 0.4, "arms_pattern": 0.25})
    genes[0, -3:] = -1.0
    assert space.time_line(genes[0], 20.0) == [("arms held up to 0.40 rad elsewhere in pattern 0.25", 0.0, 20.0)]
