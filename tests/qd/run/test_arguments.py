"""Every mistake that a user can mend: one line on stderr, exit code 2, and existing runs as they were."""

import json
import os
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from qd.run.arguments import Archive, job_of
from qd.search import run_search
from qd.show import figures
from sim.files.command import run_command
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from tests.qd import stand_in

TINY = ["--device", "cpu", "--emitters", "1", "--batch-size", "4", "--replicas", "1", "--iterations", "1"]


def fine_policy(observation: torch.Tensor) -> torch.Tensor:
    return observation[:, :12]


def other_policy(observation: torch.Tensor) -> torch.Tensor:
    return observation[:, 12:24]


def narrow_policy(observation: torch.Tensor) -> torch.Tensor:
    return observation[:, :3]


def nan_policy(observation: torch.Tensor) -> torch.Tensor:
    return observation[:, :12] * float("nan")


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(figures, "write_figures", lambda *_: [])  # they take longer than the searches
    monkeypatch.setattr(RobotCfg, "read_penalty_scales", lambda self, policy=None: stand_in.SCALES)
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


@dataclass(frozen=True, kw_only=True)
class StandInArchive(Archive):
    """The search's command on the stand-in evaluator."""

    def execute(self) -> None:
        run_search(job_of(self), open_evaluator=stand_in.open_stand_in)


def run_main(*argv: str) -> int:
    return run_command(StandInArchive, argv, name="archive")


_OF_NO_GPU = ("Warp CUDA warning", "No CUDA device was found")  # said once a process


def fails(capsys, *argv: str) -> str:
    """The error line of a command that must fail as a user's mistake."""
    capsys.readouterr()
    assert run_main(*argv) == 2
    errors = capsys.readouterr().err
    lines = [line for line in errors.splitlines() if not line.startswith(_OF_NO_GPU)]
    assert len(lines) == 1, errors
    return lines[0].removeprefix("error: ")


def test_unknown_robot_and_preset(capsys):
    expected = "unknown robot 'dog': expected one of anymal, cassie, or a Python file that sets ROBOT"
    assert fails(capsys, "--robot", "dog").startswith(expected)
    assert fails(capsys, "--robot", "dog.py") == "dog.py: no such file"
    expected = "unknown terrain space 'blocks': expected one of super_gaussian, course, or file.py:CLASS"
    assert fails(capsys, "--space", "blocks", *TINY).startswith(expected)
    assert fails(capsys, "--preset", "huge", *TINY) == "unknown preset 'huge': expected one of wide, paper, small"
    assert not Path("runs").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here")
def test_cuda_that_is_not_there(capsys):
    assert "no CUDA device was found here" in fails(capsys, "--device", "cuda")
    assert "unknown device 'tpu'" in fails(capsys, "--device", "tpu")


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("missing.pt", "no such file"),
        (f"{__name__}:narrow_policy", "must return actions of shape (num_envs, 12)"),
        (f"{__name__}:nan_policy", "not finite"),
        (f"{__name__}:no_policy", "cannot be imported"),
        ("truncated.pt", "neither a checkpoint of plain tensors nor a TorchScript module"),
    ],
)
def test_controllers_that_cannot_be_used(capsys, policy, message):
    Path("truncated.pt").write_bytes(b"PK\x03\x04 and no more")
    assert message in fails(capsys, *TINY, "--policy", policy)
    assert not Path("runs").exists()


def test_a_setting_out_of_range(capsys):
    assert fails(capsys, *TINY, "--sigma0", "0") == "sigma0 must be at least 1e-06 and at most 1000, got 0.0"


def test_directories(capsys):
    Path("full").mkdir()
    Path("full/thesis.tex").write_text("years of work")
    assert "is not empty and holds no run" in fails(capsys, *TINY, "--run-dir", "full")
    assert "cannot be made: Not a directory" in fails(capsys, *TINY, "--run-dir", "full/thesis.tex/run")
    assert "no run at nowhere" in fails(capsys, "--resume", "nowhere")
    assert not Path("nowhere").exists()
    assert "not both" in fails(capsys, "--resume", "full", "--run-dir", "other")
    assert Path("full/thesis.tex").read_text() == "years of work"


def everything_in(folder: str) -> dict[str, bytes]:
    return {name: (Path(folder) / name).read_bytes() for name in sorted(os.listdir(folder))}


def test_a_run_is_never_overwritten(capsys):
    assert run_main(*TINY, "--run-dir", "a") == 0
    before = everything_in("a")
    again = fails(capsys, *TINY, "--run-dir", "a")
    assert "a holds this run already: go on with" in again
    assert "archive --robot anymal --resume a --device cpu`" in again
    assert "a holds a run of other settings: seed (0 there, 1 wanted)" in fails(
        capsys, *TINY, "--run-dir", "a", "--seed", "1"
    )
    other = fails(capsys, "--resume", "a", "--learning-rate", "0.5")
    assert "scheduler.learning_rate (0.09 there, 0.5 wanted)" in other
    assert 'preset ("small" there, "paper" wanted)' in fails(capsys, "--resume", "a", "--preset", "paper")
    assert everything_in("a") == before


def test_a_damaged_checkpoint_is_reported_and_left_alone(capsys):
    assert run_main(*TINY, "--run-dir", "a") == 0
    checkpoint = Path("a/checkpoint.bin")
    whole = checkpoint.read_bytes()
    for content, message in ((whole[:-100], "truncated or damaged"), (b"hello", "it is another file")):
        checkpoint.write_bytes(content)
        before = everything_in("a")
        assert message in fails(capsys, "--resume", "a", "--iterations", "3")
        assert everything_in("a") == before
    checkpoint.write_bytes(whole)
    assert run_main("--resume", "a", "--iterations", "3") == 0


def test_a_controller_that_moved_is_asked_for_and_taken_where_it_is_now(capsys):
    shutil.copy(get_robot("anymal").policy_file, "mine.pt")
    assert run_main(*TINY, "--policy", "mine.pt", "--run-dir", "a") == 0
    Path("mine.pt").rename("moved.pt")
    Path("other.pt").write_bytes(Path("moved.pt").read_bytes() + b"\0")
    before = everything_in("a")
    assert fails(capsys, "--resume", "a") == (
        "a was searched with the controller in mine.pt, got no such file now: put it back, or say where it is now "
        "with --policy"
    )
    assert 'policy ("mine.pt" there, "other.pt" wanted)' in fails(capsys, "--resume", "a", "--policy", "other.pt")
    assert everything_in("a") == before
    assert run_main("--resume", "a", "--iterations", "2", "--policy", "moved.pt") == 0
    assert json.loads(Path("a/archive.json").read_text())["iterations"] == 2
    Path("moved.pt").rename("mine.pt")
    assert run_main("--resume", "a", "--iterations", "3") == 0


def test_code_runs_only_if_it_is_named_again(capsys):
    fine = f"{__name__}:fine_policy"
    assert run_main(*TINY, "--policy", fine, "--run-dir", "a") == 0
    told = capsys.readouterr().out
    assert f"replay --robot anymal --run a --elite 0 --policy {fine}" in told
    before = everything_in("a")
    refused = f"a was searched with the controller {fine}, which is code: name it again (--policy {fine})"
    assert refused in fails(capsys, "--resume", "a", "--iterations", "2")
    assert f"archive --robot anymal --resume a --policy {fine} --device cpu" in fails(
        capsys, *TINY, "--policy", fine, "--run-dir", "a"
    )
    config = json.loads(Path("a/config.json").read_text())
    Path("evil.py").write_text("open('it_ran', 'w').close()\ndef act(row): pass\n")
    for policy in ("evil:act", f"{Path.cwd()}/evil.py:act", f"{Path.cwd()}/evil.py:act@a/checkpoint.bin"):
        settings = {**config["settings"], "policy": policy}
        Path("a/config.json").write_text(json.dumps({**config, "settings": settings}))
        assert "which is code" in fails(capsys, "--resume", "a", "--iterations", "2")
    settings = {**config["settings"], "robot": f"{Path.cwd()}/evil.py"}
    Path("a/config.json").write_text(json.dumps({**config, "settings": settings}))
    assert "which is not shipped: name its settings file too" in fails(capsys, "--resume", "a", "--policy", fine)
    assert not Path("it_ran").exists()
    Path("a/config.json").write_bytes(before["config.json"])
    assert run_main("--resume", "a", "--iterations", "2", "--policy", fine) == 0
    assert json.loads(Path("a/archive.json").read_text())["iterations"] == 2


def test_what_a_killed_beginning_leaves_is_begun_in_again():
    Path("a").mkdir()
    for name in (".config.json.tmp", ".write-test"):
        Path("a", name).write_text("{")
    assert run_main(*TINY, "--run-dir", "a") == 0
    assert Path("a/archive.npz").exists()


def test_a_lost_checkpoint_is_not_begun_over(capsys):
    assert run_main(*TINY, "--run-dir", "a") == 0
    Path("a/checkpoint.bin").unlink()
    assert "a/checkpoint.bin is lost: expected it beside metrics.jsonl and archive.npz" in fails(
        capsys, "--resume", "a"
    )


def test_new_runs_get_directories_of_their_own_and_stopped_ones_are_mentioned(capsys):
    assert run_main(*TINY) == 0
    assert run_main(*TINY) == 0
    assert sorted(os.listdir("runs")) == ["anymal-small-0", "anymal-small-0-2"]
    assert "holds the same search" not in capsys.readouterr().out
    config = json.loads(Path("runs/anymal-small-0/config.json").read_text())
    Path("runs/anymal-small-0/config.json").write_text(json.dumps({**config, "iterations": 9}))
    assert run_main(*TINY) == 0
    output = capsys.readouterr().out
    assert "runs/anymal-small-0 holds the same search, stopped after 1 of 9 iterations" in output
    assert "archive --robot anymal --resume runs/anymal-small-0 --device cpu" in output


def test_the_command_to_go_on_says_all_that_was_given_of_where_to_work(capsys):
    assert run_main(*TINY, "--run-dir", "a b$c") == 0
    message = fails(capsys, *TINY, "--run-dir", "a b$c", "--workers", "1", "--reproduce", "yes")
    assert message.endswith("archive --robot anymal --resume 'a b$c' --device cpu --workers 1 --reproduce yes`")


def test_a_resumed_run_keeps_where_it_came_from():
    assert run_main(*TINY, "--run-dir", "a") == 0
    first = json.loads(Path("a/config.json").read_text())
    assert run_main("--resume", "a", "--iterations", "2") == 0
    second = json.loads(Path("a/config.json").read_text())
    assert second.pop("iterations") == 2
    assert [one["iterations"] for one in second.pop("sessions")] == [1, 2]
    assert {**second, "iterations": 1, "sessions": first["sessions"]} == first
    assert set(first) >= {"settings", "command", "commit", "device", "versions", "seed", "date"}
