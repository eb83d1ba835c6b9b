"""How commands start, fail and end, and the command lines that are printed."""

import json
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from sim.files.command import (
    Interrupted,
    UserError,
    Where,
    Which,
    Who,
    chosen_elites,
    command_line,
    peek,
    publish,
    run_command,
)

ERRORS = {"value": ValueError("two\nlines"), "user": UserError("a worker is lost"), "bug": ZeroDivisionError()}
ERRORS |= {"file": OSError("a/b cannot be written"), "number": FloatingPointError("not finite")}
ERRORS |= {"own status": type("NothingError", (UserError,), {"status": 1})("nothing is valid")}
ERRORS |= {"stop": KeyboardInterrupt(), "resumable": Interrupted("Stopped; 3 saved. Resume with x")}


@dataclass(frozen=True, kw_only=True)
class Toy(Who, Where, Which):
    """Fail as told."""

    how: str = ""
    """What to raise."""
    status: int | None = None
    """What to return."""

    def execute(self) -> int | None:
        if self.how:
            raise ERRORS[self.how]
        return self.status


def run(*argv):
    return run_command(Toy, argv, name="toy")


@pytest.mark.parametrize(
    ("how", "status", "message"),
    [
        ("value", 2, "error: two lines\n"),
        ("user", 2, "error: a worker is lost\n"),
        ("own status", 1, "error: nothing is valid\n"),
        ("file", 2, "error: a/b cannot be written\n"),
        ("number", 2, "error: not finite\n"),
        ("stop", 130, "\nStopped.\n"),
        ("resumable", 130, "\nStopped; 3 saved. Resume with x\n"),
    ],
)
def test_errors_become_one_line_and_an_exit_status(capsys, how, status, message):
    assert run("--how", how) == status
    assert capsys.readouterr().err == message


def test_a_command_returns_its_status():
    assert (run(), run("--status", "1")) == (0, 1)


def test_sigterm_in_the_midst_of_compiling_is_not_lost(monkeypatch):
    """What a handler raises in a call from llvmlite's C code is printed and dropped."""
    there = {"kill": lambda: os.kill(os.getpid(), signal.SIGTERM), "reached": []}
    exec(
        compile("def called_from_c():\n kill()\n reached.append(1)", "/x/llvmlite/binding/executionengine.py", "exec"),
        there,
    )

    @dataclass(frozen=True, kw_only=True)
    class Compiles:
        """Compiles."""

        def execute(self) -> None:
            """Compiles, and then waits."""
            there["called_from_c"]()
            time.sleep(30)

    began, before = time.monotonic(), signal.getsignal(signal.SIGTERM)
    try:
        assert run_command(Compiles, [], name="compiles") == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert there["reached"] and time.monotonic() - began < 20


def test_a_bug_keeps_its_traceback_and_so_does_every_error_for_debugging(monkeypatch):
    with pytest.raises(ZeroDivisionError):
        run("--how", "bug")
    monkeypatch.setenv("FAULTLINE_DEBUG", "1")
    with pytest.raises(ValueError, match="two"):
        run("--how", "value")
    monkeypatch.setenv("FAULTLINE_DEBUG", "0")
    assert run("--how", "value") == 2


def test_the_option_groups_are_flags(capsys):
    with pytest.raises(SystemExit) as end:
        run("--help")
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert "usage: faultline toy" in text and "Fail as told." in text
    assert [flag for flag in ("robot", "policy", "device", "workers", "run", "elite") if f"--{flag}" not in text] == []


def test_a_command_line_can_be_typed():
    flags = {"run": Path("runs/a b"), "elite": [0, 1], "reward": True, "device": None, "no_colour": False}
    assert command_line("replay", **flags) == "faultline replay --run 'runs/a b' --elite 0 1 --reward"
    assert command_line("view", run=Path("-x"), seed=-1) == "faultline view --run=-x --seed=-1"


def test_a_report_is_shown_and_written(tmp_path, capsys):
    file = tmp_path / "new" / "a.json"
    assert publish(file, lambda: {"a": 1}, lambda report: print("shown", report["a"])) == {"a": 1}
    assert capsys.readouterr().out == f"shown 1\nwritten to {file}\n"
    assert json.loads(file.read_text()) == {"a": 1}
    publish(None, lambda: {}, lambda report: None)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("out", ["/proc/nowhere/a.json", "{folder}"])
def test_where_to_write_is_tried_before_the_work(tmp_path, out):
    with pytest.raises(ValueError, match=r"cannot write to|is a directory"):
        publish(Path(out.format(folder=tmp_path)), lambda: pytest.fail("worked"), print)


def test_elites_are_named_by_numbers_or_all():
    assert chosen_elites("1", 3, "a run") == [1]
    assert chosen_elites("2 0, 2", 3, "a run") == [2, 0]
    assert chosen_elites("all", 3, "a run") == [0, 1, 2]
    for text in ("3", "-1", "one", "", "0 3", "0 all", "1.0", "²"):
        with pytest.raises(ValueError, match="a run has no elite"):
            chosen_elites(text, 3, "a run")
    with pytest.raises(ValueError, match="a run"):
        chosen_elites("all", 0, "a run")


@pytest.mark.parametrize(
    ("line", "value"),
    [("--preset wide --seed 3", "wide"), ("--preset=wide", "wide"), ("--seed 3", None), ("--preset b --preset=a", "a")],
)
def test_a_flag_is_looked_at_before_the_others_are_parsed(line, value):
    assert peek(line.split(), "--preset") == value
