"""PPO: an iteration, a checkpoint, several processes, rsl_rl's own; a training of a base controller as a whole."""

import errno
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict import TensorDict

from sim.controllers.loaders import load_policy
from sim.files.atomic import locked
from sim.files.command import Interrupted, run_command
from sim.robots.find import get_robot
from tests.train.conftest import CURRICULUM
from train.cfg import PpoCfg, RunCfg, TaskCfg, TrainCfg
from train.commands import TrainCommand
from train.ppo import training
from train.ppo.checkpoint import STD, read_checkpoint, write_checkpoint
from train.ppo.learner import CommandVecEnv, Learner, Ranks
from train.ppo.ppo import CapturedPPO, runner_settings
from train.ppo.training import train

CFG = PpoCfg(hidden_dims=(16, 8), steps_per_env=4, epochs=2, mini_batches=2)


@pytest.fixture
def learner(shared_task):
    return Learner(CommandVecEnv(shared_task), CFG, seed=0)


def saved(learner, path):
    """The learner's part of a checkpoint, written and read again."""
    write_checkpoint(path, {**learner.state(), "kind": "train", "settings": {}, "progress": {}})
    return read_checkpoint(path)


def state_of(learner):
    return {**learner.alg.get_policy().state_dict(), **learner.alg.critic.state_dict(prefix="critic.")}


def test_resumed_training_is_repeatable(learner, tmp_path):
    assert len(learner.env.episode_length_buf.unique()) > 1  # episodes begin at random ages
    before = {key: value.clone() for key, value in state_of(learner).items()}
    learner.iterate()
    assert float(learner.actor_state()[STD].mean()) == pytest.approx(1.0, abs=0.05)
    assert all((value != before[key]).any() for key, value in state_of(learner).items())
    levels = torch.arange(6)
    learner.env.task.restart_all(levels)
    saved(learner, tmp_path / "c.pt")
    saved_state = {key: value.clone() for key, value in state_of(learner).items()}
    rate, counter = learner.alg.learning_rate, int(learner.env.task.counter)
    ends = []
    for seed in (98, 99):  # what is drawn follows from the checkpoint
        again = Learner(learner.env, CFG, seed=seed)
        again.env.task.restart_all(torch.zeros(6))
        again.resume(read_checkpoint(tmp_path / "c.pt"))
        assert again.iteration == 1 and again.alg.learning_rate == pytest.approx(rate)
        assert again.env.task.levels.tolist() == levels.tolist()
        # One step of the counter is the restart's own.
        assert int(again.env.task.counter) == counter + 1
        assert all(value.equal(saved_state[key]) for key, value in state_of(again).items())
        losses = again.iterate().losses
        ends.append((losses, {key: value.clone() for key, value in state_of(again).items()}))
    (losses, state), (losses_again, state_again) = ends
    if learner.env.device == "cpu":
        assert losses == losses_again and all(value.equal(state_again[key]) for key, value in state.items())
    else:  # the solver adds in any order there; four steps of Adam, of .005 at most each, may go either way
        assert losses == pytest.approx(losses_again, rel=0.2, abs=0.02)
        assert all((value - state_again[key]).abs().max() < 0.04 for key, value in state.items())


def test_the_mean_is_of_the_actors_that_count(learner, tmp_path):
    seen = []
    for counts in (True, False, True, True):
        learner.iterate()
        learner.count_into_mean(counts)
        seen.append(learner.actor_state())
        if learner.iteration == 2:
            assert learner.averaged == 0
            assert all(value.equal(seen[-1][key]) for key, value in learner.mean_actor_state().items())
    content = saved(learner, tmp_path / "c.pt")
    again = Learner(learner.env, CFG, seed=99)
    again.resume(content)
    again.iterate()
    again.count_into_mean(True)
    seen.append(again.actor_state())
    assert (learner.averaged, again.averaged) == (2, 3)
    for key, value in again.mean_actor_state().items():
        assert torch.allclose(value, torch.stack([actor[key] for actor in seen[2:]]).mean(dim=0), atol=1e-6), key
        assert not value.equal(seen[-1][key])


@pytest.mark.parametrize("entry", ["critic_state_dict", "optimizer_state_dict", "levels"])
def test_a_damaged_state_is_refused(learner, tmp_path, entry):
    content = saved(learner, tmp_path / "c.pt")
    with pytest.raises(ValueError, match="damaged"):
        Learner(learner.env, CFG, seed=0).resume({**content, entry: {}})


@pytest.mark.parametrize(("loss", "weight"), [(float("nan"), 0.0), (1.0, float("nan"))])
def test_numbers_that_are_not_finite_stop_training(learner, monkeypatch, loss, weight):
    def spoil():
        with torch.no_grad():
            learner.alg.critic.state_dict()["mlp.0.weight"][3, 5] = weight
        return {"value": loss}

    monkeypatch.setattr(learner.alg, "update", spoil)
    with pytest.raises(FloatingPointError, match="learning-rate"):
        learner.iterate()
    assert learner.iteration == 0


@pytest.mark.slow
def test_two_processes_train_one_controller_and_go_on(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2",
         "-m", "tests.train.two_processes", str(tmp_path / "run")],
        cwd=Path(__file__).parents[3], capture_output=True, text=True, timeout=300, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("training record written to") == 2  # of two trainings: one of the processes speaks
    record = json.loads((tmp_path / "run" / "policy.train.json").read_text())
    assert (record["iterations"], record["processes"], record["env_steps"]) == (2, 2, 2 * 2 * 4 * 4)


def test_each_process_takes_its_own_gpu(monkeypatch):
    assert Ranks.from_environment() == Ranks()
    for name, value in {"RANK": "5", "LOCAL_RANK": "1", "WORLD_SIZE": "8"}.items():
        monkeypatch.setenv(name, value)
    ranks = Ranks.from_environment()
    assert not ranks.is_first
    assert (ranks.device("cuda:0"), ranks.device("cuda"), ranks.device("cpu")) == ("cuda:1", "cuda:1", "cpu")
    with pytest.raises(ValueError, match="cuda:3"):
        ranks.device("cuda:3")
    assert Ranks().device("cuda:3") == "cuda:3"


NUM_ENVS, NUM_OBS, NUM_ACTIONS = 6, 5, 2


class DummyEnv(VecEnv):
    """Random observations; the reward is higher the nearer the first action is to the first observation."""

    def __init__(self, device: str) -> None:
        self.num_envs, self.num_actions, self.max_episode_length = NUM_ENVS, NUM_ACTIONS, 10
        self.episode_length_buf = torch.zeros(NUM_ENVS, dtype=torch.long, device=device)
        self.device = device
        self.cfg = {}
        self.generator = torch.Generator().manual_seed(0)
        self.obs = self._draw()

    def _draw(self) -> TensorDict:
        rows = torch.randn(NUM_ENVS, NUM_OBS, generator=self.generator)  # the same on every device
        return TensorDict({"policy": rows.to(self.device)}, [NUM_ENVS])

    def get_observations(self) -> TensorDict:
        return self.obs

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        reward = -(actions[:, 0] - self.obs["policy"][:, 0]).square()
        self.obs = self._draw()
        done = torch.rand(NUM_ENVS, generator=self.generator).to(self.device) < 0.1
        return self.obs, reward, done.long(), {"time_outs": done & (reward > -1.0)}


def make_runner(algorithm: type[PPO], cfg: PpoCfg, device: str) -> OnPolicyRunner:
    torch.manual_seed(3)
    settings = runner_settings(cfg)
    settings["algorithm"]["class_name"] = algorithm
    return OnPolicyRunner(DummyEnv(device), settings, log_dir=None, device=device)


def parameters(runner: OnPolicyRunner) -> list[torch.Tensor]:
    return [*runner.alg.actor.parameters(), *runner.alg.critic.parameters()]


@pytest.mark.parametrize("desired_kl", [1e-5, 0.01, 10.0])  # the learning rate falls, moves both ways, rises
def test_update_equals_rsl_rl(desired_kl: float, monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    cfg = replace(CFG, desired_kl=desired_kl, clip=0.005)  # so little that values and ratios are clipped
    ours, theirs = make_runner(CapturedPPO, cfg, device), make_runner(PPO, cfg, device)
    losses = []
    for runner in (ours, theirs):
        monkeypatch.setattr(runner.logger, "log", lambda loss_dict, **_: losses.append(loss_dict))
        torch.manual_seed(5)
        runner.learn(1)
    assert losses[0] == pytest.approx(losses[1], rel=1e-4 if device == "cpu" else 1e-3)
    assert ours.alg.learning_rate == pytest.approx(theirs.alg.learning_rate, rel=1e-4)
    assert ours.alg.learning_rate != cfg.learning_rate
    # On CUDA the fused Adam of a captured graph rounds otherwise.
    close = {"rtol": 1e-5, "atol": 1e-6} if device == "cpu" else {"rtol": 1e-3, "atol": 1e-4}
    for mine, other in zip(parameters(ours), parameters(theirs), strict=True):
        torch.testing.assert_close(mine, other, **close)


def test_settings_reach_rsl_rl(device: str) -> None:
    cfg = replace(CFG, learning_rate=0.002, gamma=0.5, lam=0.6, clip=0.3, desired_kl=0.7, entropy=0.8)
    alg = make_runner(CapturedPPO, cfg, device).alg
    assert (alg.learning_rate, alg.gamma, alg.lam, alg.clip_param) == (0.002, 0.5, 0.6, 0.3)
    assert (alg.desired_kl, alg.entropy_coef, alg.num_learning_epochs, alg.num_mini_batches) == (0.7, 0.8, 2, 2)


@pytest.mark.parametrize("changes", [{"gamma": 2.0}, {"mini_batches": 49}, {"hidden_dims": ()}])
def test_settings_that_nothing_is_learned_with_are_named(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"ppo.{next(iter(changes))}"):
        TrainCfg(num_envs=NUM_ENVS, ppo=PpoCfg(**changes)).check(get_robot("anymal"))


ROBOT = get_robot("anymal")
TRAINING = TrainCfg(num_envs=6, iterations=2, ppo=CFG, task=TaskCfg(curriculum=CURRICULUM))
ON_CPU = RunCfg(device="cpu")


@pytest.fixture(scope="module")
def finished(tmp_path_factory, device):
    """A run of two iterations, and its controller in another place."""
    run_dir = tmp_path_factory.mktemp("run") / "first"
    train(ROBOT, TRAINING, run_dir, RunCfg(device=device, export=run_dir.parent / "out" / "robot.pt"))
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
    assert TrainCommand.defaults(flags).task == TRAINING.task and TrainCommand.defaults(flags).ppo == CFG
    assert run_command(TrainCommand, flags, name="train") == 0
    record = json.loads((copied / "policy.train.json").read_text())
    assert record["iterations"] == 3 and record["env_steps"] == 72
    assert [row["iteration"] for row in record["curve"]] == [1, 2, 3]
    assert [piece["from_iteration"] for piece in record["pieces"]] == [0, 2]
    assert read_checkpoint(copied / "checkpoint.pt")["iter"] == 3


def test_other_settings_robots_and_commands_are_refused(finished, copied):
    before = (finished / "checkpoint.pt").read_bytes()
    for cfg, field in (
        (replace(TRAINING, ppo=replace(CFG, entropy=0.5)), "ppo.entropy"),
        (replace(TRAINING, seed=1), "seed"),
        (replace(TRAINING, iterations=1), "iterations"),
    ):
        with pytest.raises(ValueError, match=field):
            train(ROBOT, cfg, finished, ON_CPU)
    with pytest.raises(ValueError, match="cassie"):
        train(get_robot("cassie"), TRAINING, finished, ON_CPU)
    content = torch.load(copied / "checkpoint.pt", weights_only=True)
    torch.save({**content, "kind": "finetune"}, copied / "checkpoint.pt")
    with pytest.raises(ValueError, match="finetune"):
        train(ROBOT, TRAINING, copied, ON_CPU)
    content["settings"]["ppo"]["gamma"] = "a lot"
    torch.save(content, copied / "checkpoint.pt")
    with pytest.raises(ValueError, match="gamma"):
        TrainCommand.defaults(["--resume", str(copied)])
    with locked(finished, "busy"), pytest.raises(ValueError, match="another training"):
        train(ROBOT, replace(TRAINING, iterations=3), finished, ON_CPU)
    assert (finished / "checkpoint.pt").read_bytes() == before


def test_an_interrupt_saves_and_stops(copied, monkeypatch):
    iterate, before = Learner.iterate, signal.getsignal(signal.SIGTERM)

    def interrupted(learner):
        os.kill(os.getpid(), signal.SIGTERM)
        return iterate(learner)

    monkeypatch.setattr(Learner, "iterate", interrupted)
    with pytest.raises(Interrupted, match="3 of 50"):
        train(ROBOT, replace(TRAINING, iterations=50), copied, ON_CPU)
    assert read_checkpoint(copied / "checkpoint.pt")["iter"] == 3 and (copied / "policy.pt").exists()
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_full_disk_is_an_error_that_names_the_file(copied, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("tensorboard.summary.writer.record_writer.RecordWriter.write", fail)
    with pytest.raises(OSError, match=rf"{copied}/events\.out\.tfevents.* No space left"):
        train(ROBOT, replace(TRAINING, iterations=3), copied, ON_CPU)
    assert read_checkpoint(copied / "checkpoint.pt")["iter"] == 2


def test_places_of_others_are_not_written_to(finished, tmp_path):
    (tmp_path / "archive.npz").write_bytes(b"")
    with pytest.raises(ValueError, match="search"):
        train(ROBOT, TRAINING, tmp_path, ON_CPU)
    assert [file.name for file in tmp_path.iterdir()] == ["archive.npz"]
    exported = finished.parent / "out" / "robot.pt"
    with pytest.raises(ValueError, match="export"):
        train(ROBOT, TRAINING, tmp_path / "new", RunCfg(device="cpu", export=exported))
    assert not (tmp_path / "new").exists()
    train(ROBOT, TRAINING, finished, RunCfg(device="cpu", export=exported))  # its own


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
