"""Damaged files into the readers of the four formats that runs leave and go on from, and files that would run code."""

import contextlib
import hashlib
import io
import os
import pickle
import zlib
from collections.abc import Callable
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
from tests.kills.faults import run_child
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


def read_search(file: Path) -> Any:
    return pickle.dumps(load_checkpoint(file)["metrics"])


def read_training(file: Path) -> Any:
    content = read_checkpoint(file)
    return content["iter"], {name: value.numpy().tobytes() for name, value in content["actor_state_dict"].items()}


def read_elites(file: Path) -> Any:
    return pickle.dumps(read_archive(file))


def read_crossings(file: Path) -> Any:
    """None if the cache takes the file for absent."""
    arrays = Cache(file.parent).read(file.stem)
    return None if arrays is None else {name: array.tobytes() for name, array in arrays.items()}


READERS = (read_search, read_training, read_elites, read_crossings)


@pytest.fixture(scope="module")
def formats(tmp_path_factory) -> dict[Callable[[Path], Any], Path]:
    """A whole file of each format, by what reads it."""
    folder = tmp_path_factory.mktemp("formats")
    assert run_child(folder / "log", runs.train, folder / "training", iterations=1)[0] == 0
    state = {"metrics": [{"iteration": 1, "elites": 3}], "genes": np.linspace(-1, 1, 200, dtype=np.float32)}
    save_checkpoint(folder / "checkpoint.bin", state)
    Cache(folder).write("key", {"outcome": np.arange(80, dtype=np.uint8), "duration_s": np.linspace(0, 20, 80)})
    write_archive(folder / "archive.npz", judged_archive())
    files = ("checkpoint.bin", "training/checkpoint.pt", "archive.npz", "key.npz")
    return dict(zip(READERS, map(folder.joinpath, files), strict=True))


@pytest.mark.parametrize("read", READERS)
def test_a_damaged_file_is_refused_or_says_what_was_written(formats, tmp_path, read):
    whole, expected, num_refused = formats[read].read_bytes(), read(formats[read]), 0
    assert expected is not None
    for number in range(MUTATIONS):
        file = tmp_path / formats[read].name
        file.write_bytes(mutated(whole, np.random.default_rng([SEED, number])))
        try:
            content = read(file)
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
    payload = zlib.compress(pickle.dumps({"archive": bomb}))
    search = b"faultline search checkpoint 1\n" + hashlib.sha256(payload).digest() + payload
    return {"pickle": pickle.dumps(bomb), "torch": packed.getvalue(), "search": search, "npz": objects.getvalue()}


LOADERS = {
    "checkpoint.bin": load_checkpoint,
    "checkpoint.pt": read_checkpoint,
    "key.npz": read_crossings,
    "archive.npz": read_archive,
    "elite-0.recording.npz": read_recording,
    "policy.pt": lambda file: load_policy(file, get_robot("anymal"), "cpu"),
    "controller.toml": lambda file: load_policy(file, get_robot("anymal"), "cpu"),
    "policy.onnx": lambda file: load_policy(file, get_robot("anymal"), "cpu"),
}


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
