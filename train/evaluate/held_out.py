"""Whether a controller was trained on the elites that it is evaluated on, by what its record and its file say.

Which elites are held out follows from an archive as it is. One that grew, or another seed of the split, holds out
others: among them some that a controller was trained on before.
"""

import hashlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.files.atomic import read_json
from sim.policy.loaders import read_weights
from sim.policy.spec import ControllerSpec

TRAINED_ON = "trained_on"
"""Key of the training record, and of checkpoint and controller, with the marks of all elites trained on."""
_MARK_LENGTH = 12  # of 2,000 elites, two have the same with a chance of one in 100 million


def marks_of(genes: NDArray[np.float32]) -> list[str]:
    """A short mark of each elite that depends on its genes alone.

    Args:
        genes: Shape (E, 64).
    """
    rows = np.ascontiguousarray(genes, np.float32)
    return [hashlib.sha256(row.tobytes()).hexdigest()[:_MARK_LENGTH] for row in rows]


def recorded_marks(policy: str) -> set[str]:
    """Marks of the elites that a controller was trained on; none where neither its file nor a record beside it has any.

    Args:
        policy: A controller as :class:`sim.policy.spec.ControllerSpec` takes it.

    Raises:
        ValueError: If the marks are damaged.
    """
    found: set[str] = set()
    for file in ControllerSpec.parse(policy).files:
        record = file.with_suffix(".train.json")
        contents = [(record, read_json(record))] if record.is_file() else []
        for place, content in (*contents, *((file, part) for part in _parts_of(file))):
            marks = content.get(TRAINED_ON, [])
            if not isinstance(marks, list) or not all(isinstance(mark, str) for mark in marks):
                raise ValueError(f"{place} is damaged at {TRAINED_ON}: put a copy of it back")
            found |= set(marks)
    return found


def _parts_of(file: Path) -> list[dict[str, Any]]:
    """Where marks may stand in a file of weights: itself, and what a checkpoint has beside the networks."""
    if file.suffix.lower() in (".py", ".onnx") or not file.is_file():
        return []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of TorchScript files, which have none
            content = read_weights(file)
    except Exception:  # another kind of file; whether it is a controller is for others to say
        return []
    parts = [content, content.get("extra")] if isinstance(content, dict) else []
    return [part for part in parts if isinstance(part, dict)]


def check_held_out(controllers: Mapping[str, str], genes: NDArray[np.float32], split_seed: int) -> None:
    """Refuse to call terrains held out that a controller was trained on.

    Args:
        controllers: Policy of each controller by its name.
        genes: Elites that are to be crossed, shape (T, 64).
        split_seed: Of the split that held them out.

    Raises:
        ValueError: If one of the controllers was trained on some of them, as far as its record says; naming it.
    """
    marks = marks_of(genes)
    for name, policy in controllers.items():
        trained_on = recorded_marks(policy)
        if count := sum(mark in trained_on for mark in marks):
            raise ValueError(
                f"{name} was trained on {count} of the {len(marks)} elites that split seed {split_seed} holds out of "
                "this archive: give the archive as it was then and the split seed of its training"
            )
