"""film, export and cross from the command line to their files, and every mistake named."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kernels.episode import Invalidity, Outcome
from qd.archive import write_archive
from qd.show.cross import Cross, cross, describe, numbers_of
from qd.show.crossed import crossed_of
from qd.show.elites import find_archive
from qd.show.export import Export, export
from qd.show.film import Film, make_films
from qd.show.recordings import Recordings, on_elite
from sim.bank import heights_of
from sim.files.command import run_command
from sim.maps.heightmap import as_terrain, read_heightmap
from sim.recording.file import read_recording
from sim.recording.recorder import record
from sim.recording.renderer import open_context
from sim.rollout import Rollout
from tests.builders import fresh_values, small_archive
from tests.qd.recordings import NAMES, recording_of

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

pytestmark = pytest.mark.usefixtures("in_a_folder_of_its_own")
SCALES = (1.0, 1.0, 1.0, 900.0, 0.03, 0.1)


def refused(capsys, command, argv):
    """The line that a command ends with."""
    assert run_command(command, argv, name="it") == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    return line.removeprefix("error: ")


@pytest.fixture
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def run(in_a_folder_of_its_own):
    """The newest run: three elites, with what fresh episodes say."""
    folder = Path("runs/anymal-small-0")
    folder.mkdir(parents=True)
    archive = small_archive(3)
    write_archive(folder / "archive.npz", archive.corrected_by(fresh_values(archive)))
    return folder


def test_an_elite_is_recorded_in_the_episodes_that_a_rollout_has(run):
    found = find_archive("anymal", run / "archive.npz")
    policy = "tests.sim.policies:stretch"
    wanted = [on_elite(found.archive, k, policy=policy, replicas=4) for k in (2, 1)]
    recordings = Recordings(found.robot).all_of(wanted)
    assert [one.labels for one in recordings] == [("elite 2 of anymal",), ("elite 1 of anymal",)]
    assert recordings[1].origin["policy"] == policy
    rollout = Rollout(found.robot, policy, num_terrains=2, num_replicas=4, device="cpu")  # side by side
    seeds = np.array([one.terrain_seed for one in wanted], np.uint32)
    result, both = record(rollout, found.archive.genes[[2, 1]], seeds, policy=policy)
    for k, recording in enumerate(recordings):
        for name in ("penalties", "outcome", "duration_s", "fallen"):
            np.testing.assert_array_equal(getattr(recording.result(), name)[0], getattr(result, name)[k])
        np.testing.assert_allclose(recording.result().final_position[0], result.final_position[k], atol=0.05)
        np.testing.assert_array_equal(both.of_terrain(k).qpos(0, 3), recording.qpos(0, 3))
        assert both.of_terrain(k).base_position.shape == recording.base_position.shape


@pytest.fixture
def opengl():
    try:
        open_context(16, 16).free()
    except ValueError as error:
        pytest.skip(str(error))


def frames_in(path):
    return imageio_ffmpeg.count_frames_and_secs(str(path))[0]


@pytest.mark.slow
def test_films_of_elites_and_of_their_recordings(opengl, run, capsys):
    cfg = Film(elite="0 2", policy="tests.sim.policies:stand", device="cpu", replicas=4, fps=1, shadows=False, seed=3)
    films = make_films(cfg)
    name = "tests.sim.policies-stand"  # not the search's
    assert films == [run / f"elite-0-{name}.mp4", run / f"elite-2-{name}.mp4"]
    recording = read_recording(run / f"elite-2-{name}.recording.npz")
    assert recording.outcome.shape == (1, 4) and recording.origin["seed"] == 3
    # A robot that stands is out of time after 20 s, or has fallen before: a picture a second, its end, and that held.
    last = float(np.median(recording.num_frames)) - 1
    assert abs(frames_in(run / f"elite-2-{name}.mp4") - (np.ceil(last * 0.02) + 2)) <= 1
    kept = run / f"elite-2-{name}.recording.npz"
    again = Film(recording=kept, out=Path("again.mp4"), replica=1, fps=1, shadows=False)
    assert make_films(again) == [Path("again.mp4")]
    assert frames_in("again.mp4") >= 2
    assert "Film: again.mp4" in capsys.readouterr().out


@pytest.mark.slow
def test_a_film_of_ones_own_terrain(opengl):
    np.savez("hill.npz", heights=np.zeros((3, 5)), size_m=[16.0, 8.0])
    films = make_films(
        Film(
            terrain=Path("hill.npz"), policy="tests.sim.policies:stand", device="cpu", replicas=4, fps=1, shadows=False
        )
    )
    assert films == [Path("runs/terrains/hill.npz-anymal-tests.sim.policies-stand.mp4")]
    recording = read_recording("runs/terrains/hill.npz-anymal-tests.sim.policies-stand.recording.npz")
    assert recording.labels == ("hill.npz",) and (recording.heights == 0).all()


def test_mistakes_are_named_before_anything_is_crossed(run, capsys, monkeypatch):
    def failed(*argv):
        return refused(capsys, Film, argv)

    assert failed("--elite", "3") == "runs/anymal-small-0 has no elite 3: expected all, or numbers of 0 to 2"
    assert failed("--fps", "0") == "fps must be at least 1 and at most 50, got 0"
    assert failed("--replica", "20") == "replica must be one of 0..19, got 20"
    assert failed("--terrain", "a.npz", "--recording", "b.npz") == "give one of --run, --terrain and --recording"
    assert failed("--terrain", "none.npz").startswith("no heightmap at none.npz")
    assert "no recording at none.npz" in failed("--recording", "none.npz")
    assert "is of anymal, got --robot cassie" in failed("--robot", "cassie", "--run", str(run))
    assert "no such file" in failed("--policy", "none.pt")
    assert not list(run.glob("*.mp4")) and not list(run.glob("*.recording.npz"))
    monkeypatch.setenv("MUJOCO_GL", "no_such_way")
    assert "pictures need OpenGL without a screen, but 'no_such_way' does not work here" in failed()


def test_elites_are_exported_as_the_simulation_has_them(run, capsys):
    archive = find_archive("anymal", run).archive
    files = export(Export(elite="2 1"))
    folder = run / "terrains"
    endings = ("npz", "png", "xml", "stl", "json")
    expected = [*(f"elite-{k}.{ending}" for k in (2, 1) for ending in endings), "index.json"]
    assert [path.name for path in files] == expected and sorted(expected) == sorted(p.name for p in folder.iterdir())
    for elite in (1, 2):
        heights = heights_of(archive.genes[elite : elite + 1])[0]
        np.testing.assert_array_equal(as_terrain(read_heightmap(folder / f"elite-{elite}.npz")), heights)
        about = json.loads((folder / f"elite-{elite}.json").read_text())
        read = as_terrain(read_heightmap(folder / f"elite-{elite}.png"))
        np.testing.assert_allclose(read, heights, rtol=0, atol=0.51 * about["scale_m"] + 1e-7)
        assert (about["elite"], about["robot"]) == (elite, "anymal")
        assert about["fitness"] == archive.fitness[elite] and about["fresh"]["episodes"] == 40
        assert about["ratios"] == dict(zip(archive.penalties, archive.ratios[elite].tolist(), strict=True))
        assert {"command", "commit", "versions", "date", "run"} <= about.keys() and "seed" not in about
    index = json.loads((folder / "index.json").read_text())
    assert [(row["elite"], row["files"]) for row in index["elites"]] == [(2, "elite-2"), (1, "elite-1")]
    assert "2 elites as npz, png, xml, stl: runs/anymal-small-0/terrains" in capsys.readouterr().out


def test_a_whole_archive_in_some_formats_elsewhere(run, monkeypatch):
    monkeypatch.setattr("qd.show.export._AT_ONCE", 4)
    write_archive(run / "archive.npz", small_archive(10))
    export(Export(elite="all", formats=("npz png",), out=Path("out")))
    assert len(list(Path("out").glob("*.npz"))) == len(list(Path("out").glob("*.png"))) == 10
    assert not list(Path("out").glob("*.stl"))
    heights = heights_of(small_archive(10).genes[9:])[0]
    np.testing.assert_array_equal(as_terrain(read_heightmap("out/elite-9.npz")), heights)
    assert json.loads(Path("out/elite-9.json").read_text())["fresh"] is None


def test_mistakes_of_an_export(run, capsys, monkeypatch):
    def failed(*argv):
        return refused(capsys, Export, argv)

    assert failed("--formats", "obj") == "formats must be some of npz, png, xml, stl, got obj"
    assert "has no elite 9" in failed("--elite", "0 9")
    assert "cannot write to" in failed("--out", str(run / "archive.npz" / "x"))
    monkeypatch.setattr("shutil.disk_usage", lambda folder: type("Usage", (), {"free": 1000})())
    assert "has room for 0 MB, but 3 elites as npz, png, xml, stl take about 18 MB" in failed("--elite", "all")
    assert not list(run.rglob("elite-*"))


def test_rates_of_ones_own_terrain_with_their_intervals(capsys):
    gray = np.zeros((81, 161), np.uint8)
    gray[:, 100:] = 200  # a wall of 2 m before the goal
    Image.fromarray(gray).save("wall.png")
    report = cross(
        Cross(
            terrain=Path("wall.png"), size=("16 8",), scale=0.01, policy="tests.sim.policies:stand", device="cpu",
            episodes=4, out=Path("numbers.json"),
        )
    )  # fmt: skip
    written = json.loads(Path("numbers.json").read_text())
    assert written == json.loads(json.dumps(report))
    # It stands where it starts: no collision, no goal. Wilson of 4 of 4: 1 / (1 + 3.8415 / 4) = .5101
    assert report["rates"]["success"] == {"rate": 1.0, "hits": 4, "interval": [pytest.approx(0.5101, abs=1e-4), 1.0]}
    assert report["rates"]["goal"] == {"rate": 0.0, "hits": 0, "interval": [0.0, pytest.approx(0.4899, abs=1e-4)]}
    assert report["outcomes"] == {"goal": 0, "base_collision": 0, "time_out": 4, "out": 0, "invalid": 0}
    assert report["heights_m"] == [0.0, 2.0] and report["map"] == "161 x 81 nodes over 16 x 8 m, heights 0.00 to 2.00 m"
    assert report["duration_s"] == 20.0
    # 20 s at rest against 0.75 m/s: 20 * 0.75^2
    assert report["penalties"]["vel_x"]["mean"] == pytest.approx(11.25, rel=0.1)
    assert {
        "command",
        "commit",
        "device",
        "versions",
        "seed",
        "date",
        "policy_sha256",
        "terrain_sha256",
    } <= report.keys()
    text = capsys.readouterr().out
    assert "wall.png: 161 x 81 nodes over 16 x 8 m, heights 0.00 to 2.00 m" in text
    assert "anymal with tests.sim.policies:stand on wall.png, 4 episodes" in text
    assert " ".join(text.split()).count("goal reached 0 of 4 (0%, 0 to 49%)") == 1
    assert Image.open("numbers-paths.png").size[0] > 1000


def test_files_of_another_controller_are_named_after_it():
    np.savez("hill.npz", heights=np.zeros((3, 5)), size_m=[16.0, 8.0])
    cross(Cross(terrain=Path("hill.npz"), policy="tests.sim.policies:stand", device="cpu", episodes=4))
    assert sorted(path.name for path in Path("runs/terrains").iterdir()) == [
        "hill.npz-anymal-tests.sim.policies-stand-paths.png", "hill.npz-anymal-tests.sim.policies-stand.json"
    ]  # fmt: skip


def test_invalid_episodes_are_left_out_of_the_rates():
    ends = [Outcome.BASE_COLLISION, Outcome.GOAL, Outcome.INVALID]
    sums = np.repeat([[1.0], [3.0], [np.nan]], 6, axis=1)
    made = recording_of(ends, [4.0, 14.0, 3.0], penalties=sums, fallen=[False, False, True])
    made = dataclasses.replace(
        made, duration_s=np.array([[4.0, 16.0, 1.0]]), invalidity=np.array([[0, 0, Invalidity.SPEED]], np.uint8)
    )
    numbers = numbers_of(crossed_of(made, NAMES, (1.0,) * 6))
    assert {name: rate["hits"] for name, rate in numbers["rates"].items()} == {"success": 1, "goal": 1, "fallen": 0}
    assert numbers["duration_s"] == 10.0 and numbers["penalties"]["vel_x"] == {
        "mean": 2.0,
        "std": 1.0,
        "unit": "(m/s)^2 s",
    }
    assert numbers["invalid_episodes"] == 1 and numbers["outcomes"]["invalid"] == 1
    text = describe({"robot": "anymal", "policy": "mine.pt", "terrain": "hill.npz", **numbers})
    assert "1 of 2 (50%, 9 to 91%)" in text and "1 invalid episodes are left out: 1 too fast" in text
    broken = dataclasses.replace(
        made, outcome=np.full((1, 3), Outcome.INVALID, np.uint8), invalidity=np.full((1, 3), Invalidity.SPEED, np.uint8)
    )
    numbers = numbers_of(crossed_of(broken, NAMES, (1.0,) * 6))
    assert numbers["rates"]["goal"] == {"rate": None, "hits": 0, "interval": None} and numbers["duration_s"] is None
    assert "no valid episode" in describe({"robot": "anymal", "policy": "mine.pt", "terrain": "hill.npz", **numbers})


def test_mistakes_with_ones_own_terrain(capsys):
    def failed(*argv):
        return refused(capsys, Cross, argv)

    np.savez("hill.npz", heights=np.zeros((3, 5)))
    assert "hill.npz: how large is it? give --size X Y" in failed("--terrain", "hill.npz")
    assert "two lengths of 1 to 100 m" in failed("--terrain", "hill.npz", "--size", "16")
    assert failed("--terrain", "hill.npz", "--size", "a b").startswith(
        "size must be two lengths in metres such as 16 8"
    )
    given = ("--terrain", "hill.npz", "--size", "16", "8")
    assert "episodes must be at least 1" in failed(*given, "--episodes", "0")
    assert "unknown robot" in failed(*given, "--robot", "dog")
    assert "no such file" in failed(*given, "--policy", "none.pt")
    Image.fromarray(np.zeros((3, 5), np.uint8)).save("hill.png")
    Path("hill.json").write_text('{"scale_m": 0.01, "size_m": [16, 8]}')
    before = {path.name: path.read_bytes() for path in Path().glob("hill.*")}
    assert "would overwrite the map" in failed("--terrain", "hill.png", "--out", "hill.json")
    assert {path.name: path.read_bytes() for path in Path().glob("hill.*")} == before
    assert not Path("runs").exists() or not list(Path("runs").rglob("*.json"))


@pytest.mark.parametrize(
    ("name", "taught"),
    [("film", "--ghosts"), ("export", "MJCF"), ("cross", "seen from above"), ("replay", "--device"), ("report", "HTML"),
     ("view", "ssh -L")],
)  # fmt: skip
def test_help_teaches_and_is_fast(name, taught):
    code = f"""
import sys, faultline
try:
    faultline.main(["{name}", "--help"])
finally:
    slow = ("torch", "warp", "newton", "mujoco", "imageio_ffmpeg", "matplotlib", "scipy", "viser", "ribs")
    print("slow imports:", [name for name in slow if name in sys.modules])
"""
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=True)
    assert taught in " ".join(done.stdout.split())
    assert "slow imports: []" in done.stdout
