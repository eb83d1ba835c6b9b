"""One training over several processes, as torchrun starts them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from train.ppo.learner import Ranks

ROOT = Path(__file__).parents[3]


def torchrun(*arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *arguments]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def test_two_processes_train_one_controller_and_go_on(tmp_path):
    run = tmp_path / "run"
    size = ["--device", "cpu", "--num-envs", "4", "--ppo.hidden-dims", "16", "--ppo.steps-per-env", "8"]
    first = torchrun("-m", "faultline", "train", *size, "--iterations", "2", "--run-dir", str(run))
    assert first.returncode == 0, first.stderr
    assert first.stdout.count("Controller and training record written") == 1  # one of them speaks
    record = json.loads((run / "policy.train.json").read_text())
    assert record["env_steps"] == 2 * 2 * 4 * 8
    assert record["settings"]["processes"] == 2
    before = torch.load(run / "policy.pt", weights_only=True)["actor_state_dict"]
    again = torchrun("-m", "faultline", "train", *size, "--iterations", "3", "--resume", str(run))
    assert again.returncode == 0, again.stderr
    after = torch.load(run / "policy.pt", weights_only=True)
    assert after["iter"] == 3
    assert any(not torch.equal(before[key], value) for key, value in after["actor_state_dict"].items())


def test_processes_agree_and_notice_drift():
    done = torchrun("-m", "tests.train.drift")
    assert done.returncode == 0, done.stderr


def test_each_process_takes_its_own_gpu(monkeypatch):
    assert Ranks.of_environment() == Ranks()
    for name, value in {"RANK": "5", "LOCAL_RANK": "1", "WORLD_SIZE": "8"}.items():
        monkeypatch.setenv(name, value)
    ranks = Ranks.of_environment()
    assert not ranks.is_first
    assert (ranks.device("cuda:0"), ranks.device("cuda"), ranks.device("cpu")) == ("cuda:1", "cuda:1", "cpu")
    with pytest.raises(ValueError, match="each process takes its own GPU, got device cuda:3"):
        ranks.device("cuda:3")
    assert Ranks().device("cuda:3") == "cuda:3"
