"""Films from the command line to their files."""

from pathlib import Path

import numpy as np
import pytest

from qd.archive import write_archive
from qd.show.commands import Film
from sim.files.command import run_command
from sim.recording.file import read_recording
from sim.recording.renderer import open_context
from tests.builders import small_archive

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The newest run: three elites."""
    monkeypatch.chdir(tmp_path)
    folder = Path("runs/anymal-small-0")
    folder.mkdir(parents=True)
    write_archive(folder / "archive.npz", small_archive(3))
    return folder


def film(*argv):
    common = ("--policy", "tests.sim.policies:stand", "--look.fps", "1", "--look.no-shadows")
    return run_command(Film, [*argv, *common], name="film")


def frames_in(path):
    return imageio_ffmpeg.count_frames_and_secs(str(path))[0]


@pytest.mark.slow
def test_films_of_elites_of_a_map_and_of_recordings(run):
    try:
        open_context(16, 16).free()
    except ValueError as error:
        pytest.skip(str(error))
    crossing = ("--device", "cpu", "--replicas", "4", "--seed", "3")
    assert film("--elite", "0 2", *crossing) == 0
    name = "tests.sim.policies-stand"  # not the search's
    assert frames_in(run / f"elite-0-{name}.mp4") >= 2
    recording = read_recording(run / f"elite-2-{name}.recording.npz")
    assert recording.outcome.shape == (1, 4) and recording.origin["seed"] == 3
    # A robot that stands is out of time after 20 s, or has fallen before: a picture a second, its end, and that held.
    last = float(np.median(recording.num_frames)) - 1
    assert abs(frames_in(run / f"elite-2-{name}.mp4") - (np.ceil(last * 0.02) + 2)) <= 1
    recorded = ("--terrain", str(run / f"elite-2-{name}.recording.npz"), "--look.episode", "1")
    assert film(*recorded, "--out", "again.mp4") == 0
    assert frames_in("again.mp4") >= 2
    np.savez("hill.npz", heights=np.zeros((3, 5)), size_m=[16.0, 8.0])
    assert film("--terrain", "hill.npz", *crossing) == 0
    recording = read_recording(f"runs/terrains/hill.npz-anymal-{name}.recording.npz")
    assert recording.labels == ("hill.npz",) and (recording.heights == 0).all()


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ("--elite 3", "elite 3"),
        ("--look.fps 0", "look.fps"),
        ("--look.episode 20", "episode"),
        ("--run runs/anymal-small-0 --terrain a.npz", "--terrain"),
        ("--terrain none.npz", "none.npz"),
        ("--terrain none.recording.npz", "none.recording.npz"),
        ("--robot cassie --run runs/anymal-small-0", "cassie"),
        ("--policy none.pt", "none.pt"),
    ],
)
def test_mistakes_are_refused_before_anything_is_crossed(run, capsys, flags, named):
    assert run_command(Film, [*flags.split(), "--device", "cpu"], name="film") == 2
    assert named in capsys.readouterr().err
    assert not list(run.glob("*.mp4")) and not list(run.glob("*.recording.npz"))


def test_without_opengl_nothing_is_crossed(run, capsys, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no_such_way")
    assert run_command(Film, ["--device", "cpu"], name="film") == 2
    assert "no_such_way" in capsys.readouterr().err
