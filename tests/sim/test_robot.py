"""The robot's file: published numbers, the same robot to Newton and to MuJoCo, and clear errors."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest

from kernels.penalties import BASE, FOOT, LIMB
from sim.robot import ROBOTS, build_robot, get_robot, leaf_name
from tests.sim import mujoco_c
from tests.sim.scenes import lying

LEGS = ("LF", "RF", "LH", "RH")


@pytest.fixture(scope="module")
def c_model(anymal):
    return mujoco.MjModel.from_xml_path(str(anymal.model_file))


@pytest.fixture(scope="module")
def builder(anymal):
    return build_robot(anymal)


def test_published_mass(c_model, builder):
    # ANYmal C: 52.13 kg over its 13 moving bodies.
    assert c_model.body_mass.sum() == pytest.approx(52.13, abs=0.01)
    assert sum(builder.body_mass) == pytest.approx(52.13, abs=0.01)
    assert builder.body_count == 13


def test_joints_are_in_policy_order(anymal, c_model, builder):
    expected = [f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE")]
    assert list(anymal.joint_names) == expected
    assert [c_model.joint(k).name for k in range(1, 13)] == expected
    assert [c_model.actuator(k).name for k in range(12)] == expected
    assert [leaf_name(label) for label in builder.joint_label][1:] == expected


def test_gains_and_limits_are_the_same_in_newton_and_mujoco(anymal, c_model, builder):
    # kp 80, kd 2 (legged_gym's PD), effort 80 N m (that Newton's solver heeds it: test_simulation).
    np.testing.assert_array_equal(c_model.actuator_gainprm[:, 0], 80)
    np.testing.assert_array_equal(c_model.actuator_biasprm[:, :3], [[0, -80, -2]] * 12)
    np.testing.assert_array_equal(c_model.actuator_forcerange, [[-80, 80]] * 12)
    np.testing.assert_array_equal(builder.joint_target_ke[6:], 80)
    np.testing.assert_array_equal(builder.joint_target_kd[6:], 2)
    np.testing.assert_allclose(builder.joint_armature[6:], c_model.dof_armature[6:])
    assert c_model.opt.timestep == anymal.physics_dt
    abduction = [k for k, name in enumerate(anymal.joint_names) if name.endswith("HAA")]
    limits = np.column_stack([builder.joint_limit_lower[6:], builder.joint_limit_upper[6:]])
    # Legs turn in by 0.72 rad and out by 0.49 rad: mirrored on the right.
    np.testing.assert_allclose(limits[abduction], [[-0.72, 0.49], [-0.49, 0.72]] * 2, atol=1e-6)
    np.testing.assert_allclose(c_model.jnt_range[1:][abduction], limits[abduction], atol=1e-6)
    assert not np.delete(c_model.jnt_limited[1:], abduction).any()


def test_the_default_pose_is_symmetric(anymal, c_model):
    q = np.concatenate([lying(1, 0, 0, anymal.default_base_height)[0], anymal.default_joint_pos])
    lf, rf, lh, rh = mujoco_c.geom_positions(c_model, q, [f"{leg}_FOOT" for leg in LEGS])
    np.testing.assert_allclose(lf * [1, -1, 1], rf, atol=1e-6)
    np.testing.assert_allclose(lh * [1, -1, 1], rh, atol=1e-6)
    np.testing.assert_allclose(lf * [-1, 1, 1], lh, atol=1e-6)
    # Feet of 0.03 m hang at most 6 cm over the ground, none in it, within the stance that the start looks at.
    assert 0.03 <= lf[2] < 0.09
    assert lf[0] < anymal.footprint[0]
    assert lf[1] < anymal.footprint[1]


def test_masses_and_inertias_are_those_of_a_real_body(c_model):
    inertia = np.sort(c_model.body_inertia[1:], axis=1)
    assert (inertia[:, 2] <= inertia[:, 0] + inertia[:, 1]).all()  # the triangle inequality
    left = [c_model.body(f"{leg}_{part}").mass[0] for leg in ("LF", "LH") for part in ("HIP", "THIGH", "SHANK")]
    right = [c_model.body(f"{leg}_{part}").mass[0] for leg in ("RF", "RH") for part in ("HIP", "THIGH", "SHANK")]
    np.testing.assert_allclose(left, right)


def test_mujoco_reads_every_geom_with_a_role(anymal, c_model):
    assert {c_model.geom(k).name for k in range(c_model.ngeom)} == set(anymal.geom_names)


def test_roles(anymal):
    assert anymal.role_of("base") == BASE
    assert anymal.role_of("LH_FOOT") == FOOT
    assert anymal.role_of("RF_SHANK") == anymal.role_of("LF_THIGH") == LIMB
    assert anymal.role_of("ground") == 0
    roles = [anymal.role_of(name) for name in anymal.geom_names]
    assert [roles.count(role) for role in (BASE, LIMB, FOOT)] == [1, 8, 4]


def test_sizes(anymal):
    # 12 + 3 * 12 + 17 * 11 = 235 observations; 4 * 0.005 s = 50 Hz.
    assert anymal.num_scan_points == 187
    assert anymal.observation_size == 235
    assert anymal.control_dt == pytest.approx(0.02)


def test_the_scan_runs_along_y_first(anymal):
    x, y = anymal.scan_points()
    np.testing.assert_allclose([x[0], y[0], x[1], y[1], x[11], y[11]], [-0.8, -0.5, -0.8, -0.4, -0.7, -0.5], atol=1e-6)


def test_an_unknown_robot_is_named():
    with pytest.raises(ValueError, match=rf"unknown robot 'spot'.*{', '.join(sorted(ROBOTS))}"):
        get_robot("spot")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"foot_geoms": ("LF_FOOT", "LF_TOE")}, "no geom named LF_TOE .*the file has base, .*RH_FOOT"),
        ({"base_geoms": ("pelvis",)}, "no geom named pelvis"),
        ({"joint_names": ("LF_HAA", "LF_ANKLE")}, "no joint named LF_ANKLE .*the file has LF_HAA, .*RH_KFE"),
        ({"default_joint_pos": (0.0, 0.4)}, "needs 12 angles, got 2"),
    ],
)
def test_what_the_file_lacks_is_named(anymal, change, message):
    with pytest.raises(ValueError, match=message):
        build_robot(dataclasses.replace(anymal, **change))


def test_joints_in_another_order_are_refused(anymal):
    swapped = (*anymal.joint_names[3:], *anymal.joint_names[:3])
    with pytest.raises(ValueError, match=r"file's order \('LF_HAA'.*got \('RF_HAA'"):
        build_robot(dataclasses.replace(anymal, joint_names=swapped))


def test_a_missing_file_is_named(anymal, tmp_path):
    with pytest.raises(ValueError, match=r"gone\.xml, no such file"):
        build_robot(dataclasses.replace(anymal, model_file=tmp_path / "gone.xml"))


def test_penalty_scales_are_read(anymal, monkeypatch, tmp_path):
    file = tmp_path / "scales.json"
    monkeypatch.setattr(type(anymal), "scales_file", file)
    with pytest.raises(ValueError, match="make calibrate ROBOT=anymal"):
        anymal.read_penalty_scales()
    scales = {name: 0.5 + k for k, name in enumerate(anymal.penalties)}
    file.write_text(json.dumps({"scales": scales}))
    assert anymal.read_penalty_scales() == (0.5, 1.5, 2.5, 3.5, 4.5, 5.5)
    file.write_text(json.dumps({"scales": scales | {"stumble": 0.0}}))
    with pytest.raises(ValueError, match="no positive scale for stumble"):
        anymal.read_penalty_scales()
