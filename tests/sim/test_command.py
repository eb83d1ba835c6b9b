"""How the commands end: exit codes, one line for what a user can mend, and files tried before the work."""

import sys

import pytest

from qd import speed as search_speed
from qd.cli import run_command
from sim.command import exit_code_of
from train import evaluate, speed


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


def test_ctrl_c_ends_an_evaluation_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "Rollout", lambda *_, **__: fail(KeyboardInterrupt()))
    monkeypatch.setattr(sys, "argv", ["train.evaluate", "--device", "cpu", "--terrains", "2", "--episodes", "1"])
    assert evaluate.main() == 130
    assert capsys.readouterr().err.endswith("\nStopped.\n")


@pytest.mark.parametrize("out", ["/proc/nowhere/speed.json", "{folder}"])
def test_where_to_write_is_tried_before_the_timing(tmp_path, monkeypatch, capsys, out):
    out = out.format(folder=tmp_path)
    monkeypatch.setattr(speed, "time_training", lambda *_, **__: fail(ZeroDivisionError()))
    monkeypatch.setattr(sys, "argv", ["train.speed", "--device", "cpu", "--out", out])
    assert speed.main() == 2
    monkeypatch.setattr(search_speed, "measure", lambda *_: fail(ZeroDivisionError()))
    with pytest.raises(SystemExit) as exit:
        run_command(search_speed.Arguments, search_speed.main, ["--device", "cpu", "--out", out])
    assert exit.value.code == 2
    for line in [line for line in capsys.readouterr().err.splitlines() if "Warp" not in line]:
        assert line.startswith("error: ") and ("cannot write to" in line or "is a directory" in line)
