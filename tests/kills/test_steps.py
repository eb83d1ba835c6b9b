"""A kill before every single step a run takes on the disk, and after the last: what comes of it is bit-identical."""

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sim.policy.loaders import load_policy
from sim.robots.find import get_robot
from tests.kills import searches, trainings
from tests.kills.children import Child, run_child
from tests.kills.searches import search_watched
from tests.kills.trainings import train_watched

ITERATIONS = 2


def steps_of(folder: Path, watched) -> list[str]:
    """Names and files of all steps of an undisturbed run, which is left in ``whole``."""
    log = folder / "steps"
    code, output = run_child(folder / "log", watched, folder / "whole", iterations=ITERATIONS, log=log)
    assert code == 0, output
    return log.read_text().splitlines()


def at_each(steps: dict[int, str], check: Callable[[int, str], None]) -> None:
    """Checks steps by their numbers, two at a time."""
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(check, steps.keys(), steps.values()))


@pytest.mark.kills
def test_a_search_killed_at_any_step_resumes_to_the_same_bits(folder):
    steps = steps_of(folder, search_watched)
    whole = searches.outcome(folder / "whole")
    for name in ("config.json", "checkpoint.bin", "metrics.jsonl", "archive.npz", "archive.json"):
        assert sum(f".{name}.tmp" in step for step in steps) >= 5, name  # open, write, rest, fsync, close
        assert any(step.startswith("replace") and step.endswith(f"/{name}") for step in steps), name

    def kill_at(at: int, step: str) -> None:
        path, log = folder / f"run-{at}", folder / f"log-{at}"
        assert run_child(log, search_watched, path, iterations=ITERATIONS, at=at)[0] == -9, (
            f"step {at}, {step}: not killed"
        )
        done = searches.saved_iterations(path) if path.exists() else 0
        code, output = run_child(log, searches.search, path, iterations=ITERATIONS)
        assert code == 0 and "Traceback" not in output, f"killed before step {at}, {step}:\n{output}"
        assert done == 0 or f"after {done} done" in output or f"All {done} iterations" in output, output
        assert searches.outcome(path) == whole, f"killed before step {at}, {step}"
        assert (path / "archive.json").exists()
        shutil.rmtree(path)

    at_each(dict(enumerate(steps)), kill_at)


@pytest.fixture(scope="module")
def stopped_trainings(tmp_path_factory):
    """Checkpoints of undisturbed trainings of 0, 1 and 2 iterations, and of what each comes to when it goes on."""
    folder = tmp_path_factory.mktemp("trainings")
    at_stop, at_end = [{}], []
    for done in range(ITERATIONS + 1):
        path = folder / str(done)
        for iterations in ([done] if done else []) + [ITERATIONS]:
            code, output = run_child(folder / "log", trainings.train, path, iterations=iterations)
            assert code == 0, output
            if iterations == done:
                at_stop.append(trainings.saved(path))
        at_end.append(trainings.saved(path))
    return at_stop, at_end


@pytest.mark.kills
def test_a_training_killed_at_any_step_loses_nothing_saved_and_goes_on_from_there(folder, stopped_trainings):
    at_stop, at_end = stopped_trainings
    steps = steps_of(folder, train_watched)
    for name in ("config.json", "checkpoint.pt", "policy.pt", "policy.train.json"):
        assert any(step.startswith("replace") and step.endswith(f"/{name}") for step in steps), name
    assert any("tfevents" in step for step in steps)

    def kill_at(at: int, step: str) -> None:
        path, log = folder / f"run-{at}", folder / f"log-{at}"
        code, output = run_child(log, train_watched, path, iterations=ITERATIONS, at=at)
        assert code == -9, f"step {at}, {step}: {output}"
        left = trainings.saved(path)
        done = left.get("iter", 0)
        saves = sum(earlier.startswith("replace") and "checkpoint" in earlier for earlier in steps[:at])
        assert done == min(saves, ITERATIONS), f"killed before step {at}, {step}"
        assert trainings.equal(left, at_stop[done]), f"killed before step {at}, {step}"
        code, output = run_child(log, trainings.train, path, iterations=ITERATIONS)
        assert code == 0 and "Traceback" not in output, f"killed before step {at}, {step}:\n{output}"
        assert trainings.equal(trainings.saved(path), at_end[done]), f"killed before step {at}, {step}"
        load_policy(path / "policy.pt", get_robot("anymal"), "cpu")
        shutil.rmtree(path)

    at_each(dict(enumerate(steps)), kill_at)


def test_tensorboard_reads_on_beside_a_file_cut_off_in_a_record(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    path = folder / "run"
    steps = steps_of(folder, train_watched)
    at = max(number for number, step in enumerate(steps) if step.startswith("rest") and "tfevents" in step)
    assert run_child(folder / "log", train_watched, path, iterations=ITERATIONS, at=at)[0] == -9
    assert run_child(folder / "log", trainings.train, path, iterations=ITERATIONS + 1)[0] == 0
    events = EventAccumulator(str(path))
    events.Reload()
    assert ITERATIONS + 1 in [event.step for event in events.Scalars("train/level")]


def test_children_are_killed_at_the_step_asked_for(folder):
    child = Child(folder / "log", search_watched, folder / "run", iterations=ITERATIONS, at=0)
    assert child.wait() == -9
    assert not (folder / "run").exists()  # its first step is to make the folder
