"""Kills, a full disk and damaged files: nothing saved is lost, a run ends alike, and no code in a file runs."""

import contextlib
import hashlib
import io
import os
import pickle
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from qd.search.archive import read_archive, write_archive
from qd.search.checkpoint import load_checkpoint, save_checkpoint
from qd.workers.cache import Cache
from sim.controllers.loaders import load_policy
from sim.recording.recorder import read_recording
from sim.robots.find import get_robot
from tests.builders import judged_archive
from tests.kills import runs
from tests.kills.faults import fill, run_child
from train.ppo.checkpoint import read_checkpoint

SEED = 5
MUTATIONS = 100
EXPECTED = (ValueError, FileNotFoundError)


def mutated(whole: bytes, rng: np.random.Generator) -> bytes:
    """Bytes with one to three accidents: bits flipped, a piece lost, doubled or overwritten, or the end lost."""
    data = whole
    for _ in range(int(rng.integers(1, 4))):
        first, length = int(rng.integers(len(data))), int(rng.integers(1, 64))
        piece = data[first : first + length]
        kind = int(rng.integers(5))
        flipped = bytes([piece[0] ^ int(rng.integers(1, 256))]) + piece[1:]
        data = data[:first] + (flipped, b"", 2 * piece, rng.bytes(length), b"")[kind]
        data += b"" if kind == 4 else whole[first + length :]
        data = data or b"?"
    return data


def read_training(file: Path) -> Any:
    content = read_checkpoint(file)
    return content["iter"], {name: value.numpy().tobytes() for name, value in content["actor_state_dict"].items()}


def read_crossings(file: Path) -> Any:
    """None if the cache takes the file for absent."""
    arrays = Cache(file.parent).read(file.stem)
    return None if arrays is None else {name: array.tobytes() for name, array in arrays.items()}


READERS = {
    "checkpoint.bin": lambda file: pickle.dumps(load_checkpoint(file)["metrics"]),
    "training/checkpoint.pt": read_training,
    "archive.npz": lambda file: pickle.dumps(read_archive(file)),
    "key.npz": read_crossings,
}


@pytest.fixture(scope="module")
def formats(nursery, tmp_path_factory) -> Path:
    """A folder with a whole file of each format."""
    folder = tmp_path_factory.mktemp("formats")
    assert run_child(folder / "log", runs.train, folder / "training", iterations=1)[0] == 0
    state = {"metrics": [{"iteration": 1, "elites": 3}], "genes": np.linspace(-1, 1, 200, dtype=np.float32)}
    save_checkpoint(folder / "checkpoint.bin", state)
    Cache(folder).write("key", {"outcome": np.arange(80, dtype=np.uint8), "duration_s": np.linspace(0, 20, 80)})
    write_archive(folder / "archive.npz", judged_archive())
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_refused_or_says_what_was_written(formats, tmp_path, name):
    file, expected, num_refused = tmp_path / Path(name).name, READERS[name](formats / name), 0
    assert expected is not None
    for number in range(MUTATIONS):
        file.write_bytes(mutated((formats / name).read_bytes(), np.random.default_rng([SEED, number])))
        try:
            content = READERS[name](file)
        except EXPECTED as error:
            assert str(error).strip(), f"mutation {number}: an error without a word"
            content = None
        assert content in (None, expected), f"mutation {number}: taken, with another content"
        num_refused += content is None
    assert num_refused > MUTATIONS / 2


@dataclass
class Bomb:
    """A pickle that would make a file."""

    target: Path

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


def bombs(target: Path) -> dict[str, bytes]:
    """Files that would make ``target`` if anything in them ran."""
    bomb, packed, objects = Bomb(target), io.BytesIO(), io.BytesIO()
    torch.save({"actor_state_dict": {"mlp.0.weight": bomb}, "format": "faultline training checkpoint 1"}, packed)
    np.savez(objects, allow_pickle=True, **{name: np.array([bomb], dtype=object) for name in ("key", "robot", "genes")})
    pickled = pickle.dumps(bomb)
    search = b"faultline search checkpoint 7\n" + hashlib.sha256(pickled).digest() + pickled
    return {"pickle": pickled, "torch": packed.getvalue(), "search": search, "npz": objects.getvalue()}


LOADERS = {
    "checkpoint.bin": load_checkpoint,
    "checkpoint.pt": read_checkpoint,
    "key.npz": read_crossings,
    "archive.npz": read_archive,
    "elite-0.recording.npz": read_recording,
}
for policy in ("policy.pt", "controller.toml", "policy.onnx"):
    LOADERS[policy] = lambda file: load_policy(file, get_robot("anymal"), "cpu")


@pytest.mark.parametrize("name", LOADERS)
@pytest.mark.parametrize("kind", ["pickle", "torch", "search", "npz"])
def test_no_code_in_a_file_runs(tmp_path, name, kind):
    (tmp_path / name).write_bytes(bombs(tmp_path / "ran")[kind])
    with contextlib.suppress(EXPECTED):
        assert LOADERS[name](tmp_path / name) is None
    assert not (tmp_path / "ran").exists()


def test_the_bombs_go_off_where_code_may_run(tmp_path):
    pickle.loads(bombs(tmp_path / "ran")["pickle"])
    assert (tmp_path / "ran").exists()


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


def undisturbed(folder: Path, kind: str) -> tuple[list[str], Any]:
    """Names and files of all steps of a run that ends, and what it comes to."""
    run, outcome, *_ = KINDS[kind]
    code, output = run_child(folder / "log", run, folder / "whole", iterations=ITERATIONS, log=folder / "s")
    assert code == 0, output
    return (folder / "s").read_text().splitlines(), outcome(folder / "whole")


def at_last_of_each(steps: list[str], names: tuple[str, ...], disturb: Callable[[int, str], None]) -> None:
    """Disturbs a run at each step of these names: the last at each file, when most has been saved before."""
    last = {step: at for at, step in enumerate(steps) if step.startswith(names)}
    assert {step.split()[0] for step in last} == {*names}
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(disturb, last.values(), last))


@pytest.mark.slow
@pytest.mark.usefixtures("nursery")
@pytest.mark.parametrize("kind", ["search", "training"])
def test_a_run_killed_at_a_step_loses_nothing_and_ends_alike(folder, kind):
    run, outcome, saved, checkpoint = KINDS[kind]
    steps, whole = undisturbed(folder, kind)
    saves = [at for at, step in enumerate(steps) if step.startswith("replace") and step.endswith(f"/{checkpoint}")]
    assert len(saves) >= ITERATIONS

    def kill_at(at: int, step: str) -> None:
        path, log = folder / f"run-{at}", folder / f"log-{at}"
        assert run_child(log, run, path, iterations=ITERATIONS, at=at)[0] is None, f"not killed at {at}, {step}"
        assert saved(path) == min(sum(save < at for save in saves), ITERATIONS), f"killed before step {at}, {step}"
        code, output = run_child(log, run, path, iterations=ITERATIONS)
        assert code == 0 and "Traceback" not in output, f"killed before step {at}, {step}:\n{output}"
        assert outcome(path) == whole, f"killed before step {at}, {step}"

    at_last_of_each(steps, ("mkdir", "rest", "replace"), kill_at)


@pytest.mark.slow
@pytest.mark.usefixtures("nursery")
@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_that_fills_up_is_said_in_a_line_and_the_run_goes_on_once_there_is_space(folder, kind):
    run, outcome, *_ = KINDS[kind]
    steps, whole = undisturbed(folder, kind)

    def fill_at(at: int, step: str) -> None:
        path, log = folder / f"run-{at}", folder / f"log-{at}"
        code, output = run_child(log, run, path, iterations=ITERATIONS, at=at, fault=fill)
        assert code == 2 and "Traceback" not in output, f"no space at step {at}, {step}:\n{output}"
        assert sum(line.startswith("error: ") for line in output.splitlines()) == 1, output
        assert not list(path.rglob(".*.tmp")), "what could not be written takes space"
        code, output = run_child(log, run, path, iterations=ITERATIONS)
        assert code == 0 and outcome(path) == whole, f"no space at step {at}, {step}, and then:\n{output}"

    at_last_of_each(steps, ("open", "rest"), fill_at)
