"""Marks of the elites that a controller was trained on, so that it is not tested on them."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.controllers.formats.rsl_rl import read_weights
from sim.controllers.spec import ControllerSpec
from sim.files.atomic import read_json

TRAINED_ON = "trained_on"
"""Key of the training record, and of checkpoint and controller, with the marks of all elites trained on."""
_LENGTH = 12  # of 2,000 elites, two have the same with a chance of one in 100 million


def hash_elites(genes: NDArray[np.float32]) -> list[str]:
    """A short mark of each elite that depends on its genes, shape (E, num_genes), alone."""
    rows = np.ascontiguousarray(genes, np.float32)
    return [hashlib.sha256(row.tobytes()).hexdigest()[:_LENGTH] for row in rows]


def read_trained_on(policy: str) -> set[str]:
    """Marks of the elites that a controller was trained on, by its file and the record beside it; none if none are."""
    marks: set[str] = set()
    for file in ControllerSpec.parse(policy).files:
        record = file.with_suffix(".train.json")
        for content in (read_json(record) if record.is_file() else {}, _content_of(file)):
            recorded = content.get(TRAINED_ON, [])
            if not isinstance(recorded, list) or not all(isinstance(mark, str) for mark in recorded):
                raise ValueError(f"{file} or the record beside it is damaged at {TRAINED_ON}: put a copy of it back")
            marks.update(recorded)
    return marks


def _content_of(file: Path) -> dict[str, Any]:
    """What a file of weights holds; nothing of another kind of file."""
    try:
        content = read_weights(file)
    except Exception:  # another kind of file, which has no marks
        return {}
    return content if isinstance(content, dict) else {}


def check_untrained(controllers: Mapping[str, str], genes: NDArray[np.float32], elites: str) -> None:
    """Refuses to test controllers on elites, shape (T, num_genes), that they were trained on."""
    marks = hash_elites(genes)
    for name, policy in controllers.items():
        count = len(read_trained_on(policy).intersection(marks))
        if count:
            raise ValueError(
                f"{name} must not be tested on what it was trained on, got {count} of the {len(marks)} elites of "
                f"{elites}: give the archive as it was when it was trained, or another search"
            )
