"""Recordings on disk: one npz, read as data, whose names and shapes are checked.

The file holds the fields of :class:`sim.recording.recorder.Recording` as arrays of those names, of ``ground`` its two
maps, ``origin`` as JSON, and ``format`` as its name and version. Of terrains given by genes of a shipped space it holds
no heights: the reader makes them again. Of a space of a user's own it holds both, so that reading runs no code.
"""

import json
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from sim.bank import heights_of
from sim.files.atomic import write_atomically
from sim.files.npz import array_names, check_shapes, npz_bytes, read_arrays
from sim.ground import PATCHES, GroundMaps
from sim.recording.recorder import FRAME_ARRAYS, Recording
from sim.spaces.registry import get_space, is_own

FORMAT = "faultline recording 3"
"""Name and version in every file."""

_TEXTS = ("robot", "joint_names", "foot_names", "penalty_names", "geom_names", "labels", "origin")
_EACH = ("terrains", "episodes")
_FRAME = (*_EACH, "frames")
_SHAPES: dict[str, tuple[int | str, ...]] = {
    "seeds": ("terrains",), "labels": ("terrains",), "joint_names": ("joints",),
    "foot_names": ("feet",), "penalty_names": ("penalties",), "geom_names": ("geoms",),
    "robot": (), "dt": (), "origin": (),
    **dict.fromkeys(("outcome", "invalidity", "fallen", "duration_s", "num_frames"), _EACH),
    "base_position": (*_FRAME, 3), "base_quaternion": (*_FRAME, 4), "joint_position": (*_FRAME, "joints"),
    "foot_force": (*_FRAME, "feet", 3), "penalties": (*_FRAME, "penalties"), "command": (*_FRAME, 3),
    "touching": (*_FRAME, "geoms"), "genes": ("terrains", "genes"), "heights": ("terrains", "rows", "columns"),
    "friction": ("terrains", *PATCHES), "time_constant_s": ("terrains", *PATCHES),
}  # fmt: skip
_OPTIONAL = ("genes", "heights", "friction", "time_constant_s")


def write_recording(path: Path, recording: Recording) -> None:
    """Writes a recording, atomically, as an ``.npz`` by custom; equal recordings give equal bytes."""
    values = {field.name: getattr(recording, field.name) for field in fields(Recording)}
    values |= {} if recording.ground is None else vars(recording.ground)
    del values["ground"]
    if recording.genes is not None and not is_own(recording.origin["space"]):
        del values["heights"]
    values |= {"format": FORMAT, "origin": json.dumps(recording.origin)}
    content = {name: np.asarray(value, FRAME_ARRAYS.get(name)) for name, value in values.items() if value is not None}
    content["geom_names"] = content["geom_names"].astype(str)  # without any they would be floats
    write_atomically(path, npz_bytes(content))


def read_recording(path: str | Path) -> Recording:
    """Reads what :func:`write_recording` wrote, as data; a ValueError if the file is damaged or of another kind."""
    path = Path(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no recording at {path}: commands that show crossings keep theirs in runs/recordings")
    try:
        return _read(path)
    except Exception as error:  # zip, zlib, npy headers and JSON answer damage with a dozen types
        raise ValueError(f"{path} must be a recording of crossings, got: {error}: record it again") from None


def _read(path: Path) -> Recording:
    names = array_names(path)
    version = str(read_arrays(path, ["format"])["format"]) if "format" in names else "none"
    if version != FORMAT:
        raise ValueError(f"its format is {version}, expected '{FORMAT}'")
    content = read_arrays(path, [name for name in _SHAPES if name in names or name not in _OPTIONAL])
    check_shapes(content, _SHAPES)
    origin = json.loads(str(content["origin"]))
    values: dict[str, Any] = {"genes": None, **content}
    if maps := {name: values.pop(name) for name in ("friction", "time_constant_s") if name in content}:
        values["ground"] = GroundMaps(**maps)
    if "heights" not in content:
        values["heights"] = heights_of(content["genes"], get_space(origin["space"]))
    values |= {name: content[name].astype(np.float32) for name in FRAME_ARRAYS}
    values |= {name: tuple(content[name].tolist()) if content[name].ndim else str(content[name]) for name in _TEXTS}
    return Recording(**values | {"origin": origin, "dt": float(content["dt"])})
