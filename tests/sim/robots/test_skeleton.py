import dataclasses

import mujoco
import newton
import numpy as np
import pytest
import warp as wp

from sim.robots.find import get_robot
from sim.robots.model import build_robot, geom_names
from sim.robots.skeleton import Skeleton
from tests.sim.dogs import KINDS, mjcf, with_mesh, write_dog


@pytest.fixture(scope="module")
def model(robot):
    return mujoco.MjModel.from_xml_path(str(robot.model_file))


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


def test_shapes_stand_where_mujoco_has_them(robot, model, skeleton):
    qpos = random_coordinates(robot, 4)
    positions, quaternions = skeleton.body_poses(qpos)
    data = mujoco.MjData(model)
    for frame, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        assert len(skeleton.geoms) == model.ngeom
        for k, geom in enumerate(skeleton.geoms):
            matrix, own = np.empty(9), np.empty(9)
            mujoco.mju_quat2Mat(matrix, quaternions[frame, geom.body])
            mujoco.mju_quat2Mat(own, geom.quaternion)
            matrix, own = matrix.reshape(3, 3), own.reshape(3, 3)
            centre = positions[frame, geom.body] + matrix @ geom.position
            np.testing.assert_allclose(centre, data.geom_xpos[k], atol=1e-12)
            np.testing.assert_allclose(matrix @ own, data.geom_xmat[k].reshape(3, 3), atol=1e-12)


def test_the_first_body_is_the_base_and_the_others_hang_on_it(robot, skeleton):
    qpos = random_coordinates(robot, 2)
    positions, quaternions = skeleton.body_poses(qpos)
    np.testing.assert_allclose(positions[:, 0], qpos[:, :3], atol=1e-12)
    np.testing.assert_allclose(quaternions[:, 0], qpos[:, 3:7], atol=1e-12)
    assert skeleton.parents[0] == -1
    for child, parent in enumerate(skeleton.parents[1:], start=1):  # a joint does not tear a body off
        distance = np.linalg.norm(positions[:, child] - positions[:, parent], axis=1)
        np.testing.assert_allclose(distance, np.linalg.norm(skeleton.offsets[child]), atol=1e-9)


def test_feet_are_found_by_name(robot, skeleton):
    assert [skeleton.geom(name).name for name in robot.foot_geoms] == list(robot.foot_geoms)
    with pytest.raises(ValueError, match="no geom named wing"):
        skeleton.geom("wing")


def dog_of(kind, folder):
    if kind == "urdf with a mesh":
        return get_robot(str(with_mesh(folder, "urdf")))
    if kind != "unnamed":
        return get_robot(str(write_dog(folder, **KINDS[kind])))
    file = write_dog(folder, model=mjcf(unnamed=True))
    file.write_text(file.read_text().replace('("thigh", "shank")', '("thigh_geom_0", "shank")'))
    return get_robot(str(file))


@pytest.mark.parametrize("kind", [*KINDS, "unnamed", "urdf with a mesh"])
def test_a_robot_of_ones_own_stands_where_the_simulation_has_it(tmp_path, kind):
    """Limbs and feet, by their names in the simulation's own model, in poses of every joint."""
    dog = dog_of(kind, tmp_path)
    shown, rows = Skeleton(dog), random_coordinates(dog, 3)
    positions, quaternions = shown.body_poses(rows)
    builder = build_robot(dog)
    names = geom_names(builder)
    with wp.ScopedDevice("cpu"):
        model = builder.finalize()
        state = model.state()
        for row, position, quaternion in zip(rows, positions, quaternions, strict=True):
            joints = wp.array(row[[0, 1, 2, 4, 5, 6, 3, *range(7, len(row))]].astype(np.float32))
            newton.eval_fk(model, joints, model.joint_qd, state)
            for name in (*dog.limb_geoms, *dog.foot_geoms):
                shape, geom = names.index(name), shown.geom(name)
                pose = wp.transform(*state.body_q.numpy()[model.shape_body.numpy()[shape]])
                centre = np.array((pose * wp.transform(*model.shape_transform.numpy()[shape])).p)
                matrix = np.empty(9)
                mujoco.mju_quat2Mat(matrix, quaternion[geom.body])
                there = position[geom.body] + matrix.reshape(3, 3) @ geom.position
                np.testing.assert_allclose(there, centre, atol=1e-5)


def test_coordinates_of_another_robot_are_refused(skeleton):
    with pytest.raises(ValueError, match=rf"qpos must have shape \(num_frames, {skeleton.num_coordinates}\), got"):
        skeleton.body_poses(np.zeros((2, 7)))


def test_a_file_that_cannot_be_shown_is_named(robot, tmp_path):

    file = tmp_path / "bad.xml"
    file.write_text("<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
    with pytest.raises(ValueError, match=r"bad\.xml has joints  for MuJoCo, expected a free base and "):
        Skeleton(dataclasses.replace(robot, model_file=file))
    file.write_text("no xml")
    with pytest.raises(ValueError, match=r"bad\.xml cannot be shown"):
        Skeleton(dataclasses.replace(robot, model_file=file))


def test_visual_shapes_are_shown_alone_on_bodies_that_have_some(tmp_path):
    """A URDF's visuals where they can be read, and meshes of an MJCF that touch nothing; names are the simulation's."""
    shown = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
    file = write_dog(tmp_path, **KINDS["urdf"])
    model = next(tmp_path.glob("*.urdf"))
    model.write_text(model.read_text().replace('<link name="FL_thigh">', f'<link name="FL_thigh">{shown}'))
    dog = Skeleton(get_robot(str(file)))
    kinds = {name: {geom.kind for geom in dog.geoms if geom.body == k} for k, name in enumerate(dog.body_names)}
    assert kinds["FL_thigh"] == {"box"} and kinds["FR_thigh"] == {"capsule"}
    assert dog.geom("FL_thigh").kind == "capsule"  # what touches is known all the same
    cover = '<geom type="mesh" mesh="trunk" contype="0" conaffinity="0"/><geom name="trunk"'
    file = with_mesh(tmp_path / "more", "mjcf")
    model = next(file.parent.glob("*.xml"))
    text = model.read_text().replace('<geom name="trunk" type="mesh" mesh="trunk"', f'{cover} size="0.1"', 1)
    model.write_text(text)
    dog = Skeleton(get_robot(str(file)))
    assert [geom.kind for geom in dog.geoms if geom.body == 0] == ["mesh"] and dog.geom("trunk").kind == "sphere"
    assert any(geom.kind != "mesh" for geom in dog.geoms)
