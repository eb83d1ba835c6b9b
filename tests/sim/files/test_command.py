"""How the commands end: exit codes, one line for what a user can mend, and files tried before the work."""

import sys
from pathlib import Path

import pytest

from qd.run.cli import run_command
from qd.studies import speed as search_speed
from sim.files.command import chosen_elites, exit_code_of
from train.evaluate.evaluate import evaluate
from train.ppo.ppo import speed


@pytest.fixture
def shipped_search() -> Path:
    return Path(__file__).parents[3] / "results" / "anymal" / "archive"


def fail(error: BaseException) -> int:
    raise error


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ValueError("two\nlines"), 2, "error: two lines\n"),
        (OSError("a/b cannot be written"), 2, "error: a/b cannot be written\n"),
        (FloatingPointError("not finite"), 2, "error: not finite\n"),
        (KeyboardInterrupt(), 130, "\nStopped.\n"),
    ],
)
def test_errors_become_one_line_and_an_exit_code(capsys, error, code, message):
    assert exit_code_of(lambda: fail(error)) == code
    assert capsys.readouterr().err == message


def test_a_bug_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        exit_code_of(lambda: fail(ZeroDivisionError()))


def test_ctrl_c_ends_an_evaluation_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # where its runs/ would be
    monkeypatch.setattr(evaluate, "open_evaluator", lambda *_, **__: fail(KeyboardInterrupt()))
    monkeypatch.setattr(
        sys, "argv", ["train.evaluate.evaluate", "--device", "cpu", "--terrains", "2", "--episodes", "1"]
    )
    assert evaluate.main() == 130
    assert capsys.readouterr().err.endswith("\nStopped.\n")


@pytest.mark.parametrize("out", ["/proc/nowhere/speed.json", "{folder}"])
def test_where_to_write_is_tried_before_the_timing(tmp_path, monkeypatch, capsys, out):
    out = out.format(folder=tmp_path)
    monkeypatch.setattr(speed, "time_training", lambda *_, **__: fail(ZeroDivisionError()))
    monkeypatch.setattr(sys, "argv", ["train.ppo.speed", "--device", "cpu", "--out", out])
    assert speed.main() == 2
    monkeypatch.setattr(search_speed, "measure", lambda *_: fail(ZeroDivisionError()))
    with pytest.raises(SystemExit) as exit:
        run_command(search_speed.Arguments, search_speed.main, ["--device", "cpu", "--out", out])
    assert exit.value.code == 2
    for line in [line for line in capsys.readouterr().err.splitlines() if "Warp" not in line]:
        assert line.startswith("error: ") and ("cannot write to" in line or "is a directory" in line)


@pytest.mark.parametrize(
    "flags", [["--iterations", "0"], ["--steps", "0"], ["--curve", "1000"], ["--curve", "0"]], ids=" ".join
)
def test_numbers_that_make_no_sense_are_refused_before_the_timing(capsys, flags):
    with pytest.raises(SystemExit) as exit:
        run_command(search_speed.Arguments, search_speed.main, ["--device", "cpu", *flags])
    assert exit.value.code == 2
    assert "must be positive and --curve multiples of 16" in capsys.readouterr().err


def test_a_run_of_another_device_is_not_timed_against_this_one(shipped_search):
    with pytest.raises(ValueError, match="was made on NVIDIA H200, the bare rate would be that of NVIDIA H100"):
        search_speed.read_iterations(shipped_search, 20, "NVIDIA H100")
    cfg, metrics, terrains = search_speed.read_iterations(shipped_search, 20, "NVIDIA H200")
    assert (cfg.robot, len(metrics), terrains.shape) == ("anymal", 20, (200, 64))


def test_elites_are_named_by_numbers_or_all():
    assert chosen_elites("1", 3, "a run") == [1]
    assert chosen_elites("2 0, 2", 3, "a run") == [2, 0]
    assert chosen_elites("all", 3, "a run") == [0, 1, 2]
    for text in ("3", "-1", "one", "", "0 3", "0 all", "1.0", "²"):
        with pytest.raises(ValueError, match=r"^a run has no elite .*: expected all, or numbers of 0 to 2$"):
            chosen_elites(text, 3, "a run")
    with pytest.raises(ValueError, match="the archive is empty"):
        chosen_elites("all", 0, "a run")
