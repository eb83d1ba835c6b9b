"""A disk that fills up: one clear line, nothing saved is lost, and the run goes on once there is space."""

import os
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.kills import commands, searches, trainings
from tests.kills.children import run_child
from tests.kills.damage import copied
from tests.kills.steps import NEEDS_SPACE, fill

DONE, WANTED = 2, 3


def check_message(code: int, output: str, where: str) -> None:
    assert "Traceback" not in output and "Exception ignored" not in output, f"{where}:\n{output}"
    assert code == 2, f"{where}: exit code {code}\n{output}"
    (line,) = [line for line in output.splitlines() if line.startswith("error: ")]
    assert "No space left on device" in line or "File too large" in line, line
    assert "/run" in line, f"{line}\nnames no path"
    assert "make room" in line or "give another" in line or "name another" in line, f"{line}\nsays nothing to do"


@pytest.fixture
def begun(folder):
    """A search of two iterations, and the outcome of the same with three."""
    assert run_child(folder / "log", searches.search, folder / "begun", iterations=DONE)[0] == 0
    longer = copied(folder / "begun", folder / "longer")
    assert run_child(folder / "log", searches.search, longer, iterations=WANTED)[0] == 0
    return folder / "begun", searches.outcome(longer)


def steps_that_need_space(folder: Path, function, path: Path, **named) -> dict[int, str]:
    log = folder / "steps"
    assert run_child(folder / "log", function, path, log=log, **named)[0] == 0
    steps = dict(enumerate(log.read_text().splitlines()))
    return {at: step for at, step in steps.items() if step.split()[0] in NEEDS_SPACE}


def each(steps: dict[int, str], check) -> None:
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(check, steps.keys(), steps.values()))


@pytest.mark.kills
def test_no_space_at_any_step_of_a_search(folder, begun):
    short, longer = begun
    steps = steps_that_need_space(folder, searches.search_watched, copied(short, folder / "run"), iterations=WANTED)
    assert len(steps) > 30

    def fill_at(at: int, step: str) -> None:
        path, log = copied(short, folder / f"run-{at}"), folder / f"log-{at}"
        before = searches.saved_iterations(path)
        named = {"iterations": WANTED, "at": at, "fault": fill, "lasting": True}
        check_message(*run_child(log, searches.search_watched, path, **named), f"no space at step {at}, {step}")
        assert searches.saved_iterations(path) >= before
        assert not list(path.glob(".*.tmp")), "what could not be written takes space"
        code, output = run_child(log, searches.search, path, iterations=WANTED)
        assert code == 0, f"no space at step {at}, {step}, and then:\n{output}"
        assert searches.outcome(path) == longer, f"no space at step {at}, {step}"

    each(steps, fill_at)


@pytest.mark.kills
def test_no_space_at_any_step_of_a_training(folder):
    steps = steps_that_need_space(folder, trainings.train_watched, folder / "run", iterations=1)

    def fill_at(at: int, step: str) -> None:
        path, log = folder / f"run-{at}", folder / f"log-{at}"
        named = {"iterations": 1, "at": at, "fault": fill, "lasting": True}
        check_message(*run_child(log, trainings.train_watched, path, **named), f"no space at step {at}, {step}")
        code, output = run_child(log, trainings.train, path, iterations=1)
        assert code == 0, f"no space at step {at}, {step}, and then:\n{output}"
        assert trainings.saved(path)["iter"] == 1

    each(steps, fill_at)


@pytest.mark.parametrize("limit", [3000, 9000])
@pytest.mark.kills
def test_a_limit_of_the_system_on_file_sizes(folder, begun, limit):
    short, longer = begun
    path = copied(short, folder / "run")
    check_message(*run_child(folder / "log", commands.search_below, limit, path, WANTED), f"files below {limit} bytes")
    assert run_child(folder / "log", searches.search, path, iterations=WANTED)[0] == 0
    assert searches.outcome(path) == longer


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a file system")
@pytest.mark.kills
def test_a_file_system_that_is_full(tmp_path):
    mounted = tmp_path / "small"
    mounted.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o"]
    if subprocess.run([*mount, "size=40k", "none", mounted], capture_output=True).returncode:
        pytest.skip("a file system cannot be mounted here")
    try:
        path = mounted / "run"
        check_message(*run_child(tmp_path / "log", searches.search, path, iterations=WANTED), "40 kB")
        subprocess.run(["mount", "-o", "remount,size=4m", mounted], check=True)
        assert run_child(tmp_path / "log", searches.search, path, iterations=WANTED)[0] == 0
        assert run_child(tmp_path / "log", searches.search, tmp_path / "whole", iterations=WANTED)[0] == 0
        assert searches.outcome(path) == searches.outcome(tmp_path / "whole")
    finally:
        subprocess.run(["umount", mounted], check=True)
