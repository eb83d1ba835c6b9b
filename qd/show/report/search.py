"""The page's chapters about the search: what was done, what came out, its curves and its archive."""

import numpy as np

from qd.faults import any_of, count_faults, fault_words
from qd.fitness import FAILING_GOAL_RATE
from qd.run.progress import clock
from qd.show.figures import draw_archive, draw_curves, draw_spread, label_of
from qd.show.report.elites import failures
from qd.show.report.material import Shown
from qd.show.report.page import (
    Block,
    Folded,
    absent,
    at_a_glance,
    counted,
    origin_table,
    paragraph,
    percent,
    picture,
    table,
)
from sim.files.command import command_line
from sim.files.intervals import bootstrap_interval
from sim.files.records import without_machine
from sim.policy.spec import SHIPPED, ControllerSpec

_MIN_TERRAINS = 10  # that an interval of a mean is resampled from


def lead_words(shown: Shown) -> str:
    """What the page leads with: faults where they are known, how many terrains fail, and in which ways."""
    elites, archive = shown.elites, shown.material.archive
    failing = int(elites.failing.sum())
    faults, count = archive.faults, count_faults(archive)
    words = ""
    if faults is not None and faults.certifiers and count is not None:
        what = "fault: a terrain" if count == 1 else "faults: terrains"
        words = f"{count:,} {what} that {any_of(faults.certifiers)} crosses and this controller does not. "
    words += f"The controller fails on {failing:,} of {counted(len(elites), 'elite')}"
    most_first = sorted(shown.modes.modes, key=lambda mode: -len(mode.members))
    if not most_first:
        return f"{words}."
    ways = "; ".join(
        f"{mode.deed} ({len(mode.members):,}, marked by {label_of(mode.marked_by)})" for mode in most_first
    )
    return f"{words}, in {counted(len(most_first), 'way')}. The robot {ways}."


def outcome_section(shown: Shown) -> list[Block]:
    """In how many ways the controller breaks how often, a picture of each, and what was searched at what cost."""
    elites, archive = shown.elites, shown.material.archive
    failing, ways = int(elites.failing.sum()), elites.failing_cells
    basis = (
        f"by {int(elites.counted.max(initial=0))} fresh episodes each, free of the luck that made them elites"
        if elites.fresh.any()
        else "by the episodes that found them, which flatter themselves"
    )
    faults, count = archive.faults, count_faults(archive)
    facts = []
    if faults is not None and faults.certifiers and count is not None:
        what = f"faults: elites that {any_of(faults.certifiers)} crosses and this controller does not"
        facts.append((what, f"{count:,}"))
    facts += [
        ("elites that under half of the robots cross", f"{failing:,} of {len(elites):,}"),
        ("failure modes: kinds of these", f"{len(shown.modes.modes)}"),
        ("cells that these fall into: different shares of what goes wrong", f"{ways:,}"),
        ("robots that reach the goal, mean over the elites", _rate(elites.goal_rate)),
        ("robots that end in a base collision, mean over the elites", _rate(elites.collision_rate)),
        ("robots that end fallen, mean over the elites", _rate(elites.fallen_rate)),
    ]
    text = (
        f"The controller fails on {failing:,} of {counted(len(elites), 'elite')} judged ({basis}): there under "
        f"{percent(FAILING_GOAL_RATE)} of the robots reach the goal, on {int((elites.goal_rate == 0.0).sum()):,} none. "
        f"Means over the elites{' have 95 % intervals (bootstrap over terrains)' * (len(elites) >= _MIN_TERRAINS)}."
    )
    known, material = fault_words(archive), shown.material
    judge = without_machine(command_line("judge", robot=material.robot.spec, run=material.run))
    unknown = "Which of these are faults, terrains that another controller crosses, is not known yet. Next:"
    about = [paragraph(" ".join([*known, text]))] if known else [absent(unknown, judge), paragraph(text)]
    return [at_a_glance(facts), *failures(shown), *about, _searched(shown)]


def _rate(rates: np.ndarray) -> str:
    """Mean over terrains with its interval; of few terrains without, since resampling them says too little."""
    mean = percent(float(rates.mean()))
    limits = bootstrap_interval(rates, 0) if len(rates) >= _MIN_TERRAINS else None
    return mean if limits is None else f"{mean} ({percent(limits[0])} to {percent(limits[1])})"


def _searched(shown: Shown) -> Block:
    """Robot, controller, method and cost in a sentence."""
    material, numbers = shown.material, shown.material.summary
    archive, search = material.archive, material.search
    policy = SHIPPED if search is None else search.policy
    controller = "its shipped controller" if policy == SHIPPED else f"controller {ControllerSpec.parse(policy).label}"
    if search is None:
        controller = "a controller that is not on record (the archive lies without its config.json)"
    text = f"{archive.robot} with {controller}, after {counted(archive.iterations, 'iteration')}"
    if search is not None:
        text += f" of {search.scheduler.method.replace('+', ' and ')} (seed {search.seed})"
    text += f": {counted(len(archive), 'elite')} in {percent(archive.reachable_coverage)} of the "
    text += f"{archive.cells.num_cells:,} reachable cells"
    if numbers is None or material.metrics is None:
        return paragraph(f"{text}. What that cost is not on record: there is no metrics.jsonl beside the archive.")
    text += f", from {counted(numbers['terrains_evaluated'], 'terrain')} and {numbers['episodes']:,} episodes"
    where = f" on {'up to ' if material.gpus > 1 else ''}{counted(material.gpus, 'GPU')}" if material.gpus else ""
    invalid = counted(numbers["invalid_episodes"], "episode was", "episodes were")
    return paragraph(f"{text}, in {clock(numbers['wall_s'])} of searching{where}. {invalid} invalid and left out.")


def curves_section(shown: Shown) -> list[Block]:
    """How the search went."""
    rows, archive = shown.material.metrics, shown.material.archive
    if not rows:
        left_out = "The curves are left out: there is no metrics.jsonl beside the archive. A search writes one:"
        return [absent(left_out, without_machine(command_line("archive", robot=shown.material.robot.spec)))]
    first, last = rows[0], rows[-1]
    half = next(row["iteration"] for row in rows if row["elites"] >= last["elites"] / 2)
    text = (
        f"From iteration {first['iteration']} to {last['iteration']} the archive grew from {first['elites']:,} to "
        f"{counted(last['elites'], 'elite')}, half of them found by iteration {half}; the QD score, the sum of fitness "
        f"above -20, rose from {first['qd_score']:,.0f} to {last['qd_score']:,.0f}, the mean fitness went from "
        f"{first['mean_fitness']:.1f} to {last['mean_fitness']:.1f}."
    )
    shows = "QD score, number of elites with reachable coverage, and mean fitness over the iterations"
    return [paragraph(text), picture("curves", draw_curves(archive, rows), shows)]


def archive_section(shown: Shown) -> list[Block]:
    """The archive on parallel axes, and its spread over each share."""
    elites, archive = shown.elites, shown.material.archive
    lines = (
        f"Each line is one of {counted(len(elites), 'elite')}; each axis a penalty, the height its share of all that "
        "went wrong."
    )
    return [
        paragraph(lines),
        picture("archive", draw_archive(archive), "Parallel axes: a line an elite, an axis a penalty's share"),
        Folded(
            "Show the elites by interval of each share",
            [picture("spread", draw_spread(archive), "Number of elites in each interval of each share")],
        ),
    ]


def origin_section(shown: Shown) -> list[Block]:
    """Where the numbers come from."""
    origin = shown.material.origin
    if not origin:
        lost = "The search is not on record: there is no config.json beside the archive. A search writes one:"
        return [absent(lost, without_machine(command_line("archive", robot=shown.material.robot.spec)))]
    text = f"The archive read is {without_machine(str(shown.material.run))}. Its search began with:"
    return [paragraph(text), table(["", ""], origin_table(origin), words=True)]
