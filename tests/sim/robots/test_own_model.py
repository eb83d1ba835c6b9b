"""Models of robots that the project does not ship: MJCF and URDF, merged bodies, meshes, contact; on their own feet."""

import mujoco
import newton
import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome
from sim.bank import TerrainBank
from sim.mujoco_c.model import crossing_model
from sim.robots.find import get_robot
from sim.robots.model import build_robot, geom_names, joint_names
from sim.robots.model_files import read_model_files
from sim.robots.probes import make_probes
from sim.rollout import Rollout
from sim.simulation import Simulation
from tests.sim.dogs import GAINS, JOINTS, KINDS, LEGS, MASS, TRUNK, urdf, with_mesh, write_dog
from tests.sim.scenes import put

FLAT = np.zeros((1, 161, 321), np.float32)


@pytest.fixture(params=KINDS)
def dog(request, tmp_path):
    return get_robot(str(write_dog(tmp_path, **KINDS[request.param])))


@pytest.fixture(params=KINDS)
def mesh_dog(request, tmp_path):
    return get_robot(str(with_mesh(tmp_path, request.param)))


def test_the_model_is_what_the_file_says(dog):
    builder = build_robot(dog)
    assert sum(builder.body_mass) == pytest.approx(MASS)
    assert builder.body_count == 9  # a trunk and four legs of two parts: feet are of their shanks
    assert joint_names(builder) == list(JOINTS)
    assert set(geom_names(builder)) == {
        "trunk",
        *(f"{leg}_{part}" for leg in LEGS for part in ("thigh", "shank", "foot")),
    }
    for name, value in (("target_ke", 60), ("target_kd", 2), ("armature", 0.01)):
        np.testing.assert_allclose(getattr(builder, f"joint_{name}")[6:], value)
    np.testing.assert_allclose(builder.joint_limit_lower[6:], [-1.5, -2.6] * 4, atol=1e-6)
    np.testing.assert_allclose(builder.joint_limit_upper[6:], [2.5, -0.1] * 4, atol=1e-6)


def test_shapes_are_where_they_belong(dog):
    builder = build_robot(dog)
    names = geom_names(builder)
    thigh, foot = names.index("FL_thigh"), names.index("HR_foot")
    # A capsule tag of a URDF has its length without the caps, whatever it was read as before: half of 0.15 m.
    assert builder.shape_type[thigh] == newton.GeoType.CAPSULE
    np.testing.assert_allclose(builder.shape_scale[thigh][:2], [0.03, 0.075], atol=1e-6)
    np.testing.assert_allclose(builder.shape_transform[thigh][:3], [0, 0, -0.075], atol=1e-6)
    assert builder.body_label[builder.shape_body[foot]].endswith("HR_shank")
    np.testing.assert_allclose(builder.shape_transform[foot][:3], [0, 0, -0.15], atol=1e-6)
    probes = make_probes(builder)
    strips = np.flatnonzero(probes.strip_shape.numpy() == thigh)
    starts = probes.strip_start.numpy()
    ends = probes.position.numpy()[[starts[strips[0]], starts[strips[0] + 1] - 1]]
    np.testing.assert_allclose(np.sort(ends[:, 2]), [-0.15, 0], atol=1e-6)


def test_inertias_are_those_that_mujoco_reads(dog):
    model = mujoco.MjModel.from_xml_path(str(dog.model_file))
    if dog.model_file.suffix == ".urdf":  # MuJoCo merges what is fixed to the world there, its free base
        model = mujoco.MjModel.from_xml_string(
            dog.model_file.read_text().replace(
                '<robot name="dog">', '<robot name="dog"><mujoco><compiler fusestatic="false"/></mujoco>'
            )
        )
    data = mujoco.MjData(model)
    if model.nq == 15:
        data.qpos[7:] = 0
    mujoco.mj_forward(model, data)
    builder = build_robot(dog)
    for k, label in enumerate(builder.body_label):
        name = label.rsplit("/", 1)[-1]
        bodies = [b for b in range(model.nbody) if model.body(b).name == name]
        bodies += [
            b
            for b in range(model.nbody)
            if bodies and model.body_parentid[b] == bodies[0] and model.body_jntnum[b] == 0
        ]
        mass = model.body_mass[bodies].sum()
        centre = (model.body_mass[bodies, None] * data.xipos[bodies]).sum(0) / mass
        inertia = np.zeros((3, 3))
        for body in bodies:
            axes, off = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
            inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
            inertia += model.body_mass[body] * (off @ off * np.eye(3) - np.outer(off, off))
        assert builder.body_mass[k] == pytest.approx(mass)
        np.testing.assert_allclose(np.array(builder.body_inertia[k]).reshape(3, 3), inertia, atol=1e-7)
        np.testing.assert_allclose(np.array(builder.body_com[k]), centre - data.xpos[bodies[0]], atol=1e-6)


def test_a_urdf_is_given_contact_and_effort(tmp_path, device):
    # A URDF says nothing of contact: friction 1, and the time constant of the shipped robots.
    dog = get_robot(str(write_dog(tmp_path, **KINDS["urdf"])))
    sim = Simulation(dog, TerrainBank(1, device=device), np.zeros(1, int))
    on_robot = sim.model.shape_body.numpy() >= 0
    np.testing.assert_allclose(sim.model.shape_material_mu.numpy()[on_robot], 1.0)
    solref = np.array(sim.solver.mjw_model.geom_solref.numpy()).reshape(-1, 2)
    assert (np.abs(solref - [0.01, 1.0]).max(axis=1) < 1e-6).sum() >= 13
    q = np.zeros((1, 15))
    q[:, 2], q[:, 6], q[:, 7:] = 3.0, 1.0, dog.default_joint_pos
    put(sim, q)
    targets = q.copy()
    targets[0, 7:9] += [0.01, 1.1]  # 60 N m/rad: .6 N m, and 66 N m, of which 30 are to be had
    sim.targets.assign(np.float32(targets))
    with wp.ScopedDevice(device):
        sim.physics_step()
    np.testing.assert_allclose(sim.joint_torque.numpy()[0, 6:8], [0.6, 30.0], rtol=0.1)


def test_friction_and_time_constant_of_the_settings_count(tmp_path, device):
    dog = get_robot(str(write_dog(tmp_path, more="\n    friction=0.6,\n    contact_time_constant_s=0.02,")))
    sim = Simulation(dog, TerrainBank(1, device=device), np.zeros(1, int))
    on_robot = sim.model.shape_body.numpy() >= 0
    np.testing.assert_allclose(sim.model.shape_material_mu.numpy()[on_robot], 0.6)
    solref = np.array(sim.solver.mjw_model.geom_solref.numpy()).reshape(-1, 2)
    assert (np.abs(solref - [0.02, 1.0]).max(axis=1) < 1e-6).sum() >= 13


def test_the_trot_takes_a_urdf_to_the_goal(tmp_path, device):
    dog = get_robot(str(write_dog(tmp_path, **KINDS["urdf"])))
    rollout = Rollout(dog, f"{tmp_path}/dog_trot.py:Trot", num_terrains=1, num_replicas=4, device=device)
    result = rollout.evaluate(FLAT, np.zeros(1, np.uint32))
    assert (result.outcome == Outcome.GOAL).all()
    assert not result.fallen.any()


def test_a_mesh_of_a_file_is_read(mesh_dog):
    builder = build_robot(mesh_dog)
    trunk = geom_names(builder).index("trunk")
    assert builder.shape_type[trunk] == newton.GeoType.MESH
    probes = make_probes(builder)
    starts, shapes, radii = (getattr(probes, f"strip_{name}").numpy() for name in ("start", "shape", "radius"))
    mine = np.flatnonzero(shapes == trunk)
    reach = [np.abs(probes.position.numpy()[starts[k] : starts[k + 1]]).max(0) + radii[k] for k in mine]
    np.testing.assert_allclose(np.max(reach, axis=0), TRUNK, atol=0.01)
    assert len(read_model_files(mesh_dog.model_file).files) == 2


def test_a_base_link_without_mass_is_the_body_it_is_fixed_to(tmp_path):
    # As many URDFs have it: an empty root, here 5 cm under the trunk.
    fixed = (
        '<link name="base"/><joint name="mount" type="fixed"><parent link="base"/><child link="trunk"/>'
        '<origin xyz="0 0 0.05"/></joint>'
    )
    text = urdf().replace('<robot name="dog">', f'<robot name="dog">{fixed}')
    file = write_dog(tmp_path, model=text, suffix="urdf", more=GAINS)
    file.write_text(file.read_text().replace("0.29", "0.24"))
    builder = build_robot(get_robot(str(file)))
    assert builder.body_count == 9 and builder.body_label[0].endswith("base")
    assert builder.body_mass[0] == pytest.approx(8.0)
    np.testing.assert_allclose(builder.body_com[0], [0, 0, 0.05], atol=1e-6)
    np.testing.assert_allclose(np.reshape(builder.body_inertia[0], (3, 3)).diagonal(), [0.03, 0.2, 0.2], rtol=1e-5)
    np.testing.assert_allclose(builder.shape_transform[geom_names(builder).index("trunk")][:3], [0, 0, 0.05], atol=1e-6)


def test_plain_mujoco_takes_a_robot_that_is_its_file(tmp_path):
    robot = get_robot(str(with_mesh(tmp_path / "mesh", "mjcf")))
    model = crossing_model(robot, FLAT[0])
    assert (model.nu, model.nq) == (8, 15)
    assert model.geom("trunk").type[0] == mujoco.mjtGeom.mjGEOM_MESH
    assert model.geom("trunk").conaffinity[0] == 0 and model.geom("ground").conaffinity[0] == 1
    for kind in ({"more": "\n    friction=0.6,"}, KINDS["urdf"]):
        with pytest.raises(ValueError, match=r"plain MuJoCo reads .* alone.*got (a URDF|friction in the settings)"):
            crossing_model(get_robot(str(write_dog(tmp_path / "other", **kind))), FLAT[0])
