"""Pictures: the ground lies where it is, painted by its height, and the robot stands on it."""

import numpy as np
import pytest

from sim.mujoco_c.model import surface_heights
from sim.recording.renderer import Camera, Renderer, ground_paint, open_context, scene_model
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from tests.sim.plain_mujoco import rays_from_above, to_c
from tests.sim.scenes import standing as standing_robots

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
    return to_c(standing_robots(robot, 1, x, y, z + robot.default_base_height)[0])


def test_paint_tells_heights_and_metres_apart(ground):
    paint = ground_paint(ground).astype(int)
    assert paint.shape == (640, 1280, 3)

    def at(x, y):
        return paint[round(80 * y), round(80 * x)]

    hill, pit, level = at(10.5, 6.7), at(4.5, 1.2), at(1.5, 4.5)
    assert hill[0] - hill[2] > 60 and pit[2] - pit[0] > 60 and np.ptp(level) < 25
    assert at(7.0, 4.5).sum() < 0.9 * level.sum()  # the line at 7 m
    assert (at(9.0, 6.7) < 0.95 * hill).all()  # the hill's flank, a cell wide


def test_the_ground_of_a_scene_is_the_simulations(anymal):
    rough = np.random.default_rng(1).uniform(-0.4, 0.4, (NUM_ROWS, NUM_COLS))
    model = scene_model(anymal, rough, width=64, height=64)
    points = np.random.default_rng(2).uniform([-1.9, -1.9], [12.9, 9.9], (200, 2))
    points = points[np.hypot(*(points - [2, 4]).T) > 1.5]  # there stands the robot
    hidden = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # of the groups, the ground's alone
    heights, _ = rays_from_above(model, points, standing(anymal, 2, 4, 0.5), hidden)
    np.testing.assert_allclose(heights, surface_heights(rough, *points.T), atol=1e-5)


def pixel_of(camera, x, y, height=0.0):
    """Row and column of a point in a picture taken straight from above, x to the right and y up."""
    focal = SIZE[1] / 2 / np.tan(np.deg2rad(45.0) / 2)  # MuJoCo's vertical angle of view
    depth = camera.distance + camera.target[2] - height
    return round(SIZE[1] / 2 - focal * (y - camera.target[1]) / depth), round(
        SIZE[0] / 2 + focal * (x - camera.target[0]) / depth
    )


def test_seen_from_above_everything_is_where_it_is(opengl, anymal, ground):
    above = Camera(target=(8.0, 4.0, 0.0), distance=20.0, azimuth=90.0, elevation=-90.0)
    with Renderer(anymal, ground, width=SIZE[0], height=SIZE[1], shadows=False) as renderer:
        picture = renderer.render(standing(anymal, 2.5, 3.5, 0.0), above).astype(int)
        other = renderer.render(standing(anymal, 13.5, 2.5, 0.0), above).astype(int)
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
    assert base.sum() < 320 < other[pixel_of(above, 2.5, 3.5)].sum()


def test_ghosts_forces_and_touches_have_colours(opengl, anymal, ground):
    side = Camera(target=(2.0, 4.0, 0.5), distance=4.0, azimuth=90.0, elevation=-10.0)
    pose = standing(anymal, 2.0, 4.0, 0.0)
    ghost = {"ghost": standing(anymal, 3.2, 4.0, 0.0), "ghost_name": "C-G"}
    force, base, foot = np.zeros((4, 3)), np.zeros(13, bool), np.zeros(13, bool)
    force[0, 2], base[0], foot[-4:] = 900.0, True, True
    with Renderer(anymal, ground, width=SIZE[0], height=SIZE[1], shadows=False) as renderer:
        pictures = [
            renderer.render(pose, side, **marks).astype(int)
            for marks in ({}, ghost, {"foot_force": force}, {"touching": base}, {"touching": foot}, {})
        ]
    alone, joined, pushed, hit, stepping, again = pictures
    np.testing.assert_array_equal(alone, again)  # what was added to a picture stays in it

    def pixels(picture, strong, weak):
        return (picture[..., strong].min(axis=-1) - picture[..., weak].max(axis=-1) > 60).sum()

    for picture, strong, weak in (
        (joined, [1, 2], [0]),
        (pushed, [0], [1, 2]),
        (hit, [0], [1]),
        (stepping, [0, 1], [2]),
    ):
        assert pixels(picture, strong, weak) > pixels(alone, strong, weak) + 40
