"""Films: the right episode, its time and place below it, and a file that plays."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.show.film import write_film
from qd.show.shot import (
    PANEL_HEIGHT,
    VIEW_HEIGHT,
    WIDTH,
    Panel,
    Shot,
    caption,
    follow,
    frames_of,
    num_pictures,
    shown_frames,
    typical_episode,
)
from sim.mujoco_c.model import surface_heights
from sim.recording.recorder import Recording

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

SCALES = {"yaw_rate": 2.0, "vel_x": 1.0}
FRAMES = 51
LATE = [Outcome.TIME_OUT] * 2


@pytest.fixture
def recording():
    """Five made-up episodes of a second along y = 4 m; only penalties and outcomes differ."""
    shape = (1, 5, FRAMES)
    position = np.zeros((*shape, 3), np.float32)
    position[..., 0] = np.linspace(2.0, 6.0, FRAMES)
    position[..., 1:] = 4.0, 0.6
    sums = np.float32([[1, 1], [9, 9], [3, 3], [2, 6], [5, 5]])
    quaternion = np.zeros((*shape, 4), np.float32)
    quaternion[..., 0] = 1.0
    return Recording(
        robot="anymal", joint_names=("hip",), foot_names=("foot",), penalty_names=("yaw_rate", "vel_x"), dt=0.02,
        labels=("a hill",), heights=np.zeros((1, 161, 321), np.float32), genes=None, seeds=np.uint32([1]),
        replicas=np.arange(5, dtype=np.int32),
        outcome=np.uint8([[*LATE[:1], Outcome.GOAL, *LATE, Outcome.BASE_COLLISION]]),
        invalidity=np.zeros((1, 5), np.uint8),
        fallen=np.array([[False] * 4 + [True]]), duration_s=np.ones((1, 5), np.float32),
        num_frames=np.full((1, 5), FRAMES, np.int32), base_position=position, base_quaternion=quaternion,
        joint_position=np.zeros((*shape, 1), np.float32), foot_force=np.zeros((*shape, 1, 3), np.float32),
        penalties=sums[None, :, None] * np.linspace(0, 1, FRAMES, dtype=np.float32)[:, None],
        command=np.zeros((*shape, 3), np.float32), origin={},
        geom_names=(), touching=np.zeros((*shape, 0), bool),
    )  # fmt: skip


def shot_of(recording, episode=2, **fields):
    return Shot(recording=recording, episode=episode, scales=SCALES, **fields)


def test_the_typical_episode_ends_like_most_and_costs_the_middle(recording):
    # Out of time are 0, 2 and 3; scaled sums 1/2 + 1, 3/2 + 3 and 2/2 + 6.
    assert typical_episode(recording, SCALES) == 2
    assert typical_episode(recording, {"yaw_rate": 1.0}) == 3


def test_the_caption_says_what_is_shown_and_how_all_ended(recording):
    first, second = caption(shot_of(dataclasses.replace(recording, replicas=np.int32([7, 8, 9, 10, 11]))))
    assert "episode 9" in first and "out of time" in first
    # Wilson, z^2 = 3.8415, of 1 of 5: (.2 + .3841 +- 1.96 sqrt(.032 + .0384)) / 1.7683 = .3303 +- .2941
    assert "goal 20% (4 to 62%), base collision 20% (4 to 62%), fallen 20% (4 to 62%)" in second
    outcome = recording.outcome.copy()
    outcome[0, 4] = Outcome.INVALID
    _, second = caption(shot_of(dataclasses.replace(recording, outcome=outcome)))
    assert "1 invalid: goal 25% (5 to 70%), base collision 0% (0 to 49%)" in second
    everything = dataclasses.replace(recording, outcome=np.full((1, 5), Outcome.INVALID, np.uint8))
    assert "none valid" in caption(shot_of(everything))[1]


def test_frames_are_shown_in_real_time_from_the_first_to_the_last(recording):
    frames = shown_frames(shot_of(recording), 25)
    assert frames == list(range(0, 51, 2))
    assert shown_frames(shot_of(recording), 10) == [*range(0, 50, 5), 50]
    assert num_pictures(shot_of(recording), 25) == 26 + 25
    start = dataclasses.replace(recording, num_frames=np.ones((1, 5), np.int32))
    assert shown_frames(shot_of(start), 25) == [0]


def test_the_panel_has_a_dot_at_the_place_and_sums_that_grow(recording):
    panel = Panel(shot_of(recording), WIDTH, PANEL_HEIGHT)
    early, late = panel.at(0.25, np.array([3.0, 4.0, 0.5])), panel.at(0.75, np.array([5.0, 6.0, 0.5]))
    assert early.shape == (PANEL_HEIGHT, WIDTH, 3) and early.dtype == np.uint8

    def dot(image, other):
        place = (image == (213, 94, 0)).all(axis=2) & (image != other).any(axis=2) & (np.arange(WIDTH) < WIDTH / 3)
        rows, columns = np.nonzero(place)
        return np.array([columns.mean(), rows.mean()])

    moved = dot(late, early) - dot(early, late)
    assert moved[0] == pytest.approx(-moved[1], abs=2) and moved[0] > 30  # 2 m along x, 2 m up along y
    assert (early[:, -60:] != late[:, -60:]).any()  # the sums behind the legend


def test_the_camera_follows_and_rises_where_the_ground_would_hide_the_robot(recording):
    level = follow(shot_of(recording), 3.0)
    assert len(level) == FRAMES and level[0].elevation == level[-1].elevation == -22.0
    xs = np.array([camera.target[0] for camera in level])
    assert (np.diff(xs) >= 0).all() and 2.0 <= xs[0] < 2.6 and 5.4 < xs[-1] <= 6.0
    heights = np.zeros((1, 161, 321), np.float32)
    heights[0, :60] = 1.6  # a wall on the camera's side
    hidden = shot_of(dataclasses.replace(recording, heights=heights))
    above = follow(hidden, 3.0)
    assert above[0].elevation < -22.0
    camera = above[20]
    azimuth, tilt = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
    away = -np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
    sight = np.array(camera.target) + np.linspace(0, 3.0, 50)[:, None] * away
    assert (sight[:, 2] > surface_heights(np.float64(heights[0]), sight[:, 0], sight[:, 1])).all()


def test_a_film_shows_poses_ghosts_and_forces_of_its_frames(recording):
    rendered = []

    def render(qpos, camera, *, ghosts, foot_force):
        rendered.append((qpos, camera, ghosts, foot_force))
        return np.full((VIEW_HEIGHT, WIDTH, 3), 200, np.uint8)

    force = np.random.default_rng(0).normal(size=recording.foot_force.shape).astype(np.float32)
    shot = shot_of(dataclasses.replace(recording, foot_force=force), ghosts=(0, 4))
    cameras = follow(shot, 3.0)
    pictures = list(frames_of(shot, SimpleNamespace(render=render), cameras, 10))
    assert len(pictures) == num_pictures(shot, 10) == 21 and len(rendered) == 11
    assert {picture.shape for picture in pictures} == {(720, 1280, 3)}
    for frame, (qpos, camera, ghosts, forces) in zip(shown_frames(shot, 10), rendered, strict=True):
        np.testing.assert_array_equal(qpos, recording.qpos(0, 2)[frame])
        assert camera is cameras[frame] and len(ghosts) == 2
        np.testing.assert_array_equal(forces, force[0, 2, frame])
    assert (pictures[-1] == pictures[10]).all() and (pictures[0] != pictures[10]).any()
    caption_bar = pictures[0][:56]
    assert caption_bar.max() == 255 and np.median(caption_bar) == 70  # white letters on the view, darkened
    assert (pictures[0][60:400] == 200).all()


def test_a_film_plays_as_long_as_it_should(tmp_path):
    told = []
    pictures = (np.full((64, 96, 3), 5 * k, np.uint8) for k in range(30))
    path = tmp_path / "a b.mp4"
    assert write_film(path, pictures, 10, progress=lambda: told.append(1)) == 30 == len(told)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert (count, seconds) == (30, pytest.approx(3.0, abs=0.1))
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    assert meta["size"] == (96, 64) and meta["codec"] == "h264"
    last = np.frombuffer(list(reader)[-1], np.uint8)
    assert abs(last.mean() - 145) < 4
    assert [file.name for file in tmp_path.iterdir()] == ["a b.mp4"]


def test_a_film_that_is_interrupted_leaves_the_old_one(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")

    def pictures():
        yield np.zeros((64, 96, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(path, pictures(), 10)
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1
