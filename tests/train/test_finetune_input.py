"""Bad input of the fine-tuning command: one line that says what is wrong, before any work."""

import pytest
import torch

from qd.archive import write_archive
from sim.files.command import run_command
from tests.train.archives import make_archive
from tests.train.starts import make_places, write_bad_starts
from train.finetune import Finetune


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    return make_places(tmp_path_factory.mktemp("finetune"))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--robot", "spot"], "unknown robot 'spot'"),
        (["--archive", "{dir}/nowhere"], "archive --robot anymal) and name it with --archive"),
        (["--archive", "{dir}/cassie.npz"], "the archive must be of robot 'anymal', got one of 'cassie'"),
        (["--archive", "{dir}/empty.npz"], "needs at least 5 elites, got 0"),
        (["--mix", "hand-crafted", "--archive", "{dir}/archive"], "takes no terrains from an archive"),
        (["--mix", "hard-random", "--draw", "failing"], "draw failing chooses among elites"),
        (["--policy", "{dir}/nowhere.pt"], "no such file"),
        (["--policy", "{dir}/narrow.pt"], "maps 100 observations to 12 actions"),
        (["--policy", "{dir}/script.pt"], "a fine-tuning starts from an rsl_rl checkpoint"),
        (["--policy", "{dir}/std_nan.pt"], "must be 12 numbers above 0, got tensor([nan"),
        (["--policy", "{dir}/std_negative.pt"], "must be 12 numbers above 0, got tensor([-1."),
        (["--policy", "{dir}/std_short.pt"], "must be 12 numbers above 0, got tensor([0.3000, 0.3000])"),
        (
            ["--policy", "{dir}/critic_other.pt"],
            "must have the actor's hidden layers [16, 8], 235 inputs and one output",
        ),
        (
            ["--policy", "{dir}/critic_none.pt"],
            "must have the actor's hidden layers [16, 8], 235 inputs and one output",
        ),
        (["--policy", "{dir}/critic_nan.pt"], "has weights that are not finite"),
        (["--terrains", "1"], "terrains must be at least 2"),
        (["--terrains", "30", "--num-envs", "6"], "num_envs must be at least as many as terrains, 30, got 6"),
        (["--rewards.termination", "inf"], "rewards.termination must be a finite number, got inf"),
        (["--swap-every", "0"], "swap_every must be at least 1, got 0"),
        (["--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (["--iterations", "-1"], "iterations must be at least 1, got -1"),
        (["--ppo.mini-batches", "0"], "ppo.mini_batches must be at least 1"),
        (["--export", "tuned.onnx"], "export must be a file named *.pt, got tuned.onnx: faultline export-policy"),
        (["--rows", "0"], "rows must be at least 1, got 0"),
        (["--max-seconds", "0"], "max_seconds must be above 0, got 0.0"),
        (["--save-every-s", "-1"], "save_every_s must be at least 0, got -1.0"),
        (["--seed", "-1"], "seed must be at least 0, got -1"),
        (["--resume", "{dir}/nowhere"], "no checkpoint at"),
        (["--ppo.no-captured"], "leave --ppo.captured on"),
    ],
)
def test_errors_come_before_any_work_in_one_line(flags, message, places, monkeypatch, capsys):
    write_archive(places / "cassie.npz", make_archive(10, robot="cassie"))
    write_archive(places / "empty.npz", make_archive(0))
    state = torch.load(places / "start.pt", weights_only=True)["actor_state_dict"]
    state["mlp.0.weight"] = state["mlp.0.weight"][:, :100]
    torch.save({"actor_state_dict": state}, places / "narrow.pt")
    write_bad_starts(places)
    torch.jit.script(torch.nn.Linear(235, 12)).save(places / "script.pt")
    monkeypatch.setattr("train.ppo.run.CommandTask", None)  # building anything would fail with another error
    monkeypatch.chdir(places)
    given = ["--device", "cpu", *(flag.format(dir=places) for flag in flags)]
    if "--archive" not in flags and not {"hand-crafted", "hard-random"} & set(flags) and "--resume" not in flags:
        given += ["--archive", str(places / "archive" / "archive.npz")]
    assert run_command(Finetune, given, name="finetune") == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1
