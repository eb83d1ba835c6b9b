"""The evaluation's tables by kind of controller, and the terrains in them that are worth showing before and after."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.archive import Archive, read_archive
from qd.evaluate import labels as evaluation
from qd.run.directory import check_space
from sim.policy.spec import SHIPPED, ControllerSpec, controller_hash, kind_of
from sim.robots.robot import RobotCfg

MEASURES = {name: evaluation.MEASURES[name] for name in ("goal", "success", "reward")}
"""Measures shown, in words; the first two are fractions."""
GENERATED, FAR = evaluation.HELD_OUT
"""Sets of elites that were held out of training; the second is the part farthest from what was trained on."""
CERTIFIED = {name: evaluation.MEASURES[measure] for name, measure in evaluation.CERTIFIED.items()}
"""Measures on certified terrains alone, in words."""
_KINDS = ("mended", "newly_broken", "still_failing")
_MENDED = 2  # terrains shown of that kind; of each other one
_CONTROLLERS = ("*.pt", "*.onnx")  # files beside the tables that may be one


def by_kind(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables with one column a kind of controller, where a kind was trained from several seeds.

    Args:
        tables: As :func:`qd.evaluate.tables.read_tables` gives them.

    Returns:
        The same, but for ``controllers``, measures and ``intervals``: of a kind of several those are the mean over them
        and the interval of that, under the kind's name with the number of its seeds. ``members`` says who is of it.
    """
    members: dict[str, list[str]] = {}
    for who in tables["controllers"]:
        members.setdefault(kind_of(who), []).append(who)
    labels = {f"{kind} ({len(all_)} seeds)" if len(all_) > 1 else all_[0]: all_ for kind, all_ in members.items()}
    found = {**tables, "controllers": {label: tables["controllers"][all_[0]] for label, all_ in labels.items()}}
    found |= {"members": labels, "intervals": dict(tables["intervals"])}
    for measure in (*MEASURES, *(CERTIFIED if tables.get("certified") else ())):
        values, limits = {}, {}
        for name in tables[measure]:
            several = tables["over_seeds"].get(measure, {}).get(name, {})
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
    """Terrains to show before and after."""

    archive: Archive
    """That the numbers count in."""
    run: Path
    """Where that lies."""
    chosen: tuple[Change, ...]
    policies: dict[str, str]
    """File of both controllers by their names; the robot's own is called shipped."""


def changes_of(tables: dict[str, Any], file: Path, robot: RobotCfg) -> Changes:
    """Generated terrains that became passable from the first controller to another, that ceased to be, and that do not.

    The other controller is the one that mends the most among those whose files are found.

    Args:
        tables: As :func:`qd.evaluate.tables.read_tables` gives them.
        file: Where they lie: controllers and archive may have been put beside them since.
        robot: The robot, whose own controller is one of them as a rule.

    Raises:
        ValueError: If there are none to show, which says why.
    """
    first, *others = tables["controllers"]
    known = tables["differences"].get(GENERATED) or {}
    pairs = {who: known[f"{first} -> {who}"] for who in others if f"{first} -> {who}" in known}
    pairs = {who: pair for who, pair in pairs.items() if pair["mended"]["count"] + pair["newly_broken"]["count"]}
    if not pairs:
        raise ValueError("No generated terrain of the tables is mended or newly broken between their controllers.")
    most_first = sorted(pairs, key=lambda who: -pairs[who]["mended"]["count"])
    files = {who: _file_of(tables["controllers"][who], file.parent, robot) for who in (first, *most_first)}
    after = next((who for who in most_first if files[who] is not None), most_first[0])
    policies = {}
    for who in (first, after):
        if (policy := files[who]) is None:
            raise ValueError(_why_not(who, tables["controllers"][who]["policy"], file.parent))
        policies[who] = policy
    chosen = _chosen(tables, first, after)
    archive, run = _archive_of(tables, chosen, file.parent)
    return Changes(archive=archive, run=run, chosen=chosen, policies=policies)


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


def _archive_of(tables: dict[str, Any], chosen: tuple[Change, ...], beside: Path) -> tuple[Archive, Path]:
    """The archive that the tables' terrains are numbered in, and its place.

    One beside the tables comes first: it is published with them, where the path may be that of another machine.
    """
    about = tables.get("archive") or {}
    reason = ""
    for path in (beside / "archive", Path(about.get("path", ""))):
        try:
            archive = read_archive(path)
            check_space(archive, None)
        except (OSError, ValueError) as error:
            reason = f"The archive of the tables cannot be read: {error}"
            continue
        same = (len(archive), archive.iterations) == (about.get("elites"), about.get("iterations"))
        if same and all(0 <= change.number < len(archive) for change in chosen):
            return archive, path
        reason = f"The archive at {path} has changed since the tables were made."
    raise ValueError(reason)
