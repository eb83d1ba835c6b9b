"""A dog that the project does not ship, from its files to an archive and a controller, by documented commands alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive
from qd.fresh import Reevaluate, reevaluate_run
from qd.run.arguments import Archive, job_of
from qd.show.replay import ReplayElite, replay
from tests.sim.dogs import write_dog

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
SIZE = ["--emitters", "1", "--batch-size", "4", "--replicas", "2"]


def run(*words: str) -> str:
    """What a command prints; on the CPU, in the project's folder, as README has it."""
    command = [sys.executable, "-m", "faultline", *words, "--device", "cpu"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder of the dog, outside of the project."""
    folder = tmp_path_factory.mktemp("mine")
    write_dog(folder)
    return folder


@pytest.fixture(scope="module")
def robot(home):
    return ["--robot", str(home / "dog.py")]


@pytest.fixture(scope="module")
def trot(home):
    return ["--policy", f"{home}/dog_trot.py:Trot"]


@pytest.fixture(scope="module")
def project():
    """What the project's own folder of robots holds; it must be the same at the end."""
    before = {path: path.stat().st_mtime_ns for path in (ROOT / "sim" / "robots").iterdir()}
    yield
    assert {path: path.stat().st_mtime_ns for path in (ROOT / "sim" / "robots").iterdir()} == before


@pytest.fixture(scope="module")
def calibrated(project, home, robot, trot):
    """Scales, measured by a Ray worker, which has none of the dog's files but those it is sent."""
    return run("calibrate", *robot, *trot, "--terrains", "4", "--replicas", "2", "--workers", "ray:1")


@pytest.fixture(scope="module")
def searched(calibrated, home, robot, trot):
    """A run of two iterations in two processes."""
    path = home / "run"
    said = run("archive", *robot, *trot, *SIZE, "--iterations", "2", "--run-dir", str(path), "--workers", "2")
    return path, said


def test_its_scales_lie_beside_its_settings(calibrated, home):
    assert f"written to {home / 'dog.scales.json'}" in calibrated
    scales = json.loads((home / "dog.scales.json").read_text())
    assert (scales["robot"], scales["policy"], scales["terrains"]) == ("dog", "dog_trot.py:Trot", 4)
    assert list(scales["scales"]) == ["yaw_rate", "vel_x", "vel_y", "collision"]
    assert min(scales["scales"].values()) > 0


def test_its_archive_is_that_of_its_own_penalties(searched, home, robot, trot):
    path, said = searched
    archive = read_archive(path)
    assert archive.robot == "dog" and archive.iterations == 2 and len(archive) >= 1
    assert archive.penalties == ("yaw_rate", "vel_x", "vel_y", "collision")
    assert np.isfinite(archive.fitness).all()
    config = json.loads((path / "config.json").read_text())
    assert config["robot_file"] == str(home / "dog.py")
    assert len(config["settings"]["robot_sha256"]) == len(config["settings"]["policy_sha256"]) == 64
    assert f"replay --robot {home}/dog.py --run {path} --elite 0 --policy {trot[1]}" in said


def test_an_elite_is_replayed(searched, robot, trot):
    path, _ = searched
    said = run("replay", *robot, *trot, "--run", str(path), "--replicas", "4")
    assert "of dog, found in iteration" in said
    assert (path / "elite-0.png").exists()


def test_it_goes_on_only_if_robot_and_controller_are_named_and_are_what_they_were(searched, home, robot, trot):
    path, _ = searched

    def refused(message, **named):
        with pytest.raises(ValueError, match=message):
            job_of(Archive(resume=path, device="cpu", **named))

    dog, policy = robot[1], trot[1]
    refused("is of robot 'dog', which is not shipped: name its settings file too", policy=policy)
    refused("is of dog, got --robot anymal", robot="anymal", policy=policy)
    refused(r"which is code: name it again \(--policy .*dog_trot.py:Trot\)", robot=dog)
    model, code = home / "dog.xml", home / "dog_trot.py"
    whole, gait = model.read_text(), code.read_text()
    model.write_text(whole.replace('mass="8"', 'mass="9"'))
    refused("is of robot 'dog' as it was: its settings, model or meshes have changed", robot=dog, policy=policy)
    model.write_text(whole)
    code.write_text(gait.replace("0.35", "0.3"))
    refused("other settings: policy_sha256", robot=dog, policy=policy)
    code.write_text(gait)
    run("archive", *robot, *trot, "--resume", str(path), "--iterations", "3", "--workers", "1")
    assert read_archive(path).iterations == 3


def test_a_run_that_is_handed_over_runs_nothing_of_its_own(searched, tmp_path, home, robot, trot):
    path, _ = searched
    os.symlink(path / "archive.npz", tmp_path / "archive.npz")
    config = json.loads((path / "config.json").read_text())
    (tmp_path / "evil.py").write_text(f"open('{tmp_path}/it_ran', 'w').close()\n")
    settings = {**config["settings"], "robot": f"{tmp_path}/evil.py", "policy": f"{tmp_path}/evil.py:act"}
    (tmp_path / "config.json").write_text(json.dumps({**config, "settings": settings}))
    for command in (
        lambda: replay(ReplayElite(robot=robot[1], run=tmp_path, device="cpu")),
        lambda: job_of(Archive(resume=tmp_path, device="cpu")),
        lambda: job_of(Archive(resume=tmp_path, robot=robot[1], device="cpu")),
        lambda: reevaluate_run(Reevaluate(run=tmp_path, device="cpu")),
    ):
        with pytest.raises(ValueError, match=r"not shipped|which is code|is of .*evil"):
            command()
    assert not (tmp_path / "it_ran").exists()


def test_it_is_trained_and_evaluated(project, calibrated, home, robot):
    sizes = ["--num-envs", "6", "--iterations", "2", "--ppo.hidden-dims", "16", "8", "--ppo.steps-per-env", "4"]
    where = ["--run-dir", str(home / "training"), "--export", str(home / "dog.pt")]
    run("train", *robot, *sizes, *where)
    record = json.loads((home / "dog.train.json").read_text())
    assert record["robot"] == "dog" and record["iterations"] == 2 and len(record["settings"]["robot_sha256"]) == 64
    # Its own controller from now on, which needs no naming.
    out = home / "rates.json"
    run("evaluate", *robot, "--terrains", "2", "--episodes", "1", "--out", str(out))
    report = json.loads(out.read_text())
    assert (report["robot"], report["policy"]) == ("dog", "dog.pt")
    assert report["hand_crafted"]["goal_rate"] == 0.0  # after two iterations
    tables = ["--policies", f"base=shipped trot={home}/dog_trot.py:Trot", "--sets", "hand_crafted"]
    run("evaluate", *robot, *tables, "--terrains", "2", "--episodes", "1", "--run-dir", str(home / "tables"))
    crossed = json.loads((home / "tables" / "tables.json").read_text())
    assert crossed["robot"] == "dog" and set(crossed["controllers"]) == {"base", "trot"}
