"""Evidence about one controller: one page of what was tested, by which command, and what was not, with its hashes.

It is made of files that commands wrote: gates, doses, rates, tests on packs, searches. Nothing is crossed for it.
``sha256sum --check`` reads its list of hashes, too. They show that files are as they were, and not who wrote them.
"""

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from qd.evaluate.dose import all_doses
from qd.evaluate.gate import to_rows
from qd.evaluate.labels import SETS
from qd.faults.judge import STAGES
from qd.show.report.page import Table, check_page, origin_rows, publish_page
from sim.files.atomic import prepare_output, read_json, to_json, write_atomically
from sim.files.intervals import format_value
from sim.robots.find import resolve_robot
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS

SAFE_RATE = 0.9
"""A size of an obstacle is within the limits of use if the goal rate's 95 % interval lies above this, at all smaller
sizes, too."""
_KINDS = {
    "gate": ("checks", "no gate: tests of a gate.toml (faultline evaluate --gate)"),
    "dose": ("dose", "no sizes of obstacles, and so no limits of use (faultline dose)"),
    "rates": ("hand_crafted", "no rates on random terrains (faultline evaluate)"),
    "pack": ("beside", "no test on a pack of faults (faultline evaluate --pack)"),
    "search": ("reachable_cells", "no search for terrains that break it (faultline archive)"),
}
_COUNTS = {
    "episodes": "episodes of the search",
    "elites": "terrains, each the hardest of its kind",
    "failing": "... that under half of the robots cross in fresh episodes",
    "confirmed": "... also with finer physics",
    "faults_controllers": "faults: another controller crosses them",
    "faults_witness": "faults: only a steered robot crosses them",
    "fault_families": "families of faults",
    "faults_distinct": "distinct faults",
}


def read_numbers(file: Path) -> tuple[str, dict[str, Any]]:
    """What a file of numbers is, a key of the kinds that evidence is made of, and its content."""
    if not file.is_file():
        raise FileNotFoundError(f"no file at {file}: give one that a gate, dose, rates, pack or search wrote")
    content = read_json(file)
    kinds = [kind for kind, (key, _) in _KINDS.items() if key in content]
    needed = {"robot", "robot_sha256", "sources_sha256", "dirty"}
    needed.add("controllers" if kinds == ["dose"] else "policy_sha256")
    if not kinds or not needed <= {*content} or "\n" in str(file):
        rule = "must be written by a gate, dose, rates, pack or search"
        raise ValueError(f"{file} {rule}, got another file: leave it out")
    return kinds[0], content


def tested_hash(kind: str, content: Mapping[str, Any], name: str | None) -> str | None:
    """SHA-256 of the controller that a file is about; of a dose the one of that ``name``, or the only one."""
    if kind != "dose":
        return content["policy_sha256"]
    controllers = content["controllers"]
    name = name or next(iter(controllers))
    return controllers[name]["sha256"] if name in controllers else None


def dose_limits(content: Mapping[str, Any], controller: str, speed: float) -> list[tuple[str, str]]:
    """Each obstacle of a dose and up to which size the controller may be used (:data:`SAFE_RATE`)."""
    limits = []
    for element, title in content["titles"].items():
        rows = [row for row in content["dose"] if row["element"] == element and row["controller"] == controller]
        safe = [row["interval"] is not None and row["interval"][0] >= SAFE_RATE for row in rows]
        count = [*safe, False].index(False)
        unit = f" {rows[0]['unit']}" if rows[0]["unit"] else ""
        text = f"not at {rows[0]['value']:g}{unit}, the first that was tried"
        if count:
            last = rows[count - 1]
            tried = ", the last that was tried" * (count == len(rows))
            way = "down" if rows[0]["value"] > rows[-1]["value"] else "up"
            rate = format_value(last["goal_rate"], last["interval"])
            text = f"{way} to {last['value']:g}{unit}{tried}: {rate} reach the goal, at {speed:g} m/s"
        limits.append((f"{title}, {rows[0]['parameter']}", text))
    return limits


def tabulate(content: Mapping[str, Any], kind: str, controller: str, speed: float) -> tuple[str, Table]:
    """Title and table of a file's numbers."""
    if kind == "gate":
        rates = {}
        for check in content["checks"]:
            invalid = f", {check['invalid_episodes']} invalid" if check["invalid_episodes"] else ""
            rate = format_value(check["goal_rate"]["new"], check["goal_interval"])
            rates[check["name"]] = f"{rate} of {check['episodes']} episodes{invalid}"
        rows = [(name, verdict, why, rates.get(name, "")) for name, verdict, why, _ in to_rows(content)]
        return "Gate", Table(("", "verdict", "why", "goal rate"), rows)
    if kind == "dose":
        physics = "finer physics" if content["resolved"] else "the search's physics"
        return f"Limits of use, with {physics}", Table((), dose_limits(content, controller, speed))
    if kind == "search":
        rows = [(text, f"{content[key]:,}") for key, text in _COUNTS.items() if content.get(key) is not None]
        return f"Search of {content['space']}", Table((), rows)
    sets = {"pack": content["rates"]} if kind == "pack" else {name: content[name] for name in list(SETS)[:2]}
    rows = []
    for name, rates in sets.items():
        interval = rates.get("goal_interval") or rates.get("goal_rate_interval")
        rows.append((SETS.get(name, name), format_value(rates["goal_rate"], interval), str(rates["terrains"])))
    title = "Rates"
    if kind == "pack":
        pack, trained = content["pack"], content["trained_on"]
        title = f"Pack of faults {pack['folder']}, version {pack['version']}, terrains {pack['terrains_sha256'][:12]}"
        title += f"; trained on {trained} of them" * bool(trained)
    return title, Table(("", "goal rate", "terrains"), rows)


def list_untested(contents: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """What the files say nothing of."""
    checks = [check["settings"] for _, content in contents for check in content.get("checks", ())]
    kinds = {kind for kind, _ in contents} | {"pack" if check["pack"] else "rates" for check in checks}
    untested = ["a real robot: all episodes are simulated"]
    untested += [why for kind, (_, why) in _KINDS.items() if kind not in kinds]
    spaces = [content.get("space") for _, content in contents] + [check["space"] for check in checks]
    parts = {part for space in spaces if space for part in space.split("+")[1:]}
    crossed = {*parts, *(name for group in parts & {*GROUPS} for name in GROUPS[group])}
    dosed = {row["element"] for kind, content in contents if kind == "dose" for row in content["dose"]}
    if dosed and (lacking := [name for name in all_doses() if name not in dosed and name not in CONDITIONS]):
        untested.append(f"other obstacles alone: {', '.join(lacking)}")
    if lacking := [name for name in CONDITIONS if name not in crossed | dosed]:
        untested.append(f"conditions: {', '.join(lacking)}")
    judged = {stage for kind, content in contents if kind == "search" for stage in content.get("judged_by", {})}
    if "search" in kinds and (lacking := [name for name in STAGES if name not in judged]):
        untested.append(f"stages of judging what the search found: {', '.join(lacking)}")
    return untested


def write_evidence(
    files: Sequence[Path], *, robot: str | None = None, controller: str | None = None, out: Path | None = None
) -> Path:
    """Writes the page, its numbers beside it as .json and the hashes of both and of all files as .sha256.

    ``robot`` is needed if it is not shipped. ``controller`` is its name in files of doses; their first if None. ``out``
    is the page, evidence.html beside the first file if None.
    """
    contents = [read_numbers(file) for file in files]
    tested = [resolve_robot(content, robot, file, "file") for file, (_, content) in zip(files, contents, strict=True)]
    about = [(content["robot_sha256"], tested_hash(kind, content, controller)) for kind, content in contents]
    if len({*about}) != 1 or about[0][1] is None:
        listed = ", ".join(f"{file} of {str(digest)[:12]}" for file, (_, digest) in zip(files, about, strict=True))
        rule = "evidence must be about one controller of one robot, known by its file's hash"
        raise ValueError(f"{rule}, got {listed}: leave the others out, or name it by --controller")
    out = out or files[0].with_name("evidence.html")
    check_page(out)
    written = [out.with_suffix(suffix) for suffix in (".html", ".json", ".sha256")]
    if taken := {file.resolve() for file in files}.intersection(file.resolve() for file in written):
        raise ValueError(f"out must not replace what it is made of, got {out} and {min(taken).name}: name another page")
    for file in written:
        prepare_output(file)
    names = [os.path.relpath(file, out.parent) for file in files]
    hashes = [*map(_hash_file, files)]
    parts = []
    for (kind, content), name, digest in zip(contents, names, hashes, strict=True):
        label = controller or (next(iter(content["controllers"])) if kind == "dose" else "")
        title, table = tabulate(content, kind, label, tested[0].speed)
        origin = [("file", name), ("sha256", digest), *origin_rows(content)]
        origin += [("sources_sha256", content["sources_sha256"])]
        origin += [("changed", "sources differed from the commit")] if content["dirty"] else []
        origin += [("gate_sha256", content["gate_sha256"]), ("error", content["error"])] if kind == "gate" else []
        origin += [("terrains_sha256", check["terrains_sha256"]) for check in content.get("checks", ())]
        parts.append({"title": title, "table": table._asdict(), "origin": origin})
    robot_sha256, policy_sha256 = about[0]
    evidence = {
        "robot": tested[0].name, "robot_sha256": robot_sha256, "policy_sha256": policy_sha256, "speed": tested[0].speed,
        "safe_rate": SAFE_RATE, "parts": parts, "not_tested": list_untested(contents),
    }  # fmt: skip
    publish_page(out, "evidence.html", **evidence)
    write_atomically(out.with_suffix(".json"), to_json(evidence))
    sums = [(_hash_file(file), file.name) for file in written[:2]]
    lines = [f"{digest}  {name}\n" for digest, name in [*sums, *zip(hashes, names, strict=True)]]
    write_atomically(out.with_suffix(".sha256"), "".join(lines).encode())
    return out


def _hash_file(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def verify_evidence(file: Path) -> int:
    """How many files are as a list of hashes says; a ValueError names those that are not."""
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines() if file.is_file() else []
    rows = [match.groups() for line in lines if (match := re.fullmatch(r"([0-9a-fA-F]{64}) [ *](.+)", line))]
    own = {file.with_suffix(suffix).name for suffix in (".html", ".json")}
    if not rows or len(rows) < len(lines) or not own <= {name for _, name in rows}:
        rule = "must be a list of SHA-256, as `faultline report --evidence` writes it"
        raise ValueError(f"{file} {rule}: give that file")
    wrong = [
        f"{name} {'was changed' if path.is_file() else 'is gone'}"
        for digest, name in rows
        if not (path := file.parent / name).is_file() or _hash_file(path) != digest.lower()
    ]
    if wrong:
        raise ValueError(f"{file} does not hold: {', '.join(wrong)}: make the evidence anew, or put copies back")
    return len(rows)
