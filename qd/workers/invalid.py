"""Invalid episodes, which count for nothing: how many there are, why, and what to do about them."""

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sim.files.command import UserError

if TYPE_CHECKING:
    from sim.rollout import RolloutResult

WARNED_SHARE = 0.05
"""A larger share of invalid episodes is told."""

_REASONS = {
    "action": (
        "non-finite action",
        "the controller returned NaN or infinity: look at what it makes of rare observations, and at its weights",
    ),
    "overflow": (
        "solver overflow",
        "contacts or constraints found no room: raise the robot's nconmax and njmax, of which `faultline stand` says "
        "more",
    ),
    "state": (
        "non-finite state",
        "the physics diverged: look at the robot's masses, inertias and gains with `faultline stand`",
    ),
    "speed": (
        "too fast",
        "a velocity exceeded the robot's max_speed: raise it if a falling robot can be that fast, or look at the "
        "controller and the gains",
    ),
    "none": ("of an unknown reason", "they are of an older version: cross the terrains again"),
}
"""Words and remedy of each :class:`kernels.episode.Invalidity`, by its name."""


class AllInvalidError(UserError):
    """Not one episode was valid: there is no result."""

    status = 1


def invalid_reasons(result: "RolloutResult | Any") -> dict[str, int]:
    """Invalid episodes by the name of their :class:`kernels.episode.Invalidity`, those that occur, the most first."""
    from kernels.episode import Invalidity

    codes = result.invalidity[result.invalid]
    counts = {reason.name.lower(): int((codes == reason).sum()) for reason in Invalidity}
    return dict(sorted(((name, count) for name, count in counts.items() if count), key=lambda one: -one[1]))


def reason_words(reasons: Mapping[str, int]) -> str:
    """Counts by reason in words: ``31 non-finite action, 2 too fast``."""
    return ", ".join(f"{count} {_REASONS[name][0]}" for name, count in reasons.items())


def invalid_words(reasons: Mapping[str, int], episodes: int) -> str | None:
    """What to say of invalid episodes; None where they are 5 % or less.

    Args:
        reasons: Their counts by reason, the most first.
        episodes: All episodes.
    """
    count = sum(reasons.values())
    if count <= WARNED_SHARE * episodes:
        return None
    said = f"{count} of {episodes} episodes are invalid and left out ({count / episodes:.1%}: {reason_words(reasons)})"
    return f"{said}; {_REASONS[next(iter(reasons))][1]}"


def invalid_iterations(metrics: Sequence[Mapping[str, Any]]) -> str | None:
    """What to say of the invalid episodes of a search's iterations; None where none had over 5 % of them."""
    bad = [row for row in metrics if row["invalid_episodes"] > WARNED_SHARE * row["episodes"]]
    if not bad:
        return None
    reasons: dict[str, int] = {}
    for row in bad:
        for name, count in row.get("invalid_reasons", {"none": row["invalid_episodes"]}).items():
            reasons[name] = reasons.get(name, 0) + count
    ordered = dict(sorted(reasons.items(), key=lambda one: -one[1]))
    words = invalid_words(ordered, sum(row["episodes"] for row in bad))
    return f"In {len(bad)} of {len(metrics)} iterations over {WARNED_SHARE:.0%} of the episodes are invalid: {words}."


def refuse_all_invalid(result: "RolloutResult | Any") -> None:
    """Does nothing if some episode is valid.

    Raises:
        AllInvalidError: If none is.
    """
    if not result.invalid.all():
        return
    reasons = invalid_reasons(result)
    raise AllInvalidError(
        f"all {result.invalid.size} episodes are invalid ({reason_words(reasons)}), expected some that are not: "
        f"{_REASONS[next(iter(reasons))][1]}"
    )


def tell_invalid(result: "RolloutResult | Any", what: str, *, all_ok: bool = False) -> None:
    """Prints why episodes are invalid where over 5 % are, in a line that leaves progress bars whole.

    Args:
        result: The episodes.
        what: What was crossed, for the line.
        all_ok: Whether all of them may be.

    Raises:
        AllInvalidError: If no episode is valid.
    """
    if not all_ok:
        refuse_all_invalid(result)
    words = invalid_words(invalid_reasons(result), result.invalid.size)
    if words is not None:
        tqdm.write(f"{what}: {words}", file=sys.stderr)
