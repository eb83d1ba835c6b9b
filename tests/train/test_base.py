"""The training command: what a run leaves behind, resuming, stopping, and errors."""

import json
import shutil
import signal
from dataclasses import replace

import pytest
import torch
import tyro

from sim.files.atomic import locked
from sim.files.command import run_command
from sim.policy.loaders import load_policy
from sim.robots.find import get_robot
from tests.train.conftest import CURRICULUM
from train.base import Train
from train.ppo.cfg import PpoCfg
from train.ppo.run import StopRequest, prepare_run_dir
from train.task.cfg import TaskCfg

PPO = PpoCfg(hidden_dims=(16, 8), steps_per_env=4, epochs=1, mini_batches=2)


def config(run_dir, **changes):
    values = {"num_envs": 6, "iterations": 2, "rows": 2, "device": "cpu", "ppo": PPO}
    return Train(run_dir=run_dir, **{**values, "task": TaskCfg(curriculum=CURRICULUM), **changes})


def parsed(flags):
    return tyro.cli(Train, args=flags, default=Train.defaults(flags))


@pytest.fixture(scope="module")
def finished(tmp_path_factory, device):
    run_dir = tmp_path_factory.mktemp("run") / "first"
    assert config(run_dir, export=run_dir.parent / "out" / "robot.pt", device=device).execute() == 0
    return run_dir


def test_a_run_leaves_a_controller_and_its_record(finished):
    robot = get_robot("anymal")
    exported = finished.parent / "out" / "robot.pt"
    content = torch.load(exported, weights_only=True)
    assert content["actor_state_dict"]["mlp.0.weight"].shape == (16, 235)
    policy = load_policy(exported, robot, "cpu")
    observation = torch.randn(3, 235)
    assert policy(observation).shape == (3, 12)
    record = json.loads(exported.with_suffix(".train.json").read_text())
    for key in ("command", "commit", "device", "versions", "seed", "date", "wall_s", "settings", "pieces"):
        assert key in record, key
    assert (record["robot"], record["iterations"], record["num_envs"], record["env_steps"]) == ("anymal", 2, 6, 48)
    assert [row["iteration"] for row in record["curve"]] == [1, 2]
    assert record["settings"]["ppo"]["hidden_dims"] == [16, 8]


def test_a_run_leaves_tensorboard_scalars(finished):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(finished))
    events.Reload()
    assert {"train/level", "terms/stumble", "losses/value", "train/env_steps_per_s"} <= set(events.Tags()["scalars"])


def test_resume_goes_on_elsewhere_or_in_place(finished, tmp_path, device):
    before = (finished / "checkpoint.pt").read_bytes()
    assert config(tmp_path / "second", resume=finished, iterations=3, device=device).execute() == 0
    assert (finished / "checkpoint.pt").read_bytes() == before
    record = json.loads((tmp_path / "second" / "policy.train.json").read_text())
    assert record["iterations"] == 3 and record["env_steps"] == 72
    assert [row["iteration"] for row in record["curve"]] == [1, 2, 3]
    assert [piece["from_iteration"] for piece in record["pieces"]] == [0, 2]
    assert config(None, resume=tmp_path / "second", iterations=4, device=device).execute() == 0
    assert torch.load(tmp_path / "second" / "checkpoint.pt", weights_only=True)["iter"] == 4


def test_a_resumed_run_goes_on_as_it_was_begun(tmp_path, capsys):
    # The robot's own settings may have changed since; what the command line gives counts.
    run = tmp_path / "begun"
    begun = config(run, task=TaskCfg(curriculum=CURRICULUM, push_speed=0.3, friction=(0.7, 0.8)))
    assert begun.execute() == 0
    (run / "config.json").unlink()  # is for people to read
    resumed = parsed(["--resume", str(run), "--task.friction", "0.6", "0.9", "--device", "cpu"])
    assert resumed.task == replace(begun.task, friction=(0.6, 0.9)) and resumed.ppo == PPO
    capsys.readouterr()
    assert resumed.execute() == 0
    said = capsys.readouterr().out
    assert "6 robots on cpu, 2 iterations" in said
    assert [line for line in said.splitlines() if "Changed since" in line] == [
        "Changed since the checkpoint: task.friction ([0.7, 0.8] there, [0.6, 0.9] wanted)"
    ]


def damaged(finished, tmp_path, damage):
    """A copy of a run whose checkpoint has other settings."""
    shutil.copytree(finished, tmp_path / "run")
    file = tmp_path / "run" / "checkpoint.pt"
    content = torch.load(file, weights_only=True)
    damage(content["extra"]["settings"])
    torch.save(content, file)
    return tmp_path / "run"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda settings: settings["task"].update(gravity=3.0), "task has no setting gravity"),
        (lambda settings: settings["ppo"].update(gamma="a lot"), "gamma must be a finite number, got 'a lot'"),
        (lambda settings: settings["task"].update(friction=0.5), "friction must be a tuple, got 0.5"),
        (lambda settings: settings["task"].update(friction=[0.5]), r"friction must have 2 values, got \[0.5\]"),
        (lambda settings: settings["task"].update(rewards=7), "rewards must be an object, got 7"),
        (lambda settings: settings.pop("ppo"), "'ppo'"),
    ],
)
def test_a_run_whose_settings_cannot_be_read_is_refused(finished, tmp_path, damage, message):
    run = damaged(finished, tmp_path, damage)
    with pytest.raises(ValueError, match=f"checkpoint.pt is damaged, or of another version: {message}; put a copy"):
        parsed(["--resume", str(run)])


def test_a_run_of_another_kind_is_named_before_its_settings_are_read(finished, tmp_path):
    run = damaged(finished, tmp_path, lambda settings: settings.update(mix={}, task="crossing"))
    with pytest.raises(ValueError, match=r"is a fine-tuning: go on with .*finetune --robot anymal --resume"):
        parsed(["--resume", str(run)])
    with pytest.raises(ValueError, match="is of robot 'anymal', expected 'cassie': name its robot"):
        parsed(["--robot", "cassie", "--resume", str(finished)])


def test_fewer_iterations_than_are_done_are_refused(finished):
    before = (finished / "policy.pt").stat().st_mtime_ns
    with pytest.raises(ValueError, match="has done 2 iterations already: give at least as many in all"):
        config(None, resume=finished, iterations=1).execute()
    assert (finished / "policy.pt").stat().st_mtime_ns == before


def test_a_fine_tuning_is_left_to_its_own_command(finished, tmp_path):
    content = torch.load(finished / "checkpoint.pt", weights_only=True)
    content["extra"]["mix"] = {}
    torch.save(content, tmp_path / "checkpoint.pt")
    before = (tmp_path / "checkpoint.pt").read_bytes()
    with pytest.raises(ValueError, match=r"is a fine-tuning: go on with .*finetune --robot anymal --resume"):
        config(None, resume=tmp_path, iterations=3).execute()
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_a_run_directory_takes_one_training_at_a_time(finished):
    before = (finished / "checkpoint.pt").read_bytes()
    with locked(finished, "busy"), pytest.raises(ValueError, match="another training works in"):
        config(None, resume=finished, iterations=3).execute()
    assert (finished / "checkpoint.pt").read_bytes() == before


def test_changed_settings_are_named(finished, tmp_path, capsys):
    ppo = replace(PPO, entropy=0.5)
    config(tmp_path / "changed", resume=finished, iterations=2, ppo=ppo).execute()
    assert "Changed since the checkpoint: ppo.entropy (0.01 there, 0.5 wanted)\n" in capsys.readouterr().out


def test_out_of_time_saves_and_says_how_to_go_on(finished, tmp_path, capsys):
    assert config(tmp_path / "late", resume=finished, iterations=50, max_seconds=1.0).execute() == 0
    assert (tmp_path / "late" / "checkpoint.pt").exists()
    said = capsys.readouterr().out
    assert "Stopped after 2 of 50 iterations. Go on with:" in said and f"--resume {tmp_path / 'late'}" in said


def test_an_interrupt_saves_and_says_how_to_go_on(finished, tmp_path, capsys, monkeypatch):
    from train.ppo.learner import Learner

    iterate = Learner.iterate

    def interrupted(learner):
        signal.raise_signal(signal.SIGINT)
        return iterate(learner)

    monkeypatch.setattr(Learner, "iterate", interrupted)
    assert config(tmp_path / "cut", resume=finished, iterations=50).execute() == 130
    assert torch.load(tmp_path / "cut" / "checkpoint.pt", weights_only=True)["iter"] == 3
    assert "train --robot anymal --resume" in capsys.readouterr().out


def test_handlers_are_put_back():
    before = signal.getsignal(signal.SIGINT)
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--robot", "spot"], "unknown robot 'spot': expected one of anymal"),
        (["--device", "cuda"], "no CUDA device was found"),
        (["--device", "cpu", "--run-dir", "/proc/nowhere"], "cannot write to /proc/nowhere"),
        (["--device", "cpu", "--resume", "{empty}"], "no checkpoint at"),
        (["--device", "cpu", "--iterations", "0"], "iterations must be at least 1, got 0"),
        (["--device", "cpu", "--iterations", "-3"], "iterations must be at least 1, got -3"),
        (["--device", "cpu", "--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (["--device", "cpu", "--seed", "-1"], "seed must be at least 0, got -1"),
    ],
)
@pytest.mark.skipif(torch.cuda.is_available(), reason="one of the errors is the absence of CUDA")
def test_errors_come_before_any_work_in_one_line(flags, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("train.ppo.run.CommandTask", None)  # building anything would fail with another error
    monkeypatch.chdir(tmp_path)
    assert run_command(Train, [flag.format(empty=tmp_path) for flag in flags], name="train") == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1


def test_networks_that_do_not_fit_leave_the_run_as_it_was(finished):
    before = {file.name: file.read_bytes() for file in finished.glob("*.*") if "tfevents" not in file.name}
    with pytest.raises(ValueError, match="do not fit"):
        config(None, resume=finished, iterations=3, ppo=replace(PPO, hidden_dims=(8, 8))).execute()
    assert {name: (finished / name).read_bytes() for name in before} == before


def test_a_run_of_a_search_is_not_written_to(tmp_path):
    (tmp_path / "config.json").write_text('{"settings": {}, "iterations": 3}')
    with pytest.raises(ValueError, match="holds the run of a search"):
        config(tmp_path).execute()
    assert [file.name for file in tmp_path.iterdir()] == ["config.json"]


def test_a_run_is_not_overwritten(finished, tmp_path):
    before = (finished / "checkpoint.pt").read_bytes()
    for resume in (None, tmp_path / "other"):
        if resume is not None:
            assert config(resume, resume=finished).execute() == 0
        with pytest.raises(ValueError, match="already holds a training run"):
            config(finished, resume=resume).execute()
    assert (finished / "checkpoint.pt").read_bytes() == before


def test_trainings_of_one_second_have_places_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("train.ppo.run.time.strftime", lambda form: "20260102-030405")
    flags, places = tyro.cli(Train, args=["--robot", "anymal"]), []
    for _ in range(3):
        places.append(prepare_run_dir(flags, "anymal-base"))
        places[-1].mkdir(parents=True, exist_ok=True)
    assert [place.name for place in places] == [
        "anymal-base-20260102-030405",
        "anymal-base-20260102-030405-2",
        "anymal-base-20260102-030405-3",
    ]
