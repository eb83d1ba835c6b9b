"""What is shown of a robot stands where MuJoCo and the simulation have it, under the simulation's names."""

import mujoco
import newton
import numpy as np
import pytest
import warp as wp

from sim.robots.find import get_robot
from sim.robots.model import build_robot, geom_names
from sim.robots.skeleton import Skeleton
from tests.kernels import oracle
from tests.sim.dogs import KINDS, with_mesh, write_dog


@pytest.fixture(scope="module")
def skeleton(robot):
    return Skeleton(robot)


def random_coordinates(robot, count):
    rng = np.random.default_rng(3)
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.concatenate(
        [rng.uniform(-3, 3, (count, 3)), quaternion, rng.uniform(-1, 1, (count, robot.num_joints))], axis=1
    )


def matrix_of(quaternion_wxyz):
    return oracle.rotation_matrix(np.roll(quaternion_wxyz, -1))


def test_bodies_and_shapes_stand_where_mujoco_has_them(robot, skeleton):
    model = mujoco.MjModel.from_xml_path(str(robot.model_file))
    data, qpos = mujoco.MjData(model), random_coordinates(robot, 4)
    positions, quaternions = skeleton.body_poses(qpos)
    np.testing.assert_allclose(positions[:, 0], qpos[:, :3], atol=1e-12)
    np.testing.assert_allclose(quaternions[:, 0], qpos[:, 3:7], atol=1e-12)
    assert len(skeleton.geoms) == model.ngeom and skeleton.parents[0] == -1
    for frame, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        for k, geom in enumerate(skeleton.geoms):
            turn = matrix_of(quaternions[frame, geom.body])
            centre = positions[frame, geom.body] + turn @ geom.position
            np.testing.assert_allclose(centre, data.geom_xpos[k], atol=1e-12)
            np.testing.assert_allclose(turn @ matrix_of(geom.quaternion), data.geom_xmat[k].reshape(3, 3), atol=1e-12)
        for child, parent in enumerate(skeleton.parents[1:], start=1):
            joint = positions[frame, parent] + matrix_of(quaternions[frame, parent]) @ skeleton.offsets[child]
            np.testing.assert_allclose(positions[frame, child], joint, atol=1e-9)


def test_shapes_have_names_and_coordinates_a_shape(robot, skeleton):
    assert [skeleton.geom(name).name for name in robot.foot_geoms] == list(robot.foot_geoms)
    with pytest.raises(ValueError, match="wing"):
        skeleton.geom("wing")
    with pytest.raises(ValueError, match="qpos"):
        skeleton.body_poses(np.zeros((2, 7)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_users_robot_stands_where_the_simulation_has_it(tmp_path, kind):
    """Limbs and feet, by their names in the simulation's own model, in poses of every joint."""
    dog = get_robot(str(with_mesh(tmp_path, kind)))
    skeleton, rows, builder = Skeleton(dog), random_coordinates(dog, 3), build_robot(dog)
    positions, quaternions = skeleton.body_poses(rows)
    names = geom_names(builder)
    with wp.ScopedDevice("cpu"):
        model = builder.finalize()
        state = model.state()
    for row, position, quaternion in zip(rows, positions, quaternions, strict=True):
        state.joint_q.assign(row[[0, 1, 2, 4, 5, 6, 3, *range(7, len(row))]].astype(np.float32))
        newton.eval_fk(model, state.joint_q, model.joint_qd, state)
        for name in (*dog.limb_geoms, *dog.foot_geoms):
            shape, geom = names.index(name), skeleton.geom(name)
            pose = wp.transform(*state.body_q.numpy()[builder.shape_body[shape]])
            expected = np.array((pose * builder.shape_transform[shape]).p)
            shown = position[geom.body] + matrix_of(quaternion[geom.body]) @ geom.position
            np.testing.assert_allclose(shown, expected, atol=1e-5)


def test_bodies_with_visual_shapes_show_those_alone(tmp_path):
    """A URDF's visuals where they can be read, and meshes of an MJCF that touch nothing; names are the simulation's."""
    file = write_dog(tmp_path, **KINDS["urdf"])
    model = file.with_suffix(".urdf")
    visual = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
    model.write_text(model.read_text().replace('<link name="FL_thigh">', f'<link name="FL_thigh">{visual}'))
    dog = Skeleton(get_robot(str(file)))
    kinds = {name: {geom.kind for geom in dog.geoms if geom.body == k} for k, name in enumerate(dog.body_names)}
    assert kinds["FL_thigh"] == {"box"} and kinds["FR_thigh"] == {"capsule"}
    assert dog.geom("FL_thigh").kind == "capsule"  # what touches is known all the same
    file = with_mesh(tmp_path / "more", "mjcf")
    model = file.with_suffix(".xml")
    cover = '<geom type="mesh" mesh="trunk" contype="0" conaffinity="0"/><geom name="trunk" size="0.1"'
    model.write_text(model.read_text().replace('<geom name="trunk" type="mesh" mesh="trunk"', cover, 1))
    dog = Skeleton(get_robot(str(file)))
    assert [geom.kind for geom in dog.geoms if geom.body == 0] == ["mesh"] and dog.geom("trunk").kind == "sphere"
    assert any(geom.kind != "mesh" for geom in dog.geoms)
