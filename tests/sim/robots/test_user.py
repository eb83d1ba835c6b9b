"""Robots that the project does not ship: their files are found and checked; MJCF, URDF and meshes become models."""

import dataclasses
import pickle
import re
import shutil

import newton
import numpy as np
import pytest
from matplotlib.image import imsave

from kernels.episode import Outcome
from sim.controllers.described import read_row
from sim.crossing import resolved
from sim.mujoco_c.crossing import cross_in_mujoco_c, draw_starts
from sim.robots.compiled import robot_spec
from sim.robots.find import get_robot, read_penalty_scales
from sim.robots.model import build_robot
from sim.robots.model_files import find_above, read_model_files
from sim.robots.robot import robot_digest
from sim.robots.skeleton import Skeleton
from sim.robots.user import PackedRobot, describe_inferred, pack_robot
from sim.terrains.terrains import Terrains
from tests.sim import dogs
from tests.sim.dogs import DRIVE, GAINS, KINDS, TRUNK, mjcf, stl, with_mesh, write_dog, write_toml
from tests.sim.scenes import FLAT, crossing


def replace_once(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_a_file_is_a_robot(tmp_path, monkeypatch):
    file = write_dog(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    dog = get_robot("mine/dog.py")
    assert (dog.name, dog.num_joints, dog.observation_size) == ("dog", 8, 12 + 24 + 15)
    assert (dog.settings_file, dog.spec, dog.model_file) == (file, str(file), tmp_path / "mine" / "dog.xml")
    assert (dog.policy_file, dog.scales_file) == (file.with_name("dog.pt"), file.with_name("dog.scales.json"))
    with pytest.raises(ValueError, match=re.escape(str(dog.scales_file))):
        read_penalty_scales(dog)
    (tmp_path / "link.py").symlink_to(file)
    assert get_robot(dog) is dog
    assert get_robot("link.py") == pickle.loads(pickle.dumps(dog)) == dog


@pytest.mark.slow
def test_what_a_robot_toml_leaves_out_is_what_a_user_would_write(tmp_path):
    keys = f'<keyframe><key name="home" qpos="0 0 .3 1 0 0 0{4 * " 0.6 -1.2"}"/></keyframe></mujoco>'
    file = write_toml(tmp_path / "dog", model=mjcf().replace("</mujoco>", keys))
    dog, written = get_robot(str(file)), get_robot(str(write_dog(tmp_path / "py")))
    for name in ("name", "joint_names", "default_joint_pos", "base_geoms", "foot_geoms", "collision_bit", "spec"):
        expected = str(file) if name == "spec" else getattr(written, name)
        assert getattr(dog, name) == expected, name
    assert {*dog.limb_geoms} == {*written.limb_geoms}
    assert dog.penalties == get_robot("anymal").penalties and (dog.scan_x, dog.scan_y) == ((), ())
    assert dog.contact_force_limit == pytest.approx(dogs.MASS * 9.81, rel=5e-3)
    assert dog.max_speed == 300.0
    # Legs are longest with hips of 0.8 * 0.6 rad, knees of 0.8 * -1.2: soles 0.3 cos 0.48 + 0.025 = 0.2911 m below.
    assert dog.default_base_height == pytest.approx(0.2911, abs=3e-3)
    (file.parent / "dog.xml").write_text(mjcf())  # without a keyframe: 0, and -.1 where knees end
    assert get_robot(str(file)).default_joint_pos == (0.0, -0.1) * 4


def test_values_of_a_robot_toml_may_be_of_all_joints_or_by_their_names(tmp_path):
    text = 'stiffness = 50\ndamping = {".*_hip" = 2, ".*_knee" = 3, HR_knee = 4}\nspeed = 0.5\n'
    text += 'saturation_effort = 40\nvelocity_limit = {".*_hip" = 20, ".*_knee" = 15}\n'
    file = write_toml(tmp_path / "dog", f"{text}default_joint_pos = {{'.*hip' = 0.6, '.*knee' = -1.2}}")
    terms = '{term = "contacts"}, {term = "scan", x = [0.0, 0.2], y = [0]}, {term = "rpy", axes = "yaw"}'
    (file.parent / "controller.toml").write_text(f"observation = [{terms}]")
    dog = get_robot(str(file))
    assert (dog.stiffness, dog.damping, dog.default_joint_pos) == ((50,) * 8, (2, 3) * 3 + (2, 4), (0.6, -1.2) * 4)
    assert (dog.saturation_effort, dog.velocity_limit) == ((40,) * 8, (20, 15) * 4)
    assert dog.senses == ("pose", "contacts") and "senses = [" in describe_inferred(dog)
    assert (dog.speed, dog.scan_x, dog.scan_y, dog.policy_file.name) == (0.5, (0.0, 0.2), (0.0,), "controller.toml")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("speeed = 1", "speeed"),
        ("njmax = 100", "njmax"),
        ("label = 'Dog'", "label"),
        ("stiffness = {'.*hip' = 50}\ndamping = 2", "FL_knee"),
        ("stiffness = {'.*' = 50, '.*knee' = 40}\ndamping = 2", "FL_knee"),
        ("stiffness = {'.*' = 50, '.*ankle' = 40}\ndamping = 2", "ankle"),
        ("default_joint_pos = [0.1]", "default_joint_pos"),
        ("default_joint_pos = nan", "must be 8 angles"),
        ("armature = {'[' = 1}", "armature must have names or regular expressions"),
        ("speed = 'fast'", "speed"),
        ("base_geoms = ['tail']", "tail"),
        ("base_geoms = 3", "base_geoms"),
        ("=", "TOML"),
    ],
)
def test_a_wrong_robot_toml_is_refused(tmp_path, text, named):
    with pytest.raises(ValueError, match=re.escape(named)) as error:
        get_robot(str(write_toml(tmp_path / "dog", text)))
    assert "robot.toml" in str(error.value)


@pytest.mark.slow
def test_a_blind_robot_crosses_in_both_simulators(tmp_path, device):
    dog = dataclasses.replace(get_robot(str(write_dog(tmp_path))), scan_x=(), scan_y=())

    def hold(row):
        return read_row(row, dog).last_action

    flat = Terrains(heights=FLAT[None], seeds=np.array([1]))
    assert crossing(dog, device, hold).evaluate(flat).outcome.tolist() == [[Outcome.TIME_OUT] * 4]
    short = dataclasses.replace(dog, max_duration_s=0.1)
    result = cross_in_mujoco_c(short, hold, FLAT, draw_starts(short, FLAT, 1, 2))
    assert result.outcome.tolist() == [[Outcome.TIME_OUT] * 2]


FREE = '<freejoint name="root"/>'
WORLD = "<worldbody>"
HIP = '<joint name="FL_hip"'
BALL = 'type="sphere" size="0.025"'
FIRST_DRIVE = DRIVE.format("FL_hip")
MESH = "<asset></asset>"
SHORT_HOME = '<keyframe><key name="home" qpos="0 0 1"/></keyframe>'
START = f'{WORLD}\n    <body name="trunk" pos="0 0 {dogs.STAND}">'
PAYLOAD = '<body name="imu"><inertial mass="2" pos="0 0 0" diaginertia="0.01 0.01 0.01"/></body>'
MORE = "collision_bit=False,"
LIMIT = '<limit lower="-1.5" upper="2.5" effort="30" velocity="30"/>'
FIRST_MASS = '<mass value="0.8"/>'
PLUGIN = '<plugin plugin="mujoco.pid" joint="FL_hip"><config key="kp" value="40"/></plugin>'
EXTENSION = '</actuator><extension><plugin plugin="mujoco.pid"/></extension><actuator>'
ROD = '<connect body1="FL_toe" body2="FR_toe" anchor="0 0 0"/>'


def equality(*pairs, more=""):
    """Hips that follow others, by their legs."""
    hips = [pair.split() for pair in pairs]
    joints = "".join(f'<joint joint1="{leg}_hip" joint2="{of}_hip" {more}/>' for leg, of in hips)
    return f"<equality>{joints}</equality></mujoco>"


MISTAKES = [  # a row a rule: the file it is in, what is replaced there by what, and the part that the error names
    ("py", 'name="dog"', 'name="anymal"', "name"),
    ("py", 'name="dog"', 'name="a dog"', "name"),
    ("py", "ROBOT =", "DOG =", "ROBOT"),
    ("py", "ROBOT =", "1 / 0; ROBOT =", "dog.py"),
    ("py", "dog.xml", "cat.xml", "cat.xml"),
    ("py", "150.0", "-1", "contact_force_limit"),
    ("py", MORE, f"{MORE} training=TrainingCfg(soft_joint_limit=2.0),", "training.soft_joint_limit"),
    ("py", MORE, f'{MORE} training=TrainingCfg(steady_joints=("tail",)),', "steady_joints"),
    ("py", 'base_geoms=("trunk",)', 'base_geoms=("FL_foot",)', "FL_foot"),
    ("py", '("FL", "FR", "HL", "HR")', '("FL", "FL", "HL", "HR")', "joint_names"),
    ("py", '("hip", "knee")', '("hip", "shin")', "FL_shin"),
    ("py", '("hip", "knee")', '("knee", "hip")', "joint_names must follow"),
    ("py", "(0.6, -1.2) * 4", "(0.6, 1.2) * 4", "FL_knee"),
    ("py", '"vel_y", "collision"', '"vel_z"', "penalties"),
    ("py", MORE, f"{MORE} stiffness=(60.0,) * 8,", "damping"),
    ("py", MORE, f"{MORE} velocity_limit=(20.0,) * 8,", "saturation_effort"),
    ("py", MORE, f"{MORE} saturation_effort=(30.0,) * 8, velocity_limit=(9.0,) * 7,", "velocity_limit needs 8"),
    ("py", MORE, f"{MORE} max_duration_s=0.001,", "max_duration_s"),
    ("py", MORE, f"{MORE} contact_time_constant_s=0.004,", "contact_time_constant_s"),
    ("xml", FIRST_DRIVE, "", "FL_hip"),
    ("xml", FREE, "", "first body"),
    ("xml", HIP, f'<joint name="FL_out" axis="1 0 0"/>{HIP}', "FL_out"),
    ("xml", BALL, 'type="ellipsoid" size="0.02 0.02 0.03"', "FL_foot"),
    ("xml", BALL, 'type="sphere" size="25"', "FL_foot: it is 50 m"),
    ("xml", "</mujoco>", "", "XML"),
    ("xml", WORLD, f'<include file="dog.xml"/>{WORLD}', "included"),
    ("xml", MESH, '<asset><mesh name="m" file="dog.py"/></asset>', "dog.py"),
    ("xml", MESH, '<asset><mesh name="m" file="gone.stl"/></asset>', "gone.stl"),
    ("xml", HIP, f'{HIP} ref="0.3"', "ref"),
    ("xml", FIRST_DRIVE, FIRST_DRIVE.replace("kp", 'gear="2" kp'), "gear"),
    ("xml", FIRST_DRIVE, FIRST_DRIVE.replace("kp", 'timeconst="0.1" kp'), "timeconst"),
    ("xml", FIRST_DRIVE, f"{PLUGIN}{EXTENSION}", "an actuator of a plugin on FL_hip"),
    ("xml", 'contype="1" conaffinity="0"', 'contype="0" conaffinity="0"', "no geom touches anything"),
    ("xml", "</actuator>", '<velocity joint="FL_hip" kv="9"/></actuator>', "wheels, on FL_hip"),
    ("xml", '<geom name="trunk"', '<site name="trunk"/><geom name="body"', "trunk"),
    ("xml", '<geom name="trunk"', '<geom contype="0" name="trunk"', "touches the ground is named trunk"),
    ("xml", FIRST_DRIVE, '<general joint="FL_hip" biastype="affine" gainprm="60" biasprm="1 -60"/>', "<position>"),
    ("xml", "0.03 0.2 0.2", "1e-12 1e-12 1e-12", "a point"),
    ("xml", 'friction="0.8"', 'friction="0.8" margin="0.02"', "<geom margin> of trunk (line"),
    ("xml", "</mujoco>", '<option gravity="0 0 0"/></mujoco>', "<option gravity>"),
    ("xml", "</mujoco>", '<option><flag contact="disable"/></option></mujoco>', "<flag contact"),
    ("xml", "</mujoco>", f"<equality>{ROD}</equality></mujoco>", "<equality> connect of FL_toe (line"),
    ("xml", "</mujoco>", f"<equality>{ROD}</equality></mujoco>", "SolverKamino, closed loops"),
    ("xml", HIP, f'<joint name="FL_out" axis="1 0 0"/>{HIP}', "SolverMuJoCo, D6 joints"),
    ("xml", "</mujoco>", equality("FR FL"), "a drive of a joint that follows another on FR_hip"),
    ("xml", "</mujoco>", equality("FR FL", "HR FR"), "<equality> joint of HR_hip"),
    ("xml", "</mujoco>", equality("FR FL", more='solref="0.1 1"'), "<equality> joint of FR_hip"),
    ("xml", FREE, '<joint type="free" stiffness="0.1"/>', "<joint stiffness>"),
    ("xml", HIP, f'{HIP} stiffness="1 2"', "<joint stiffness> of FL_hip"),
    ("xml", FIRST_DRIVE, FIRST_DRIVE.replace("kp", 'armature="0.1" kp'), "<actuator armature> of FL_hip"),
    ("xml", "</mujoco>", '<option actuatorgroupdisable="0"/></mujoco>', "disableactuator"),
    ("xml", "</mujoco>", '<option><flag override="enable"/></option></mujoco>', "<flag override"),
    ("xml", 'pos="0.2 0.12 0"', 'pos="0.2 nan 0"', "position"),
    ("xml", "</mujoco>", f"{SHORT_HOME}</mujoco>", "home must be 15 numbers, got 3"),
    ("xml", START, f'<compiler inertiafromgeom="true"/>{START}{PAYLOAD}', "<inertial> of imu (line"),
    ("urdf", '<box size="0.5 0.16 0.1"/>', '<mesh filename="package://other/trunk.stl"/>', "package other"),
    ("urdf", '<box size="0.5 0.16 0.1"/>', '<mesh filename="https://example.org/trunk.stl"/>', "https"),
    ("urdf", LIMIT, "", "FL_hip has no <limit>"),
    ("urdf", LIMIT, f'{LIMIT}<mimic joint="tail"/>', "tail"),
    ("urdf", FIRST_MASS, '<mass value="0,8"/>', '<mass value="0,8" />'),
    ("urdf", FIRST_MASS, '<mass value="${m}"/>', "xacro"),
    ("urdf", 'effort="30"', 'effort="-30"', "effort"),
    ("urdf", '<child link="FL_thigh"/>', '<child link="leg"/>', "leg"),
]


@pytest.mark.parametrize(("suffix", "old", "new", "part"), MISTAKES)
def test_a_mistake_in_settings_or_model_is_named(tmp_path, suffix, old, new, part):
    file = write_dog(tmp_path, **KINDS["urdf" if suffix == "urdf" else "mjcf"])
    replace_once(file.with_suffix(f".{suffix}"), old, new)
    with pytest.raises(ValueError, match=re.escape(part)):
        get_robot(str(file))


def test_every_mistake_of_settings_and_model_is_named_at_once(tmp_path):
    file = write_dog(tmp_path)
    wrong = {"* 4": "* 3", '"shank"': '"shin"', 'base_geoms=("trunk",)': "base_geoms=()"}
    for old, new in wrong.items():
        replace_once(file, old, new)
    replace_once(file.with_suffix(".xml"), HIP, f'{HIP} armature="-1"')
    with pytest.raises(ValueError, match=r"dog\.py") as raised:
        get_robot(str(file))
    for part in ("default_joint_pos", "FL_shin", "base_geoms", "armature"):
        assert part in str(raised.value)


NO_LIMIT = GAINS.replace("effort_limit=(30.0,) * 8,", "")
LIMITLESS = {
    "urdf": {"model": dogs.urdf().replace(' effort="30"', ""), "suffix": "urdf", "more": NO_LIMIT},
    "motor": {"model": mjcf(drive=""), "more": f"{NO_LIMIT} saturation_effort=(9.0,) * 8, velocity_limit=(9.0,) * 8,"},
}


@pytest.mark.parametrize("kind", LIMITLESS.values(), ids=LIMITLESS)
def test_a_limit_of_effort_is_needed(tmp_path, kind):
    with pytest.raises(ValueError, match=r"no torque limit .* FL_hip"):
        get_robot(str(write_dog(tmp_path, **kind)))


def test_geoms_without_a_name_are_called_by_their_body_and_shown_so(tmp_path):
    file = write_dog(tmp_path, model=re.sub(r'name="\w+_thigh" (?=type)', "", mjcf()))
    replace_once(file, '("thigh", "shank")', '("thigh_geom_0", "shank")')
    dog = get_robot(str(file))
    assert "HR_thigh_geom_0" in build_robot(dog).shape_label and Skeleton(dog).model.geom("HR_thigh_geom_0")


def test_the_digest_tells_models_apart(tmp_path):
    file = with_mesh(tmp_path, "mjcf")
    drives, model, mesh = file.with_name("drives.xml"), file.with_name("dog.xml"), tmp_path / "dog/meshes/trunk.stl"
    body, _, actuators = model.read_text().partition("<actuator>")
    drives.write_text("<mujoco><actuator>" + actuators)
    file.with_name("parts.xml").write_text('<mujoco><include file="drives.xml"/></mujoco>')
    model.write_text(body + '<include file="parts.xml"/></mujoco>')
    first = robot_digest(get_robot(str(file)))
    shutil.copytree(tmp_path / "dog", tmp_path / "elsewhere" / "dog")
    digests = {first}
    for changed, new in (
        (model, model.read_bytes().replace(b'mass="0.8"', b'mass="0.9"')),
        (drives, drives.read_bytes().replace(b'kp="60"', b'kp="61"')),
        (mesh, stl(1.01 * np.array(TRUNK))),
    ):
        before = changed.read_bytes()
        changed.write_bytes(new)
        digests.add(robot_digest(get_robot(str(file))))
        changed.write_bytes(before)
    assert len(digests) == 4
    file.write_text(f"# a remark\n{file.read_text()}")
    for same in (file, tmp_path / "elsewhere" / "dog" / "model" / "dog.py"):
        assert robot_digest(get_robot(str(same))) == first
    drives.unlink()
    with pytest.raises(ValueError, match=r"drives\.xml"):
        get_robot(str(file))


ASSET = '<asset><mesh name="trunk" file="trunk.stl"/></asset>'
OTHERS = '<asset><model name="toy" file="parts/toy.xml"/><texture name="t" type="2d" file="t.png"/></asset>'
PLACES = {  # lines of the file, lines of parts/more.xml, where the mesh is
    "meshdir of the file": ('<compiler meshdir="m"/>', ASSET, "m/trunk.stl"),
    "meshdir of the part": (ASSET, '<compiler meshdir="m" strippath="true"/>', "m/trunk.stl"),
    "beside the part": ("", ASSET, "parts/trunk.stl"),
    "a part of the part": ("", f'{ASSET}<include file="parts/toy.xml"/>', "trunk.stl"),
    "a model and a texture": (OTHERS, ASSET, "trunk.stl"),
}


@pytest.mark.parametrize(("text", "more", "mesh"), PLACES.values(), ids=PLACES)
def test_included_files_and_meshes_are_found_where_mujoco_looks(tmp_path, text, more, mesh):
    texts = {"parts/more.xml": f"<mujoco>{more}</mujoco>", "parts/toy.xml": '<mujoco model="toy"><worldbody/></mujoco>'}
    for name, content in ({name: text.encode() for name, text in texts.items()} | {mesh: stl(TRUNK)}).items():
        (tmp_path / "dog" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "dog" / name).write_bytes(content)
    imsave(tmp_path / "dog" / "t.png", np.zeros((2, 2, 3)))
    model = mjcf(trunk='type="mesh" mesh="trunk"').replace(MESH, f'{text}<include file="parts/more.xml"/>')
    packed = pack_robot(get_robot(str(write_dog(tmp_path / "dog", model=model))))
    assert robot_spec(packed.unpacked(tmp_path / "there")).compile().nmesh == 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_travels_with_its_files(tmp_path, anymal, kind):
    assert pack_robot(anymal) == "anymal"
    robot = get_robot(str(with_mesh(tmp_path / "here", kind)))
    assert len(read_model_files(robot.model_file).files) == 2
    packed, digest = pickle.loads(pickle.dumps(pack_robot(robot))), robot_digest(robot)
    assert isinstance(packed, PackedRobot)
    shutil.rmtree(tmp_path / "here")
    unpacked = packed.unpacked(tmp_path / "there")
    assert unpacked == dataclasses.replace(robot, model_file=unpacked.model_file)
    assert tmp_path / "there" in unpacked.model_file.parents
    builder = build_robot(unpacked)
    assert sum(builder.body_mass) == pytest.approx(dogs.MASS) and robot_digest(unpacked) == digest
    trunk = builder.shape_label.index("trunk")
    assert builder.shape_type[trunk] == newton.GeoType.MESH
    half = np.abs(builder.shape_source[trunk].vertices).max(axis=0)  # about its principal axes
    np.testing.assert_allclose(np.sort(half), np.sort(TRUNK), atol=1e-6)


def test_what_looks_at_a_fixed_body_is_left_out(tmp_path):
    file = write_dog(tmp_path)
    mark = '<body name="mark" pos="0.3 0 0"><geom size="0.01" mass="0.1"/></body><body><geom size="0.01"/></body>'
    replace_once(file.with_suffix(".xml"), FREE, f'{FREE}{mark}<camera mode="targetbody" target="mark"/>')
    model = robot_spec(get_robot(str(file))).compile()
    assert model.body_jntnum[1:].tolist() == [1] * (model.nbody - 1) and model.nbody == 1 + 1 + 8
    assert {model.geom(k).name for k in range(model.ngeom)} >= {"mark_geom_0", "body_3_geom_0"}


@pytest.mark.parametrize(("physics_dt", "decimation", "steps"), [(0.005, 4, 20), (0.0025, 5, 13), (0.0005, 10, 10)])
def test_finer_physics_keeps_the_control_rate(anymal, physics_dt, decimation, steps):
    robot = dataclasses.replace(anymal, physics_dt=physics_dt, decimation=decimation, drive_delay_steps=2)
    finer = resolved(robot)[0]
    assert finer.decimation == steps and finer.physics_dt <= min(0.001, physics_dt)
    assert finer.control_dt == pytest.approx(robot.control_dt, rel=1e-9)
    assert finer.drive_delay_steps == round(2 * physics_dt / finer.physics_dt)


PACKAGED = """<robot name="dog"><link name="trunk"><collision><geometry><mesh filename="package://dog_description/trunk.stl"/>
</geometry></collision></link></robot>"""


@pytest.mark.parametrize(
    ("name", "folder", "file"),
    [
        ("{LEGGED_GYM_ROOT_DIR}/a/policy.pt", "lab/b/c", "lab/a/policy.pt"),
        ("models/policy.pt", "lab/configs", "lab/models/policy.pt"),
        ("package://dog/meshes/trunk.stl", "lab/cat/urdf", "lab/dog/meshes/trunk.stl"),
        ("package://dog/meshes/trunk.stl", "a_dog/urdf", "a_dog/meshes/trunk.stl"),
        ("policy.pt", "lab/b", None),  # of a folder above it may be any other
        ("{ROOT}/a/policy.pt", "lab/b", None),
    ],
)
def test_what_stands_for_a_folder_is_looked_for_in_folders_above(tmp_path, name, folder, file):
    for path in (f"{folder}/readme.md", "lab/policy.pt", *filter(None, [file])):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    assert find_above(name, tmp_path / folder) == (file and tmp_path / file)


def test_a_mesh_of_a_package_is_among_the_files_of_a_model(tmp_path):
    model, mesh = tmp_path / "urdf" / "dog.urdf", tmp_path / "dog_description" / "trunk.stl"
    for file in (model, mesh):
        file.parent.mkdir()
        file.write_text(PACKAGED)
    assert read_model_files(model).files == (model, mesh)


def test_a_robot_of_the_menagerie_is_known_by_its_name(tmp_path, monkeypatch):
    pytest.importorskip("mujoco_menagerie")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))  # a checkout, from which nothing is downloaded
    model, settings = tmp_path / "unitree_go2" / "go2.xml", tmp_path / "robot.toml"
    model.parent.mkdir()
    model.write_text(mjcf())
    settings.write_text('name = "dog"\nmodel_file = "menagerie:unitree_go2"')
    assert get_robot(str(settings)).model_file == model
    for name, named in (("unitree_go3", "unitree_go2"), ("unitree_go2/go3", "go2_mjx"), ("unitree_a1", "unitree_a1")):
        settings.write_text(f'model_file = "menagerie:{name}"')
        with pytest.raises(ValueError, match=named):
            get_robot(str(settings))
