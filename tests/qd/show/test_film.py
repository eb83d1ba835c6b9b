"""Films: the right episode and its seconds about the failure, and files that play; crossings are made up."""

import io
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from kernels.episode import Outcome
from qd.show.commands import FilmCommand
from qd.show.crossed import find_failure_time, find_typical_episode, make_title
from qd.show.film import Shot, as_gif, follow, interpolate_pose
from sim.files.command import run_command
from sim.mujoco_c.model import surface_heights
from tests.builders import small_archive, write_run
from tests.qd.recordings import recording_of, stand_in_cross

SCALES = {"yaw_rate": 2.0, "vel_x": 1.0}
LATE = Outcome.TIME_OUT


@pytest.fixture
def recording():
    """Five episodes of five seconds from x = 2 to 6 m on flat ground; only penalties and outcomes differ."""
    sums = np.zeros((5, 6))
    sums[:, :2] = [[1, 1], [9, 9], [3, 3], [2, 6], [5, 5]]
    outcomes, fallen = [LATE, Outcome.GOAL, LATE, LATE, Outcome.BASE_COLLISION], [False] * 4 + [True]
    made = recording_of(outcomes, [6.0] * 5, penalties=sums, fallen=fallen, frames=251)
    made.base_position[..., 1:] = 4.0, 0.6
    return replace(made, heights=np.zeros((1, 161, 321), np.float32))


def test_the_typical_episode_ends_like_most_and_costs_the_middle(recording):
    # Out of time are 0, 2 and 3; scaled sums 1/2 + 1, 3/2 + 3 and 2/2 + 6.
    assert find_typical_episode(recording, SCALES) == 2
    assert find_typical_episode(recording, {"yaw_rate": 1.0}) == 3
    # Two of five arrive, more than end in any other way, and under half: one of the others is shown.
    ends = np.array([[Outcome.GOAL, Outcome.GOAL, Outcome.OUT, LATE, Outcome.BASE_COLLISION]], np.uint8)
    failing = replace(recording, outcome=ends)
    assert ends[0, find_typical_episode(failing, SCALES)] != Outcome.GOAL
    ends[0, 3] = Outcome.GOAL
    assert find_typical_episode(failing, SCALES) in (0, 1, 3)


def test_the_moment_of_failure_by_hand(recording):
    def moment(**fields):
        return find_failure_time(replace(recording, **fields), 4)

    # 251 frames of 0.02 s from x = 2 to 6 m, 0.016 m apart
    assert moment() == pytest.approx(5.0)  # the base collision ends the episode
    stuck = np.full((1, 5), LATE, np.uint8)
    # Within 0.3 m of x = 6 m for the first time at frame 232: 2 + 232 * 0.016 = 5.712; frame 231 is at 5.696.
    assert moment(outcome=stuck) == pytest.approx(4.64)
    lying = recording.base_quaternion.copy()
    lying[:, :, 10:15] = lying[:, :, 30:] = [np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0]  # rolled by 90 degrees
    for outcome in (stuck, recording.outcome, np.full((1, 5), Outcome.OUT, np.uint8)):
        assert moment(outcome=outcome, base_quaternion=lying) == pytest.approx(0.6)  # it rose from the first fall
    assert moment(outcome=np.full((1, 5), Outcome.GOAL, np.uint8), base_quaternion=lying) == pytest.approx(5.0)
    assert moment(num_frames=np.full((1, 5), 31, np.int32)) == pytest.approx(0.6)


def test_the_title_names_the_commonest_ending(recording):
    def title(outcomes, fallen):
        made = replace(recording, outcome=np.array([outcomes], np.uint8), fallen=np.array([fallen]))
        return make_title(replace(made, labels=("elite 313",)))

    hit, never = Outcome.BASE_COLLISION, [False] * 5
    assert title([LATE, Outcome.GOAL, LATE, LATE, hit], never) == "ANYmal C, elite 313: gets stuck, 3 of 5"
    assert title([hit, hit, hit, LATE, Outcome.INVALID], [True, True, False, False, True]).endswith("topples, 2 of 4")
    assert title([LATE, LATE, LATE, hit, hit], [True, True, False, True, False]).endswith("topples, 3 of 5")
    assert title([hit, hit, hit, LATE, LATE], [True, False, False, True, True]).endswith("hits the ground, 3 of 5")
    assert make_title(replace(recording, robot="dog", labels=("a hill",)), "C-G").startswith("dog with C-G, a hill: ")


def test_a_film_begins_three_seconds_before_the_failure_slows_down_and_ends_one_after(recording):
    # Of an end at 5 s: 2 to 4 s, then 4 to 5 s in 4 s, then 1 s in which the last frame is held.
    times = Shot(recording=recording, episode=4, fps=10).times
    np.testing.assert_allclose(times[[0, 20, 40, 60, 70]], [2.0, 4.0, 4.5, 5.0, 6.0])
    assert len(times) == 71
    whole = Shot(recording=recording, episode=4, whole=True, fps=10).times
    np.testing.assert_allclose(whole[[0, 40, 60, 80, 90]], [0.0, 4.0, 4.5, 5.0, 6.0])
    arrives = Shot(recording=recording, episode=1, fps=10).times
    np.testing.assert_allclose(arrives, np.arange(61) / 10)  # all of it, at its speed
    short = replace(recording, num_frames=np.full((1, 5), 26, np.int32))
    np.testing.assert_allclose(Shot(recording=short, episode=4, fps=10).times[[0, 20, 30]], [0.0, 0.5, 1.5])
    # A ghost that arrives at 5 s, after a failure at 0.5 s: from 1.5 s on in 0.875 s, and 1 s more.
    beside = "C-G", replace(recording, outcome=np.full((1, 5), Outcome.GOAL, np.uint8))
    shot = Shot(recording=short, episode=4, beside=beside, fps=8)
    assert shot.arrival == pytest.approx(5.0)
    np.testing.assert_allclose(shot.times[[0, 16, 24, 31, 39]], [0.0, 0.5, 1.5, 5.0, 6.0])
    assert replace(shot, beside=("C-G", recording)).times[-1] == pytest.approx(1.5)  # it gets stuck


def test_the_camera_turns_to_a_ghost_that_arrives_once_the_failure_was_shown(recording):
    ahead = replace(
        recording, outcome=np.full((1, 5), Outcome.GOAL, np.uint8), base_position=recording.base_position + 3
    )
    for failed in (
        replace(recording, num_frames=np.full((1, 5), 26, np.int32)),  # its episode ends with the fall
        replace(
            recording, num_frames=np.full((1, 5), 151, np.int32), base_position=0 * recording.base_position
        ),  # stuck
    ):
        alone = Shot(recording=failed, episode=4)
        beside = replace(alone, beside=("C-G", ahead))
        assert alone.moment is not None and beside.arrival is not None and beside.stop == alone.moment + 1.0
        times = np.array([alone.moment, beside.stop - 0.5, beside.stop + 0.5, beside.arrival])
        xs, ghost = (
            [c.target[0] for c in follow(shot, times, 3.0)] for shot in (beside, Shot(recording=ahead, episode=4))
        )
        np.testing.assert_allclose(xs[:2], [camera.target[0] for camera in follow(alone, times[:2], 3.0)], atol=0.1)
        np.testing.assert_allclose(xs[2:], ghost[2:], atol=0.02)


def test_poses_lie_between_those_recorded():
    turned = [np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)]
    poses = np.array([[0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.2], [0.4, 0.0, 0.5, *(-np.array(turned)), 0.4]])
    half = interpolate_pose(poses, 0.5)  # the same turn by a quaternion of the other sign: 45 degrees of 90
    np.testing.assert_allclose(half, [0.2, 0.0, 0.5, np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8), 0.3])
    np.testing.assert_array_equal(interpolate_pose(poses, 7.3)[:3], poses[1, :3])


def test_the_camera_follows_and_rises_where_the_ground_would_hide_the_robot(recording):
    times = np.linspace(0.0, 6.0, 61)
    level = follow(Shot(recording=recording, episode=4), times, 3.0)
    assert len(level) == 61 and level[0].elevation == level[-1].elevation == -22.0
    xs = np.array([camera.target[0] for camera in level])
    assert (np.diff(xs) >= 0).all() and 2.0 <= xs[0] < 2.2 and 5.8 < xs[-1] <= 6.0
    recording.heights[0, :60] = 1.6  # a wall on the camera's side
    camera = follow(Shot(recording=recording, episode=4), times, 3.0)[20]
    assert camera.elevation < -22.0
    azimuth, tilt = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
    away = -np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
    sight = np.array(camera.target) + np.linspace(0, 3.0, 50)[:, None] * away
    assert (sight[:, 2] > surface_heights(np.float64(recording.heights[0]), sight[:, 0], sight[:, 1])).all()


def test_a_gif_has_as_many_colours_as_its_size_allows():
    noise = np.random.default_rng(0).integers(0, 255, (8, 20, 30, 3), np.uint8)
    large, small = (Image.open(io.BytesIO(as_gif(noise, most))) for most in (100_000, 5_000))
    assert large.n_frames == small.n_frames == 8 and large.info["duration"] == small.info["duration"] == 80
    colors = [len(np.unique(np.asarray(gif.convert("RGB")).reshape(-1, 3), axis=0)) for gif in (large, small)]
    assert colors[0] > 128 >= colors[1] > 8
    with pytest.raises(ValueError, match="GIF"):
        as_gif(noise, 100)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The newest run: three elites; the simulation is replaced."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("qd.show.recordings.RecordingCrosser", lambda robot, device: stand_in_cross([]))
    monkeypatch.setattr("qd.show.film.FPS", 2)
    monkeypatch.setattr("qd.show.film.GIF_FPS", 2.0)
    return write_run(Path("runs/anymal-small-0"), small_archive(3))


def film(*argv):
    return run_command(FilmCommand, [*argv, "--device", "cpu", "--no-shadows"], name="film")


@pytest.mark.slow
def test_films_of_elites_and_of_a_map(run, opengl, capsys):
    crossing = ("--replicas", "4", "--seed", "3", "--policy", "tests.sim.policies:stand")
    assert film("--elite", "0 2", *crossing) == 0
    name = "tests.sim.policies-stand"  # not the search's
    # One of four arrives: one that fails is filmed, 0.4 s in 1.6 s and 1 s more, two pictures a second
    films = [run / f"elite-{elite}-{name}.mp4" for elite in (0, 2)]
    for path in films:
        assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (6, pytest.approx(3.0, abs=0.1))
        assert next(imageio_ffmpeg.read_frames(str(path)))["codec"] == "h264"
    assert "replaced" not in capsys.readouterr().out
    assert film("--elite", "2", "--episode", "1", "--out", str(films[0]), *crossing) == 0
    assert "replaced" in capsys.readouterr().out
    np.savez("hill.npz", heights=np.zeros((3, 5)), size_m=[16.0, 8.0])
    assert film("--terrain", "hill.npz", "--beside", "shipped", "--gif", *crossing) == 0
    with Image.open(f"runs/terrains/hill.npz-anymal-{name}.gif") as gif:
        assert gif.size == (480, 270) and gif.n_frames > 1


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ("--elite 3", "elite 3"),
        ("--episode 20", "episode"),
        ("--run runs/anymal-small-0 --terrain a.npz", "--terrain"),
        ("--beside nobody.pt", "C-G, S, shipped"),
        ("--out film.gif", "--gif"),
    ],
)
def test_mistakes_are_refused_before_anything_is_crossed(run, capsys, flags, named):
    assert film(*flags.split()) == 2
    assert named in capsys.readouterr().err
    assert not list(run.glob("*.mp4"))


def test_a_ghost_that_is_not_there_is_refused_with_its_remedy(run, opengl, capsys):
    remedies = ("faultline finetune --robot anymal --specialist", f"`faultline judge --robot anymal --run {run}`")

    def name_remedies(name):
        assert film("--beside", name) == 2
        error = capsys.readouterr().err
        assert "C-G, S, shipped" in error
        return [remedy in error for remedy in remedies]

    assert name_remedies("specialist") == [True, True]
    certifier = run / "certifiers" / "specialist.pt"
    certifier.parent.mkdir()
    certifier.touch()  # it came after the judging
    assert name_remedies("specialist") == [False, True]
    assert name_remedies("nobody") == [False, False]


def test_without_opengl_nothing_is_crossed(run, capsys, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no_such_way")
    assert film() == 2
    assert "no_such_way" in capsys.readouterr().err
