"""The shipped robots: published numbers, the same robot to Newton and to MuJoCo, and what is asked of each; records
name the robot and the controller that they are of, and of a robot that is another now they are refused."""

import dataclasses
import hashlib
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from kernels.penalties import BASE, FOOT, LIMB
from sim.controllers.loaders import load_policy
from sim.controllers.spec import controller_identity
from sim.robots.find import get_robot, read_penalty_scales, resolve_robot
from sim.robots.model import build_robot
from sim.robots.robot import ROBOTS, check_robot_identity, robot_digest, robot_identity
from sim.robots.stand import describe_model, stand
from sim.robots.training import TrainingCfg
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank
from tests.builders import rsl_rl_actor, save_checkpoint
from tests.sim.dogs import KINDS, LEGS, write_dog
from tests.sim.scenes import ONLY_ANYMAL, ONLY_CASSIE


@pytest.fixture(scope="module")
def c_model(robot):
    return mujoco.MjModel.from_xml_path(str(robot.model_file))


@pytest.fixture(scope="module")
def builder(robot):
    return build_robot(robot)


def test_published_mass(robot, c_model, builder):
    # ANYmal C: 52.13 kg over its 13 moving bodies. Cassie: a pelvis of 10.33 + 0.1 kg and two legs of
    # 1.82 + 1.17 + 5.52 + 0.577 + 0.782 + 0.15 = 10.019 kg in six bodies each.
    mass, tolerance = {"anymal": (52.13, 0.01), "cassie": (10.43 + 2 * 10.019, 1e-6)}[robot.name]
    assert c_model.body_mass.sum() == pytest.approx(mass, abs=tolerance)
    assert sum(builder.body_mass) == pytest.approx(mass, abs=tolerance)
    assert builder.body_count == 13


def read_limits(builder):
    return np.column_stack([builder.joint_limit_lower[6:], builder.joint_limit_upper[6:]])


def test_armature_and_limits_are_the_same_in_newton_and_mujoco(robot, c_model, builder):
    # Gains and limits of effort, by the torques that they make: tests/sim/test_solver.py.
    np.testing.assert_allclose(builder.joint_armature[6:], c_model.dof_armature[6:])
    limited = c_model.jnt_limited[1:] == 1
    np.testing.assert_allclose(c_model.jnt_range[1:][limited], read_limits(builder)[limited], atol=1e-6)
    assert (np.abs(read_limits(builder)[~limited]) > 1e6).all()
    assert c_model.opt.timestep == robot.physics_dt


@ONLY_ANYMAL
def test_anymals_drives_and_hips(robot, c_model, builder):
    np.testing.assert_allclose(c_model.dof_armature[6:], 0.06)  # robot-side inertia of an ANYdrive's rotor [kg m^2]
    # Legs turn in by 0.72 rad and out by 0.49 rad: mirrored on the right.
    abduction = np.array([name.endswith("HAA") for name in robot.joint_names])
    np.testing.assert_allclose(read_limits(builder)[abduction], [[-0.72, 0.49], [-0.49, 0.72]] * 2, atol=1e-6)
    np.testing.assert_array_equal(c_model.jnt_limited[1:], abduction)


@ONLY_CASSIE
def test_cassies_published_limits_and_frames(c_model, builder):
    lower_joints = [[-0.3927, 0.3927], [-0.8727, 1.3963], [-2.8623, -0.6458], [0.6458, 2.8623], [-2.4435, -0.5236]]
    expected = [[-0.2618, 0.3927], *lower_joints, [-0.3927, 0.2618], *lower_joints]  # abduction: farther out than in
    np.testing.assert_allclose(read_limits(builder), expected, atol=1e-6)
    # Reflected through its gears the motor of a toe adds .01 kg m^2 to what is of the toe itself: .010449 in all.
    np.testing.assert_array_equal(c_model.dof_armature[6:], [0, 0, 0, 0, 0, 0.01] * 2)
    data = mujoco.MjData(c_model)
    mujoco.mj_kinematics(c_model, data)
    # With all angles 0 the leg hangs straight down, its x axis along it. Below the pelvis, by the offsets of the chain:
    # .09 + .12 + .4348 + .408 m; forward -.07 + .021 + .02 - .04 m; sideways .135 - .0045 m.
    below = data.body("left_toe").xpos - data.body("pelvis").xpos
    np.testing.assert_allclose(below, [-0.069, 0.1305, -1.0528], atol=1e-6)
    np.testing.assert_allclose(data.body("left_toe").xmat.reshape(3, 3)[:, 0], [0, 0, -1], atol=1e-6)
    # The hip's rotation turns about the vertical; flexion and the joints below, about the axis to the right.
    for joint, axis in (("hip_rotation", [0, 0, 1]), ("hip_flexion", [0, -1, 0]), ("toe_joint", [0, -1, 0])):
        np.testing.assert_allclose(data.joint(f"{joint}_left").xaxis, axis, atol=1e-6)


def test_penalties_and_observations_of_each_robot(anymal, cassie):
    # The paper: six penalties of ANYmal and no bit; five of Cassie and whether the pelvis collides.
    assert anymal.penalties == ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")
    assert cassie.penalties == anymal.penalties[:-1]
    assert (anymal.collision_bit, cassie.collision_bit) == (False, True)
    # 12 + 3 * 12 + 17 * 11 = 235 observations, with 11 x 11 points 169; 4 * 0.005 s = 50 Hz.
    assert (anymal.observation_size, cassie.observation_size) == (235, 169)
    assert anymal.control_dt == cassie.control_dt == pytest.approx(0.02)


def test_roles(robot, c_model):
    roles = {"anymal": [BASE] + [LIMB] * 8 + [FOOT] * 4, "cassie": [BASE, FOOT, FOOT]}[robot.name]
    simulation = Simulation(robot, TerrainBank(1, device="cpu"), np.zeros(1, dtype=int))
    assert simulation.geom_role.numpy().tolist() == roles
    assert {c_model.geom(k).name for k in range(c_model.ngeom)} == set(robot.geom_names)


def test_the_scan_runs_along_y_first(robot):
    first = {"anymal": -0.8, "cassie": -0.5}[robot.name]
    points = np.column_stack(robot.scan_points())
    expected = [[first, -0.5], [first, -0.4], [first + 0.1, -0.5], [-first, 0.5]]
    np.testing.assert_allclose(points[[0, 1, 11, -1]], expected, atol=1e-6)


def test_penalty_scales_are_read(anymal, monkeypatch, tmp_path):
    file = tmp_path / "scales.json"
    monkeypatch.setattr(type(anymal), "scales_file", file)
    scales = {name: 0.5 + k for k, name in enumerate(anymal.penalties)}
    file.write_text(json.dumps({"scales": scales, **robot_identity(anymal)}))
    assert read_penalty_scales(anymal) == (0.5, 1.5, 2.5, 3.5, 4.5, 5.5)
    file.write_text(json.dumps({"scales": scales | {"stumble": 0.0}, **robot_identity(anymal)}))
    with pytest.raises(ValueError, match="stumble"):
        read_penalty_scales(anymal)


def test_records_name_robot_and_controller_by_hash(anymal, tmp_path):
    record = controller_identity(anymal, anymal.policy_file)
    assert record["robot"] == "anymal" and record["policy"] == "anymal.pt"
    assert record["robot_sha256"] == robot_digest(anymal)
    assert record["policy_sha256"] == hashlib.sha256(anymal.policy_file.read_bytes()).hexdigest()
    check_robot_identity(record, anymal, Path("a.json"), "make it anew")
    for key in ("robot_sha256", "penalty_definition"):
        for changed in (record | {key: "other"}, {name: value for name, value in record.items() if name != key}):
            with pytest.raises(ValueError, match=r"a\.json"):
                check_robot_identity(changed, anymal, Path("a.json"), "make it anew")
    # A robot's hash follows its settings but those of training.
    assert robot_digest(dataclasses.replace(anymal, max_speed=99.0)) != record["robot_sha256"]
    assert robot_digest(dataclasses.replace(anymal, training=TrainingCfg(push_speed=9.0))) == record["robot_sha256"]


def test_a_changed_robot_is_warned_of_by_its_controller_and_refused_by_its_records(tmp_path, capsys):
    dog = write_dog(tmp_path)
    robot = get_robot(str(dog))
    record = {"robot": "dog", **robot_identity(robot)}
    assert resolve_robot(record, str(dog), tmp_path) == robot
    policy = save_checkpoint(dog.parent / "a1.pt", rsl_rl_actor(12 + 24 + 15, 8).state_dict())
    policy.with_suffix(".train.json").write_text(json.dumps({"settings": {"robot_sha256": robot_digest(robot)}}))
    load_policy(policy, dataclasses.replace(robot, physics_dt=0.001, decimation=20), "cpu")  # finer, not another
    assert "warning" not in capsys.readouterr().err
    dog.write_text(dog.read_text().replace("contact_force_limit=150.0", "contact_force_limit=15.0"))
    changed = get_robot(str(dog))
    with pytest.raises(ValueError, match=record["robot_sha256"][:12]):
        resolve_robot(record, str(dog), tmp_path)
    load_policy(policy, changed, "cpu")
    load_policy(policy, changed, "cpu")
    assert capsys.readouterr().err.count("warning") == 1


@pytest.mark.parametrize("name", ROBOTS)
def test_the_shipped_scales_are_of_the_shipped_robot_and_controller(name):
    """If this fails, a shipped file has changed: its scales must be measured again."""
    robot = ROBOTS[name]
    assert controller_identity(robot, robot.policy_file).items() <= json.loads(robot.scales_file.read_text()).items()


@pytest.mark.parametrize("kind", KINDS)
def test_a_dog_stands_on_its_feet(tmp_path, device, kind):
    dog = get_robot(str(write_dog(tmp_path, **KINDS[kind])))
    standing = stand(dog, device=device, seconds=1.5, drops=4)
    assert standing.stands and standing.finite and not standing.overflowed
    assert set(standing.carried) == {f"{leg}_foot" for leg in LEGS}
    assert sum(standing.carried.values()) == pytest.approx(1.0, abs=0.03)
    assert standing.height[0] == 0.29 and 0.24 < standing.height[1] < 0.29
    assert standing.tilt_deg < 2.0 and standing.joint_error < 0.1
    assert 4 <= standing.contacts < dog.nconmax
    assert not standing.mistakes
    assert standing.describe().endswith("It stands.")
    for change in ({"carried": {}}, {"height": (0.29, 0.1)}, {"tilt_deg": 16.0}, {"finite": False}):
        assert not dataclasses.replace(standing, **change).stands


@pytest.mark.parametrize(
    ("change", "mistake", "parts"),
    [
        # Thigh and shank of 0.15 m lean by 0.6 rad to either side: soles 0.3 cos 0.6 + 0.025 = 0.2726 m under the hips.
        ({"default_base_height": 0.2}, "sunk", ("0.073", "default_base_height 0.29")),
        ({"default_base_height": 0.45}, "falls", ("0.177 m", "default_base_height 0.29")),  # 0.45 - 0.2726 m
        ({"default_joint_pos": (0.0, -2.6) * 4}, "feet are not lowest", ("default pose",)),
        ({"nconmax": 3}, "contacts", ("nconmax",)),
        ({"foot_geoms": ("FL_foot",)}, "weight without a role", ("FR_foot, HL_foot, HR_foot",)),
        ({"armature": (0.0,) * 8}, "bounces", ("armature", "contact_time_constant_s")),
    ],
)
def test_what_has_to_be_mended_is_named(tmp_path, device, change, mistake, parts):
    robot = dataclasses.replace(get_robot(str(write_dog(tmp_path, **KINDS["urdf"]))), **change)
    standing = stand(robot, device=device, seconds=1.5, drops=2)
    assert mistake in standing.mistakes
    text = standing.describe()
    mended = "\n".join(line for line in text.splitlines() if line.startswith("To mend"))
    assert all(part in mended for part in parts) and "biped" not in text
    dead = dataclasses.replace(standing, finite=False)
    assert "not finite" in dead.mistakes and "physics_dt" in dead.describe()


def test_a_biped_falls_and_nothing_is_wrong_with_it(cassie, device):
    standing = stand(cassie, device=device, drops=1)
    assert not standing.stands and "pelvis" in standing.carried and not standing.mistakes
    assert "biped" in standing.describe()


def test_motors_and_delay_are_listed(tmp_path):
    more = "saturation_effort=(35.0,) * 8, velocity_limit=(21.5,) * 8, drive_delay_steps=3,"
    first, heads, *rows = describe_model(get_robot(str(write_dog(tmp_path, more=more)))).splitlines()[1:11]
    assert "3 physics steps" in first and "saturation" in heads
    assert all(row.split()[-2:] == ["35", "21.5"] for row in rows)


def test_shipped_robots_are_in_the_right_units_and_grams_are_not(robot, tmp_path):
    assert "Warning" not in describe_model(robot)
    file = write_dog(tmp_path)
    model = file.with_suffix(".xml")
    model.write_text(model.read_text().replace('mass="8"', 'mass="8000"'))
    assert "kilograms" in describe_model(get_robot(str(file)))
