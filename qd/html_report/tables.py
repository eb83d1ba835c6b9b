"""The evaluation's ``tables.json``, read as data: what it must have, and which terrains to show before and after."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.archive import Archive, read_archive
from sim.controller_spec import ControllerSpec
from sim.files import read_json
from sim.provenance import controller_hash

MEASURES = {"success": "success (no base collision)", "goal": "goal reached", "reward": "training reward"}
"""Measures shown, in words; the first two are fractions."""
CHANGES = ("mended", "still_failing", "newly_broken", "fine")
"""What may have become of a terrain between two controllers."""
_KEYS = ("robot", "episodes", "controllers", "terrains", "intervals", "differences", *MEASURES)
_MENDED, _BROKEN = 2, 1  # terrains shown of each kind
_GENERATED = "generated"


@dataclass(frozen=True, kw_only=True)
class Change:
    """A terrain that two controllers fare differently on."""

    kind: str
    """mended: the first controller fails it, the second does not; newly broken: the other way round."""
    number: int
    """Of the elite in the tables' archive."""
    before: str
    """Name of the first controller."""
    after: str


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Terrains to show before and after, or why there are none to show."""

    archive: Archive | None = None
    """That the numbers count in."""
    chosen: tuple[Change, ...] = ()
    policies: dict[str, str] | None = None
    """File of each controller by its name."""
    reason: str = ""
    """Why there are none."""


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


def changes_of(tables: dict[str, Any]) -> Changes:
    """Generated terrains that became passable from the first controller to another, and one that ceased to be.

    Args:
        tables: As :func:`read_tables` gives them.
    """
    first, *others = tables["controllers"]
    pairs = (tables["differences"].get(_GENERATED) or {}) if others else {}
    pairs = {who: pairs.get(f"{first} -> {who}") for who in others}
    pairs = {
        who: pair for who, pair in pairs.items() if pair and pair["mended"]["count"] + pair["newly_broken"]["count"]
    }
    if not pairs:
        return Changes(reason="No generated terrain of the tables is mended or newly broken between their controllers.")
    best = max(pairs, key=lambda who: pairs[who]["mended"]["count"])
    chosen = [Change(kind="mended", number=n, before=first, after=best) for n in _first(pairs[best], "mended", _MENDED)]
    chosen += [
        Change(kind="newly broken", number=n, before=first, after=best)
        for n in _first(pairs[best], "newly_broken", _BROKEN)
    ]
    policies = {who: tables["controllers"][who] for who in (first, best)}
    for who, about in policies.items():
        if ControllerSpec.parse(about["policy"]).runs_code:  # what a file names is never run
            return Changes(reason=f"Controller {who} of the tables is code, {about['policy']}, and is not run.")
        if controller_hash(about["policy"]) != about["sha256"]:
            return Changes(reason=f"Controller {who} of the tables is not at {about['policy']} as it was then.")
    archive, reason = _archive_of(tables, chosen)
    files = {who: about["policy"] for who, about in policies.items()}
    return Changes(archive=archive, chosen=tuple(chosen) if archive else (), policies=files, reason=reason)


def _first(pair: dict[str, Any], kind: str, count: int) -> list[int]:
    return pair[kind]["terrains"][:count]


def _archive_of(tables: dict[str, Any], chosen: list[Change]) -> tuple[Archive | None, str]:
    """The archive that the tables' terrains are numbered in, or why it cannot be had."""
    about = tables.get("archive") or {}
    path = about.get("path", "")
    try:
        archive = read_archive(path)
    except (OSError, ValueError) as error:
        return None, f"The archive of the tables cannot be read: {error}"
    same = (len(archive), archive.iterations) == (about.get("elites"), about.get("iterations"))
    if not same or any(not 0 <= change.number < len(archive) for change in chosen):
        return None, f"The archive at {path} has changed since the tables were made."
    return archive, ""
