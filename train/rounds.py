"""The file of a hardening: the counts of all its searches, and tables of all its controllers."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from qd.archive import read_archive
from qd.evaluate.evaluate import evaluate
from qd.evaluate.sets import MIN_ELITES, Part, TerrainSet, generated_set, make_sets
from qd.faults import count_faults, fault_numbers
from qd.run.directory import ROUNDS_FILE, RunDirectory, read_archive_of
from qd.workers.evaluator import origin_of
from sim.files.atomic import has_shape, read_json, to_json, write_atomically
from sim.files.intervals import value_words
from sim.files.records import identity
from train.harden import Comparison

if TYPE_CHECKING:
    from train.hardening import Hardening, Stage

FIXED_SETS = ("hand_crafted", "hard_random")
"""Sets that every controller is evaluated on, beside the archives."""
_COUNTS = (
    "terrains_evaluated", "episodes", "elites", "elites_reproduced", "corrected_elites", "failing", "confirmed",
    "certified", "faults", "panel",
)  # fmt: skip
_SHAPES = {  # of what is read of rounds.json
    "settings": dict, "sessions": list, "rounds": list, "comparisons": {...: {"rounds": int}},
    "choices": {...: {"kept": object, "why": object}},
}  # fmt: skip
_SESSION = ("command", "commit", "device", "date")


def read_rounds(path: Path) -> dict[str, Any]:
    """``rounds.json`` of a directory, nothing if there is none.

    Raises:
        ValueError: If it is damaged.
    """
    file = path / ROUNDS_FILE
    content = read_json(file) if file.exists() else {}
    damaged = [name for name, shape in _SHAPES.items() if name in content and not has_shape(content[name], shape)]
    if not damaged and not all(_is_known(kind, row["rounds"]) for kind, row in content.get("comparisons", {}).items()):
        damaged = ["comparisons"]
    if damaged:
        raise ValueError(f"{file} is damaged at {damaged[0]}: put a copy of it back")
    return content


def _is_known(kind: str, rounds: int) -> bool:
    """Whether there is such a comparison; JSON's true is an int in Python, but no number of rounds."""
    return kind in get_args(Comparison) and rounds is not True and rounds > 0


def divisible(runs: Sequence[Path]) -> tuple[Path, ...]:
    """The searches that found enough elites to train on some and hold out others; the first must have."""
    enough = tuple(run for run in runs if len(read_archive(run)) >= MIN_ELITES)
    if runs and runs[0] not in enough:
        raise ValueError(
            f"{runs[0]} must have found at least {MIN_ELITES} elites to train on, got {len(read_archive(runs[0]))}: "
            "give more --search-episodes and another --run-dir"
        )
    return enough


def begin(job: "Hardening") -> None:
    """Writes what is to be done, with this session after those before."""
    file = job.path / ROUNDS_FILE
    now = origin_of(job.device, job.flags.seed, job.flags.workers)
    content = read_rounds(job.path) or {**now, "settings": job.settings}
    sessions = [*content.pop("sessions", []), {name: now[name] for name in _SESSION}]
    write_atomically(file, to_json({**content, "sessions": sessions}))
    started = time.strftime("%H:%M")
    rounds = f"{job.flags.rounds} round{'s' * (job.flags.rounds != 1)}"
    print(f"Hardening '{job.robot.name}' for {rounds} in {job.path}, from {started}", flush=True)


def record(job: "Hardening") -> None:
    """Writes ``rounds.json``: the counts of all searches that are over, and the tables of all controllers there are."""
    file = job.path / ROUNDS_FILE
    content = read_json(file)
    judged = [stage for stage in job.stages if job.is_settled(stage) and job.is_judged(stage)]
    rows = {stage.controller: (stage, _row(job, stage)) for stage in judged}
    known = dict(content.get("comparisons") or {})  # those of this session and of sessions before
    known |= {one: {"rounds": job.compared[one], **row} for stage, row in rows.values() if (one := stage.compared)}
    written = {
        **content,
        **{name: job.settings[name] for name in ("robot", "robot_sha256", "penalty_definition")},
        "rounds": [row for stage, row in rows.values() if not stage.compared],
        "comparisons": known,
        "tables": _tables(job, known),
    }
    write_atomically(file, to_json(written))


def _row(job: "Hardening", stage: "Stage") -> dict[str, Any]:
    """What the search against a controller found."""
    # The faults by the archive: a kill may come between it and its numbers.
    archive = read_archive(stage.search)
    known = RunDirectory(stage.search).read_summary() | fault_numbers(archive)
    known |= {"panel": known["certifiers"], "faults": count_faults(archive)}
    counts = {name: known.get(name) for name in _COUNTS}
    who = {name: value for name, value in identity(job.robot, stage.policy).items() if name.startswith("policy")}
    return {
        "controller": stage.controller,
        **who,
        "tuned": [tune.run.name for tune in stage.tunes],
        "kept": [tune.kept for tune in stage.tunes],
        "search": stage.search.name,
        **counts,
    }


def _tables(job: "Hardening", known: Mapping[str, Any]) -> dict[str, Any]:
    """Every controller there is on the fixed sets and on the held-out elites of every archive.

    The same keys as of ``tables.json``; what was crossed before is not crossed again. A comparison that goes on to more
    rounds is left out until its row, one of those ``known``, is that of the same controller.
    """
    there = list(filter(job.is_settled, job.stages))
    others = [one for one, row in known.items() if row["rounds"] != job.compared.get(one)]
    there = [stage for stage in there if stage.compared not in others]
    controllers = {stage.controller: stage.policy for stage in there}
    sets = dict(make_sets(FIXED_SETS, job.terrains, 0, space=job.space))
    searched = [stage.search for stage in there if not stage.compared and job.is_searched(stage)]
    sets |= {run.name: held_out(job, run) for run in divisible(searched)}
    return {
        **evaluate(
            controllers, sets, robot=job.robot, compute=job.compute, episodes=job.episodes,
            cache=job.path / "crossings", open_evaluator=job.open_evaluator,
        )
    }  # fmt: skip


def held_out(job: "Hardening", run: Path, part: Part = "test") -> TerrainSet:
    """Elites of an archive that no training draws."""
    archive = read_archive_of(job.robot, run, job.flags.space)
    return replace(generated_set(archive, job.terrains, 0, part), name=run.name)


def tell(content: Mapping[str, Any]) -> None:
    """The rounds in a few lines."""
    goal, limits = content["tables"]["goal"], content["tables"]["intervals"]["goal"]
    print(f"\n{'controller':<14}{'elites':>8}{'failing':>9}{'faults':>8}  goal on")
    for row in [*content["rounds"], *content["comparisons"].values()]:
        who = row["controller"]
        elites, failing, faults = ("-" if row[key] is None else row[key] for key in ("elites", "failing", "faults"))
        rates = (f"{name} {value_words(goal[name].get(who), limits[name].get(who))}" for name in FIXED_SETS)
        print(f"{who:<14}{elites:>8}{failing:>9}{faults:>8}  {', '.join(rates)}")
    tuned = {name for row in [*content["rounds"], *content["comparisons"].values()] for name in row["tuned"]}
    for name, choice in content.get("choices", {}).items():
        if name in tuned and not choice["kept"]:
            print(f"{name} was not kept: {choice['why']}")
