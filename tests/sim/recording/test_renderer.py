"""Pictures: the ground lies where it is, painted by its height, and the robot stands on it."""

import dataclasses

import mujoco
import numpy as np
import pytest

from sim.crossing import CrossingCfg
from sim.mujoco_c.model import surface_heights
from sim.recording.recorder import record
from sim.recording.renderer import Camera, Renderer, open_context
from sim.recording.scene import MARGIN_NODES, ground_paint, scene_model
from sim.robots.find import get_robot
from sim.rollout import Rollout
from sim.terrain import NUM_COLS, NUM_ROWS, SPACING
from tests.sim.dogs import KINDS, write_dog

SIZE = (640, 320)


@pytest.fixture(scope="module")
def opengl():
    try:
        open_context(16, 16).free()
    except ValueError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def ground():
    """A hill at x 9..12, y 6..7.5 and a pit at x 3..6, y 0.5..2: no turn or mirror image of it is the same."""
    heights = np.zeros((NUM_ROWS, NUM_COLS), np.float32)
    heights[120:151, 180:241] = 0.6
    heights[10:41, 60:121] = -0.6
    return heights


def standing(robot, x, y, z):
    pose = np.zeros(7 + robot.num_joints)
    pose[:4] = x, y, z + robot.default_base_height, 1.0
    pose[7:] = robot.default_joint_pos
    return pose


def test_paint_tells_heights_and_metres_apart(ground):
    paint = ground_paint(ground).astype(int)
    assert paint.shape == (640, 1280, 3)

    def at(x, y):
        return paint[round(80 * y), round(80 * x)]

    hill, pit, level = at(10.5, 6.7), at(4.5, 1.2), at(1.5, 4.5)
    assert hill[0] - hill[2] > 60 and pit[2] - pit[0] > 60 and np.ptp(level) < 25
    assert at(7.0, 4.5).sum() < 0.9 * level.sum()  # the line at 7 m
    assert (at(9.0, 6.7) < 0.95 * hill).all()  # the hill's flank, a cell wide


def test_the_ground_of_a_scene_is_the_simulations(robot):
    rough = np.random.default_rng(1).uniform(-0.4, 0.4, (NUM_ROWS, NUM_COLS))
    model = scene_model(robot, rough, width=64, height=64)
    data = mujoco.MjData(model)
    data.qpos[:] = standing(robot, 2, 4, 0.5)
    mujoco.mj_forward(model, data)
    hidden = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # of the groups, the ground's alone
    for x, y in np.random.default_rng(2).uniform([-1.9, -1.9], [12.9, 9.9], (200, 2)):
        if np.hypot(x - 2, y - 4) < 1.5:
            continue  # there stands the robot
        distance = mujoco.mj_ray(
            model, data, np.array([x, y, 5.0]), np.array([0, 0, -1.0]), hidden, 1, -1, np.zeros(1, np.int32)
        )
        assert 5.0 - distance == pytest.approx(float(surface_heights(rough, x, y)), abs=1e-5)


def pixel_of(camera, x, y, height=0.0):
    """Row and column of a point in a picture taken straight from above, x to the right and y up."""
    focal = SIZE[1] / 2 / np.tan(np.deg2rad(45.0) / 2)  # MuJoCo's vertical angle of view
    depth = camera.distance + camera.target[2] - height
    return round(SIZE[1] / 2 - focal * (y - camera.target[1]) / depth), round(
        SIZE[0] / 2 + focal * (x - camera.target[0]) / depth
    )


def test_seen_from_above_everything_is_where_it_is(opengl, anymal, ground):
    above = Camera(target=(8.0, 4.0, 0.0), distance=20.0, azimuth=90.0, elevation=-90.0)
    with Renderer(anymal, ground, width=SIZE[0], height=SIZE[1]) as renderer:
        picture = renderer.render(standing(anymal, 2.5, 3.5, 0.0), above).astype(int)
        without = renderer.render(standing(anymal, 13.5, 2.5, 0.0), above).astype(int)
    assert picture.shape == (320, 640, 3)
    hill = picture[pixel_of(above, 10.5, 6.7, 0.6)]
    pit = picture[pixel_of(above, 4.5, 1.3, -0.6)]
    assert hill[0] - hill[2] > 40 and pit[2] - pit[0] > 40
    for x, y in [(4.5, 6.7), (10.5, 1.3), (1.5, 4.5)]:  # where mirror images of them would be
        level = picture[pixel_of(above, x, y)]
        assert abs(level[0] - level[2]) < 30
    goal = picture[pixel_of(above, 14.3, 4.2)]
    assert goal[1] > goal[0] + 20 and goal[1] > goal[2]
    base = picture[pixel_of(above, 2.5, 3.5, 0.6)]
    assert base.sum() < 250 < without[pixel_of(above, 2.5, 3.5)].sum()


def test_ghosts_are_paler_and_forces_are_arrows(opengl, anymal, ground):
    side = Camera(target=(2.0, 4.0, 0.5), distance=4.0, azimuth=90.0, elevation=-10.0)
    pose = standing(anymal, 2.0, 4.0, 0.0)
    with Renderer(anymal, ground, width=SIZE[0], height=SIZE[1], shadows=False) as renderer:
        alone = renderer.render(pose, side).astype(int)
        joined = renderer.render(pose, side, ghosts=[standing(anymal, 3.2, 4.0, 0.0)]).astype(int)
        again = renderer.render(pose, side).astype(int)
        pushed = renderer.render(pose, side, foot_force=[[0, 0, 900.0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]).astype(int)
    np.testing.assert_array_equal(alone, again)  # what was added to a picture stays in it
    changed = np.abs(joined - alone).sum(axis=2) > 6
    dark = alone.sum(axis=2) < 200
    assert changed.sum() > 500 and dark.sum() > 500
    assert (joined[changed].sum(axis=1) > 200).mean() > 0.9  # seen through, not as dark as the robot

    def red(picture):
        return ((picture[..., 0] > 100) & (picture[..., 1:].max(axis=2) < 60)).sum()

    assert red(pushed) > red(alone) + 20


def foot_positions(renderer, qpos):
    """Centres of the foot geoms in the pose that is drawn, shape (num_feet, 3)."""
    return renderer._posed(0, qpos).geom_xpos[renderer._feet].copy()


def test_bones_join_a_robot_of_bare_shapes(opengl, robot):
    """From hip to foot there is something to see, where the file has shapes to collide with alone."""
    model = scene_model(robot, np.zeros((NUM_ROWS, NUM_COLS)), width=64, height=64)
    plain = mujoco.MjModel.from_xml_path(str(robot.model_file))
    assert model.ngeom > plain.ngeom + robot.num_joints // 2
    assert model.nq == plain.nq == 7 + robot.num_joints
    with Renderer(robot, np.zeros((NUM_ROWS, NUM_COLS)), width=64, height=64) as renderer:
        feet = foot_positions(renderer, standing(robot, 5.0, 4.0, 0.0))
    data = mujoco.MjData(plain)
    data.qpos[:] = standing(robot, 5.0, 4.0, 0.0)
    mujoco.mj_kinematics(plain, data)
    np.testing.assert_allclose(feet, [data.geom(name).xpos for name in robot.foot_geoms], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_of_ones_own_is_shown_as_the_simulation_has_it(opengl, tmp_path, device, kind):
    dog = get_robot(str(write_dog(tmp_path, **KINDS[kind])))
    rollout = Rollout(dog, str(tmp_path / "dog_trot.py") + ":Trot", num_terrains=1, num_replicas=4, device=device,
                      cfg=CrossingCfg(max_duration_s=0.4))  # fmt: skip
    _, recording = record(rollout, np.zeros((1, NUM_ROWS, NUM_COLS), np.float32), np.array([1]), policy="trot")
    with Renderer(dog, recording.heights[0], width=64, height=64) as renderer:
        feet = np.array([foot_positions(renderer, pose) for pose in recording.qpos(0, 0)])
        renderer.render(
            recording.qpos(0, 0)[0], Camera(target=(2, 4, 0), distance=2), foot_force=recording.foot_force[0, 0, 9]
        )
    assert feet.shape == (21, 4, 3)
    pushing = np.linalg.norm(recording.foot_force[0, 0], axis=2) > 15
    assert pushing.sum() > 10
    assert np.abs(feet[pushing][:, 2] - 0.025).max() < 0.01  # spheres of 25 mm on level ground


def test_a_margin_is_shown_beyond_the_terrain(anymal, ground):
    model = scene_model(anymal, ground, width=64, height=64)
    assert model.hfield_nrow[0] == NUM_COLS + 2 * MARGIN_NODES and MARGIN_NODES * SPACING == 2.0


def test_what_cannot_be_shown_is_named(anymal, tmp_path, monkeypatch):
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody>")
    for file, message in ((tmp_path / "broken.xml", "cannot be shown"), (tmp_path / "none.xml", "cannot be shown")):
        with pytest.raises(ValueError, match=message):
            scene_model(dataclasses.replace(anymal, model_file=file), np.zeros((9, 9)), width=8, height=8)
    (tmp_path / "body.xml").write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    bare = dataclasses.replace(anymal, model_file=tmp_path / "body.xml", base_geoms=(), limb_geoms=(), foot_geoms=())
    with pytest.raises(ValueError, match=r"has joints  for MuJoCo, expected a free base and LF_HAA, "):
        scene_model(bare, np.zeros((NUM_ROWS, NUM_COLS)), width=8, height=8)
    monkeypatch.setenv("MUJOCO_GL", "no_such_way")
    with pytest.raises(ValueError, match=r"'no_such_way' does not work here: ModuleNotFoundError.*libegl1"):
        open_context(8, 8)


def test_paths_are_drawn_where_they_run(opengl):
    robot, heights = get_robot("anymal"), np.zeros((NUM_ROWS, NUM_COLS), np.float32)
    points = np.array([[4.0, 4.0, 0.5], [8.0, 4.0, 0.5], [12.0, 4.0, 0.5]])
    camera = Camera(target=(8.0, 4.0, 0.5), distance=5.0, azimuth=90.0, elevation=-89.0)  # 1.3 cm a pixel
    with Renderer(robot, heights, width=640, height=320, shadows=False) as renderer:
        pose = standing(robot, 2.0, 1.0, 0.0)
        bare, drawn = (
            renderer.render(pose, camera, paths=p).astype(int) for p in ((), [(points, (1.0, 0.0, 0.0, 1.0))])
        )
    rows, columns = np.nonzero(np.abs(drawn - bare).sum(axis=2) > 60)
    assert abs(rows.mean() - 160) < 3 and np.ptp(rows) < 8  # level across the middle of the picture
    assert abs(columns.mean() - 320) < 5 and np.ptp(columns) > 200
    assert (drawn[160, 320] - bare[160, 320])[0] > (drawn[160, 320] - bare[160, 320])[2]  # it is red
