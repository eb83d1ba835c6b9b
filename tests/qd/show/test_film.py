"""Films: the right episode, its time and place below it, and a file that plays; crossings are made up."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import write_archive
from qd.show.commands import Film
from qd.show.crossed import moment_of_failure, typical_episode
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
)
from sim.files.command import run_command
from sim.mujoco_c.model import surface_heights
from sim.recording.file import read_recording
from sim.recording.renderer import open_context
from tests.builders import small_archive
from tests.qd.recordings import recording_of, stand_in_cross

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

SCALES = {"yaw_rate": 2.0, "vel_x": 1.0}
FRAMES = 51
LATE = Outcome.TIME_OUT


@pytest.fixture
def recording():
    """Five episodes of a second from x = 2 to 6 m on flat ground; only penalties and outcomes differ."""
    sums = np.zeros((5, 6))
    sums[:, :2] = [[1, 1], [9, 9], [3, 3], [2, 6], [5, 5]]
    outcomes, fallen = [LATE, Outcome.GOAL, LATE, LATE, Outcome.BASE_COLLISION], [False] * 4 + [True]
    made = recording_of(outcomes, [6.0] * 5, penalties=sums, fallen=fallen, frames=FRAMES)
    made.base_position[..., 1:] = 4.0, 0.6
    return replace(made, heights=np.zeros((1, 161, 321), np.float32))


def shot_of(recording, episode=2, **fields):
    return Shot(recording=recording, episode=episode, scales=SCALES, **fields)


def test_the_typical_episode_ends_like_most_and_costs_the_middle(recording):
    # Out of time are 0, 2 and 3; scaled sums 1/2 + 1, 3/2 + 3 and 2/2 + 6.
    assert typical_episode(recording, SCALES) == 2
    assert typical_episode(recording, {"yaw_rate": 1.0}) == 3


def test_the_moment_of_failure_by_hand(recording):
    def moment(**fields):
        return moment_of_failure(replace(recording, **fields), 4)

    # 51 frames of 0.02 s from x = 2 to 6 m, 0.08 m apart
    assert moment() == pytest.approx(1.0)  # the base collision ends the episode
    stuck = np.full((1, 5), LATE, np.uint8)
    # Within 0.3 m of x = 6 m for the first time at frame 47: 2 + 47 * 0.08 = 5.76; frame 46 is at 5.68.
    assert moment(outcome=stuck) == pytest.approx(0.94)
    lying = recording.base_quaternion.copy()
    lying[:, :, 10:15] = lying[:, :, 30:] = [np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0]  # rolled by 90 degrees
    for outcome in (stuck, recording.outcome, np.full((1, 5), Outcome.OUT, np.uint8)):
        assert moment(outcome=outcome, base_quaternion=lying) == pytest.approx(0.6)  # it rose from the first fall
    arrived = np.full((1, 5), Outcome.GOAL, np.uint8)
    assert moment(outcome=arrived, base_quaternion=lying) == pytest.approx(1.0)
    assert moment(num_frames=np.full((1, 5), 31, np.int32)) == pytest.approx(0.6)


def test_the_caption_has_the_episode_and_the_rates_of_all(recording):
    first, second = caption(shot_of(replace(recording, replicas=np.int32([7, 8, 9, 10, 11]))))
    assert "episode 9" in first and "out of time" in first
    # Wilson, z^2 = 3.8415, of 1 of 5: (.2 + .3841 +- 1.96 sqrt(.032 + .0384)) / 1.7683 = .3303 +- .2941
    assert "goal 20% (4 to 62%), base collision 20% (4 to 62%), fallen 20% (4 to 62%)" in second
    recording.outcome[0, 4] = Outcome.INVALID
    _, second = caption(shot_of(recording))
    assert "1 invalid" in second and "goal 25% (5 to 70%), base collision 0% (0 to 49%)" in second


def test_frames_are_shown_in_real_time_from_the_first_to_the_last(recording):
    assert shown_frames(shot_of(recording), 25) == list(range(0, 51, 2))
    assert shown_frames(shot_of(recording), 10) == [*range(0, 50, 5), 50]
    assert num_pictures(shot_of(recording), 25) == 26 + 25
    assert shown_frames(shot_of(replace(recording, num_frames=np.ones((1, 5), np.int32))), 25) == [0]


def test_the_panel_has_a_dot_at_the_place(recording):
    panel = Panel(shot_of(recording), WIDTH, PANEL_HEIGHT)
    early, late = panel.at(0.25, np.array([3.0, 4.0, 0.5])), panel.at(0.75, np.array([5.0, 6.0, 0.5]))
    assert early.shape == (PANEL_HEIGHT, WIDTH, 3) and early.dtype == np.uint8

    def dot(image, other):
        place = (image == (213, 94, 0)).all(axis=2) & (image != other).any(axis=2) & (np.arange(WIDTH) < WIDTH / 3)
        rows, columns = np.nonzero(place)
        return np.array([columns.mean(), rows.mean()])

    moved = dot(late, early) - dot(early, late)
    assert moved[0] == pytest.approx(-moved[1], abs=2) and moved[0] > 30  # 2 m along x, 2 m up along y


def test_the_camera_follows_and_rises_where_the_ground_would_hide_the_robot(recording):
    level = follow(shot_of(recording), 3.0)
    assert len(level) == FRAMES and level[0].elevation == level[-1].elevation == -22.0
    xs = np.array([camera.target[0] for camera in level])
    assert (np.diff(xs) >= 0).all() and 2.0 <= xs[0] < 2.6 and 5.4 < xs[-1] <= 6.0
    recording.heights[0, :60] = 1.6  # a wall on the camera's side
    camera = follow(shot_of(recording), 3.0)[20]
    assert camera.elevation < -22.0
    azimuth, tilt = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
    away = -np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
    sight = np.array(camera.target) + np.linspace(0, 3.0, 50)[:, None] * away
    assert (sight[:, 2] > surface_heights(np.float64(recording.heights[0]), sight[:, 0], sight[:, 1])).all()


def test_a_film_shows_poses_ghosts_and_forces_of_its_frames(recording):
    rendered = []

    def render(qpos, camera, *, ghosts, foot_force):
        rendered.append((qpos, camera, ghosts, foot_force))
        return np.full((VIEW_HEIGHT, WIDTH, 3), 200, np.uint8)

    recording.foot_force[:] = np.random.default_rng(0).normal(size=recording.foot_force.shape)
    recording.base_position[0, 4, :, 1] = 5.0
    shot = shot_of(recording, ghosts=(0, 4))
    cameras = follow(shot, 3.0)
    pictures = list(frames_of(shot, SimpleNamespace(render=render), cameras, 10))
    assert len(pictures) == num_pictures(shot, 10) == 21 and len(rendered) == 11
    assert {picture.shape for picture in pictures} == {(720, 1280, 3)}
    for frame, (qpos, camera, ghosts, forces) in zip(shown_frames(shot, 10), rendered, strict=True):
        np.testing.assert_array_equal(qpos, recording.qpos(0, 2)[frame])
        np.testing.assert_array_equal(ghosts[1], recording.qpos(0, 4)[frame])
        np.testing.assert_array_equal(forces, recording.foot_force[0, 2, frame])
        assert camera is cameras[frame] and len(ghosts) == 2
    assert (pictures[-1] == pictures[10]).all() and (pictures[0] != pictures[10]).any()
    assert pictures[0][:56].max() == 255 and np.median(pictures[0][:56]) == 70  # white letters on the view, darkened
    assert (pictures[0][60:400] == 200).all()


def test_a_film_plays_as_long_as_it_should(tmp_path):
    pictures = (np.full((64, 96, 3), 5 * k, np.uint8) for k in range(30))
    path = tmp_path / "a b.mp4"
    write_film(path, pictures, 10)
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (30, pytest.approx(3.0, abs=0.1))
    meta, *read = imageio_ffmpeg.read_frames(str(path))
    assert meta["size"] == (96, 64) and meta["codec"] == "h264"
    assert abs(np.frombuffer(read[-1], np.uint8).mean() - 145) < 4

    def stopped():
        yield np.zeros((64, 96, 3), np.uint8)
        raise KeyboardInterrupt

    whole = path.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_film(path, stopped(), 10)
    assert path.read_bytes() == whole and list(tmp_path.iterdir()) == [path]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The newest run: three elites; the simulation is replaced."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("qd.show.recordings.Simulation", lambda robot, device: stand_in_cross([]))
    folder = Path("runs/anymal-small-0")
    folder.mkdir(parents=True)
    write_archive(folder / "archive.npz", small_archive(3))
    return folder


def film(*argv):
    return run_command(Film, [*argv, "--device", "cpu", "--look.fps", "2", "--look.no-shadows"], name="film")


def test_films_of_elites_of_a_map_and_of_recordings(run):
    try:
        open_context(16, 16).free()
    except ValueError as error:
        pytest.skip(str(error))
    crossing = ("--replicas", "4", "--seed", "3", "--policy", "tests.sim.policies:stand")
    assert film("--elite", "0 2", *crossing) == 0
    name = "tests.sim.policies-stand"  # not the search's
    # at 2 pictures a second the start, the end after 0.4 s, and this held for a second
    films = [run / f"elite-{elite}-{name}.mp4" for elite in (0, 2)]
    assert [imageio_ffmpeg.count_frames_and_secs(str(path))[0] for path in films] == [4, 4]
    recorded = run / f"elite-2-{name}.recording.npz"
    recording = read_recording(recorded)
    assert recording.outcome.shape == (1, 4) and recording.origin["seed"] == 3
    assert film("--terrain", str(recorded), "--look.episode", "1", "--out", "again.mp4") == 0
    assert imageio_ffmpeg.count_frames_and_secs("again.mp4")[0] == 4
    assert Path("again.mp4").read_bytes() != films[1].read_bytes()  # episode 1 is not the typical one
    np.savez("hill.npz", heights=np.zeros((3, 5)), size_m=[16.0, 8.0])
    assert film("--terrain", "hill.npz", *crossing) == 0
    recording = read_recording(f"runs/terrains/hill.npz-anymal-{name}.recording.npz")
    assert recording.labels == ("hill.npz",) and (recording.heights == 0).all()


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ("--elite 3", "elite 3"),
        ("--look.episode 20", "episode"),
        ("--run runs/anymal-small-0 --terrain a.npz", "--terrain"),
        ("--terrain none.recording.npz", "none.recording.npz"),
    ],
)
def test_mistakes_are_refused_before_anything_is_crossed(run, capsys, flags, named):
    assert film(*flags.split()) == 2
    assert named in capsys.readouterr().err
    assert not list(run.glob("*.mp4")) and not list(run.glob("*.recording.npz"))


def test_without_opengl_nothing_is_crossed(run, capsys, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no_such_way")
    assert film() == 2
    assert "no_such_way" in capsys.readouterr().err
