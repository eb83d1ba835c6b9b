"""The page of a hardening, in data: faults by round, rates by round, and what became of terrains."""

from pathlib import Path
from typing import Any

from qd.evaluate.labels import SETS
from qd.evaluate.tables import as_tables
from qd.run.directory import ROUNDS_FILE
from qd.show.report.evaluation import compared_of
from qd.show.report.page import Table, check_page, origin_rows, publish_page
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.files.intervals import value_words
from sim.files.records import without_machine
from sim.robots.find import get_robot

_COUNTS = ("elites", "failing", "confirmed", "certified", "faults")


def write_rounds(run: Path, robot: str | None, out: Path | None) -> Path:
    """Writes the page; returns its file."""
    content = _read(run, robot)
    out = out or run / "report.html"
    check_page(out)
    rounds = content["rounds"]
    rows = [
        [row["controller"], *(value_words(row.get(key), None, ",") for key in ("episodes", *_COUNTS)),
         ", ".join(row["certifiers"]) or "nobody"] for row in rounds
    ]  # fmt: skip
    return publish_page(
        out,
        "rounds.html",
        robot=content["robot"],
        run=without_machine(str(run)),
        rounds=rounds,
        counts=Table(head=["controller searched", "episodes", *_COUNTS, "crossed by"], rows=rows),
        goals={
            SETS.get(name, f"{name}, held out"): {who: 100.0 * rate for who, rate in rates.items() if rate is not None}
            for name, rates in content["tables"]["goal"].items()
        },
        compared=compared_of(content["tables"]),
        choices=content.get("choices", {}),
        origin=origin_rows(content),
        reports=[without_machine(command_line("report", run=run / row["search"])) for row in rounds],
    )


def _read(run: Path, robot: str | None) -> dict[str, Any]:
    file = run / ROUNDS_FILE
    content = read_json(file)
    if not content.get("rounds"):
        raise ValueError(f"{file} must have a search that is over, got none: let the hardening go on")
    try:
        content["tables"] = as_tables({"robot": content["robot"], **content["tables"]})
        if not all({"controller", "search", "certifiers", "faults"} <= set(row) for row in content["rounds"]):
            raise ValueError("a round lacks a name")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} must be of `faultline harden`, got another or a damaged file: {error}") from None
    if robot is not None and get_robot(robot).name != content["robot"]:
        raise ValueError(f"{file} is of robot {content['robot']}, got --robot {robot}: give that robot or another run")
    for row in content["rounds"]:  # without a specialist the faults are those that the panel shows
        row["faults"] = row.get("faults_panel") if row["faults"] is None else row["faults"]
    return content
