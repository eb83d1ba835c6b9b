"""Whether a controller was trained on the elites that it is evaluated on, by what its training record says.

Which elites are held out follows from an archive as it is. One that grew, or another seed of the split, holds out
others: among them some that a controller was trained on before.
"""

import hashlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sim.controller_spec import ControllerSpec
from sim.files import read_json

TRAINED_ON = "trained_on"
"""Key of the training record under which the marks of all elites trained on stand."""
_MARK_LENGTH = 12  # of 2,000 elites, two have the same with a chance of one in 100 million


def marks_of(genes: NDArray[np.float32]) -> list[str]:
    """A short mark of each elite that depends on its genes alone.

    Args:
        genes: Shape (E, 64).
    """
    rows = np.ascontiguousarray(genes, np.float32)
    return [hashlib.sha256(row.tobytes()).hexdigest()[:_MARK_LENGTH] for row in rows]


def recorded_marks(policy: str) -> set[str]:
    """Marks of the elites that a controller was trained on; none where no record lies beside its file.

    Args:
        policy: A controller as :class:`sim.controller_spec.ControllerSpec` takes it.

    Raises:
        ValueError: If the record is damaged.
    """
    found: set[str] = set()
    for file in ControllerSpec.parse(policy).files:
        record = file.with_suffix(".train.json")
        if record.is_file():
            marks = read_json(record).get(TRAINED_ON, [])
            if not isinstance(marks, list) or not all(isinstance(mark, str) for mark in marks):
                raise ValueError(f"{record} is damaged at {TRAINED_ON}: put a copy of it back")
            found |= set(marks)
    return found


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
