import numpy as np
from scipy.spatial.transform import Rotation

from qd.show.view.scene import arrow_mesh, arrow_pose, robot_parts
from sim.robots.skeleton import Skeleton


def test_each_part_of_a_robot_shows_one_touch(robot):
    parts = robot_parts(Skeleton(robot), robot)
    assert len({(part.body, part.touches) for part in parts}) == len(parts)
    assert {column for part in parts for column in part.touches} == set(range(len(robot.geom_names)))
    foot = next(part.mesh for part in parts if part.is_foot)
    # Of ANYmal's 0.19, 0.19, 0.20 of 1, sRGB 0.19 is (.19 + .055 over 1.055) ** 2.4 = .030 of the light: 8 of 255.
    if robot.name == "anymal":
        assert foot.visual.vertex_colors[0].tolist() == [8, 8, 8, 255]


def test_an_arrow_points_from_its_beginning_to_its_end():
    begin, way = np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.4, 1.2])
    quaternion, length = arrow_pose(begin, begin + way)
    np.testing.assert_allclose(arrow_mesh().bounds[:, 2], [0.0, 1.0], atol=1e-6)
    turn = Rotation.from_quat(np.roll(quaternion, -1))
    np.testing.assert_allclose(turn.apply([0.0, 0.0, length]), way, atol=1e-5)
