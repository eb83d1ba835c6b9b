"""A robot, controller or definition of the penalties that is another now: every reader says so and changes nothing."""

import dataclasses
import json
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.commands import Archive, Evaluate, Judge
from qd.judge import judge
from qd.run.presets import SchedulerCfg
from qd.show.commands import Export, Film, Replay
from qd.show.elites import find_archive
from qd.show.recordings import Recordings, on_elite
from qd.show.report.command import Report
from qd.show.view.command import View
from qd.workers.evaluator import Compute
from sim.files.command import run_command
from sim.files.records import identity, robot_digest
from sim.recording.file import write_recording
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.robots.shipped import ROBOTS
from tests.builders import hashes, rsl_rl_actor, save_checkpoint
from tests.qd import stand_in
from tests.qd.searches import crossing_by, without_figures
from tests.qd.show.view.made import make_recording
from tests.sim.dogs import KINDS, write_dog
from train.cfg import TrainCfg
from train.commands import Finetune
from train.ppo.training import check_settings, settings_of

SIZE = {"scheduler": SchedulerCfg(emitters=1, batch_size=4), "replicas": 2, "iterations": 1, "device": "cpu"}
NAMES = ("yaw_rate", "vel_x", "vel_y", "collision")


@contextmanager
def open_dog(cfg):
    """The stand-in with the dog's four penalties."""

    def evaluate(genes, seeds, progress=None):
        result = stand_in.evaluate(genes, seeds, cfg.num_replicas)
        return dataclasses.replace(result, penalties=result.penalties[..., :4], penalty_names=NAMES)

    yield evaluate


@pytest.fixture
def dog(tmp_path, monkeypatch):
    """The dog's settings, beside them its controller's scales, and a run of it."""
    monkeypatch.chdir(tmp_path)
    without_figures(monkeypatch)
    file = write_dog(tmp_path / "mine", **KINDS["urdf"])
    (tmp_path / "mine" / "bad.py").write_text(
        "from dog_trot import Trot as First\n\n\nclass Trot(First):\n    faultline_factory = True\n"
    )
    robot, policy = get_robot(str(file)), trot(file)
    content = {**identity(robot, policy), "scales": dict.fromkeys(NAMES, 1.0)}
    robot.scales_file.write_text(json.dumps(content))
    search(robot=str(file), policy=policy, run_dir=Path("runs/dog"))
    return file


def search(**flags) -> None:
    with crossing_by(open_dog):
        Archive(**SIZE, **flags).execute()


def trot(file: Path) -> str:
    return f"{file.parent}/dog_trot.py:Trot"


def change_robot(file: Path) -> None:
    """Softer joints and a lower limit of the feet's forces, under the same name."""
    text = file.read_text()
    assert "stiffness=(60.0,)" in text and "contact_force_limit=150.0" in text
    text = text.replace("stiffness=(60.0,)", "stiffness=(24.0,)").replace("limit=150.0", "limit=15.0")
    file.write_text(text)


def refused(capsys, command, *argv: str) -> str:
    """The line that a command ends with, which must change no file."""
    before = hashes(Path())
    capsys.readouterr()
    assert run_command(command, argv, name="it") == 2
    assert hashes(Path()) == before
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("error: ")


READERS = {
    "archive --resume": (Archive, ("--resume", "runs/dog", "--device", "cpu", "--policy")),
    "judge": (Judge, ("--run", "runs/dog", "--device", "cpu", "--policy")),
    "replay": (Replay, ("--run", "runs/dog", "--device", "cpu", "--policy")),
    "film": (Film, ("--run", "runs/dog", "--device", "cpu", "--policy")),
    "report": (Report, ("--run", "runs/dog", "--device", "cpu", "--policy")),
    "view": (View, ("--run", "runs/dog")),
    "export": (Export, ("--run", "runs/dog")),
    "an archive alone": (Export, ("--run", "alone.npz")),
    "finetune": (Finetune, ("--archive", "runs/dog", "--device", "cpu", "--policy")),
    "evaluate": (Evaluate, ("--archive", "runs/dog", "--device", "cpu")),
}


@pytest.fixture
def without_gl(monkeypatch):
    """No film is drawn here, so no OpenGL is needed."""
    monkeypatch.setattr("sim.recording.renderer.open_context", lambda *_: SimpleNamespace(free=lambda: None))


@pytest.mark.usefixtures("without_gl")
def test_no_command_takes_a_run_of_the_robot_before_it_changed(dog, capsys):
    Path("alone.npz").write_bytes(Path("runs/dog/archive.npz").read_bytes())
    actor = rsl_rl_actor(12 + 24 + 15, 8).state_dict()
    controller = save_checkpoint(dog.parent / "dog.pt", actor, critic_state_dict=None)
    was = robot_digest(get_robot(str(dog)))
    change_robot(dog)
    now = robot_digest(get_robot(str(dog)))
    for name, (command, argv) in READERS.items():
        given = controller if name == "finetune" else trot(dog)
        words = [*argv, str(given)] if argv[-1] == "--policy" else argv
        line = refused(capsys, command, "--robot", str(dog), *words)
        assert line.startswith(argv[1]), (name, line)
        for part in ("is of robot 'dog' as it was", was[:12], now[:12], str(dog)):
            assert part in line, (name, line)


def test_no_command_compares_numbers_of_another_definition(dog, capsys, monkeypatch):
    assert read_archive("runs/dog").penalty_definition == "squared"
    Path("alone.npz").write_bytes(Path("runs/dog/archive.npz").read_bytes())
    actor = rsl_rl_actor(12 + 24 + 15, 8).state_dict()
    controller = save_checkpoint(dog.parent / "dog.pt", actor, critic_state_dict=None)
    scales = get_robot(str(dog)).read_penalty_scales()
    monkeypatch.setattr("sim.files.records.PENALTY_DEFINITION", "cubed")
    with pytest.raises(ValueError, match=r"dog\.scales\.json is of penalties by squared errors.*calibrate --robot"):
        get_robot(str(dog)).read_penalty_scales()
    monkeypatch.setattr(RobotCfg, "read_penalty_scales", lambda *_: scales)  # or evaluate would stop at them
    for name, (command, argv) in READERS.items():
        given = controller if name == "finetune" else trot(dog)
        words = [*argv, str(given)] if argv[-1] == "--policy" else argv
        line = refused(capsys, command, "--robot", str(dog), *words)
        assert line.startswith(f"{argv[1]} is of penalties by squared errors, expected cubed ones"), (name, line)
        assert "; make it anew" in line or "; search again, or give another archive" in line, (name, line)


def test_scales_of_another_robot_are_refused_and_those_of_another_controller_told(dog, capsys):
    other = f"{dog.parent}/bad.py:Trot"
    search(robot=str(dog), policy=other, run_dir=Path("runs/other"))
    said = capsys.readouterr()
    assert f"scaled by those of dog_trot.py:Trot, with which {dog.parent}/dog.scales.json was measured" in said.out
    search(robot=str(dog), policy=trot(dog), run_dir=Path("runs/own"))
    assert "scaled by" not in capsys.readouterr().out
    change_robot(dog)
    argv = ("--robot", str(dog), "--policy", trot(dog), "--run-dir", "runs/new", "--device", "cpu")
    line = refused(capsys, Archive, *argv)
    assert line.startswith(f"{dog.parent}/dog.scales.json is of robot 'dog' as it was")
    assert f"calibrate --robot {dog} --policy {trot(dog)}`" in line


def test_a_controller_that_changed_is_another_and_writes_other_files(dog, capsys):
    code = dog.parent / "dog_trot.py"
    code.write_text(code.read_text().replace("0.35", "0.3"))
    line = refused(
        capsys, Archive, "--resume", "runs/dog", "--robot", str(dog), "--policy", trot(dog), "--device", "cpu"
    )
    assert "policy_sha256" in line
    # Named, it is another controller than was searched, whatever its name.
    found = find_archive(str(dog), Path("runs/dog"))
    assert found.suffix(found.policy(trot(dog))) == "-dog_trot.py-Trot"
    with pytest.raises(ValueError, match="must be the controller that was searched"):
        judge(Path("runs/dog"), robot=str(dog), policy=trot(dog), compute=Compute(), open_evaluator=open_dog)
    code.write_text(code.read_text().replace("0.3", "0.35"))
    assert found.suffix(trot(dog)) == ""


def test_a_lost_or_changed_file_of_the_search_is_refused_unless_named(dog, capsys):
    policy = save_checkpoint(dog.parent / "mine.pt", rsl_rl_actor(12 + 24 + 15, 8).state_dict())
    search(robot=str(dog), policy=str(policy), run_dir=Path("runs/file"))
    found = find_archive(str(dog), Path("runs/file"))
    assert found.policy(None) == str(policy)
    save_checkpoint(policy, rsl_rl_actor(12 + 24 + 15, 8, normalised=True).state_dict())
    for command in (Replay, Judge):
        line = refused(capsys, command, "--robot", str(dog), "--run", "runs/file", "--device", "cpu")
        assert f"the controller in {policy}, which is another one now" in line and "--policy" in line
    assert found.suffix(found.policy(str(policy))) == "-mine"


def test_an_archive_alone_names_what_it_is_of(dog):
    archive, robot = read_archive("runs/dog"), get_robot(str(dog))
    expected = identity(robot, trot(dog))
    del expected["policy"]
    assert archive.named() == expected
    config = json.loads(Path("runs/dog/config.json").read_text())["settings"]
    summary = json.loads(Path("runs/dog/archive.json").read_text())
    for name, value in expected.items():
        assert config[name] == value and summary[name] == value
    older = dataclasses.replace(archive, robot_sha256=None, policy_sha256=None)
    write_archive(Path("old.npz"), older)
    assert read_archive("old.npz").robot_sha256 is None


@pytest.mark.usefixtures("without_gl")
def test_recordings_of_the_robot_before_are_made_anew_or_refused(dog, capsys):
    robot, archive = get_robot(str(dog)), read_archive("runs/dog")
    wanted = on_elite(archive, 0, policy=trot(dog), replicas=2)

    def made_of(robot):
        policy_sha256 = identity(robot, trot(dog))["policy_sha256"]
        seeds = np.array([wanted.terrain_seed], np.uint32)
        return make_recording(robot, wanted.terrain[None], seeds=seeds, policy_sha256=policy_sha256, replicas=2)

    kept = Recordings(robot, folder=Path("kept"))
    kept.keep(wanted, made_of(robot))
    assert Recordings(robot, folder=Path("kept")).read(wanted) is not None
    write_recording(Path("named.recording.npz"), made_of(robot))
    change_robot(dog)
    changed = get_robot(str(dog))
    now = Recordings(changed, folder=Path("kept"))
    assert now.read(wanted) is None
    argv = ["--robot", str(dog), "--terrain", "named.recording.npz"]
    line = refused(capsys, Film, *argv)
    assert line.startswith("named.recording.npz is of robot 'dog' as it was")


def test_a_training_does_not_go_on_with_the_robot_after_it_changed(dog):
    cfg = TrainCfg(num_envs=4, iterations=1)
    saved = {"settings": settings_of(cfg, get_robot(str(dog))), "iter": 1}
    check_settings(Path("training"), saved, settings_of(cfg, get_robot(str(dog))))
    change_robot(dog)
    with pytest.raises(ValueError, match="robot_sha256"):
        check_settings(Path("training"), saved, settings_of(cfg, get_robot(str(dog))))


def test_a_controller_trained_with_the_robot_before_is_told_so(dog, capsys):
    from sim.policy.loaders import load_policy

    robot = get_robot(str(dog))
    policy = save_checkpoint(dog.parent / "a1.pt", rsl_rl_actor(12 + 24 + 15, 8).state_dict())
    record = {"settings": {"robot_sha256": robot_digest(robot)}}
    policy.with_suffix(".train.json").write_text(json.dumps(record))
    load_policy(policy, robot, "cpu")
    load_policy(policy, dataclasses.replace(robot, physics_dt=0.001, decimation=20), "cpu")  # finer, not another
    assert "warning" not in capsys.readouterr().err
    change_robot(dog)
    changed = get_robot(str(dog))
    load_policy(policy, changed, "cpu")
    load_policy(policy, changed, "cpu")
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("warning"))
    assert f"{policy} was trained with a robot of other settings" in line
    assert robot_digest(robot)[:12] in line and robot_digest(changed)[:12] in line


@pytest.mark.parametrize("name", ROBOTS)
def test_the_shipped_scales_are_of_the_shipped_robot_and_controller(name):
    """If this fails, a shipped file has changed: `faultline calibrate` measures its scales again."""
    robot = ROBOTS[name]
    content = json.loads(robot.scales_file.read_text())
    assert identity(robot, robot.policy_file).items() <= content.items()
