"""Random bytes and mutated files into every loader: the content comes out or a ValueError, and nothing runs."""

import hashlib
import io
import json
import os
import pickle
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from qd.archive import Archive, read_archive, write_archive
from qd.run.checkpoint import load_checkpoint
from qd.run.directory import RunDirectory
from sim.maps.heightmap import as_terrain, read_heightmap
from sim.maps.terrain_files import write_terrain
from sim.policy.export import to_onnx
from sim.policy.loaders import MlpPolicy, load_policy
from sim.recording.file import read_recording, write_recording
from sim.recording.recorder import Recording
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from tests.builders import small_archive
from tests.kills import searches, trainings
from tests.kills.children import run_child
from tests.kills.damage import flipped, npz, other_arrays, other_values
from tests.qd.recordings import recording_of
from train.ppo.checkpoint import FORMAT, read_checkpoint

SEED = 5
ANYMAL = get_robot("anymal")
EXPECTED = (ValueError, FileNotFoundError)


def mutated(whole: bytes, rng: np.random.Generator) -> bytes:
    """Bytes with one to three accidents: bits flipped, a piece lost, doubled or overwritten, the end lost, all lost."""
    data = whole
    for _ in range(int(rng.integers(1, 4))):
        if not data:
            return rng.bytes(100)
        first, length = int(rng.integers(len(data))), int(rng.integers(1, 64))
        kind = int(rng.integers(6))
        if kind == 0:
            data = flipped(data, first, int(rng.integers(1, 256)))
        elif kind < 4:
            data = (
                data[:first]
                + (b"", data[first : first + length] * 2, rng.bytes(length))[kind - 1]
                + data[first + length :]
            )
        elif kind == 4:
            data = data[:first]
        elif rng.random() < 0.2:
            data = rng.bytes(int(rng.integers(1, 2000)))
    return data


def load(what: str, read: Callable[[Path], Any], file: Path, data: bytes) -> Any:
    """What a loader makes of bytes; None where it refuses them as it should."""
    file.write_bytes(data)
    try:
        return read(file)
    except EXPECTED as error:
        assert str(error).strip(), f"{what}: an error without a word"
        return None
    except Exception as error:
        raise AssertionError(f"{what}: {type(error).__name__} instead of a ValueError: {error}") from error


def with_right_checksums(whole: bytes, rng: np.random.Generator) -> bytes:
    """A zip file with an accident in one of its parts before it was packed."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as old, zipfile.ZipFile(buffer, "w") as new:
        names = old.namelist()
        chosen = names[int(rng.integers(len(names)))]
        for name in names:
            new.writestr(name, mutated(old.read(name), rng) if name == chosen else old.read(name))
    return buffer.getvalue()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A search, a training and controllers in TorchScript and ONNX."""
    folder = tmp_path_factory.mktemp("made")
    assert run_child(folder / "log", searches.search, folder / "search", iterations=2)[0] == 0
    assert run_child(folder / "log", trainings.train, folder / "training", iterations=1)[0] == 0
    script = torch.jit.script(torch.nn.Sequential(torch.nn.Linear(235, 4), torch.nn.ELU(), torch.nn.Linear(4, 12)))
    script.save(folder / "script.ts")
    (folder / "policy.onnx").write_bytes(to_onnx(small_actor()))
    write_recording(folder / "elite-0.recording.npz", recording_of([1, 2, 3, 4], [14.0, 6.0, 8.0, 9.0]))
    hill = np.random.default_rng(0).uniform(-0.3, 0.3, (161, 321)).astype(np.float32)
    write_terrain(folder / "hill", hill, formats=["npz", "png"], about={})
    return folder


def small_actor() -> MlpPolicy:
    """An actor of four hidden units."""
    first, second = torch.linspace(-1, 1, 4 * 235).reshape(4, 235), torch.linspace(-1, 1, 12 * 4).reshape(12, 4)
    biases = {"mlp.0.bias": torch.zeros(4), "mlp.2.bias": torch.zeros(12)}
    return MlpPolicy({"mlp.0.weight": first, "mlp.2.weight": second, **biases})


def actions(file: Path) -> bytes:
    """What a controller does, bit for bit."""
    return load_policy(file, ANYMAL, "cpu")(torch.linspace(-1, 1, 8 * 235).reshape(8, 235)).detach().numpy().tobytes()


def elites(file: Path) -> bytes:
    """All of an archive, bit for bit."""
    archive = read_archive(file)
    return b"".join(np.asarray(getattr(archive, field.name)).tobytes() for field in fields(Archive))


def search_state(file: Path) -> bytes:
    return pickle.dumps(load_checkpoint(file)["metrics"])


def training_state(file: Path) -> bytes:
    content = read_checkpoint(file)
    counts = content["iter"], content["progress"]["env_steps"]
    return pickle.dumps([sorted(content), content["levels"].tolist(), *counts])


def recorded(file: Path) -> bytes:
    """All of a recording, bit for bit."""
    recording = read_recording(file)
    values = [getattr(recording, field.name) for field in fields(Recording)]
    return b"".join(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode() for value in values)


def terrain(file: Path) -> bytes:
    """The ground that a heightmap becomes, bit for bit."""
    return as_terrain(read_heightmap(file, size_m=(16, 8), scale_m=1e-5, offset_m=0)).tobytes()


LOADERS = {
    "a recording": ("elite-0.recording.npz", recorded),
    "a heightmap": ("hill.npz", terrain),
    "an image of heights": ("hill.png", terrain),
    "a controller's checkpoint": ("training/policy.pt", actions),
    "a TorchScript controller": ("script.ts", actions),
    "an ONNX controller": ("policy.onnx", actions),
    "the archive": ("search/archive.npz", elites),
    "the checkpoint of a search": ("search/checkpoint.bin", search_state),
    "the checkpoint of a training": ("training/checkpoint.pt", training_state),
}


@pytest.mark.kills
@pytest.mark.parametrize("what", LOADERS)
def test_mutated_files(made, tmp_path, what):
    name, read = LOADERS[what]
    whole = (made / name).read_bytes()
    expected = read(made / name)
    refused = 0
    for number in range(300):
        data = mutated(whole, np.random.default_rng([SEED, number]))
        content = load(f"{what}, seed {SEED}, mutation {number}", read, tmp_path / Path(name).name, data)
        refused += content is None
        assert content in (None, expected), f"{what}, seed {SEED}, mutation {number}: taken, with another content"
    assert refused > 200


@pytest.mark.kills
@pytest.mark.parametrize(
    "what",
    ["a controller's checkpoint", "the archive", "the checkpoint of a training", "a recording", "a heightmap"],
)
def test_mutated_parts_behind_right_checksums(made, tmp_path, what):
    name, read = LOADERS[what]
    whole = (made / name).read_bytes()
    for number in range(300):
        data = with_right_checksums(whole, np.random.default_rng([SEED, number]))
        load(f"{what}, seed {SEED}, repacked mutation {number}", read, tmp_path / Path(name).name, data)


def test_other_arrays_in_an_archive(tmp_path):
    write_archive(tmp_path / "archive.npz", small_archive())
    with np.load(tmp_path / "archive.npz") as data:
        arrays = {name: data[name] for name in data.files}
    older = [f"without {name}" for name in ("robot_sha256", "policy_sha256", "penalty_definition")]
    for name, others in other_arrays(arrays):
        taken = load(name, read_archive, tmp_path / "archive.npz", npz(others)) is not None
        assert taken == (name in older), f"{name} is {'taken' if taken else 'refused'}"


def read_scales(file: Path) -> tuple[float, ...]:
    robot = type("Robot", (RobotCfg,), {"scales_file": file})
    return robot(**{field.name: getattr(ANYMAL, field.name) for field in fields(RobotCfg)}).read_penalty_scales()


def read_config(file: Path) -> Any:
    return RunDirectory(file.parent).read_cfg()


JSON_LOADERS = {
    "penalty scales": (lambda made: ANYMAL.scales_file, read_scales),
    "the config of a search": (
        lambda made: made / "search/config.json",
        lambda file: RunDirectory(file.parent).read_cfg(),
    ),
}


@pytest.mark.parametrize("what", JSON_LOADERS)
def test_mutated_json(made, tmp_path, what):
    find, read = JSON_LOADERS[what]
    source = find(made)
    whole = source.read_bytes()
    file = tmp_path / "config.json"
    assert load(what, read, file, whole) is not None
    for number in range(600):
        rng = np.random.default_rng([SEED, number])
        data = mutated(whole, rng) if number % 2 else json.dumps(other_values(json.loads(whole), rng)).encode()
        load(f"{what}, seed {SEED}, mutation {number}", read, file, data)


def test_mutated_metrics_of_other_runs_are_passed_over(made, tmp_path):
    whole = (made / "search/metrics.jsonl").read_bytes()
    count = lambda file: RunDirectory(file.parent).iterations_done()  # noqa: E731
    for number in range(100):
        data = mutated(whole, np.random.default_rng([SEED, number]))
        load(f"metrics, seed {SEED}, mutation {number}", count, tmp_path / "metrics.jsonl", data)


class Bomb:
    """A pickle that would make a file."""

    def __init__(self, target: Path):
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


def bombs(target: Path) -> dict[str, bytes]:
    """Files that would make ``target`` if anything in them ran."""
    bomb = Bomb(target)
    state = {"actor_state_dict": {"mlp.0.weight": bomb}, "format": FORMAT, "extra": bomb}
    packed = io.BytesIO()
    torch.save(state, packed)
    payload = zlib.compress(pickle.dumps({"archive": bomb}))
    search = b"faultline search checkpoint 1\n" + hashlib.sha256(payload).digest() + payload
    objects = npz({field.name: np.array([bomb], dtype=object) for field in fields(Archive)})
    return {"pickle": pickle.dumps(bomb), "torch": packed.getvalue(), "search": search, "npz": objects}


@pytest.mark.kills
@pytest.mark.parametrize("what", LOADERS)
@pytest.mark.parametrize("kind", ["pickle", "torch", "search", "npz"])
def test_no_code_in_a_file_runs(tmp_path, what, kind):
    target = tmp_path / "ran"
    data = bombs(target)[kind]
    assert load(what, LOADERS[what][1], tmp_path / Path(LOADERS[what][0]).name, data) is None
    assert not target.exists()


def test_the_bombs_go_off_where_code_may_run(tmp_path):
    pickle.loads(bombs(tmp_path / "ran")["pickle"])
    assert (tmp_path / "ran").exists()
