"""The evaluation's ``tables.json``, read as data, and the terrains in it that are worth showing before and after."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.archive import Archive, read_archive
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.policy.spec import SHIPPED, ControllerSpec, controller_hash, kind_of
from sim.robots.identity import check_identity
from sim.robots.robot import RobotCfg

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
_KINDS = ("mended", "newly_broken", "still_failing")
_MENDED = 2  # terrains shown of that kind; of each other one
_CONTROLLERS = ("*.pt", "*.onnx")  # files beside the tables that may be one
_KEYS = ("robot", "episodes", "controllers", "terrains", "intervals", "differences", *MEASURES)


def read_tables(file: Path, robot: RobotCfg) -> dict[str, Any]:
    """The evaluation's tables.

    Args:
        file: What ``faultline evaluate`` wrote.
        robot: Robot it must be of.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, another file, of another robot, or of one that has changed since.
    """
    writer = f"`{command_line('evaluate', robot=robot.spec, policies='...')}`"
    if not file.exists():
        raise FileNotFoundError(f"no tables at {file}: {writer} writes them")
    tables = read_json(file)
    if problem := _problem_of(tables):
        raise ValueError(f"{file} must hold the tables of {writer}, but {problem}: give that file")
    if tables["robot"] != robot.name:
        raise ValueError(
            f"{file} is of robot {tables['robot']}, got --robot {robot.name}: give that robot or other tables"
        )
    check_identity(tables, robot, file, f"make them anew with {writer}")
    return tables


def _problem_of(tables: dict[str, Any]) -> str:
    """What keeps the tables from being shown; empty if nothing does."""
    if missing := [key for key in _KEYS if key not in tables]:
        return f"it lacks {', '.join(missing)}"
    checks: dict[str, Callable[[], bool]] = {
        "number of episodes": lambda: type(tables["episodes"]) is int,
        "controllers": lambda: _all(_is_controller, tables["controllers"].values()),
        "terrains": lambda: _all(lambda count: type(count) is int, tables["terrains"].values()),
        "differences": lambda: all(_all(_is_pair, pairs.values(), 0) for pairs in tables["differences"].values()),
        "means over seeds": lambda: _are_over_seeds(tables.get("over_seeds", {})),
        **{measure: lambda measure=measure: _is_measure(tables, measure) for measure in MEASURES},
    }
    for what, holds in checks.items():
        try:
            if holds():
                continue
        except (AttributeError, KeyError, TypeError):  # of values of other kinds
            pass
        return f"its {what} cannot be read"
    return ""


def _all(holds: Callable[[Any], bool], values: Any, least: int = 1) -> bool:
    """Whether there are values, and something holds for all of them."""
    return len(values) >= least and all(map(holds, values))


def _is_controller(about: Any) -> bool:
    return isinstance(about["policy"], str) and "sha256" in about


def _is_pair(pair: Any) -> bool:
    """Whether this says what became of terrains between two controllers."""
    kinds = [pair[kind] for kind in CHANGES]
    return type(pair["compared"]) is int and all(
        type(kind["count"]) is int
        and isinstance(kind["terrains"], list)
        and all(type(number) is int for number in kind["terrains"])
        for kind in kinds
    )


def _is_measure(tables: dict[str, Any], measure: str) -> bool:
    """Whether a measure has a value and an interval of every controller on every set."""
    who, limits = tables["controllers"].keys(), tables["intervals"][measure]
    return _all(lambda name: name in tables["terrains"], tables[measure]) and all(
        row.keys() == who == limits[name].keys() and all(_is_measured(row[one], limits[name][one]) for one in who)
        for name, row in tables[measure].items()
    )


def _is_measured(value: Any, limits: Any) -> bool:
    """Whether these are a number with two limits, or both nothing."""
    if value is None or limits is None:
        return value is None and limits is None
    return len(limits) == 2 and all(type(number) in (int, float) for number in (value, *limits))


def _are_over_seeds(found: Any) -> bool:
    """Whether these are means over the controllers of a kind: measure -> set -> kind."""
    kinds = [about for sets in found.values() for row in sets.values() for about in row.values()]
    pairs = [(about["mean"], about["interval"]) for about in kinds]
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


@dataclass(frozen=True, kw_only=True)
class Change:
    """What became of a terrain from one controller to another."""

    kind: str
    """mended: the first controller fails it, the second does not; newly broken: the other way round; still failing:
    both do."""
    number: int
    """Of the elite in the tables' archive."""
    before: str
    """Name of the first controller."""
    after: str
    far: bool
    """Whether it is among the held-out elites farthest from what was trained on."""


@dataclass(frozen=True, kw_only=True)
class Changes:
    """Terrains to show before and after, or why there are none to show."""

    archive: Archive | None = None
    """That the numbers count in."""
    run: Path | None = None
    """Where that lies."""
    chosen: tuple[Change, ...] = ()
    policies: dict[str, str] | None = None
    """File of each controller by its name; the robot's own is called shipped."""
    reason: str = ""
    """Why there are none."""


def changes_of(tables: dict[str, Any], file: Path, robot: RobotCfg) -> Changes:
    """Generated terrains that became passable from the first controller to another, that ceased to be, and that do not.

    The other controller is the one that mends the most among those whose files are found.

    Args:
        tables: As :func:`read_tables` gives them.
        file: Where they lie: controllers and archive may have been put beside them since.
        robot: The robot, whose own controller is one of them as a rule.
    """
    first, *others = tables["controllers"]
    known = tables["differences"].get(GENERATED) or {}
    pairs = {who: known[f"{first} -> {who}"] for who in others if f"{first} -> {who}" in known}
    pairs = {who: pair for who, pair in pairs.items() if pair["mended"]["count"] + pair["newly_broken"]["count"]}
    if not pairs:
        return Changes(reason="No generated terrain of the tables is mended or newly broken between their controllers.")
    most_first = sorted(pairs, key=lambda who: -pairs[who]["mended"]["count"])
    files = {who: _file_of(tables["controllers"][who], file.parent, robot) for who in (first, *most_first)}
    after = next((who for who in most_first if files[who] is not None), most_first[0])
    for who in (first, after):
        if files[who] is None:
            return Changes(reason=_why_not(who, tables["controllers"][who]["policy"], file.parent))
    chosen = _chosen(tables, first, after)
    archive, run, reason = _archive_of(tables, chosen, file.parent)
    policies = {who: str(files[who]) for who in (first, after)}
    return Changes(archive=archive, run=run, chosen=chosen if archive else (), policies=policies, reason=reason)


def _file_of(about: dict[str, Any], beside: Path, robot: RobotCfg) -> str | None:
    """A file that is this controller by its hash: the robot's own, the one it was, or one beside the tables."""
    if about["sha256"] is None or ControllerSpec.parse(about["policy"]).runs_code:  # what a file names is never run
        return None
    if controller_hash(str(robot.policy_file)) == about["sha256"]:
        return SHIPPED
    files = [about["policy"], *(str(path) for kind in _CONTROLLERS for path in sorted(beside.glob(kind)))]
    return next((path for path in files if controller_hash(path) == about["sha256"]), None)


def _why_not(who: str, policy: str, beside: Path) -> str:
    if ControllerSpec.parse(policy).runs_code:
        return f"Controller {who} of the tables is code, {policy}, and is not run."
    return f"Controller {who} of the tables is not at {policy} as it was then, and is no .pt or .onnx file in {beside}."


def _chosen(tables: dict[str, Any], before: str, after: str) -> tuple[Change, ...]:
    """The worst terrain of each kind; of those mended the worst of the farthest too, or the second one."""
    pair = f"{before} -> {after}"
    found = tables["differences"][GENERATED][pair]
    far = (tables["differences"].get(FAR) or {}).get(pair)
    far_of = {kind: far[kind]["terrains"] if far else [] for kind in _KINDS}
    numbers = {kind: found[kind]["terrains"][:1] for kind in _KINDS}
    mended = found["mended"]["terrains"]
    numbers["mended"] = list(dict.fromkeys([*mended[:1], *far_of["mended"][:1], *mended]))[:_MENDED]
    return tuple(
        Change(kind=kind.replace("_", " "), number=number, before=before, after=after, far=number in far_of[kind])
        for kind in _KINDS
        for number in numbers[kind]
    )


def _archive_of(
    tables: dict[str, Any], chosen: tuple[Change, ...], beside: Path
) -> tuple[Archive | None, Path | None, str]:
    """The archive that the tables' terrains are numbered in and its place, or why it cannot be had.

    One beside the tables comes first: it is published with them, where the path may be that of another machine.
    """
    about = tables.get("archive") or {}
    reasons = []
    for path in (beside / "archive", Path(about.get("path", ""))):
        try:
            archive = read_archive(path)
        except (OSError, ValueError) as error:
            reasons.append(f"The archive of the tables cannot be read: {error}")
            continue
        same = (len(archive), archive.iterations) == (about.get("elites"), about.get("iterations"))
        if same and all(0 <= change.number < len(archive) for change in chosen):
            return archive, path, ""
        reasons.append(f"The archive at {path} has changed since the tables were made.")
    return None, None, reasons[-1]
