"""How commands start, fail and end, and the command lines that are printed."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from sim.files.command import Interrupted, UserError, choose_elites, command_line, peek, publish, run_command
from sim.files.settings import NonNegativeInt

NothingError = type("NothingError", (UserError,), {"status": 1})
IMAGE = str(Path.home() / "hill.png")
ERRORS = {  # what is raised, the exit status, and the line on stderr, or what it must have
    "value": (ValueError("two\nlines"), 2, "^error: two lines\n$"),
    "own status": (NothingError("nothing is valid"), 1, "^error: nothing is valid\n$"),
    "number": (FloatingPointError("not finite"), 2, "^error: not finite\n$"),
    "stop": (KeyboardInterrupt(), 130, "^\nStopped.\n$"),
    "resumable": (Interrupted("Stopped; 3 saved"), 130, "^\nStopped; 3 saved\n$"),
    "kernels": (Exception("Failed to load CPU module 'x'"), 2, "/cache/warp .*remove"),
    "cache": (OSError(13, "Permission denied", "/cache/warp/x"), 2, "/cache/warp: .*WARP_CACHE_PATH"),
    "package": (ModuleNotFoundError("No module named 'onnx'", name="onnx"), 2, r"make setup.*faultline\[onnx\]"),
    "file at home": (OSError(2, "No such file", IMAGE), 2, f"No such file: '{IMAGE}'\n$"),
    "bug": (ZeroDivisionError(), 0, ""),
}


@dataclass(frozen=True, kw_only=True)
class Toy:
    """Fail as told."""

    how: str = ""  # what to raise; "term" waits for a signal that arrives while code is compiled
    status: NonNegativeInt | None = None
    size: tuple[float, float] | None = None

    def execute(self) -> int | None:
        if self.how == "term":
            compiled = {"kill": lambda: os.kill(os.getpid(), signal.SIGTERM)}
            exec(compile("def called_from_c():\n kill()\n reached = True", "/x/llvmlite/engine.py", "exec"), compiled)
            compiled["called_from_c"]()
            time.sleep(30)
        elif self.how in ERRORS:
            raise ERRORS[self.how][0]
        elif self.how == "broken":
            read, write = os.pipe()
            os.close(read)
            os.write(write, b"x")
        print("a word", flush=self.how == "now")
        return self.status


def run(*argv):
    return run_command(Toy, argv, name="toy")


def run_apart(*argv, **options):
    script = "import sys; from tests.sim.files.test_command import run; sys.exit(run(*sys.argv[1:]))"
    return subprocess.run([sys.executable, "-c", script, *argv], text=True, stderr=subprocess.PIPE, **options)


@pytest.mark.parametrize("how", [how for how in ERRORS if how != "bug"])
def test_errors_become_one_line_and_an_exit_status(capsys, how, monkeypatch):
    monkeypatch.setenv("WARP_CACHE_PATH", "/cache/warp")
    _, status, message = ERRORS[how]
    assert run("--how", how) == status
    assert re.search(message, capsys.readouterr().err)


def test_a_command_returns_its_status_and_refuses_flags_out_of_their_range(capsys):
    assert (run(), run("--status", "1")) == (0, 1)
    for argv in (("--status", "-1"), ("--size", "3"), ("--status=z",), ("--nobody",)):
        assert run(*argv) == 2 and argv[0].strip("-=z") in capsys.readouterr().err


WIDTHS = (1, 2, 3, 5, 8, 13, 20, 39, 40, 41, 46, 80, 200, 399, 400)
HELP_IN_ANY_WIDTH = f"""
import os
import faultline
for columns in {WIDTHS}:
    os.environ["COLUMNS"] = str(columns)
    assert faultline.main(["archive", "--help"]) == 0
    assert faultline.main(["archive", "--nobody"]) == 2
"""


@pytest.mark.slow
def test_help_fits_a_terminal_of_any_width_and_says_no_none(capsys, monkeypatch):
    for columns in WIDTHS:
        monkeypatch.setenv("COLUMNS", str(columns))
        assert run("--help") == 0
        text = capsys.readouterr().out
        assert text.startswith("Fail as told.") and "usage: faultline toy" in text and "--status INT" in text
        assert "None" not in text and "(default: )" not in text
        assert max(len(line) for line in text.splitlines() if not line.startswith("usage")) <= max(columns, 40)
    limit = (2**33, 2**33)  # [B]; a help that never ends would take all memory
    options = {"capture_output": True, "preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_AS, limit)}
    done = subprocess.run([sys.executable, "-c", HELP_IN_ANY_WIDTH], timeout=120, **options)
    assert done.returncode == 0, done.stderr[-2000:]


def test_sigterm_in_the_midst_of_compiling_is_not_lost():
    """What a handler raises in a call from llvmlite's C code is printed and dropped: it comes again afterwards."""
    began, before = time.monotonic(), signal.getsignal(signal.SIGTERM)
    try:
        assert run("--how", "term") == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert 0.05 < time.monotonic() - began < 20


def test_a_bug_has_its_traceback_and_so_has_every_error_for_debugging(monkeypatch, capsys):
    assert run("--how", "bug") == 2
    assert "Traceback" in (err := capsys.readouterr().err) and "ZeroDivisionError" in err
    monkeypatch.setenv("FAULTLINE_DEBUG", "1")
    assert run("--how", "value") == 2
    assert "Traceback" in (err := capsys.readouterr().err) and "two" in err


@pytest.mark.parametrize("flag", ["--how=end", "--how=now", "--help"])
@pytest.mark.slow
def test_where_nobody_reads_its_output_any_more_a_command_ends_without_a_word(flag):
    """As in ``faultline ... | head -1``, whether it notices at once or when it ends."""
    read, write = os.pipe()
    os.close(read)
    done = run_apart(flag, stdout=write)
    os.close(write)
    assert done.returncode == 1 and not done.stderr
    another = run_apart("--how=broken", stdout=subprocess.DEVNULL)
    assert another.returncode == 2 and another.stderr.startswith("error: ")


def test_a_command_line_can_be_typed():
    flags = {"run": Path("runs/a b"), "elite": [0, 1], "reward": True, "device": None, "no_colour": False}
    assert command_line("replay", **flags) == "faultline replay --run 'runs/a b' --elite 0 1 --reward"
    assert command_line("view", run=Path("-x"), seed=-1) == "faultline view --run=-x --seed=-1"
    flags = {"robot": "/mine/robot.toml", "run": Path.cwd() / "runs" / "a", "policy": f"{Path.cwd()}/b/act.py:act"}
    assert command_line("film", **flags) == "faultline film --robot /mine/robot.toml --run runs/a --policy b/act.py:act"
    elsewhere = f"/x{Path.cwd()}/a"  # the present folder's path within another one
    assert command_line("view", run=elsewhere) == f"faultline view --run {elsewhere}"


def test_a_report_is_shown_and_written_and_where_is_tried_before_the_work(tmp_path, capsys):
    file = tmp_path / "new" / "a.json"
    assert publish(file, lambda: {"a": 1}, lambda report: print("shown", report["a"])) == {"a": 1}
    assert capsys.readouterr().out == f"shown 1\nwritten to {file}\n"
    assert json.loads(file.read_text()) == {"a": 1}
    for nowhere in (Path("/proc/nowhere/a.json"), tmp_path):
        with pytest.raises(ValueError, match=f"{nowhere.parts[1]}"):
            publish(nowhere, lambda: pytest.fail("worked"), print)


def test_elites_are_named_by_numbers_or_all():
    assert choose_elites("2 0, 2", [0, 2], "") == [2, 0] and choose_elites("all", range(3), "") == [0, 1, 2]
    for text, count in (("3", 3), ("-1", 3), ("", 3), ("0 all", 3), ("all", 0)):
        with pytest.raises(ValueError, match="a run"):
            choose_elites(text, range(count), "a run has no elite")


@pytest.mark.parametrize(("line", "value"), [("--seed 3 --a wide", "wide"), ("--a=b=c", "b=c"), ("--a b --a=", "")])
def test_a_flag_is_looked_at_before_the_others_are_parsed(line, value):
    assert peek(line.split(), "--a") == value and peek(line.split(), "--b") is None
