"""Controllers of one kind that were trained from different seeds: what their kind is worth, whatever the seed."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from sim.files.intervals import MAX_T_VALUES, t_interval
from sim.policy.spec import MARK, controller_hash, kind_of

RATES = ("success", "goal", "fallen")
"""Measures that lie between 0 and 1, and so do their intervals."""


def check_seeds(controllers: Mapping[str, str]) -> None:
    """Refuse one training as several: the interval over its "seeds" would be none.

    Args:
        controllers: Policy of each controller by its name.

    Raises:
        ValueError: If two of a kind are the same controller, or a name is no kind with at most one seed.
    """
    for name in controllers:
        if not re.fullmatch(f"[^{MARK}]+({MARK}[^{MARK}]+)?", name):
            raise ValueError(f"a controller is named KIND or KIND{MARK}SEED, as C-G{MARK}1, got '{name}'")
    known: dict[tuple[str, str], str] = {}
    for name, policy in controllers.items():
        key = (kind_of(name), controller_hash(policy) or policy)
        if key in known:
            raise ValueError(
                f"{known[key]} and {name} must be of one kind from different seeds, got the same controller twice: "
                "name another file, or leave one out"
            )
        known[key] = name


def firsts(names: Iterable[str]) -> list[str]:
    """The first controller of each kind, in order."""
    found = {}
    for name in names:
        found.setdefault(kind_of(name), name)
    return list(found.values())


def over_seeds(tables: dict[str, Any], measures: Iterable[str]) -> dict[str, Any]:
    """Mean over the controllers of each kind that has several.

    Args:
        tables: Measure -> set -> controller -> value.
        measures: Which of them.

    Returns:
        Measure -> set -> kind -> ``mean``, 95 % t ``interval`` over controllers and their ``values``; empty where no
        kind has several. A mean is None where one of the values is, an interval too where there are more than
        :data:`sim.files.intervals.MAX_T_VALUES`.
    """
    found: dict[str, Any] = {}
    for measure in measures:
        for name, row in tables[measure].items():
            for kind in dict.fromkeys(map(kind_of, row)):
                values = [value for who, value in row.items() if kind_of(who) == kind]
                if len(values) > 1:
                    summary = _summary(values, is_rate=measure in RATES)
                    found.setdefault(measure, {}).setdefault(name, {})[kind] = summary
    return found


def _summary(values: list[float | None], *, is_rate: bool) -> dict[str, Any]:
    numbers = [value for value in values if value is not None]
    if len(numbers) < len(values):
        return {"mean": None, "interval": None, "values": values}
    interval = t_interval(np.array(numbers)) if len(numbers) <= MAX_T_VALUES else None
    if interval is not None and is_rate:
        interval = [max(interval[0], 0.0), min(interval[1], 1.0)]
    return {"mean": sum(numbers) / len(numbers), "interval": interval, "values": values}


def print_over_seeds(found: dict[str, Any]) -> None:
    """Print what :func:`over_seeds` found; nothing where no kind has several controllers."""
    if not found:
        return
    print("\nmean over the controllers of a kind, and its 95 % t interval over them")
    for name in next(iter(found.values())):
        for kind in found[next(iter(found))][name]:
            cells = (f"{measure} {_shown(rows[name][kind])}" for measure, rows in found.items())
            print(f"  {name}, {kind}: " + ", ".join(cells))


def _shown(summary: dict[str, Any]) -> str:
    if summary["mean"] is None:
        return "-"
    limits = summary["interval"]
    return f"{summary['mean']:.3f}" + ("" if limits is None else f" [{limits[0]:.3f} {limits[1]:.3f}]")
