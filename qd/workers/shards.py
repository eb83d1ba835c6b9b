"""Results of whole terrains taken apart, put together, and looked at before they are believed."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

MIN_ROWS = 4
"""Fewest robots of a simulation: one more process costs more than fewer of them gain."""

_STEPS = ("physics_steps", "robot_steps", "busy_steps")


def checked_count(terrains: NDArray, seeds: NDArray) -> int:
    """Number of terrains to evaluate.

    Raises:
        ValueError: If there is none, or not one seed for each.
    """
    count = len(terrains)
    if seeds.shape != (count,) or count == 0:
        raise ValueError(f"seeds must have shape ({count},), one a terrain and at least one, got {seeds.shape}")
    return count


def taken(result: Any, count: int, *, first: int = 0) -> Any:
    """Some of a result's terrains: ``count`` from ``first`` on, and their share of what all took."""
    own, total = slice(first, first + count), len(result.penalties)
    # Copies, since what Ray delivers can only be read.
    fields = {name: value[own].copy() for name, value in _fields(result).items() if isinstance(value, np.ndarray)}
    for name in _STEPS:  # parts make the whole again
        fields[name] = getattr(result, name) * own.stop // total - getattr(result, name) * own.start // total
    return dataclasses.replace(result, **fields, wall_s=result.wall_s * count / total)


def merged(results: list[Any], *, join: int) -> Any:
    """Results side by side (``join`` 0: they ran at the same time) or one after the other (1)."""
    if len(results) == 1:
        return results[0]
    combine = (max, sum)[join]
    fields: dict[str, Any] = {
        name: np.concatenate([getattr(result, name) for result in results])
        for name, value in _fields(results[0]).items()
        if isinstance(value, np.ndarray)
    }
    for name in ("physics_steps", "wall_s"):
        fields[name] = combine(getattr(result, name) for result in results)
    for name in ("robot_steps", "busy_steps"):
        fields[name] = sum(getattr(result, name) for result in results)
    return dataclasses.replace(results[0], **fields)


def flaw_of(result: Any, count: int, num_replicas: int) -> str | None:
    """Why a result cannot be one of ``count`` terrains, in words; None if it can.

    Memory gone bad on another machine must not become a number in an archive: shapes, finite penalties of every valid
    episode and none of an invalid one, and times that can be.
    """
    try:
        shape = (count, num_replicas)
        arrays = {name: value for name, value in _fields(result).items() if isinstance(value, np.ndarray)}
        wrong = [f"{name} of shape {value.shape}" for name, value in arrays.items() if value.shape[:2] != shape]
        if wrong:
            return f"{', '.join(wrong)} for {count} terrains of {num_replicas} episodes"
        penalties, invalid = result.penalties, result.invalid
        if penalties.shape != (*shape, len(result.penalty_names)) or penalties.dtype.kind != "f":
            return f"penalties of shape {penalties.shape} and type {penalties.dtype}"
        if not (np.isfinite(penalties[~invalid]).all() and (penalties[~invalid] >= 0.0).all()):
            return "valid episodes with penalties that are negative or not finite"
        if ((result.invalidity != 0) != invalid).any():
            return "invalid episodes without a reason, or valid ones with one"
        if "reward" in arrays and not np.isfinite(arrays["reward"][~invalid]).all():
            return "valid episodes with rewards that are not finite"
        if (np.asarray(result.base_collision) & (np.asarray(result.reached_goal) | invalid)).any():
            return "episodes of several outcomes"
        if not (result.duration_s > 0.0).all() or not result.physics_steps > 0:
            return "episodes that took no time"
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        return f"no result: {type(error).__name__}: {error}"
    return None


def _fields(result: Any) -> dict[str, Any]:
    return {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
