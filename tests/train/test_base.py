"""Training a base controller: what a run leaves, how it goes on and stops, and what is refused."""

import errno
import json
import os
import signal
from dataclasses import replace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sim.controllers.loaders import load_policy
from sim.files.atomic import locked
from sim.files.command import Interrupted, run_command
from sim.robots.find import get_robot
from tests.train.conftest import CURRICULUM
from train.cfg import PpoCfg, RunCfg, TaskCfg, TrainCfg
from train.commands import TrainCommand
from train.ppo import training
from train.ppo.checkpoint import read_checkpoint
from train.ppo.learner import Learner
from train.ppo.training import train

ROBOT = get_robot("anymal")
PPO = PpoCfg(hidden_dims=(16, 8), steps_per_env=4, epochs=1, mini_batches=2)
CFG = TrainCfg(num_envs=6, iterations=2, ppo=PPO, task=TaskCfg(curriculum=CURRICULUM))
ON_CPU = RunCfg(device="cpu")


@pytest.fixture(scope="module")
def finished(tmp_path_factory, device):
    """A run of two iterations, and its controller in another place."""
    run_dir = tmp_path_factory.mktemp("run") / "first"
    train(ROBOT, CFG, run_dir, RunCfg(device=device, export=run_dir.parent / "out" / "robot.pt"))
    return run_dir


@pytest.fixture
def copied(finished, tmp_path):
    """The checkpoint of the finished run in a directory of its own."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint.pt").write_bytes((finished / "checkpoint.pt").read_bytes())
    return tmp_path / "run"


def test_a_run_leaves_a_controller_and_its_record(finished):
    exported = finished.parent / "out" / "robot.pt"
    assert torch.load(exported, weights_only=True)["actor_state_dict"]["mlp.0.weight"].shape == (16, 235)
    assert load_policy(exported, ROBOT, "cpu")(torch.randn(3, 235)).shape == (3, 12)
    record = json.loads(exported.with_suffix(".train.json").read_text())
    assert {"command", "commit", "sources_sha256", "device", "versions", "seed", "date", "wall_s"} <= record.keys()
    assert (record["robot"], record["iterations"], record["num_envs"], record["env_steps"]) == ("anymal", 2, 6, 48)
    assert [row["iteration"] for row in record["curve"]] == [1, 2]
    assert record["settings"]["ppo"]["hidden_dims"] == [16, 8]
    events = EventAccumulator(str(finished))
    events.Reload()
    assert {"train/level", "terms/stumble", "losses/value", "train/env_steps_per_s"} <= set(events.Tags()["scalars"])


def test_it_goes_on_by_its_own_settings(copied):
    flags = ["--resume", str(copied), "--iterations", "3", "--device", "cpu"]
    assert TrainCommand.defaults(flags).task == CFG.task and TrainCommand.defaults(flags).ppo == PPO
    assert run_command(TrainCommand, flags, name="train") == 0
    record = json.loads((copied / "policy.train.json").read_text())
    assert record["iterations"] == 3 and record["env_steps"] == 72
    assert [row["iteration"] for row in record["curve"]] == [1, 2, 3]
    assert [piece["from_iteration"] for piece in record["pieces"]] == [0, 2]
    assert read_checkpoint(copied / "checkpoint.pt")["iter"] == 3


def test_other_settings_robots_and_commands_are_refused(finished, copied):
    before = (finished / "checkpoint.pt").read_bytes()
    for cfg, field in (
        (replace(CFG, ppo=replace(PPO, entropy=0.5)), "ppo.entropy"),
        (replace(CFG, seed=1), "seed"),
        (replace(CFG, iterations=1), "iterations"),
    ):
        with pytest.raises(ValueError, match=field):
            train(ROBOT, cfg, finished, ON_CPU)
    with pytest.raises(ValueError, match="cassie"):
        train(get_robot("cassie"), CFG, finished, ON_CPU)
    content = torch.load(copied / "checkpoint.pt", weights_only=True)
    torch.save({**content, "kind": "finetune"}, copied / "checkpoint.pt")
    with pytest.raises(ValueError, match="finetune"):
        train(ROBOT, CFG, copied, ON_CPU)
    content["settings"]["ppo"]["gamma"] = "a lot"
    torch.save(content, copied / "checkpoint.pt")
    with pytest.raises(ValueError, match="gamma"):
        TrainCommand.defaults(["--resume", str(copied)])
    with locked(finished, "busy"), pytest.raises(ValueError, match="another training"):
        train(ROBOT, replace(CFG, iterations=3), finished, ON_CPU)
    assert (finished / "checkpoint.pt").read_bytes() == before


def test_an_interrupt_saves_and_stops(copied, monkeypatch):
    iterate, before = Learner.iterate, signal.getsignal(signal.SIGTERM)

    def interrupted(learner):
        os.kill(os.getpid(), signal.SIGTERM)
        return iterate(learner)

    monkeypatch.setattr(Learner, "iterate", interrupted)
    with pytest.raises(Interrupted, match="3 of 50"):
        train(ROBOT, replace(CFG, iterations=50), copied, ON_CPU)
    assert read_checkpoint(copied / "checkpoint.pt")["iter"] == 3 and (copied / "policy.pt").exists()
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_full_disk_is_an_error_that_names_the_file(copied, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("tensorboard.summary.writer.record_writer.RecordWriter.write", fail)
    with pytest.raises(OSError, match=rf"{copied}/events\.out\.tfevents.* No space left"):
        train(ROBOT, replace(CFG, iterations=3), copied, ON_CPU)
    assert read_checkpoint(copied / "checkpoint.pt")["iter"] == 2


def test_places_of_others_are_not_written_to(finished, tmp_path):
    (tmp_path / "archive.npz").write_bytes(b"")
    with pytest.raises(ValueError, match="search"):
        train(ROBOT, CFG, tmp_path, ON_CPU)
    assert [file.name for file in tmp_path.iterdir()] == ["archive.npz"]
    exported = finished.parent / "out" / "robot.pt"
    with pytest.raises(ValueError, match="export"):
        train(ROBOT, CFG, tmp_path / "new", RunCfg(device="cpu", export=exported))
    assert not (tmp_path / "new").exists()
    train(ROBOT, CFG, finished, RunCfg(device="cpu", export=exported))  # its own


@pytest.mark.parametrize(
    ("flags", "field"),
    [
        (["--device", "cuda"], "CUDA"),
        (["--run-dir", "/proc/nowhere"], "/proc/nowhere"),
        (["--resume", "{empty}"], "checkpoint.pt"),
        (["--iterations", "-3"], "iterations"),
        (["--task.episode-s", "0.001"], "task.episode_s"),
    ],
)
@pytest.mark.skipif(torch.cuda.is_available(), reason="one of the errors is the absence of CUDA")
def test_errors_come_before_any_work(flags, field, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(training, "CommandTask", None)  # building anything would fail with another error
    monkeypatch.chdir(tmp_path)
    given = [flag.format(empty=tmp_path) for flag in flags]
    assert run_command(TrainCommand, [*given, *([] if "--device" in flags else ["--device", "cpu"])], name="train") == 2
    error = capsys.readouterr().err
    assert field in error and error.count("\n") == 1
