"""Recordings on disk: one npz, read as data and checked before anything is made of it.

The file holds the fields of :class:`sim.recording.recorder.Recording` as arrays of those names, ``origin`` as JSON, and
``format`` as its name and version. Of terrains given by genes of a shipped space it holds no heights: the reader makes
them again. Of a space of a user's own it holds both, so that reading runs no code.
"""

import json
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Invalidity, Outcome
from sim.bank import heights_of
from sim.files.atomic import write_atomically
from sim.files.npz import array_names, npz_bytes, read_arrays
from sim.ground import PATCHES
from sim.recording.recorder import FRAME_ARRAYS, Recording, space_in
from sim.spaces.registry import get_space, is_own

FORMAT = "faultline recording 1"
"""Name and version in every file."""

_WORDS = ("robot", "joint_names", "foot_names", "penalty_names", "geom_names", "labels", "origin")
_KINDS = dict.fromkeys(_WORDS, "U") | {
    "seeds": "u", "outcome": "u", "invalidity": "u", "replicas": "i", "num_frames": "i", "fallen": "b",
    "touching": "b",
}  # fmt: skip
_NAMES = tuple(field.name for field in fields(Recording))
_LIMITS = {"base_position": 1e3, "base_quaternion": 1.001, "joint_position": 1e3, "command": 1e3}
"""Largest values that mean anything."""


def write_recording(path: Path, recording: Recording) -> None:
    """Writes a recording, atomically; equal recordings give equal bytes.

    Args:
        path: File to write, an ``.npz`` by custom.
        recording: What to write.

    Raises:
        OSError: If it cannot be written.
    """
    content: dict[str, Any] = {
        name: np.asarray(value)
        for name in _NAMES
        if name not in ("origin", "genes") and (value := getattr(recording, name)) is not None
    }
    content["geom_names"] = content["geom_names"].astype(str)  # none has no type of its own
    content |= {name: content[name].astype(kept) for name, kept in FRAME_ARRAYS.items()}
    if recording.genes is not None:
        content["genes"] = recording.genes
        if not is_own(space_in(recording.origin)):
            del content["heights"]
    content |= {"format": np.array(FORMAT), "origin": np.array(json.dumps(recording.origin))}
    write_atomically(path, npz_bytes(content))


def read_recording(path: str | Path) -> Recording:
    """Reads a recording; data only, nothing in the file can run.

    Args:
        path: What :func:`write_recording` wrote.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, another file, or of another version.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no recording at {path}: `faultline film` writes one beside its film")
    try:
        content = _read(path)
        _check_kinds(content)
        _check_shapes(content)
        recording = _built(content)
        _check_values(recording)
    except Exception as error:  # zip, zlib, npy headers and JSON answer damage with a dozen types
        raise ValueError(
            f"{path} must be a recording of crossings, but it is damaged or another file: {error}: record it again"
        ) from None
    return recording


def _read(path: Path) -> dict[str, NDArray[Any]]:
    found = array_names(path)
    version = str(read_arrays(path, ["format"])["format"]) if "format" in found else "none"
    if version != FORMAT:
        raise ValueError(f"its format must be '{FORMAT}', got {version}")
    absent = {"genes", "heights"} - {*found} if {"genes", "heights"} & {*found} else set()
    late = {"invalidity", "geom_names", "touching", "friction", "time_constant_s"} - {*found}  # the first have none
    content = read_arrays(path, [name for name in _NAMES if name not in absent | late])
    made = {"invalidity": np.zeros(content["outcome"].shape, np.uint8), "geom_names": np.array((), str)}
    return content | {name: made[name] for name in late & made.keys()}


def _check_kinds(content: dict[str, NDArray[Any]]) -> None:
    for name, value in content.items():
        expected = _KINDS.get(name, "f")
        if value.dtype.kind != expected:
            raise ValueError(f"{name} must be of kind '{expected}', got {value.dtype}")
        if name in FRAME_ARRAYS and value.dtype != FRAME_ARRAYS[name]:
            raise ValueError(f"{name} must be {np.dtype(FRAME_ARRAYS[name])}, got {value.dtype}")


def _check_shapes(content: dict[str, NDArray[Any]]) -> None:
    """That all arrays agree in how many terrains, episodes, frames, joints, feet and penalties there are."""
    (terrains,), (episodes,) = content["seeds"].shape, content["replicas"].shape
    each = (terrains, episodes)
    frames = content["base_position"].shape[2:3]
    row = {
        "base_position": (3,),
        "base_quaternion": (4,),
        "joint_position": content["joint_names"].shape,
        "foot_force": (*content["foot_names"].shape, 3),
        "penalties": content["penalty_names"].shape,
        "command": (3,),
    }
    expected = {name: (*each, *frames, *rest) for name, rest in row.items()}
    expected |= dict.fromkeys(("outcome", "invalidity", "fallen", "duration_s", "num_frames"), each)
    expected |= {"labels": (terrains,), "robot": (), "dt": (), "origin": ()}
    if "touching" in content:
        expected["touching"] = (*each, *frames, *content["geom_names"].shape)
    for name, shape in expected.items():
        if content[name].shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {content[name].shape}")
    for name in ("friction", "time_constant_s"):
        if name in content and (len(content[name]) != terrains or content[name].shape[1:] != PATCHES):
            raise ValueError(f"{name} must be maps of {terrains} terrains, got shape {content[name].shape}")
    for name, num_axes in (("genes", 2), ("heights", 3)):
        if name in content and (content[name].ndim != num_axes or len(content[name]) != terrains):
            raise ValueError(f"{name} must have {num_axes} axes and {terrains} terrains, got {content[name].shape}")
    if not terrains or not episodes or not frames or not frames[0]:
        raise ValueError(f"it must have terrains, episodes and frames, got {(*each, *frames)}")


def _built(content: dict[str, NDArray[Any]]) -> Recording:
    genes = content.get("genes")
    if genes is not None and not np.isfinite(genes).all():
        raise ValueError("genes must be finite")
    values: dict[str, Any] = {**content, "genes": genes}
    values |= {name: content[name].astype(np.float32) for name in FRAME_ARRAYS}
    for name in _WORDS:
        values[name] = tuple(content[name].tolist()) if content[name].ndim else str(content[name])
    origin = json.loads(values["origin"])
    if not isinstance(origin, dict):
        raise ValueError(f"origin must be a JSON object, got {type(origin).__name__}")
    if "heights" not in content and genes is not None:
        values["heights"] = heights_of(genes, get_space(space_in(origin)))
    return Recording(**values | {"origin": origin, "dt": float(content["dt"])})


def _check_values(recording: Recording) -> None:
    """That the numbers are such as episodes have."""
    if not 0.0 < recording.dt < 1.0 or not np.isfinite(recording.heights).all():
        raise ValueError(f"dt must be positive and below 1 s, and heights finite, got dt {recording.dt}")
    most = recording.base_position.shape[2]
    if not ((recording.num_frames >= 1) & (recording.num_frames <= most)).all():
        raise ValueError(f"num_frames must lie in 1..{most}")
    ended = (recording.outcome > Outcome.RUNNING) & (recording.outcome <= max(Outcome))
    if not ended.all() or not (recording.duration_s > 0.0).all():
        raise ValueError(f"outcomes must lie in 1..{max(Outcome)} and durations be positive")
    if (recording.invalidity > max(Invalidity)).any():
        raise ValueError(f"invalidity must lie in 0..{max(Invalidity)}")
    there = np.arange(most) < recording.num_frames[..., None]
    for name in FRAME_ARRAYS:
        values = getattr(recording, name)
        known = np.isfinite(values).reshape(*there.shape, -1)
        if not known[there].all() or known[~there].any():
            raise ValueError(f"{name} must be finite in the frames that an episode has, and NaN after them")
        if np.nanmax(np.abs(values), initial=0.0) > _LIMITS.get(name, np.inf):
            raise ValueError(f"{name} must be at most {_LIMITS[name]:g}")
    if (recording.friction is None) != (recording.time_constant_s is None):
        raise ValueError("friction and time_constant_s must be there both, or neither")
    _ = recording.ground  # checks their values
    if recording.touching is not None and recording.touching[~there].any():
        raise ValueError("touching must be False after the frames that an episode has")
    length = np.linalg.norm(recording.base_quaternion[there], axis=1)
    if np.abs(length - 1.0).max() > 1e-3:
        raise ValueError(f"base_quaternion must have length 1, got {length.min():g} to {length.max():g}")
