"""A kill, and a full disk, at the steps that a run takes on the disk: nothing saved is lost, and it ends alike."""

import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.kills import runs
from tests.kills.faults import fill, run_child

ITERATIONS = 2
KINDS = {
    "search": (runs.search, runs.search_outcome, runs.saved_iterations, "checkpoint.bin"),
    "training": (runs.train, runs.train_outcome, runs.saved_updates, "checkpoint.pt"),
}


@pytest.fixture
def folder(tmp_path):
    """An empty folder in memory where the system has one: every write waits for the disk, and here there are many."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else tmp_path) as path:
        yield Path(path)


def undisturbed(folder: Path, kind: str) -> list[str]:
    """Names and files of all steps of a run that ends, which is left in ``whole``."""
    code, output = run_child(folder / "log", KINDS[kind][0], folder / "whole", iterations=ITERATIONS, log=folder / "s")
    assert code == 0, output
    return (folder / "s").read_text().splitlines()


def saves(steps: list[str], checkpoint: str) -> int:
    return sum(step.startswith("replace") and step.endswith(f"/{checkpoint}") for step in steps)


def at_last_of_each(steps: list[str], names: tuple[str, ...], disturb: Callable[[int, str], None]) -> None:
    """Disturbs a run at each step of these names: the last at each file, when most has been saved before."""
    last = {step: at for at, step in enumerate(steps) if step.startswith(names)}
    assert {step.split()[0] for step in last} == {*names}
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(disturb, last.values(), last))


@pytest.mark.parametrize("kind", ["search", pytest.param("training", marks=pytest.mark.slow)])
def test_a_run_killed_at_a_step_loses_nothing_and_ends_alike(folder, kind):
    run, outcome, saved, checkpoint = KINDS[kind]
    steps = undisturbed(folder, kind)
    whole = outcome(folder / "whole")
    assert saves(steps, checkpoint) >= ITERATIONS

    def kill_at(at: int, step: str) -> None:
        path, log = folder / f"run-{at}", folder / f"log-{at}"
        assert run_child(log, run, path, iterations=ITERATIONS, at=at)[0] is None, f"not killed at {at}, {step}"
        assert saved(path) == min(saves(steps[:at], checkpoint), ITERATIONS), f"killed before step {at}, {step}"
        code, output = run_child(log, run, path, iterations=ITERATIONS)
        assert code == 0 and "Traceback" not in output, f"killed before step {at}, {step}:\n{output}"
        assert outcome(path) == whole, f"killed before step {at}, {step}"

    at_last_of_each(steps, ("mkdir", "rest", "replace"), kill_at)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_that_fills_up_is_said_in_a_line_and_the_run_goes_on_once_there_is_space(folder, kind):
    run, outcome, *_ = KINDS[kind]
    steps = undisturbed(folder, kind)
    whole = outcome(folder / "whole")

    def fill_at(at: int, step: str) -> None:
        path, log = folder / f"run-{at}", folder / f"log-{at}"
        code, output = run_child(log, run, path, iterations=ITERATIONS, at=at, fault=fill)
        assert code == 2 and "Traceback" not in output, f"no space at step {at}, {step}:\n{output}"
        assert sum(line.startswith("error: ") for line in output.splitlines()) == 1, output
        assert not list(path.rglob(".*.tmp")), "what could not be written takes space"
        code, output = run_child(log, run, path, iterations=ITERATIONS)
        assert code == 0 and outcome(path) == whole, f"no space at step {at}, {step}, and then:\n{output}"

    at_last_of_each(steps, ("open", "rest"), fill_at)
