"""Results of whole terrains put together, and looked at before they are believed."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.recording.frames import Frames
from sim.rollout import RolloutResult

_STEPS = ("physics_steps", "robot_steps", "busy_steps")


def copied(result: RolloutResult) -> RolloutResult:
    """A result that can be written to, which what Ray delivers cannot."""
    return replace(result, **{name: value.copy() for name, value in result_arrays(result).items()})


def join_results(results: Sequence[RolloutResult], *, join: int) -> RolloutResult:
    """Results side by side (``join`` 0: they ran at the same time) or one after the other (1)."""
    if len(results) == 1:
        return results[0]
    changes: dict[str, Any] = {
        name: np.concatenate([getattr(result, name) for result in results]) for name in result_arrays(results[0])
    }
    if results[0].frames is not None:
        changes["frames"] = Frames.join([result.frames for result in results if result.frames is not None])
    for name in (*_STEPS, "wall_s"):
        combine = max if join == 0 and name in ("physics_steps", "wall_s") else sum
        changes[name] = combine(getattr(result, name) for result in results)
    return replace(results[0], **changes)


def choose_rows(result: RolloutResult, rows: NDArray[np.intp]) -> RolloutResult:
    """A result with some of its terrains alone, in the order given."""
    frames = None if result.frames is None else result.frames[rows]
    return replace(result, **{name: values[rows] for name, values in result_arrays(result).items()}, frames=frames)


def find_flaw(result: Any, count: int, replicas: int) -> str | None:
    """Why a result cannot be one of ``count`` terrains, in words; None if it can.

    Memory gone bad on another machine must not become a number in an archive: shapes, finite penalties of every valid
    episode, and times that can be.
    """
    if not isinstance(result, RolloutResult):
        return f"no result but {type(result).__name__}"
    shape = (count, replicas)
    shapes = {name: value.shape for name, value in result_arrays(result).items()}
    wrong = [f"{name} of shape {got}" for name, got in shapes.items() if got[:2] != shape]
    if wrong:
        return f"{', '.join(wrong)} for {count} terrains of {replicas} episodes"
    penalties = result.penalties
    invalid = result.invalid
    if penalties.shape != (*shape, len(result.penalty_names)):
        return f"penalties of shape {penalties.shape}"
    if not (np.isfinite(penalties[~invalid]) & (penalties[~invalid] >= 0.0)).all():
        return "valid episodes with penalties that are negative or not finite"
    if ((result.invalidity != 0) != invalid).any():
        return "invalid episodes without a reason, or valid ones with one"
    if result.reward is not None and not np.isfinite(result.reward[~invalid]).all():
        return "valid episodes with rewards that are not finite"
    if not (result.duration_s > 0.0).all() or not result.physics_steps > 0:
        return "episodes that took no time"
    return None


def result_arrays(result: RolloutResult) -> dict[str, np.ndarray]:
    """The arrays of a result by their names, which lead with (num_terrains, replicas)."""
    values = {field.name: getattr(result, field.name) for field in fields(result)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
