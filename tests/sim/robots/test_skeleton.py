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
    assert skeleton.parents[0] == -1
    for frame, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(positions[frame], data.xpos[1:], atol=1e-12)
        for geom in map(skeleton.geom, robot.geom_names):
            turn = matrix_of(quaternions[frame, geom.body])
            centre = positions[frame, geom.body] + turn @ geom.position
            np.testing.assert_allclose(centre, data.geom(geom.name).xpos, atol=1e-12)
            expected = data.geom(geom.name).xmat.reshape(3, 3)
            np.testing.assert_allclose(turn @ matrix_of(geom.quaternion), expected, atol=1e-12)
        for child, parent in enumerate(skeleton.parents[1:], start=1):
            joint = positions[frame, parent] + matrix_of(quaternions[frame, parent]) @ skeleton.offsets[child]
            np.testing.assert_allclose(positions[frame, child], joint, atol=1e-9)
    with pytest.raises(ValueError, match="wing"):
        skeleton.geom("wing")
    with pytest.raises(ValueError, match="qpos"):
        skeleton.body_poses(np.zeros((2, 7)))


def test_a_shipped_robot_shows_the_look_of_every_body_and_all_its_touches(robot, skeleton):
    """No shape that collides is seen; each role shows its touch, feet by what is where they are."""
    assert {geom.body for geom in skeleton.geoms} == set(range(len(skeleton.body_names)))
    assert not {geom.name for geom in skeleton.geoms} & set(robot.geom_names)
    for column, name in enumerate(robot.geom_names):
        shapes, geom = [shape for shape in skeleton.geoms if column in shape.touches], skeleton.geom(name)
        assert shapes and {shape.body for shape in shapes} == {geom.body}
        away = min(np.linalg.norm(shape.position - geom.position) for shape in shapes)
        assert away < (0.01 if name in robot.foot_geoms else 0.12)
    if robot.name == "anymal":  # a shank's touch is not its foot's
        assert all(len(shape.touches) <= 1 for shape in skeleton.geoms)


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


LOOK = (
    '<mujoco><worldbody><body name="{}"><geom type="box" size=".1 .2 .3" rgba="1 0 0 1"/></body></worldbody></mujoco>'
)


def test_what_is_seen_of_a_users_robot(tmp_path):
    """A look beside its file, else a URDF's visuals and what touches nothing in an MJCF, else all it has and bones."""
    file = write_dog(tmp_path, **KINDS["urdf"])
    model = file.with_suffix(".urdf")
    visual = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
    model.write_text(model.read_text().replace('<link name="FL_thigh">', f'<link name="FL_thigh">{visual}'))
    robot = get_robot(str(file))
    dog = Skeleton(robot)
    kinds = {name: [geom.kind for geom in dog.geoms if geom.body == k] for k, name in enumerate(dog.body_names)}
    assert kinds["FL_thigh"] == ["box"] and kinds["FR_thigh"] == ["capsule", "capsule"]  # the second is its bone
    assert dog.geom("FL_thigh").kind == "capsule"  # what touches is known all the same
    thigh, other = (robot.geom_names.index(f"{leg}_thigh") for leg in ("FL", "HR"))
    assert [shape.touches for shape in dog.geoms if shape.kind == "box"] == [(0,), (thigh,)]
    file.with_suffix(".look.xml").write_text(LOOK.format("HR_thigh"))
    (red,) = (shape for shape in Skeleton(robot).geoms if shape.color == (1.0, 0.0, 0.0))
    assert red.touches == (other,) and red.size.tolist() == pytest.approx([0.1, 0.2, 0.3])
    file = with_mesh(tmp_path / "more", "mjcf")
    model = file.with_suffix(".xml")
    cover = '<geom type="mesh" mesh="trunk" contype="0" conaffinity="0"/><geom name="trunk" size="0.1"'
    model.write_text(model.read_text().replace('<geom name="trunk" type="mesh" mesh="trunk"', cover, 1))
    dog = Skeleton(get_robot(str(file)))
    assert [geom.kind for geom in dog.geoms if geom.body == 0] == ["mesh"] and dog.geom("trunk").kind == "sphere"
    assert any(geom.kind != "mesh" for geom in dog.geoms)


def test_a_look_of_no_body_of_the_robot_is_named(tmp_path):
    file = write_dog(tmp_path, **KINDS["mjcf"])
    for text, words in ((LOOK.format("tail"), "tail"), ("<mujoco><worldbody>", "XML")):
        file.with_suffix(".look.xml").write_text(text)
        with pytest.raises(ValueError, match=rf"dog\.look\.xml.*{words}"):
            Skeleton(get_robot(str(file)))
