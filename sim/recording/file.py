"""Recordings on disk: one npz, read as data.

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

from sim.files.atomic import write_atomically
from sim.files.npz import npz_bytes, read_arrays
from sim.recording.recorder import FRAME_ARRAYS, Recording
from sim.terrains.bank import make_heights
from sim.terrains.ground import GroundMaps
from sim.terrains.spaces.registry import get_space, is_user_space

FORMAT = "faultline recording 3"
"""Name and version in every file."""
_OF_GROUND = tuple(field.name for field in fields(GroundMaps))


def write_recording(path: Path, recording: Recording) -> None:
    """Writes a recording, atomically, as an ``.npz`` by custom; equal recordings give equal bytes."""
    values = {field.name: getattr(recording, field.name) for field in fields(Recording)}
    values |= {} if recording.ground is None else vars(recording.ground)
    del values["ground"]
    if recording.genes is not None and not is_user_space(recording.origin["space"]):
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
    content = read_arrays(path)
    version = str(content.pop("format", "none"))
    if version != FORMAT:
        raise ValueError(f"its format is {version}, expected '{FORMAT}'")
    values: dict[str, Any] = {"genes": None, **content}
    for name, array in content.items():
        if array.dtype.kind == "U":
            values[name] = tuple(array.tolist()) if array.ndim else str(array)
    origin = values["origin"] = json.loads(values["origin"])
    if maps := {name: values.pop(name) for name in _OF_GROUND if name in content}:
        values["ground"] = GroundMaps(**maps)
    if "heights" not in content:
        values["heights"] = make_heights(content["genes"], get_space(origin["space"]))
    values |= {name: content[name].astype(np.float32) for name in FRAME_ARRAYS} | {"dt": float(content["dt"])}
    return Recording(**values)
