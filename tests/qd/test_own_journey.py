"""A dog that the project does not ship, from its files to an archive and a controller, by documented commands alone.

Each stage begins with wrong steps, which must say what is wrong, end with a status, and change no file.
"""

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import faultline
from qd.archive import read_archive
from qd.commands import Archive
from qd.judge import judge
from qd.show.commands import Replay
from qd.workers.evaluator import Compute
from tests.builders import hashes
from tests.sim.dogs import KINDS, write_dog

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
CPU = ["--device", "cpu"]
SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "4", "--replicas", "2"]


def archive_command(path: Path, **named: str) -> None:
    """Goes on with a search, as a command line that names these does."""
    flags = Archive.defaults(["--resume", str(path)])
    replace(flags, resume=path, device="cpu", **named).execute()


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


@pytest.fixture
def wrong(home, capsys, monkeypatch):
    """Takes a wrong step: what it says of it must hold some words, and all files must stay as they are."""
    monkeypatch.chdir(home)

    def take(*argv: str, says: tuple[str, ...], status: int = 2) -> None:
        before = hashes(home)
        capsys.readouterr()
        try:
            ended = faultline.main([*argv])
        except SystemExit as end:  # of the parser of flags
            ended = end.code
        said = capsys.readouterr()
        text = " ".join((said.out + said.err if status == 1 else said.err).split())
        assert ended == status, text
        assert [part for part in says if part not in text] == [], text
        assert "Traceback" not in text
        after = hashes(home)
        assert {name for name in {*before, *after} if before.get(name) != after.get(name)} == set()

    return take


@contextmanager
def edited(file, old, new):
    """A file with a mistake in it, for a while."""
    whole = file.read_text()
    assert old in whole
    file.write_text(whole.replace(old, new))
    try:
        yield
    finally:
        file.write_text(whole)


@pytest.fixture(scope="module")
def project():
    """What the project's own folder of robots holds; it must be the same at the end."""
    before = {path: path.stat().st_mtime_ns for path in (ROOT / "sim" / "robots").iterdir()}
    yield
    assert {path: path.stat().st_mtime_ns for path in (ROOT / "sim" / "robots").iterdir()} == before


@pytest.fixture(scope="module")
def calibrated(project, home, robot, trot):
    """Scales, measured by a Ray worker, which has none of the dog's files but those it is sent."""
    return run("calibrate", *robot, *trot, "--terrains", "4", "--most-terrains", "4", "--workers", "ray:1")


@pytest.fixture(scope="module")
def searched(calibrated, home, robot, trot):
    """A run of two iterations in two processes."""
    path = home / "run"
    said = run("archive", *robot, *trot, *SIZE, "--iterations", "2", "--run-dir", str(path), "--workers", "2")
    return path, said


def test_wrong_files_are_refused_before_there_is_anything(home, wrong, robot):
    wrong("stan", *robot, says=("no command 'stan'", "stand"))
    wrong("stand", "--robt", robot[1], says=("--robt", "--robot"))
    wrong("stand", "--robot", "dig.py", says=("dig.py: no such file",))
    wrong("stand", "--robot", "dig", says=("unknown robot 'dig'", "anymal, cassie"))
    with edited(home / "dog.py", "dog.xml", "dig.xml"):
        wrong("stand", *robot, says=(f"{home}/dig.xml, no such file",))
    with edited(home / "dog.py", "contact_force_limit", "contact_limit"):
        wrong("stand", *robot, says=("contact_limit", "line 7"))
    with edited(home / "dog.py", "limit=150.0", 'limit="150"'):
        wrong("stand", *robot, says=("contact_force_limit must be a finite number, got '150'",))
    with edited(home / "dog.py", '("hip", "knee")', '("hip", "knie")'):
        wrong("stand", *robot, says=("FL_knie", "FL_knee"))
    with edited(home / "dog.xml", 'kp="60"', 'kp="60,0"'):
        wrong("stand", *robot, says=("dog.xml, line", 'kp="60,0"', "decimal point"))
    twin = write_dog(home / "twin", **KINDS["urdf"])
    with edited(home / "twin" / "dog.urdf", 'value="8.0"', 'value="8,0"'):
        wrong("stand", "--robot", str(twin), says=('dog.urdf, line 3: <mass value="8,0">', "decimal point"))
    with edited(twin, "stiffness=(60.0,) * 8", "stiffness=(60.0,) * 7"):
        wrong("stand", "--robot", str(twin), says=("stiffness", "8", "7"))
    with edited(home / "dog.py", "height=0.29", "height=0.9"):
        wrong("stand", *robot, *CPU, says=("default_base_height 0.291 is right, got 0.9",), status=1)


def test_nothing_is_measured_or_searched_with_what_is_not_there(home, wrong, robot, trot):
    small = [*robot, *CPU, "--terrains", "4"]
    wrong("archive", *robot, *trot, *CPU, says=("no penalty scales of robot 'dog'", f"calibrate --robot {robot[1]}"))
    wrong("calibrate", *small, says=("no shipped controller yet", f"{home}/dog.pt"))
    wrong("calibrate", *small, "--policy", "walk.pt", says=("policy 'walk.pt': no such file",))
    wrong("calibrate", *small, "--policy", "dog_trot.py", says=("dog_trot.py:CALLABLE",))
    wrong("calibrate", *small, "--policy", "dog_trot.py:Walk", says=("Walk", "dog_trot.py", "Trot"))
    wrong("calibrate", *robot, *trot, "--terains", "4", says=("--terains", "--terrains"))
    wrong("calibrate", *robot, *trot, *CPU, "--terrains", "0", says=("terrains must be at least 1, got 0",))
    wrong("calibrate", *robot, *trot, "--device", "gpu", says=("unknown device 'gpu'", "cpu"))
    with edited(home / "dog_trot.py", "    faultline_factory = True\n", ""):
        wrong("calibrate", *small, *trot, says=("class without the mark", "faultline_factory"))
    with edited(home / "dog_trot.py", "return legs.flatten(1)", "return legs.flatten(1)[:, 1:]"):
        wrong("calibrate", *small, *trot, says=("(num_envs, 8)", "(4, 7)"))
    with edited(home / "dog_trot.py", "return legs.flatten(1)", "return float('nan') * legs.flatten(1)"):
        wrong("calibrate", *small, *trot, says=("not finite",))
    wrong("evaluate", *robot, *CPU, "--policy", "walk.pt", says=("policy 'walk.pt': no such file",))
    wrong("replay", *robot, *trot, *CPU, says=("no archive of dog", "archive --robot"))


def test_its_scales_lie_beside_its_settings(calibrated, home):
    assert f"written to {home / 'dog.scales.json'}" in calibrated
    scales = json.loads((home / "dog.scales.json").read_text())
    assert (scales["robot"], scales["policy"], scales["terrains"]) == ("dog", "dog_trot.py:Trot", 4)
    assert list(scales["scales"]) == ["yaw_rate", "vel_x", "vel_y", "collision"]
    assert min(scales["scales"].values()) > 0


def test_no_search_begins_wrongly(calibrated, home, wrong, robot, trot):
    search = ["archive", *robot, *trot, *CPU, *SIZE, "--run-dir", "no"]
    wrong(*search[:-2], "--resume", "no", says=("no run at no",))
    wrong(*search, "--iterations", "0", says=("iterations", "0"))
    wrong(*search, "--presett", "small", says=("--presett", "--preset"))
    with edited(home / "dog.scales.json", '"scales": {', '"scales": [{'):
        wrong(*search, says=(f"{home}/dog.scales.json must be a JSON file",))
    with edited(home / "dog.scales.json", '"scales": {\n  "yaw_rate": ', '"scales": {\n  "yaw_rate": -'):
        wrong(*search, says=("no positive scale for yaw_rate", "calibrate"))
    with edited(home / "dog.xml", 'kp="60"', 'kp="50"'):
        wrong(*search, says=("dog.scales.json is of robot 'dog' as it was", "calibrate"))
    with edited(home / "dog.py", '"vel_y", ', '"vel_y", "stumble", '):
        wrong(*search, says=("dog.scales.json is of robot 'dog' as it was", "calibrate"))


def test_its_archive_is_that_of_its_own_penalties(searched, home, robot, trot):
    path, _ = searched
    archive = read_archive(path)
    assert archive.robot == "dog" and archive.iterations == 2 and len(archive) >= 1
    assert archive.penalties == ("yaw_rate", "vel_x", "vel_y", "collision")
    assert np.isfinite(archive.fitness).all()
    config = json.loads((path / "config.json").read_text())
    assert len(config["settings"]["robot_sha256"]) == len(config["settings"]["policy_sha256"]) == 64


def test_wrong_steps_with_its_run(searched, home, wrong, robot, trot):
    run, who = ["--run", "run"], [*robot, *trot, *CPU]
    resume = ["archive", *who, "--workers", "1", "--resume", "run"]
    wrong(*resume, "--iterations", "1", says=("iterations must be at least 2", "got 1"))
    wrong(*resume, "--scheduler.emitters", "2", says=("scheduler.emitters (1 there, 2 wanted)",))
    wrong("archive", *who, *SIZE, "--scheduler.emitters", "2", "--run-dir", "run", says=("scheduler.emitters",))
    of_run = {
        "archive": (*resume, "--iterations", "3"),
        "replay": ("replay", *who, *run),
        "film": ("film", *who, *run),
        "judge": ("judge", *who, *run),
        "report": ("report", *who, *run),
        "export": ("export", *robot, *run, "--elite", "0"),
        "evaluate": ("evaluate", *robot, *CPU, "--archive", "run"),
    }
    with edited(home / "dog.xml", 'kp="60"', 'kp="50"'):
        for words in of_run.values():
            wrong(*words, says=("run is of robot 'dog' as it was", "put back"))
    for name in ("archive", "replay", "report"):  # an export is of the archive alone
        with edited(home / "run" / "config.json", '"settings": {', '"settings": {{'):
            wrong(*of_run[name], says=("run/config.json must be a JSON file",))
    for name in ("replay", "film", "export"):
        wrong(*of_run[name][:1], *who[: 2 if name == "export" else None], *run, "--elite", "99", says=("no elite 99",))
    wrong("replay", *who, "--run", "rum", says=("no archive at rum",))
    wrong("cross", *who, "--terrain", "hill.png", says=("no heightmap at hill.png",))
    wrong("finetune", *who, "--archive", "run", says=("rsl_rl checkpoint", "dog_trot.py:Trot", "train --robot"))


def test_an_export_is_not_replaced_unasked(searched, home, wrong, robot):
    path, _ = searched
    assert faultline.main(["export", *robot, "--run", str(path), "--elite", "0"]) == 0
    wrong(
        "export", *robot, "--run", "run", "--elite", "0", says=("run/terrains holds an export already", "--overwrite")
    )


def test_an_elite_is_replayed(searched, robot, trot):
    path, _ = searched
    said = run("replay", *robot, *trot, "--run", str(path), "--replicas", "4")
    assert "of dog, found in iteration" in said
    assert (path / "elite-0.png").exists()


def test_it_goes_on_only_if_robot_and_controller_are_named_and_are_what_they_were(searched, home, robot, trot):
    path, _ = searched

    def refused(message, **named):
        with pytest.raises(ValueError, match=message):
            archive_command(path, **named)

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
        lambda: Replay(robot=robot[1], run=tmp_path, device="cpu").execute(),
        lambda: archive_command(tmp_path),
        lambda: archive_command(tmp_path, robot=robot[1]),
        lambda: judge(tmp_path, compute=Compute()),
    ):
        with pytest.raises(ValueError, match=r"not shipped|which is code|is of .*evil"):
            command()
    assert not (tmp_path / "it_ran").exists()


def test_it_is_trained_and_evaluated(project, calibrated, searched, home, wrong, robot):
    sizes = ["--num-envs", "6", "--iterations", "2", "--ppo.hidden-dims", "16", "8", "--ppo.steps-per-env", "4"]
    where = ["--run-dir", str(home / "training"), "--export", str(home / "dog.pt")]
    run("train", *robot, *sizes, *where)
    wrong("train", *robot, *sizes, *CPU, "--export", "dog.pt", says=("dog.pt", "--overwrite"))
    wrong("train", *robot, *sizes, *CPU, *where[:2], says=("training",))
    wrong("archive", *robot, *CPU, "--resume", "run", says=("policy",))
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
