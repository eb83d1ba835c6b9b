"""Recordings: of the very episodes that an evaluation runs, whole on disk, and checked when they are read."""

import dataclasses
import hashlib

import numpy as np
import pytest

from kernels.episode import Outcome
from sim.crossing import CrossingCfg
from sim.mujoco_c.model import surface_heights
from sim.recording.frames import FRAME_ARRAYS
from sim.recording.recorder import Recording, RolloutRecorder, make_recording, read_recording, write_recording
from sim.recording.renderer import Camera, Renderer, ground_paint, scene_model
from sim.rollout import Rollout
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.sim.plain_mujoco import rays_from_above, to_c
from tests.sim.scenes import FLAT, slope, spike
from tests.sim.scenes import standing as standing_robots

SHORT = CrossingCfg(poll_every_s=0.5)
SEEDS = np.array([5, 6], np.uint32)
SLOPE = slope(np.deg2rad(4), np.deg2rad(-3))  # other along x than along y, and no mirror image of itself
TERRAINS = Terrains(heights=np.stack([spike(), SLOPE]), seeds=SEEDS)


@pytest.fixture(scope="module")
def rollout(anymal, device):
    robot = dataclasses.replace(anymal, max_duration_s=1.0)
    return Rollout(robot, anymal.policy_file, num_terrains=2, replicas=4, device=device, cfg=SHORT)


@pytest.fixture(scope="module")
def recording(rollout, anymal) -> Recording:
    """Episodes that end in the middle of a control step, on a spike, beside some that last."""
    return record(rollout, TERRAINS, labels=["spike", "slope"])


def record(rollout, terrains, *, labels=("one", "two"), progress=None) -> Recording:
    recorder = RolloutRecorder(rollout)
    recorder.put(terrains)
    robot = rollout.robot
    result = recorder.take(progress)
    return make_recording(robot, str(robot.policy_file), terrains, result, device=rollout.sim.device, labels=labels)


def test_recorded_episodes_are_those_of_an_evaluation(rollout, recording):
    result = rollout.evaluate(TERRAINS)
    names = ("outcome", "duration_s", "fallen", "penalties")  # float32 sums, stored as they are: equal, not close
    for name in names if rollout.sim.device == "cpu" else ("outcome",):
        np.testing.assert_array_equal(getattr(recording.result(), name), getattr(result, name))
    assert (result.base_collision[0] & ~result.base_collision[1]).all()
    last = recording.num_frames - 1
    # The last frame is up to a control step after the end, at less than 2 m/s.
    assert (last * recording.dt - 0.02 - 1e-6 < result.duration_s).all()
    assert (result.duration_s <= last * recording.dt + 1e-6).all()
    np.testing.assert_allclose(recording.result().final_position, result.final_position, atol=0.04)


def test_frames_begin_at_the_start_and_go_on_to_the_end(rollout, recording, anymal):
    rollout.put(TERRAINS)
    robots = np.argsort(rollout.episode.numpy())  # on a GPU they take episodes in any order
    start = np.array(rollout.sim.joint_q.numpy())[robots].reshape(2, 4, -1)
    np.testing.assert_array_equal(recording.base_position[:, :, 0], start[..., :3])
    np.testing.assert_array_equal(recording.base_quaternion[:, :, 0], start[..., [6, 3, 4, 5]])
    np.testing.assert_allclose(recording.qpos(1, 2)[0], to_c(start[1, 2]), atol=5e-4)
    np.testing.assert_allclose(recording.joint_position[:, :, 0], start[..., 7:], atol=5e-4)
    assert (recording.penalties[:, :, 0] == 0).all() and (recording.foot_force[:, :, 0] == 0).all()
    # Toward the goal, from the start on, at 0.75 m/s; once ended, no command.
    np.testing.assert_allclose(np.linalg.norm(recording.command[:, :, 0, :2], axis=-1), 0.75, atol=1e-3)
    count = recording.num_frames[0, 0]
    assert (recording.command[0, 0, count - 1] == 0).all()
    assert (np.diff(recording.penalties[1], axis=1) >= 0).all()
    assert (recording.num_frames[1] == 51).all() and (recording.num_frames[0] < 51).all()
    for name, array in ((name, getattr(recording, name)) for name in FRAME_ARRAYS):
        assert array.shape[:3] == (2, 4, 51) and np.isfinite(array[0, 0, :count]).all()
        assert not array[0, 0, count:].any() if name == "touching" else np.isnan(array[0, 0, count:]).all()


def test_geoms_that_touch_are_those_that_are_pushed(recording, anymal):
    assert recording.geom_names == anymal.geom_names and recording.touching.shape == (2, 4, 51, 13)
    assert not recording.touching[:, :, 0].any()
    feet = [recording.geom_names.index(name) for name in recording.foot_names]
    force = np.nan_to_num(np.linalg.norm(recording.foot_force, axis=-1))
    near = np.abs(force - 0.1) < 1e-3  # forces are stored in float16
    assert (recording.touching[..., feet] == (force > 0.1))[~near].all()
    # On the spike every episode ends with a touch of the base; the slope is walked over on the feet alone.
    last = recording.num_frames[0] - 1
    assert recording.touching[0, np.arange(4), last, recording.geom_names.index("base")].all()
    assert recording.touching[1][:, :, feet].any() and not np.delete(recording.touching[1], feet, axis=-1).any()
    # A body that touches at the end of a control step has been counted in it.
    limbs = np.delete(recording.touching[0], feet, axis=-1).any(axis=-1)
    counted = np.diff(recording.penalties[0, :, :, recording.penalty_names.index("collision")], axis=1) > 0
    assert counted[limbs[:, 1:]].all()


def test_an_episode_that_breaks_ends_with_its_last_good_frame(rollout, anymal):
    def break_joint(share):
        values = np.array(rollout.sim.joint_q.numpy())
        values[rollout.episode.numpy() == 6, 8] = np.nan  # terrain 1, replica 2
        rollout.sim.joint_q.assign(values)

    recording = record(rollout, Terrains(heights=np.stack([FLAT, FLAT]), seeds=SEEDS), progress=break_joint)
    assert recording.outcome[1, 2] == Outcome.INVALID and np.isnan(recording.result().penalties[1, 2]).all()
    assert recording.num_frames[1, 2] == 26  # broken after 0.5 s, in the 26th control step; frames 0 to 25
    np.testing.assert_allclose(recording.duration_s[1, 2], 0.505, atol=1e-6)
    assert np.isfinite(recording.qpos(1, 2)[:25]).all()
    assert (recording.foot_force[:, :, 0] == 0).all()  # whatever robots did before


def test_a_recording_comes_back_from_its_file(recording, anymal, tmp_path):
    for name in ("a.npz", "b.npz"):
        write_recording(tmp_path / name, recording)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = read_recording(tmp_path / "a.npz")
    for field in dataclasses.fields(Recording):
        value, expected = getattr(back, field.name), getattr(recording, field.name)
        np.testing.assert_array_equal(value, expected)
        assert type(value) is type(expected) and getattr(value, "dtype", 0) == getattr(expected, "dtype", 0)
    assert back.origin["policy_sha256"] == hashlib.sha256(anymal.policy_file.read_bytes()).hexdigest()
    assert {"policy", "space", "command", "commit", "device", "versions", "seed", "date"} <= back.origin.keys()
    assert back.labels == ("spike", "slope") and back.robot == "anymal" and back.genes is None
    hit, longest = back.select_terrain(0), recording.num_frames[0].max()
    for name in ("penalties", "touching"):
        np.testing.assert_array_equal(getattr(hit, name), getattr(recording, name)[:1, :, :longest])
    assert hit.labels == ("spike",) and hit.seeds.tolist() == [5]
    # A frame is 3 + 4 + 6 floats of 4 bytes and 12 + 12 + 3 of 2; with two height grids no more than that.
    assert (tmp_path / "a.npz").stat().st_size < 8 * 51 * 106 + 2 * 161 * 321 * 4


def test_terrains_given_by_genes_are_stored_as_genes(rollout, anymal, tmp_path):
    genes = SUPER_GAUSSIAN.uniform_random(2, 3)
    recording = record(rollout, Terrains(genes=genes, seeds=SEEDS))
    write_recording(tmp_path / "a.npz", recording)
    with np.load(tmp_path / "a.npz") as content:
        assert "heights" not in content
    back = read_recording(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.genes, genes)
    np.testing.assert_allclose(back.heights, recording.heights, atol=1e-5)
    assert np.ptp(back.heights) > 0.1


def test_what_is_no_recording_is_refused(recording, tmp_path):
    path = tmp_path / "a.npz"
    write_recording(path, recording)
    with np.load(path) as content:
        arrays = dict(content)
    for name, value in {"format": "faultline recording 0", "heights": None, "origin": "{"}.items():
        changed = arrays | {name: np.array(value)}
        np.savez(path, **{key: array for key, array in changed.items() if array.dtype != object})
        with pytest.raises(ValueError, match=r"a\.npz"):
            read_recording(path)
    with pytest.raises(FileNotFoundError):
        read_recording(tmp_path / "elsewhere.npz")


SIZE = (640, 320)


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

    hill, pit, level, line, flank = paint[[536, 96, 360, 360, 536], [840, 360, 120, 560, 720]]  # 80 pixels a metre
    assert hill[0] - hill[2] > 60 and pit[2] - pit[0] > 60 and np.ptp(level) < 25
    assert line.sum() < 0.9 * level.sum()  # the line at 7 m
    assert (flank < 0.95 * hill).all()  # the hill's flank, a cell wide


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
    row, column = -focal * (y - camera.target[1]) / depth, focal * (x - camera.target[0]) / depth
    return round(SIZE[1] / 2 + row), round(SIZE[0] / 2 + column)


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

    seen = (joined, [1, 2], [0]), (pushed, [0], [1, 2]), (hit, [0], [1]), (stepping, [0, 1], [2])
    for picture, strong, weak in seen:
        assert pixels(picture, strong, weak) > pixels(alone, strong, weak) + 40
