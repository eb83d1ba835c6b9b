"""Which terrains to show before and after fine-tuning, and the files that this needs, known by their hashes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.archive import Archive, read_archive
from qd.show.report.tables import FAR, GENERATED
from sim.policy.spec import SHIPPED, ControllerSpec, controller_hash
from sim.robots.robot import RobotCfg

_KINDS = ("mended", "newly_broken", "still_failing")
_MENDED = 2  # terrains shown of that kind; of each other one
_CONTROLLERS = ("*.pt", "*.onnx")  # files beside the tables that may be one


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
        tables: As :func:`qd.show.report.tables.read_tables` gives them.
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
