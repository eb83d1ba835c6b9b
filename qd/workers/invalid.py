"""What is said of invalid episodes, the error where there are no others, and results that cannot be true."""

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kernels.episode import Invalidity
from sim.files.command import UserError
from sim.rollout import RolloutResult

WARNED_SHARE = 0.05
"""A larger share of invalid episodes is reported."""

_REASONS = {  # of each Invalidity the words and the remedy
    "action": ("non-finite action", "look at what the controller makes of rare observations, and at its weights"),
    "overflow": ("solver overflow", "raise the robot's nconmax, of which `faultline check` says more"),
    "state": ("non-finite state", "look at the robot's masses, inertias and gains with `faultline check`"),
    "speed": ("too fast", "look at gains and armature, or raise max_speed if a falling robot can be that fast"),
}


class AllInvalidError(UserError):
    """Not one episode was valid: there is no result."""

    status = 1


def invalid_reasons(result: RolloutResult) -> dict[str, int]:
    """Invalid episodes by the name of their :class:`kernels.episode.Invalidity`, the most frequent first."""
    counts = Counter(Invalidity(code).name.lower() for code in sorted(result.invalidity[result.invalid].tolist()))
    return dict(counts.most_common())


def format_reasons(reasons: Mapping[str, int]) -> str:
    """Counts by reason in words: ``31 non-finite action, 2 too fast``."""
    return ", ".join(f"{count} {_REASONS[name][0]}" for name, count in reasons.items())


def explain_invalid(reasons: Mapping[str, int], episodes: int) -> str | None:
    """What to say of invalid episodes by reason, the most frequent first; None where they are 5 % or less."""
    if (count := sum(reasons.values())) <= WARNED_SHARE * episodes:
        return None
    share = f"{count / episodes:.1%}: {format_reasons(reasons)}"
    return f"{count} of {episodes} episodes are invalid and left out ({share}); {_REASONS[next(iter(reasons))][1]}"


def invalid_iterations(metrics: Sequence[Mapping[str, Any]]) -> str | None:
    """What to say of the invalid episodes of a search's iterations; None where none had over 5 % of them."""
    bad = [row for row in metrics if row["invalid_episodes"] > WARNED_SHARE * row["episodes"]]
    reasons: Counter[str] = sum((Counter(row["invalid_reasons"]) for row in bad), Counter())
    text = explain_invalid(dict(reasons.most_common()), sum(row["episodes"] for row in bad)) if bad else None
    return text and f"In {len(bad)} of {len(metrics)} iterations over {WARNED_SHARE:.0%} are invalid: {text}."


def refuse_all_invalid(result: RolloutResult) -> None:
    """Raises AllInvalidError if no episode is valid."""
    if result.invalid.size and result.invalid.all():
        text = explain_invalid(invalid_reasons(result), result.invalid.size)
        raise AllInvalidError(f"no episode is valid, expected some: {text}")


def report_invalid(result: RolloutResult, label: str, *, all_ok: bool = False) -> None:
    """Prints why episodes are invalid where over 5 % are; if all are, that is an AllInvalidError unless ``all_ok``."""
    if not all_ok:
        refuse_all_invalid(result)
    if text := explain_invalid(invalid_reasons(result), result.invalid.size):
        print(f"{label}: {text}", file=sys.stderr)


def find_flaw(result: Any, count: int, replicas: int) -> str | None:
    """Why a result cannot be one of ``count`` terrains; None if it can. Memory may go bad on another machine."""
    if not isinstance(result, RolloutResult):
        return f"no result but {type(result).__name__}"
    shape, invalid = (count, replicas), result.invalid
    if wrong := [f"{name} of shape {a.shape}" for name, a in result.arrays.items() if a.shape[:2] != shape]:
        return f"{', '.join(wrong)} for {count} terrains of {replicas} episodes"
    if result.penalties.shape != (*shape, len(result.penalty_names)):
        return f"penalties of shape {result.penalties.shape}"
    penalties = result.penalties[~invalid]
    rewards = np.zeros(0) if result.reward is None else result.reward[~invalid]
    flaws = {
        "valid episodes with penalties that are negative or not finite": (penalties < 0.0) | ~np.isfinite(penalties),
        "invalid episodes without a reason, or valid ones with one": (result.invalidity != 0) != invalid,
        "valid episodes with rewards that are not finite": ~np.isfinite(rewards),
        "episodes that took no time": ~(result.duration_s > 0.0) | (not result.physics_steps > 0),
    }
    return next((flaw for flaw, is_wrong in flaws.items() if np.any(is_wrong)), None)
