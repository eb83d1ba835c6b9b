"""One robot in the many spellings of MJCF and URDF: the simulation moves it as MuJoCo C moves the file."""

import re

import mujoco
import numpy as np
import pytest

from sim.robots.compiled import robot_spec, rotation_matrix
from sim.robots.find import get_robot
from tests.sim.dogs import DRIVE, GAINS, JOINTS, KINDS, mjcf, urdf, write_dog
from tests.sim.plain_mujoco import on_plane, to_c
from tests.sim.scenes import FLAT, put, simulate, standing

OFFSET = 0.3  # of the targets from the default pose [rad]
DT = 0.005
STEPS = 80
HEIGHT = 5.0
PLAIN = mjcf()


def swap(*pairs):
    text = PLAIN
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


def drives(drive):
    return mjcf(drive=drive)


def saved():
    """What MuJoCo itself writes of the file: ``<position>`` is ``<general>``."""
    spec = mujoco.MjSpec.from_string(PLAIN)
    spec.compile()
    return spec.to_xml()


# Drives in another order than the joints, each with gains of its own.
BACKWARDS = [DRIVE.format(name).replace('kp="60"', f'kp="{40 + 5 * k}"') for k, name in enumerate(JOINTS)][::-1]
LEG = re.search(r'<body name="FL_thigh".*</body>\s*(?=<body name="FR_thigh")', PLAIN, re.S)[0]
SPELLINGS = {
    "plain": PLAIN,
    "defaults that are called main": swap(("<default>\n", '<default class="main">\n')),
    "defaults of drives": swap(("</default>", '<position kp="60" kv="2" forcerange="-30 30"/></default>'),
                               (' kp="60" kv="2" forcerange="-30 30"/>', "/>")),
    "settotalmass": swap(('autolimits="true"', 'autolimits="true" settotalmass="24"')),
    "springdamper": swap(('armature="0.01"', 'armature="0.01" springdamper="0.2 1"')),
    "a base with a brake": swap(('<freejoint name="root"/>', '<joint type="free" damping="2" frictionloss="5" '
                                                             'armature="0.3"/>')),
    "springs and friction": swap(('armature="0.01"', 'armature="0.01" stiffness="9" springref="0.2" damping="0.7" '
                                                     'frictionloss="0.4"')),
    "frames": PLAIN.replace(LEG, f'<frame pos="0.01 0 0" euler="0 0.1 0">{LEG}</frame>'),
    "gravity of the moon": swap(("<default>\n", '<option gravity="0 0 -1.62"/><default>\n')),
    "saved by MuJoCo": saved(),
    "dampratio": drives('<position name="{0}" joint="{0}" kp="60" dampratio="0.8" forcerange="-30 30"/>'),
    "forcelimited false": drives('<position name="{0}" joint="{0}" kp="60" kv="2" forcerange="-3 3" '
                                 'forcelimited="false"/>'),
    "weak drives": drives('<position name="{0}" joint="{0}" kp="60" kv="2" forcerange="-3 3"/>'),
    "ranges of targets": drives('<position name="{0}" joint="{0}" kp="60" kv="2" ctrlrange="-1.25 0.65"/>'),
    "drives backwards": drives("{0}").replace("".join(JOINTS), "".join(BACKWARDS)),
    "degrees": swap(('angle="radian"', 'angle="degree"'), ('range="-1.5 2.5"', 'range="-86 143"'),
                    ('range="-2.6 -0.1"', 'range="-149 -5.7"')),
    "a floor": swap(("<worldbody>", '<worldbody><geom name="floor" type="plane" size="1 1 1"/>')),
    "another solver": swap(("<default>\n", '<option cone="pyramidal" integrator="RK4" timestep="0.01" tolerance="1"/>'
                                           "<default>\n")),
    "sensors, keys and flags": swap(("</mujoco>", '<sensor><gyro site="imu"/></sensor><keyframe><key/></keyframe>'
                                                  '<option><flag energy="enable"/></option></mujoco>'),
                                    ('<geom name="trunk"', '<site name="imu"/><geom name="trunk"')),
}  # fmt: skip


def fly_in_mujoco(robot):
    """Position [m] and joint angles [rad] of the robot's file after the same flight in MuJoCo C; its mass [kg]."""
    spec = mujoco.MjSpec.from_file(str(robot.model_file))
    option = spec.option
    option.timestep, option.integrator, option.tolerance = DT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 1e-8
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = to_c(standing(robot, 1, z=HEIGHT)[0])
    for name, angle in zip(JOINTS, robot.default_joint_pos, strict=True):
        data.ctrl[model.actuator(name).id] = angle + OFFSET
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    joints = [int(model.joint(name).qposadr[0]) for name in JOINTS]
    return data.qpos[[0, 1, 2, *joints]], float(model.body_subtreemass[0])


def start_flight(robot, device, offset):
    """A simulation of the robot high up, at rest, whose targets are so far from its default pose [rad]."""
    sim = simulate(robot, FLAT[None], device)
    q = standing(robot, 1, z=HEIGHT)
    put(sim, q)
    q[0, 7:] += offset
    sim.targets.assign(np.float32(q))
    return sim


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'", "ignore:.*floor belongs to the world")
@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_a_file_flies_as_in_mujoco(tmp_path, device, text):
    robot = get_robot(str(write_dog(tmp_path, model=text)))
    assert robot.joint_names == JOINTS
    expected, mass = fly_in_mujoco(robot)
    sim = start_flight(robot, device, OFFSET)
    assert sim.model.body_mass.numpy().sum() == pytest.approx(mass, rel=1e-6)
    for _ in range(STEPS):
        sim.physics_step()
    np.testing.assert_allclose(np.delete(sim.joint_q.numpy()[0], range(3, 7)), expected, atol=1e-3)


FREE_GAINS = GAINS.replace("effort_limit=(30.0,) * 8,", "")
OF_JOINTS = mjcf(drive="").replace('range="-1.5 2.5"', 'range="-1.5 2.5" actuatorfrcrange="-5 5"')
MOTORS = {  # model, torque limit of the settings [N m], what holds
    "forcerange": (drives('<motor name="{0}" joint="{0}" forcerange="-5 5"/>'), None, 5.0),
    "ctrlrange": (drives('<motor name="{0}" joint="{0}" ctrlrange="-5 5"/>'), None, 5.0),
    "gear and ctrlrange": (drives('<motor name="{0}" joint="{0}" gear="2.5" ctrlrange="-2 2"/>'), None, 5.0),
    "gear and forcerange": (drives('<motor name="{0}" joint="{0}" gear="2.5" forcerange="-2 2"/>'), None, 5.0),
    "settings above": (drives('<motor name="{0}" joint="{0}" forcerange="-5 5"/>'), 20.0, 5.0),
    "settings below": (drives('<motor name="{0}" joint="{0}" forcerange="-20 20"/>'), 5.0, 5.0),
    "nothing": (drives(""), None, 66.0),
    "drives that settings replace": (drives('<position name="{0}" joint="{0}" kp="9" forcerange="-5 5"/>'), None, 5.0),
    "of some joints": (OF_JOINTS, None, [5.0, 66.0] * 4),
}


@pytest.mark.parametrize(("model", "effort", "expected"), MOTORS.values(), ids=MOTORS)
def test_the_smallest_torque_limit_holds(tmp_path, device, model, effort, expected):
    more = FREE_GAINS if effort is None else GAINS.replace("30.0", str(effort))
    robot = get_robot(str(write_dog(tmp_path, model=model, more=more)))
    sim = start_flight(robot, device, 1.1)  # 66 N m by a gain of 60
    sim.physics_step()
    np.testing.assert_allclose(sim.joint_torque.numpy()[0, 6:], expected, rtol=1e-5)


CONTACTS = {
    "plain": {},
    "conaffinity alone": {"model": swap(('contype="1" conaffinity="0"', 'contype="0" conaffinity="1"'))},
    "condim 1": {"model": swap(('solref="0.01 1"', 'solref="0.01 1" condim="1"'))},
    "solref of one number": {"model": swap(('solref="0.01 1"', 'solref="0.01"'))},
    "impratio": {"model": swap(("<default>\n", '<option impratio="100"/><default>\n'))},
    "no option but a cone": {"model": swap(("<default>\n", '<option cone="pyramidal"/><default>\n'))},
    "contact of the settings": {"more": "\n    friction=0.4,\n    contact_time_constant_s=0.02,"},
    "gains of the settings": {"model": mjcf(drive=""), "more": GAINS},
    "urdf": KINDS["urdf"],
}


@pytest.mark.parametrize("kind", CONTACTS.values(), ids=CONTACTS)
def test_a_push_moves_it_on_the_ground_as_in_mujoco(tmp_path, device, kind):
    robot = get_robot(str(write_dog(tmp_path, **kind)))
    start = standing(robot, 1)
    speed = np.array([[0.5, 1.0, *[0.0] * 12]])
    model = on_plane(robot)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = to_c(start[0]), speed[0], robot.default_joint_pos
    sim = simulate(robot, FLAT[None], device)
    put(sim, start, speed)
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
        sim.physics_step()
    assert np.hypot(*(data.qpos[:2] - start[0, :2])) > 0.02
    np.testing.assert_allclose(sim.joint_q.numpy()[0, :3], data.qpos[:3], atol=5e-4)
    np.testing.assert_allclose(sim.joint_q.numpy()[0, 7:], data.qpos[7:], atol=5e-3)


@pytest.mark.slow
def test_a_mimicking_joint_follows_without_a_drive(tmp_path, device):
    knee = '<joint name="FL_knee" type="revolute">'
    assert knee in urdf()
    text = urdf().replace(knee, f'{knee}<mimic joint="FL_hip" multiplier="-2.0" offset="0.1"/>')
    robot = get_robot(str(write_dog(tmp_path, **KINDS["urdf"] | {"model": text})))
    sim = simulate(robot, FLAT[None], device)
    q = standing(robot, 1, z=HEIGHT)
    q[0, 8] = -2.0 * q[0, 7] + 0.1
    put(sim, q)
    q[0, 7:9] = 0.8, 2.0  # what the follower is told counts for nothing
    sim.targets.assign(np.float32(q))
    for _ in range(STEPS):
        sim.physics_step()
    hip, knee = sim.joint_q.numpy()[0, 7:9]
    assert hip == pytest.approx(0.8, abs=0.1) and knee == pytest.approx(-2.0 * hip + 0.1, abs=0.03)


def compile_urdf(folder, text, more=GAINS):
    """A URDF as simulations have it, compiled."""
    return robot_spec(get_robot(str(write_dog(folder, model=text, suffix="urdf", more=more)))).compile()


WORLD = '<link name="world"/><joint name="root" type="floating"><parent link="world"/><child link="trunk"/></joint>'
URDFS = {
    "a turned inertia": ('<origin xyz="0 0 -0.07"/>', '<origin xyz="0 0 -0.07" rpy="0.4 0.3 0.2"/>'),
    "lines for MuJoCo": ('"dog">', '"dog"><mujoco><compiler fusestatic="true" meshdir="m"/><size njmax="9"/></mujoco>'),
    "a world": ('"dog">', f'"dog">{WORLD}'),
}


@pytest.mark.parametrize(("old", "new"), URDFS.values(), ids=URDFS)
def test_a_link_of_a_urdf_turns_as_in_mujoco(tmp_path, old, new):
    text = re.sub("<visual>.*?</visual>", "", urdf()).replace(old, new, 1)
    bodies = [m.body("FL_thigh") for m in (compile_urdf(tmp_path, text), mujoco.MjModel.from_xml_string(text))]
    axes = [rotation_matrix(body.iquat) for body in bodies]
    actual, expected = (turn @ np.diag(body.inertia) @ turn.T for turn, body in zip(axes, bodies, strict=True))
    np.testing.assert_allclose(actual, expected, atol=1e-9)


def test_a_base_link_without_mass_is_the_body_it_is_fixed_to(tmp_path):
    # As many URDFs have it: an empty root, here 5 cm under the trunk and turned by a quarter about the vertical.
    mount = (
        '<robot name="dog"><link name="base"/><joint name="mount" type="fixed"><parent link="base"/>'
        '<child link="trunk"/><origin xyz="0 0 0.05" rpy="0 0 1.5707963"/></joint>'
    )
    model = compile_urdf(tmp_path, urdf().replace('<robot name="dog">', mount))
    base = model.body("base")
    trunk = model.geom("trunk")
    assert model.nbody == 1 + 9 and base.mass[0] == pytest.approx(8.0) and trunk.bodyid == base.id == 1
    axes = rotation_matrix(base.iquat)
    np.testing.assert_allclose(axes @ np.diag(base.inertia) @ axes.T, np.diag([0.2, 0.03, 0.2]), atol=1e-6)
    np.testing.assert_allclose([base.ipos, trunk.pos], [[0, 0, 0.05]] * 2, atol=1e-6)
    np.testing.assert_allclose(rotation_matrix(trunk.quat)[:, 0], [0, 1, 0], atol=1e-6)


def test_what_is_fixed_to_a_link_of_a_urdf_adds_its_mass(tmp_path):
    # A camera whose inertia is that of no body by itself, 1 m ahead of the trunk.
    camera = (
        '<link name="camera"><inertial><mass value="0.5"/><inertia ixx="0.00001" iyy="0.00001" izz="0.0001" ixy="0" '
        'ixz="0" iyz="0"/></inertial></link><joint name="mount" type="fixed"><parent link="trunk"/>'
        '<child link="camera"/><origin xyz="1 0 0"/></joint></robot>'
    )
    without, with_camera = (compile_urdf(tmp_path, text) for text in (urdf(), urdf().replace("</robot>", camera)))
    mass = without.body_mass[1]
    assert with_camera.nbody == without.nbody and with_camera.body_mass[1] == pytest.approx(mass + 0.5)
    assert with_camera.body_ipos[1, 0] == pytest.approx(0.5 / (mass + 0.5))
    # Steiner about the vertical: both about their common centre.
    yaw = without.body_inertia[1].max() + 0.0001 + mass * 0.5 / (mass + 0.5)
    assert with_camera.body_inertia[1].max() == pytest.approx(yaw, rel=1e-6)


def test_a_motors_inertia_in_a_link_of_a_urdf_is_the_joints_armature(tmp_path):
    plain = compile_urdf(tmp_path, urdf())
    shank = re.search(r'<link name="FL_shank">.*?<inertia [^>]*/>', urdf(), re.S)[0]
    iyy = re.search(r'iyy="([^"]*)"', shank)[1]
    more = urdf().replace(shank, shank.replace(f'iyy="{iyy}"', f'iyy="{float(iyy) + 0.02}"'))
    model = compile_urdf(tmp_path, more, GAINS.replace("armature=(0.01,) * 8,", ""))
    dof = int(model.joint("FL_knee").dofadr[0])
    body = model.body("FL_shank").id
    turned = [m.body_inertia[body].sum() + m.dof_armature[dof] for m in (plain, model)]
    assert 0.019 < model.dof_armature[dof] < 0.02 + 1e-4
    assert turned[1] == pytest.approx(turned[0] - plain.dof_armature[dof] + 0.02, rel=1e-6)
