"""A dog that the project does not ship, from its files to an archive and a controller, by documented commands alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import faultline
from qd.archive import read_archive
from tests.builders import hashes
from tests.sim.dogs import write_dog

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "4", "--replicas", "2"]


def run(*words: str) -> str:
    """What a command prints; on the CPU, in the project's folder, as README has it."""
    command = [sys.executable, "-m", "faultline", *words, "--device", "cpu"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder of the dog, outside of the project, whose own folder of robots must stay as it is."""
    before = {path: path.stat().st_mtime_ns for path in (ROOT / "sim" / "robots").iterdir()}
    folder = tmp_path_factory.mktemp("mine")
    write_dog(folder)
    yield folder
    assert {path: path.stat().st_mtime_ns for path in (ROOT / "sim" / "robots").iterdir()} == before


@pytest.fixture(scope="module")
def robot(home):
    return ["--robot", str(home / "dog.py")]


@pytest.fixture(scope="module")
def trot(home):
    return ["--policy", f"{home}/dog_trot.py:Trot"]


@pytest.fixture
def refused(home, capsys, monkeypatch):
    """Takes a wrong step: a line that names what is wrong, a status, no traceback, and no file changed."""
    monkeypatch.chdir(home)

    def take(*argv: str, names: str) -> None:
        before = hashes(home)
        capsys.readouterr()
        try:
            status = faultline.main([*argv, "--device", "cpu"])
        except SystemExit as end:  # of the parser of flags
            status = end.code
        said = capsys.readouterr().err
        assert status == 2 and names in said and "Traceback" not in said, said
        assert hashes(home) == before

    return take


@pytest.fixture(scope="module")
def calibrated(home, robot, trot):
    """Scales, measured by a Ray worker, which has none of the dog's files but those it is sent."""
    run("calibrate", *robot, *trot, "--terrains", "4", "--most-terrains", "4", "--workers", "ray:1")
    return json.loads((home / "dog.scales.json").read_text())


@pytest.fixture(scope="module")
def searched(calibrated, home, robot, trot):
    """A run of two iterations in two processes."""
    path = home / "run"
    run("archive", *robot, *trot, *SIZE, "--iterations", "2", "--run-dir", str(path), "--workers", "2")
    return path


def test_wrong_steps_before_there_is_anything(home, refused, robot, trot):
    refused("stan", *robot, names="stand")
    refused("stand", "--robt", robot[1], names="--robot")
    refused("stand", "--robot", "dig.py", names="dig.py")
    refused("archive", *robot, *trot, names="calibrate --robot")
    refused("calibrate", *robot, "--terrains", "4", names="dog.pt")
    refused("calibrate", *robot, "--terrains", "4", "--policy", "dog_trot.py:Walk", names="Walk")
    refused("replay", *robot, *trot, names="no archive of dog")


def test_its_scales_lie_beside_its_settings(calibrated):
    assert (calibrated["robot"], calibrated["policy"], calibrated["terrains"]) == ("dog", "dog_trot.py:Trot", 4)
    assert list(calibrated["scales"]) == ["yaw_rate", "vel_x", "vel_y", "collision"]
    assert min(calibrated["scales"].values()) > 0


def test_its_archive_is_that_of_its_own_penalties(searched):
    archive = read_archive(searched)
    assert archive.robot == "dog" and archive.iterations == 2 and len(archive) >= 1
    assert archive.penalties == ("yaw_rate", "vel_x", "vel_y", "collision")
    assert np.isfinite(archive.fitness).all()
    settings = json.loads((searched / "config.json").read_text())["settings"]
    assert len(settings["robot_sha256"]) == len(settings["policy_sha256"]) == 64


def test_an_elite_is_replayed_and_exported_once(searched, robot, trot, refused):
    run("replay", *robot, *trot, "--run", str(searched), "--replicas", "4")
    assert (searched / "elite-0.png").exists()
    export = ["export", *robot, "--run", str(searched), "--elite", "0"]
    assert faultline.main(export) == 0
    assert faultline.main(export) == 2  # it is not replaced unasked


def test_it_goes_on_only_if_robot_and_controller_are_named_and_are_what_they_were(searched, home, robot, trot, refused):
    resume = ["archive", "--resume", str(searched)]
    refused(*resume, *trot, names="not shipped")
    refused(*resume, "--robot", "anymal", *trot, names="anymal")
    refused(*resume, *robot, names="dog_trot.py:Trot")
    for file, old, new, names in (
        (home / "dog.xml", 'mass="8"', 'mass="9"', "changed"),
        (home / "dog_trot.py", "0.35", "0.3", "policy_sha256"),
    ):
        whole = file.read_text()
        file.write_text(whole.replace(old, new))
        refused(*resume, *robot, *trot, names=names)
        file.write_text(whole)
    run(*resume, *robot, *trot, "--iterations", "3", "--workers", "1")
    assert read_archive(searched).iterations == 3


def test_a_run_that_is_handed_over_runs_nothing_of_its_own(searched, tmp_path, robot, refused):
    os.symlink(searched / "archive.npz", tmp_path / "archive.npz")
    config = json.loads((searched / "config.json").read_text())
    (tmp_path / "evil.py").write_text(f"open('{tmp_path}/it_ran', 'w').close()\n")
    settings = {**config["settings"], "robot": f"{tmp_path}/evil.py", "policy": f"{tmp_path}/evil.py:act"}
    (tmp_path / "config.json").write_text(json.dumps({**config, "settings": settings}))
    for words in (
        ("replay", *robot, "--run", str(tmp_path)),
        ("archive", "--resume", str(tmp_path)),
        ("archive", *robot, "--resume", str(tmp_path)),
        ("judge", "--run", str(tmp_path)),
    ):
        refused(*words, names="")
    assert not (tmp_path / "it_ran").exists()


def test_it_is_trained_and_evaluated(calibrated, home, robot, refused):
    sizes = ["--num-envs", "6", "--iterations", "2", "--ppo.hidden-dims", "16", "8", "--ppo.steps-per-env", "4"]
    where = ["--run-dir", str(home / "training"), "--export", str(home / "dog.pt")]
    run("train", *robot, *sizes, *where)
    refused("train", *robot, *sizes, "--export", "dog.pt", names="dog.pt")
    record = json.loads((home / "dog.train.json").read_text())
    assert record["robot"] == "dog" and record["iterations"] == 2 and len(record["settings"]["robot_sha256"]) == 64
    # Its own controller from now on, which needs no naming.
    out = home / "rates.json"
    run("evaluate", *robot, "--terrains", "2", "--episodes", "1", "--out", str(out))
    report = json.loads(out.read_text())
    assert (report["robot"], report["policy"]) == ("dog", "dog.pt")
    assert report["hand_crafted"]["goal_rate"] == 0.0  # after two iterations
    tables = ["--policies", f"base=shipped trot={home}/dog_trot.py:Trot", "--sets", "hand_crafted"]
    run("evaluate", *robot, *tables, "--terrains", "2", "--episodes", "1", "--out", str(home / "tables.json"))
    crossed = json.loads((home / "tables.json").read_text())
    assert crossed["robot"] == "dog" and set(crossed["controllers"]) == {"base", "trot"}
