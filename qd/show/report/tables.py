"""The evaluation's tables by kind of controller."""

from typing import Any

from qd.evaluate import labels as evaluation
from sim.policy.spec import kind_of

MEASURES = {name: evaluation.MEASURES[name] for name in ("goal", "success", "reward")}
"""Measures shown, in words; the first two are fractions."""
GENERATED, FAR = evaluation.HELD_OUT
"""Sets of elites that were held out of training; the second is the part farthest from what was trained on."""
CERTIFIED = {name: evaluation.MEASURES[measure] for name, measure in evaluation.CERTIFIED.items()}
"""Measures on certified terrains alone, in words."""


def by_kind(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables with one column a kind of controller, where a kind was trained from several seeds.

    Args:
        tables: As :func:`qd.evaluate.tables.read_tables` gives them.

    Returns:
        The same, but for ``controllers``, measures and ``intervals``: of a kind of several those are the mean over them
        and the interval of that, under the kind's name with the number of its seeds. ``members`` says who is of it.
    """
    members: dict[str, list[str]] = {}
    for controller in tables["controllers"]:
        members.setdefault(kind_of(controller), []).append(controller)
    labels = {f"{kind} ({len(all_)} seeds)" if len(all_) > 1 else all_[0]: all_ for kind, all_ in members.items()}
    joined = {**tables, "controllers": {label: tables["controllers"][all_[0]] for label, all_ in labels.items()}}
    joined |= {"members": labels, "intervals": dict(tables["intervals"])}
    for measure in (*MEASURES, *(CERTIFIED if tables.get("certified") else ())):
        values, limits = {}, {}
        for name in tables[measure]:
            several = tables["over_seeds"].get(measure, {}).get(name, {})
            pairs = {label: _of_kind(tables, measure, name, all_, several) for label, all_ in labels.items()}
            values[name] = {label: value for label, (value, _) in pairs.items()}
            limits[name] = {label: interval for label, (_, interval) in pairs.items()}
        joined[measure], joined["intervals"][measure] = values, limits
    return joined


def _of_kind(
    tables: dict[str, Any], measure: str, name: str, members: list[str], several: dict[str, Any]
) -> tuple[float | None, list[float] | None]:
    """Value and interval of a kind of controller on a set."""
    if len(members) == 1:
        return tables[measure][name][members[0]], tables["intervals"][measure][name][members[0]]
    about = several.get(kind_of(members[0]), {"mean": None, "interval": None})
    return about["mean"], about["interval"]
