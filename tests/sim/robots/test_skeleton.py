"""What is shown of a robot stands where MuJoCo and the simulation have it, under the simulation's names."""

import mujoco
import newton
import numpy as np
import pytest
import warp as wp

from sim.robots.find import get_robot
from sim.robots.model import build_robot
from sim.robots.skeleton import Skeleton
from tests.kernels import oracle
from tests.kernels.states import random_states
from tests.sim.dogs import KINDS, with_mesh, write_dog


def to_matrix(quaternion_wxyz):
    return oracle.rotation_matrix(np.roll(quaternion_wxyz, -1))


def test_a_shipped_robot_shows_the_look_of_every_body_and_all_its_touches(robot):
    """No shape that collides is seen; each role shows its touch, feet by what is where they are."""
    skeleton = Skeleton(robot)
    model = skeleton.model
    touches = skeleton.touches
    assert {model.geom_bodyid[geom] - 1 for geom in touches} == set(range(skeleton.num_bodies))
    for column, name in enumerate(robot.geom_names):
        touching = model.geom(name)
        shapes = [geom for geom, columns in touches.items() if column in columns]
        assert touching.id not in touches and {model.geom_bodyid[geom] for geom in shapes} == set(touching.bodyid)
        distance = min(np.linalg.norm(model.geom_pos[geom] - touching.pos) for geom in shapes)
        assert distance < (0.01 if name in robot.foot_geoms else 0.12)
    if robot.name == "anymal":  # a shank's touch is not its foot's
        assert all(len(columns) <= 1 for columns in touches.values())


@pytest.mark.parametrize("kind", [*KINDS, "anymal", "cassie"])
def test_shapes_stand_where_the_simulation_has_them(tmp_path, kind):
    """By their names in the simulation's own model, in poses of every joint."""
    robot = get_robot(str(with_mesh(tmp_path, kind)) if kind in KINDS else kind)
    skeleton = Skeleton(robot)
    rows = np.float64(random_states(3, robot.num_joints)[0])
    builder = build_robot(robot)
    positions, quaternions = skeleton.body_poses(rows)
    names = builder.shape_label
    with wp.ScopedDevice("cpu"):
        model = builder.finalize()
        state = model.state()
    for row, position, quaternion in zip(rows, positions, quaternions, strict=True):
        state.joint_q.assign(row[[0, 1, 2, 4, 5, 6, 3, *range(7, len(row))]].astype(np.float32))
        newton.eval_fk(model, state.joint_q, model.joint_qd, state)
        for name in (*robot.limb_geoms, *robot.foot_geoms):
            shape, geom = names.index(name), skeleton.model.geom(name)
            pose = wp.transform(*state.body_q.numpy()[builder.shape_body[shape]]) * builder.shape_transform[shape]
            body = geom.bodyid[0] - 1
            turn = to_matrix(quaternion[body])
            np.testing.assert_allclose(position[body] + turn @ geom.pos, np.array(pose.p), atol=1e-5)
            expected = oracle.rotation_matrix(np.array(pose.q))
            np.testing.assert_allclose(turn @ to_matrix(geom.quat), expected, atol=1e-5)


BOX = '<geom type="box" size=".1 .2 .3" rgba="1 0 0 1"/>'
LOOK = f'<mujoco><worldbody><body name="{{}}">{BOX}</body></worldbody></mujoco>'


def seen_shapes(dog, body):
    """Types of what is seen of a body, and what touches they show."""
    shapes = [geom for geom in dog.touches if dog.model.body(dog.model.geom_bodyid[geom]).name == body]
    return [(mujoco.mjtGeom(dog.model.geom_type[geom]).name[7:], dog.touches[geom]) for geom in shapes]


def test_what_is_seen_of_a_users_robot(tmp_path):
    """A look beside its file, else a URDF's visuals and what touches nothing in an MJCF, else all it has."""
    file = write_dog(tmp_path, **KINDS["urdf"])
    model = file.with_suffix(".urdf")
    visual = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
    model.write_text(model.read_text().replace('<link name="FL_thigh">', f'<link name="FL_thigh">{visual}'))
    robot = get_robot(str(file))
    thigh, other, third = ((robot.geom_names.index(f"{leg}_thigh"),) for leg in ("FL", "FR", "HR"))
    dog = Skeleton(robot)
    assert seen_shapes(dog, "FL_thigh") == [("BOX", thigh)] and dog.model.geom("FL_thigh").type == [3]  # a capsule
    assert seen_shapes(dog, "FR_thigh") == [("CAPSULE", other)]
    file.with_suffix(".look.xml").write_text(LOOK.format("HR_thigh"))
    dog = Skeleton(robot)
    assert seen_shapes(dog, "HR_thigh") == [("BOX", third)]
    shape, color = dog.shape(next(geom for geom, columns in dog.touches.items() if columns == third))
    assert color.tolist() == [1.0, 0.0, 0.0] and shape.extents.tolist() == pytest.approx([0.2, 0.4, 0.6])
    file = with_mesh(tmp_path / "more", "mjcf")
    model = file.with_suffix(".xml")
    cover = '<geom type="mesh" mesh="trunk" contype="0" conaffinity="0"/><geom name="trunk" size="0.1"'
    model.write_text(model.read_text().replace('<geom name="trunk" type="mesh" mesh="trunk"', cover, 1))
    assert seen_shapes(Skeleton(get_robot(str(file))), "trunk") == [("MESH", (0,))]


def test_a_look_of_no_body_of_the_robot_is_named(tmp_path):
    file = write_dog(tmp_path, **KINDS["mjcf"])
    for text, reason in ((LOOK.format("tail"), "tail"), ("<mujoco><worldbody>", "XML")):
        file.with_suffix(".look.xml").write_text(text)
        with pytest.raises(ValueError, match=rf"dog\.look\.xml.*{reason}"):
            Skeleton(get_robot(str(file)))


SHAPES = {  # sizes as MuJoCo has them, and what that is along x, y and z after the turn [m]
    "sphere": (".2", (0.4, 0.4, 0.4)),
    "capsule": (".1 .3", (0.2, 0.8, 0.2)),
    "ellipsoid": (".1 .2 .3", (0.4, 0.6, 0.2)),
    "cylinder": (".1 .3", (0.2, 0.6, 0.2)),
    "box": (".1 .2 .3", (0.4, 0.6, 0.2)),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_a_shape_has_its_size_and_stands_where_it_should(tmp_path, kind):
    file = write_dog(tmp_path, **KINDS["mjcf"])
    sizes, extents = SHAPES[kind]
    shape = f'type="{kind}" size="{sizes}" pos=".3 -.2 .1" quat=".5 .5 -.5 .5"'  # turns y to x, z to y, x to z
    file.with_suffix(".look.xml").write_text(LOOK.format("trunk").replace('type="box" size=".1 .2 .3"', shape))
    dog = Skeleton(get_robot(str(file)))
    (geom,) = (geom for geom in dog.touches if dog.model.geom_bodyid[geom] == 1)
    mesh = dog.shape(geom)[0]
    np.testing.assert_allclose(mesh.extents, extents, rtol=0.03)  # a sphere has corners
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [0.3, -0.2, 0.1], atol=1e-6)
    assert mesh.volume > 0.0  # faces look outward
