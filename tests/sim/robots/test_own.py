"""Settings of robots that the project does not ship: what they hold, what is refused, what tells robots apart."""

import dataclasses
import os
import pickle
import re
import shutil

import numpy as np
import pytest

from sim.files.records import robot_digest
from sim.robots.find import get_robot
from sim.robots.model import build_robot
from sim.robots.model_files import read_model_files
from sim.robots.own import PackedRobot, pack_robot
from tests.sim.dogs import GAINS, KINDS, MASS, TRUNK, mjcf, stl, urdf, with_mesh, write_dog


def test_a_file_is_a_robot(tmp_path, monkeypatch):
    write_dog(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    dog = get_robot("mine/dog.py")
    file = tmp_path / "mine" / "dog.py"
    assert (dog.name, dog.num_joints, dog.observation_size) == ("dog", 8, 12 + 24 + 15)
    assert (dog.settings_file, dog.spec, dog.model_file) == (file, str(file), tmp_path / "mine" / "dog.xml")
    assert dog.policy_file == tmp_path / "mine" / "dog.pt"
    assert dog.scales_file == tmp_path / "mine" / "dog.scales.json"
    with pytest.raises(ValueError, match=rf"calibrate --robot {re.escape(str(file))}`"):
        dog.read_penalty_scales()
    assert get_robot(dog) is dog
    assert pickle.loads(pickle.dumps(dog)) == dog


FREE = '<freejoint name="root"/>'
FLOOR = '<worldbody><geom name="floor" type="plane" size="1 1 1"/>'
HIP = '<joint name="FL_hip"'
BALL = 'type="sphere" size="0.025"'
EGG = 'type="ellipsoid" size="0.02 0.02 0.03"'
DRIVE = '<position name="FL_hip"'
MORE = "collision_bit=False,"
CHANGES = [  # what is changed in the settings, and the field or part that the error names
    ('name="dog"', 'name="anymal"', "name"),
    ('name="dog"', 'name="a dog"', "name"),
    ('name="dog"', 'nam="dog"', "nam"),
    ("ROBOT =", "DOG =", "ROBOT"),
    ("ROBOT = RobotCfg(", "ROBOT = dict(", "dict"),
    ("dog.xml", "cat.xml", "cat.xml"),
    ('base_geoms=("trunk",)', 'base_geoms=("trunk")', "base_geoms"),
    ('base_geoms=("trunk",)', "base_geoms=()", "base_geoms"),
    ('base_geoms=("trunk",)', 'base_geoms=("FL_foot",)', "FL_foot"),
    ('base_geoms=("trunk",)', 'base_geoms=("body", "head")', "body, head"),
    ('("hip", "knee")', '("hip", "shin")', "FL_shin"),
    ("(0.6, -1.2) * 4", "(0.6, -1.2) * 3", "default_joint_pos"),
    ("(0.6, -1.2) * 4", "(0.6, 1.2) * 4", "FL_knee"),
    ("(0.6, -1.2) * 4", "(0.6, None) * 4", "default_joint_pos"),
    ("footprint=(0.3, 0.2)", "footprint=(0.3, -0.2)", "footprint"),
    ('"vel_y", "collision"', '"vel_z"', "penalties"),
    ('("FL", "FR", "HL", "HR")', '("FL", "FL", "HL", "HR")', "joint_names"),
    (MORE, f"{MORE} decimation=4.0,", "decimation"),
    (MORE, 'collision_bit="no",', "collision_bit"),
    (MORE, f"{MORE} stiffness=(60.0,) * 8,", "damping"),
    (MORE, MORE + GAINS, "FL_hip"),  # the file has position actuators
    (MORE, f"{MORE} effort_limit=(1.0,) * 4,", "effort_limit"),
    (MORE, f"{MORE} contact_time_constant_s=0.004,", "contact_time_constant_s"),
]


@pytest.mark.parametrize(("old", "new", "field"), CHANGES)
def test_what_is_wrong_in_the_settings_is_named(tmp_path, old, new, field):
    file = write_dog(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=re.escape(field)):
        get_robot(str(file))


def test_settings_and_model_are_judged_together_and_all_that_is_wrong_is_named(tmp_path):
    model = mjcf().replace('mass="8"', 'mass="0"').replace(BALL, EGG).replace(HIP, f'{HIP} armature="-1"')
    file = write_dog(tmp_path, model=model)
    text = file.read_text().replace("150.0", "-1").replace("* 4", "* 3").replace('"shank"', '"shin"')
    file.write_text(text.replace('base_geoms=("trunk",)', "base_geoms=()"))
    with pytest.raises(ValueError, match=r"dog\.py: ") as raised:
        get_robot(str(file))
    parts = (
        "contact_force_limit", "base_geoms", "trunk", "armature", "default_joint_pos", "FL_shin", "FL_foot", "HR_foot",
    )  # fmt: skip
    assert [part for part in parts if part not in str(raised.value)] == []


MODELS = [
    (mjcf(actuators="motor"), "gains for FL_hip"),
    (mjcf().replace(FREE, ""), "first body"),
    (mjcf().replace("<worldbody>", FLOOR), "floor"),
    (mjcf().replace(HIP, f'<joint name="FL_out" axis="1 0 0"/>{HIP}'), "hinge or slide"),
    (mjcf().replace(BALL, EGG, 1), "FL_foot"),
    (mjcf().replace("</mujoco>", ""), "XML"),
    ("<sdf/>", "sdf"),
    (mjcf().replace("<worldbody>", '<include file="dog.xml"/><worldbody>'), "includes itself"),
    (mjcf(asset='<mesh name="m" file="dog.py"/>'), "STL or OBJ"),
    (mjcf(asset='<mesh name="m" file="gone.stl"/>'), "gone.stl"),
    (mjcf().replace(HIP, f'{HIP} type="ball"'), "FL_hip"),
    (mjcf().replace(HIP, f'{HIP} ref="0.3"'), "ref"),
    (mjcf().replace('axis="0 1 0"', 'axis="0 0 0"', 1), "axis"),
    (mjcf().replace(DRIVE, f'{DRIVE} gear="2"'), "gear"),
    (mjcf().replace(DRIVE, f'{DRIVE} timeconst="0.1"'), "timeconst"),
    (mjcf().replace("</actuator>", '<velocity joint="FL_hip" kv="9"/></actuator>'), "FL_hip"),
    (mjcf().replace('kv="2"', 'kv="-2"'), "kv"),
    (mjcf().replace('mass="8"', 'mass="nan"'), "mass"),
    (mjcf().replace("0.03 0.2 0.2", "0 0 0"), "inertia"),
    (mjcf().replace('pos="0.2 0.12 0"', 'pos="0.2 nan 0"'), "position and rotation"),
    (mjcf().replace(BALL, 'type="sphere" size="0"', 1), "FL_foot: its sizes"),
    (mjcf().replace(BALL, 'type="sphere" size="25"', 1), "FL_foot: it is 50 m long"),
    (urdf(), "gains for FL_hip"),
    (urdf(trunk='<mesh filename="package://other/trunk.stl"/>'), "package other"),
    (urdf(trunk='<mesh filename="https://example.org/trunk.stl"/>'), "downloaded"),
]
LIMIT = '<limit lower="-1.5" upper="2.5" effort="30" velocity="30"/>'
FIRST_MASS = '<mass value="0.8"/>'
URDFS = [
    # The hip's <joint> is the 22nd line, the thigh's <mass> the eighth.
    (urdf().replace(LIMIT, "", 1), "line 22: joint FL_hip has no <limit>"),
    (urdf().replace('lower="-1.5" ', "", 1), "line 22: joint FL_hip has no lower"),
    (urdf().replace('effort="30"', 'effort="0"', 2), "FL_hip, FL_knee"),
    (urdf().replace(FIRST_MASS, "", 1), "FL_thigh"),
    (urdf().replace(FIRST_MASS, '<mass value="0,8"/>', 1), "line 8"),
    (urdf().replace('xyz="0.2 0.12 0"', 'xyz="0.2 left 0"'), "line 23"),
    (urdf().replace(FIRST_MASS, '<mass value="${m}"/>'), "line 8: a xacro file"),
    (urdf().replace('<parent link="trunk"/>', "", 1), "line 22: joint FL_hip has no <parent link"),
    (urdf().replace('<child link="FL_thigh"/>', '<child link="leg"/>'), "leg"),
    (urdf().replace('"revolute"', '"hinge"', 1), "revolute"),
    (urdf().replace('"trunk">', '"">', 1), "line 2"),
]


@pytest.mark.parametrize(("model", "part"), URDFS)
def test_what_a_urdf_lacks_is_named_by_line(tmp_path, model, part):
    more = GAINS.replace("\n    effort_limit=(30.0,) * 8,", "")
    with pytest.raises(ValueError, match=re.escape(part)):
        get_robot(str(write_dog(tmp_path, model=model, suffix="urdf", more=more)))


def test_effort_may_stand_in_the_settings_and_a_link_without_inertial_weighs_nothing(tmp_path):
    foot = '<inertial><origin xyz="0 0 0.0"/><mass value="0.1"/>'
    model = urdf().replace(' effort="30"', "")
    start = model.index(foot)
    model = model[:start] + model[model.index("</inertial>", start) + len("</inertial>") :]
    builder = build_robot(get_robot(str(write_dog(tmp_path, model=model, suffix="urdf", more=GAINS))))
    assert builder.joint_effort_limit[6:] == [30.0] * 8
    assert sum(builder.body_mass) == pytest.approx(MASS - 0.1)


@pytest.mark.parametrize(("model", "part"), MODELS)
def test_what_is_wrong_with_the_model_is_named(tmp_path, model, part):
    with pytest.raises(ValueError, match=re.escape(part)):
        get_robot(str(write_dog(tmp_path, model=model)))


def test_actuators_that_would_pull_are_refused(tmp_path):
    with pytest.raises(ValueError, match="pulls by itself"):
        get_robot(str(write_dog(tmp_path, model=mjcf(actuators="general"), more=GAINS)))


def test_geoms_without_a_name_are_called_by_their_body(tmp_path):
    file = write_dog(tmp_path, model=mjcf(unnamed=True))
    with pytest.raises(ValueError, match="FL_thigh_geom_0"):
        get_robot(str(file))
    text = file.read_text().replace(
        'f"{leg}_{part}" for leg in LEGS for part in ("thigh", "shank")', 'f"{leg}_thigh_geom_0" for leg in LEGS'
    )
    file.write_text(text)
    assert get_robot(str(file)).limb_geoms[0] == "FL_thigh_geom_0"


def test_what_is_wrong_in_the_training_settings_is_named(tmp_path):
    file = write_dog(tmp_path)
    wrong = (
        'training=TrainingCfg(rewards=RewardCfg(torques=float("nan")), soft_joint_limit=2.0, push_speed=None, '
        'added_base_mass=(1.0, 0.0)), learning=LearningCfg(num_envs=0, entropy="some"), collision_bit'
    )
    head = "from sim.robots.training import LearningCfg, RewardCfg, TrainingCfg\n"
    file.write_text(head + file.read_text().replace("collision_bit", wrong))
    with pytest.raises(
        ValueError,
        match=r"rewards.torques must be a fin.*soft_joint_limit.*added_base_mass.*entropy.*num_envs",
    ):
        get_robot(str(file))


def test_a_mesh_in_millimetres_is_told_so(tmp_path):
    file = with_mesh(tmp_path, "mjcf")
    (mesh,) = (path for path in read_model_files(get_robot(str(file)).model_file).files if path.suffix == ".stl")
    mesh.write_bytes(stl(1000.0 * np.array(TRUNK)))
    with pytest.raises(ValueError, match="trunk: it is 500 m long, at most 10 m are taken"):
        get_robot(str(file))


@pytest.mark.parametrize("content", [None, "1 / 0", "raise SystemExit(0)"])
def test_a_file_that_is_not_there_or_fails_is_named(tmp_path, content):
    if content is not None:
        (tmp_path / "bad.py").write_text(content)
    with pytest.raises(ValueError, match=r"bad\.py"):
        get_robot(str(tmp_path / "bad.py"))


def test_a_link_to_the_settings_is_the_robot(tmp_path):
    file = write_dog(tmp_path / "mine")
    (tmp_path / "link.py").symlink_to(file)
    assert get_robot(str(tmp_path / "link.py")) == get_robot(str(file))


def test_a_variant_of_a_shipped_robot_is_a_robot(tmp_path, anymal):
    (tmp_path / "blind.py").write_text(
        "from dataclasses import replace\nfrom sim.robots.find import get_robot\n"
        'ROBOT = replace(get_robot("anymal"), name="blind-anymal", scan_x=(), scan_y=())\n'
    )
    robot = get_robot(str(tmp_path / "blind.py"))
    assert robot.observation_size == 48
    assert robot.model_file == anymal.model_file
    assert robot.policy_file == tmp_path / "blind-anymal.pt"


def test_the_hash_tells_robots_apart(tmp_path, anymal):
    file = with_mesh(tmp_path, "mjcf")
    text, model, mesh = file.read_text(), file.with_name("dog.xml"), tmp_path / "dog" / "meshes" / "trunk.stl"
    assert robot_digest(anymal) != robot_digest(dataclasses.replace(anymal, action_scale=0.25))

    def digest(path=file):
        return robot_digest(get_robot(str(path)))

    first = digest()
    file.write_text("# a remark\n" + text)
    assert digest() == first
    file.write_text(
        text.replace("collision_bit", "training=TrainingCfg(push_speed=0.5), collision_bit").replace(
            "import RobotCfg", "import RobotCfg, TrainingCfg"
        )
    )
    assert digest() == first
    shutil.copytree(tmp_path / "dog", tmp_path / "elsewhere" / "dog")
    file.write_text(text)
    assert digest(tmp_path / "elsewhere" / "dog" / "model" / "dog.py") == first
    found = {first}
    for changed, old, new in ((file, b"150.0", b"151.0"), (model, b'mass="0.8"', b'mass="0.9"')):
        before = changed.read_bytes()
        changed.write_bytes(before.replace(old, new, 1))
        found.add(digest())
        changed.write_bytes(before)
    mesh.write_bytes(stl(np.array(TRUNK) * 1.01))
    found.add(digest())
    mesh.write_bytes(stl(TRUNK))
    assert len(found) == 4 and digest() == first


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_travels_with_its_files(tmp_path, kind):
    robot = get_robot(str(with_mesh(tmp_path / "here", kind)))
    packed, digest = pickle.loads(pickle.dumps(pack_robot(robot))), robot_digest(robot)
    assert isinstance(packed, PackedRobot) and len(packed.files) == 2
    shutil.rmtree(tmp_path / "here")
    there = packed.unpacked(tmp_path / "there")
    assert there == dataclasses.replace(robot, model_file=there.model_file)
    assert tmp_path / "there" in there.model_file.parents
    assert sum(build_robot(there).body_mass) == pytest.approx(MASS)
    assert robot_digest(there) == digest


def test_what_an_mjcf_includes_belongs_to_it(tmp_path):
    file = with_mesh(tmp_path, "mjcf")
    model = file.with_name("dog.xml")
    body, _, actuators = model.read_text().partition("<actuator>")
    (file.parent / "parts").mkdir()
    (file.parent / "parts" / "drives.xml").write_text("<mujoco><actuator>" + actuators)
    model.write_text(body + '<include file="parts/drives.xml"/></mujoco>')
    robot = get_robot(str(file))
    names = [file.name for file in read_model_files(robot.model_file).files]
    assert sorted(names) == ["dog.xml", "drives.xml", "trunk.stl"]
    first = robot_digest(robot)
    (file.parent / "parts" / "drives.xml").write_text("<mujoco><actuator>" + actuators.replace('kp="60"', 'kp="61"'))
    assert robot_digest(get_robot(str(file))) != first
    os.remove(file.parent / "parts" / "drives.xml")
    with pytest.raises(ValueError, match=r"not there: .*drives\.xml"):
        get_robot(str(file))


def test_a_shipped_robot_travels_by_name(anymal):
    assert pack_robot(anymal) == "anymal"
