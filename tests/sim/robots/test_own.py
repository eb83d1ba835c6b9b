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
from sim.robots.robot import RobotCfg
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


CHANGES = [
    ('name="dog"', 'name="anymal"', "name must be one of its own, got 'anymal'"),
    ('name="dog"', 'name="a dog"', "name must be letters, digits"),
    ('name="dog"', 'nam="dog"', r"dog\.py fails: TypeError: .*nam"),
    ("ROBOT =", "DOG =", r"dog\.py must set ROBOT to a sim.robots.robot.RobotCfg, got nothing"),
    ("ROBOT = RobotCfg(", "ROBOT = dict(", "got dict"),
    ("dog.xml", "cat.xml", r"model file expected at .*cat\.xml, no such file"),
    ('base_geoms=("trunk",)', 'base_geoms=("trunk")', "base_geoms must be a tuple, got 'trunk'"),
    ('base_geoms=("trunk",)', "base_geoms=()", "base_geoms must name at least one"),
    ('base_geoms=("trunk",)', 'base_geoms=("FL_foot",)', "a geom has one role: FL_foot"),
    ('base_geoms=("trunk",)', 'base_geoms=("body", "head")', "no geom named body, head .*the file has trunk, FL_thigh"),
    ('("hip", "knee")', '("hip", "shin")', "no joint named FL_shin, FR_shin, .*the file has FL_hip, FL_knee"),
    ("(0.6, -1.2) * 4", "(0.6, -1.2) * 3", "default_joint_pos needs 8 angles, got 6"),
    ("(0.6, -1.2) * 4", "(0.6, 1.2) * 4", r"file's range for FL_knee \(-2.6 to -0.1, got 1.2\), FR_knee"),
    ("(0.6, -1.2) * 4", "(0.6, None) * 4", "default_joint_pos must be a finite number"),
    ("footprint=(0.3, 0.2)", "footprint=(0.3, -0.2)", r"footprint must be above 0, got \(0.3, -0.2\)"),
    ("contact_force_limit=150.0", "contact_force_limit=0.0", "contact_force_limit must be above 0, got 0.0"),
    ('"vel_y", "collision"', '"vel_z"', "penalties must be at least 2 of yaw_rate.*got yaw_rate, vel_x, vel_z"),
    ("collision_bit=False,", "collision_bit=False, decimation=0,", "decimation must be at least 1, got 0"),
    ("collision_bit=False,", "collision_bit=False, decimation=4.0,", "decimation must be a whole number, got 4.0"),
    ('("FL", "FR", "HL", "HR")', '("FL", "FL", "HL", "HR")', "joint_names must hold each name once"),
    ("collision_bit=False,", 'collision_bit="no",', "collision_bit must be True or False"),
    ("collision_bit=False,", "collision_bit=False, stiffness=(60.0,) * 8,", "must be given together"),
    ("collision_bit=False,", "collision_bit=False," + GAINS, "has position actuators for FL_hip.*take one of them out"),
    ("collision_bit=False,", "collision_bit=False, effort_limit=(0.0,) * 8,", "effort_limit must be above 0"),
    ("collision_bit=False,", "collision_bit=False, effort_limit=(1.0,) * 4,", r"effort_limit needs 8 limits.*got 4"),
    ("collision_bit=False,", "collision_bit=False, physics_dt=1.0,", "physics_dt must be at most 0.05, got 1"),
    ("collision_bit=False,", "collision_bit=False, friction=-1.0,", "friction must be above 0"),
    ("collision_bit=False,", 'collision_bit=False, friction="a",', "friction must be a finite number or None"),
    ("collision_bit=False,", 'collision_bit=False, contact_time_constant_s="a",', "constant_s must be a finite number"),
    (
        "collision_bit=False,", "collision_bit=False, contact_time_constant_s=0.004,",
        "contact_time_constant_s must be at least twice physics_dt, 0.01 s",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), CHANGES, ids=[message for *_, message in CHANGES])
def test_what_is_wrong_in_the_settings_is_named(tmp_path, old, new, message):
    file = write_dog(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        get_robot(str(file))


def test_all_that_is_wrong_is_named_at_once(tmp_path):
    file = write_dog(tmp_path)
    text = file.read_text().replace("0.29", "-0.29").replace("150.0", "-1").replace('"vel_y"', '"vel_z"')
    file.write_text(text)
    with pytest.raises(ValueError, match=r"default_base_height.*contact_force_limit.*penalties"):
        get_robot(str(file))
    file.write_text(write_dog(tmp_path).read_text().replace('"trunk"', '"body"').replace('"knee"', '"shin"'))
    with pytest.raises(ValueError, match=r"no joint named FL_shin.*no geom named body"):
        get_robot(str(file))


def test_settings_and_model_are_judged_together(tmp_path):
    model = mjcf().replace('mass="8"', 'mass="0"').replace(BALL, EGG).replace(HIP, f'{HIP} armature="-1"')
    file = write_dog(tmp_path, model=model)
    text = file.read_text().replace("150.0", "-1").replace("* 4", "* 3").replace('"shank"', '"shin"')
    file.write_text(text.replace('base_geoms=("trunk",)', "base_geoms=()"))
    with pytest.raises(ValueError, match=r"dog\.py: ") as raised:
        get_robot(str(file))
    parts = (
        "contact_force_limit must be above 0, got -1", "base_geoms must name at least one", "above 0, unlike trunk",
        "armature must be a number, 0 or more, got FL_hip (-1)", "default_joint_pos needs 8 angles, got 6",
        "no geom named FL_shin", "geom FL_foot: no probes for a ELLIPSOID", "geom HR_foot: no probes for a ELLIPSOID",
    )  # fmt: skip
    assert [part for part in parts if part not in str(raised.value)] == []


FREE = '<freejoint name="root"/>'
FLOOR = '<worldbody><geom name="floor" type="plane" size="1 1 1"/>'
HIP = '<joint name="FL_hip"'
BALL = 'type="sphere" size="0.025"'
EGG = 'type="ellipsoid" size="0.02 0.02 0.03"'
DRIVE = '<position name="FL_hip"'
MODELS = [
    (mjcf(actuators="general"), "no gains for FL_hip, .*<position> actuators"),
    (mjcf(actuators="motor"), "no gains for FL_hip"),
    (mjcf().replace(FREE, ""), "first body must move freely"),
    (mjcf().replace("<worldbody>", FLOOR), "belong to the world.*floor"),
    (mjcf().replace(HIP, f'<joint name="FL_out" axis="1 0 0"/>{HIP}'), "hinge or slide on a body of its own"),
    (mjcf().replace(BALL, EGG, 1), "FL_foot: no probes for a ELLIPSOID"),
    (mjcf().replace("</mujoco>", ""), "cannot be read as XML"),
    ("<sdf/>", r"must be an MJCF \(<mujoco>\) or a URDF \(<robot>\), got <sdf>"),
    (mjcf().replace("<worldbody>", '<include file="dog.xml"/><worldbody>'), r"dog\.xml includes itself"),
    (mjcf(asset='<mesh name="m" file="dog.py"/>'), r"meshes must be STL or OBJ files, got .*dog\.py: convert them"),
    (mjcf(asset='<mesh name="m" file="gone.stl"/>'), r"names files that are not there: .*gone\.stl"),
    (mjcf().replace(HIP, f'{HIP} type="ball"'), "hinge or slide on a body of its own.*unlike FL_hip"),
    (mjcf().replace(HIP, f'{HIP} ref="0.3"'), r"a ref other than 0 \(FL_hip\) is not understood"),
    (mjcf().replace(HIP, f'{HIP} armature="-1"'), r"armature must be a number, 0 or more, got FL_hip \(-1\)"),
    (mjcf().replace('axis="0 1 0"', 'axis="0 0 0"', 1), "axis must be a direction, unlike that of FL_hip"),
    (mjcf().replace(DRIVE, f'{DRIVE} gear="2"'), r"a gear other than 1 on an actuator \(number 0\)"),
    (mjcf().replace(DRIVE, f'{DRIVE} timeconst="0.1"'), "an actuator with a timeconst .* is not understood"),
    (mjcf().replace("</actuator>", '<velocity joint="FL_hip" kv="9"/></actuator>'), r"on a joint \(FL_hip\)"),
    (mjcf().replace('kv="2"', 'kv="-2"'), r"kv must be a number, 0 or more, got FL_hip \(-2\)"),
    (mjcf().replace('mass="8"', 'mass="0"'), "every body must have a mass above 0, unlike trunk"),
    (mjcf().replace('mass="8"', 'mass="nan"'), "every body must have a mass above 0, unlike trunk"),
    (mjcf().replace("0.03 0.2 0.2", "0 0 0"), "inertia above 0 about every axis, unlike trunk"),
    (mjcf().replace('pos="0.2 0.12 0"', 'pos="0.2 nan 0"'), "position and rotation must be numbers, .* FL_hip"),
    (mjcf().replace(BALL, 'type="sphere" size="0"', 1), "FL_foot: its sizes must be positive numbers, got 0 m"),
    (mjcf().replace(BALL, 'type="sphere" size="25"', 1), "FL_foot: it is 50 m long.*in millimetres has a scale"),
    (urdf(), "no gains for FL_hip"),
    (urdf(trunk='<mesh filename="package://other/trunk.stl"/>'), "in package other, but none of the folders above"),
    (urdf(trunk='<mesh filename="https://example.org/trunk.stl"/>'), "nothing is downloaded"),
    (urdf(trunk='<mesh filename="../meshes/gone.stl"/>'), r"not there: .*meshes/gone\.stl"),
]


LIMIT = '<limit lower="-1.5" upper="2.5" effort="30" velocity="30"/>'
FIRST_MASS = '<mass value="0.8"/>'
URDFS = [
    # The hip's <joint> is the 22nd line, the thigh's <mass> the eighth.
    (urdf().replace(LIMIT, "", 1), r"dog\.urdf, line 22: joint FL_hip has no <limit>.*without effort .*: FL_hip"),
    (urdf().replace('lower="-1.5" ', "", 1), "line 22: joint FL_hip has no lower: give it <limit lower"),
    (urdf().replace('effort="30"', 'effort="0"', 2), "joints without effort .*: FL_hip, FL_knee: .*effort_limit"),
    (urdf().replace(' effort="30"', "", 1), r"joints without effort \(<limit effort>\): FL_hip: "),
    (urdf().replace(FIRST_MASS, "", 1), "mass above 0, unlike FL_thigh: give it an <inertial>"),
    (urdf().replace(FIRST_MASS, '<mass value="0,8"/>', 1), r'line 8: <mass value="0,8"> must be numbers.* point'),
    (urdf().replace('xyz="0.2 0.12 0"', 'xyz="0.2 left 0"'), 'line 23: <origin xyz="0.2 left 0"> must be numbers'),
    (urdf().replace(FIRST_MASS, '<mass value="${m}"/>'), r"line 8: a xacro file \(\$\{m\}\).*`xacro dog\.urdf > "),
    (urdf().replace('<parent link="trunk"/>', "", 1), "line 22: joint FL_hip has no <parent link"),
    (
        urdf().replace('<child link="FL_thigh"/>', '<child link="leg"/>'),
        "joint FL_hip: no link named leg, the file has",
    ),
    (urdf().replace('"revolute"', '"hinge"', 1), "joint FL_hip must be of type revolute.*got 'hinge'"),
    (urdf().replace('"trunk">', '"">', 1), "line 2: a link without a name"),
]


@pytest.mark.parametrize(("model", "message"), URDFS, ids=[message for _, message in URDFS])
def test_what_a_urdf_lacks_is_named_by_file_and_line(tmp_path, model, message):
    more = GAINS.replace("\n    effort_limit=(30.0,) * 8,", "")
    with pytest.raises(ValueError, match=message):
        get_robot(str(write_dog(tmp_path, model=model, suffix="urdf", more=more)))


def test_effort_may_stand_in_the_settings_and_a_link_without_inertial_weighs_nothing(tmp_path):
    foot = '<inertial><origin xyz="0 0 0.0"/><mass value="0.1"/>'
    model = urdf().replace(' effort="30"', "")
    start = model.index(foot)
    model = model[:start] + model[model.index("</inertial>", start) + len("</inertial>") :]
    builder = build_robot(get_robot(str(write_dog(tmp_path, model=model, suffix="urdf", more=GAINS))))
    assert builder.joint_effort_limit[6:] == [30.0] * 8
    assert sum(builder.body_mass) == pytest.approx(MASS - 0.1)


def test_a_decimal_comma_in_the_settings_is_asked_for(tmp_path):
    file = write_dog(tmp_path)
    file.write_text(file.read_text().replace("height=0.29", "height=0,29"))
    line = next(number for number, text in enumerate(file.read_text().splitlines(), 1) if "0,29" in text)
    with pytest.raises(ValueError, match=rf"fails: SyntaxError: .*the comma in line {line} a decimal point"):
        get_robot(str(file))


@pytest.mark.parametrize(("model", "message"), MODELS, ids=[message for _, message in MODELS])
def test_what_is_wrong_with_the_model_is_named(tmp_path, model, message):
    with pytest.raises(ValueError, match=message):
        get_robot(str(write_dog(tmp_path, model=model)))


def test_actuators_that_would_pull_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"pulls by itself \(number 0, number 1, .*<motor> are\)"):
        get_robot(str(write_dog(tmp_path, model=mjcf(actuators="general"), more=GAINS)))


def test_geoms_without_a_name_are_called_by_their_body(tmp_path):
    file = write_dog(tmp_path, model=mjcf(unnamed=True))
    with pytest.raises(ValueError, match=r"no geom named FL_thigh, .*the file has trunk, FL_thigh_geom_0, FL_shank"):
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


def test_a_file_that_is_not_there_or_fails_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.py: no such file"):
        get_robot(str(tmp_path / "gone.py"))
    (tmp_path / "bad.py").write_text("1 / 0")
    with pytest.raises(ValueError, match=r"bad\.py fails: ZeroDivisionError"):
        get_robot(str(tmp_path / "bad.py"))
    (tmp_path / "bad.py").write_text("raise SystemExit(0)")
    with pytest.raises(ValueError, match=r"bad\.py fails: SystemExit: 0"):
        get_robot(str(tmp_path / "bad.py"))


def test_a_link_to_the_settings_is_the_robot(tmp_path):
    file = write_dog(tmp_path / "mine")
    (tmp_path / "link.py").symlink_to(file)
    assert get_robot(str(tmp_path / "link.py")) == get_robot(str(file))


def test_a_variant_of_a_shipped_robot_is_a_robot(tmp_path, anymal):
    (tmp_path / "blind.py").write_text(
        "from dataclasses import replace\nfrom sim.robots.robot import get_robot\n"
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


def test_a_setting_that_is_new_changes_no_hash_while_it_has_its_default(anymal):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Later(RobotCfg):
        toes: int = 0

    later = Later(**{one.name: getattr(anymal, one.name) for one in dataclasses.fields(RobotCfg)})
    assert robot_digest(later) == robot_digest(anymal) != robot_digest(dataclasses.replace(later, toes=1))


def test_the_defaults_that_hashes_leave_out_stay():
    """If this fails, robots have changed whose hashes have not: give the setting another name, or keep its default."""
    assert {
        "default_base_height": 0.0, "action_scale": 0.5, "physics_dt": 0.005, "decimation": 4, "max_speed": 100.0,
        "nconmax": 40, "njmax": 100, "stiffness": None, "damping": None, "effort_limit": None, "armature": None,
        "friction": None, "contact_time_constant_s": None,
    }.items() <= {one.name: one.default for one in dataclasses.fields(RobotCfg)}.items()  # fmt: skip


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
