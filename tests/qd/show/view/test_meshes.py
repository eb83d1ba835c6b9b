import mujoco
import numpy as np
import pytest
import trimesh

from qd.show.view.meshes import arrow_mesh, arrow_pose, body_meshes, geom_mesh, terrain_mesh, touch_mesh
from qd.show.view.playing import rotated
from sim.mujoco_c.model import surface_heights
from sim.robots.skeleton import Geom, Skeleton

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
SIZES = {
    "sphere": (0.2, 0.0, 0.0),
    "capsule": (0.1, 0.3, 0.0),
    "ellipsoid": (0.1, 0.2, 0.3),
    "cylinder": (0.1, 0.3, 0.0),
    "box": (0.1, 0.2, 0.3),
}


def make_geom(kind, size, position=(0.3, -0.2, 0.1), quaternion=(0.5, 0.5, -0.5, 0.5)):
    """A shape turned and moved about."""
    arrays = [np.array(values, dtype=float) for values in (size, position, quaternion)]
    return Geom(name="it", body=0, kind=kind, size=arrays[0], position=arrays[1], quaternion=arrays[2])


def outside(geom, points):
    """Distance of points from a shape's surface along the line to its centre [m], by MuJoCo's ray casting."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, geom.quaternion)
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{geom.kind.upper()}")
    inward = geom.position - points
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    far = points - inward  # a metre off
    cast = [mujoco.mju_rayGeom(geom.position, matrix, geom.size, a, b, kind) for a, b in zip(far, inward, strict=True)]
    return np.array(cast) - 1.0


@pytest.mark.parametrize("kind", SIZES)
def test_the_vertices_of_a_shape_lie_on_it(kind):
    geom = make_geom(kind, SIZES[kind])
    mesh = geom_mesh(geom, (0, 20, 255))
    vertices = np.float64(np.float32(mesh.vertices))  # a ray along an edge misses it
    vertices = vertices[np.linalg.norm(vertices - geom.position, axis=1) > 1e-6]  # not the middle of a lid
    assert np.abs(outside(geom, vertices)).max() < 1e-5
    assert mesh.is_watertight and mesh.volume > 0.0  # faces look outward
    # of 255, sRGB 20 is (.0784 + .055 over 1.055) ** 2.4 = .0070 of the light
    assert mesh.visual.vertex_colors.tolist() == [[0, 2, 255, 255]] * len(mesh.vertices)


def test_bones_hold_the_robot_together(robot):
    skeleton = Skeleton(robot)
    qpos = np.concatenate([[0.0, 0.0, 1.0], IDENTITY, robot.default_joint_pos])[None]
    positions, quaternions = skeleton.body_poses(qpos)
    world = []
    for k, mesh in enumerate(body_meshes(skeleton, robot)):
        if mesh is not None:
            world.append(positions[0, k] + rotated(quaternions[0, k], mesh.vertices))
    clouds = [trimesh.bounds.corners(np.stack([points.min(axis=0), points.max(axis=0)])) for points in world]
    for k, corners in enumerate(clouds):  # the box round each part overlaps that of another one
        low, high = corners.min(axis=0), corners.max(axis=0)
        others = [c for j, c in enumerate(clouds) if j != k]
        assert any((low <= c.max(axis=0)).all() and (high >= c.min(axis=0)).all() for c in others)


def test_the_terrain_is_the_surface_of_the_physics():
    rng = np.random.default_rng(5)
    heights = rng.normal(size=(5, 7)).astype(np.float32)
    mesh = terrain_mesh(heights)
    triangles = mesh.vertices[mesh.faces]
    assert len(triangles) == 2 * 4 * 6
    weights = rng.dirichlet(np.ones(3), size=(len(triangles), 5))
    points = np.einsum("tkc,tcd->tkd", weights, triangles).reshape(-1, 3)
    np.testing.assert_allclose(
        points[:, 2], surface_heights(heights.astype(float), points[:, 0], points[:, 1]), atol=1e-6
    )
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (normals[:, 2] > 0.0).all()


@pytest.mark.parametrize("way", [(0.3, -0.4, 1.2), (0.0, 0.0, 2.0), (0.0, 0.0, -0.5), (1.0, 0.0, 0.0)])
def test_an_arrow_points_from_its_beginning_to_its_end(way):
    begin = np.array([1.0, 2.0, 3.0])
    quaternion, length = arrow_pose(begin, begin + way)
    vertices = arrow_mesh().vertices
    tip = vertices[np.argmax(vertices[:, 2])]
    np.testing.assert_allclose(tip, [0.0, 0.0, 1.0], atol=1e-6)
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(begin + rotated(quaternion, tip * [1.0, 1.0, length]), begin + way, atol=1e-5)


def test_a_touch_is_shown_round_the_shape_that_touches(robot):
    skeleton = Skeleton(robot)
    for name in robot.geom_names:
        geom = skeleton.geom(name)
        inner, outer = geom_mesh(geom, (0, 0, 0)), touch_mesh(geom)
        np.testing.assert_allclose(outer.extents, inner.extents + 0.01, atol=1e-6)
        np.testing.assert_allclose(outer.bounds.mean(axis=0), inner.bounds.mean(axis=0), atol=1e-6)
