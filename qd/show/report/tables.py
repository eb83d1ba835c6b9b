"""The evaluation's ``tables.json``, read as data: what it must have, and what it says of every kind of controller."""

from pathlib import Path
from typing import Any

from sim.files.atomic import read_json
from sim.policy.spec import kind_of

MEASURES = {"success": "success (no base collision)", "goal": "goal reached", "reward": "training reward"}
"""Measures shown, in words; the first two are fractions."""
CHANGES = ("mended", "still_failing", "newly_broken", "fine")
"""What may have become of a terrain between two controllers."""
GENERATED, FAR = "generated", "generated_far"
"""Sets of elites that were held out of training; the second is the part farthest from what was trained on."""
LABELS = {
    "hand_crafted": "hand-crafted",
    "hard_random": "hard-random",
    GENERATED: "generated, held out",
    FAR: "generated, farthest third",
}
"""Sets in words."""
_KEYS = ("robot", "episodes", "controllers", "terrains", "intervals", "differences", *MEASURES)


def read_tables(file: Path, robot: str) -> dict[str, Any]:
    """The evaluation's tables.

    Args:
        file: What ``make evaluate`` wrote.
        robot: Robot it must be of.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, another file, or of another robot.
    """
    if not file.exists():
        raise FileNotFoundError(f"no tables at {file}: `make evaluate ROBOT={robot} POLICIES=...` writes them")
    tables = read_json(file)
    problem = _problem_of(tables)
    if problem:
        raise ValueError(
            f"{file} must hold the tables of `make evaluate ROBOT={robot} POLICIES=...`, but {problem}: give that file"
        )
    if tables["robot"] != robot:
        raise ValueError(f"{file} is of robot {tables['robot']}, got --robot {robot}: give that robot or other tables")
    return tables


def _problem_of(tables: dict[str, Any]) -> str:
    """What keeps the tables from being shown; empty if nothing does."""
    missing = [key for key in _KEYS if key not in tables]
    if missing:
        return f"it lacks {', '.join(missing)}"
    dicts = [tables[key] for key in ("controllers", "terrains", "intervals", "differences", *MEASURES)]
    if not all(isinstance(part, dict) and part for part in dicts) or not isinstance(tables["episodes"], int):
        return "its parts are not such as that writes"
    if not all(_is_controller(about) for about in tables["controllers"].values()):
        return "its controllers are not such as that writes"
    if not all(
        isinstance(pairs, dict) and all(map(_is_pair, pairs.values())) for pairs in tables["differences"].values()
    ):
        return "its differences are not such as that writes"
    if not _are_over_seeds(tables.get("over_seeds", {})):
        return "its means over seeds are not such as that writes"
    for measure in MEASURES:
        for name, row in tables[measure].items():
            limits = (tables["intervals"].get(measure) or {}).get(name)
            if not isinstance(row, dict) or not isinstance(limits, dict) or name not in tables["terrains"]:
                return f"its {measure} of {name} has no values, intervals or number of terrains"
            if row.keys() != tables["controllers"].keys() or limits.keys() != row.keys():
                return f"its {measure} of {name} is not of its controllers"
            if not all(_is_measured(row[who], limits[who]) for who in row):
                return f"its {measure} of {name} holds something else than numbers"
    return ""


def _is_controller(about: Any) -> bool:
    return isinstance(about, dict) and isinstance(about.get("policy"), str) and "sha256" in about


def _is_pair(pair: Any) -> bool:
    """Whether this says what became of terrains between two controllers."""
    if not isinstance(pair, dict) or type(pair.get("compared")) is not int:
        return False
    kinds = [pair.get(kind) for kind in CHANGES]
    return all(
        isinstance(kind, dict)
        and type(kind.get("count")) is int
        and isinstance(kind.get("terrains"), list)
        and all(type(number) is int for number in kind["terrains"])
        for kind in kinds
    )


def _is_measured(value: Any, limits: Any) -> bool:
    """Whether these are a number with two limits, or both nothing."""
    if value is None or limits is None:
        return value is None and limits is None
    numbers = [value, *limits] if isinstance(limits, list) and len(limits) == 2 else [None]
    return all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers)


def _are_over_seeds(found: Any) -> bool:
    """Whether these are means over the controllers of a kind: measure -> set -> kind."""
    try:
        kinds = [about for sets in found.values() for row in sets.values() for about in row.values()]
        pairs = [(about["mean"], about["interval"]) for about in kinds]
    except (AttributeError, KeyError, TypeError):
        return False
    # of very many seeds no interval is known
    return all(_is_measured(*pair) or (pair[1] is None and _is_measured(pair[0], [pair[0]] * 2)) for pair in pairs)


def by_kind(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables with one column a kind of controller, where a kind was trained from several seeds.

    Args:
        tables: As :func:`read_tables` gives them.

    Returns:
        The same, but for ``controllers``, measures and ``intervals``: of a kind of several those are the mean over them
        and the interval of that, under the kind's name with the number of its seeds.
    """
    members: dict[str, list[str]] = {}
    for who in tables["controllers"]:
        members.setdefault(kind_of(who), []).append(who)
    labels = {f"{kind} ({len(all_)} seeds)" if len(all_) > 1 else all_[0]: all_ for kind, all_ in members.items()}
    found = {**tables, "controllers": {label: tables["controllers"][all_[0]] for label, all_ in labels.items()}}
    found["intervals"] = dict(tables["intervals"])
    for measure in MEASURES:
        values, limits = {}, {}
        for name in tables[measure]:
            several = tables.get("over_seeds", {}).get(measure, {}).get(name, {})
            pairs = {label: _of_kind(tables, measure, name, all_, several) for label, all_ in labels.items()}
            values[name] = {label: value for label, (value, _) in pairs.items()}
            limits[name] = {label: interval for label, (_, interval) in pairs.items()}
        found[measure], found["intervals"][measure] = values, limits
    return found


def _of_kind(
    tables: dict[str, Any], measure: str, name: str, members: list[str], several: dict[str, Any]
) -> tuple[float | None, list[float] | None]:
    """Value and interval of a kind of controller on a set."""
    if len(members) == 1:
        return tables[measure][name][members[0]], tables["intervals"][measure][name][members[0]]
    about = several.get(kind_of(members[0]), {"mean": None, "interval": None})
    return about["mean"], about["interval"]
