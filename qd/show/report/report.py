"""One page about a run: what is known of it, and robots that cross its worst terrains for the page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qd.evaluate.tables import read_tables
from qd.faults.families import VERDICTS, Ranking, rank
from qd.faults.minimise.minimise import read_minimal
from qd.faults.numbers import further_rates
from qd.search.archive import Archive
from qd.search.directory import ROUNDS_FILE, folder_for
from qd.search.progress import Bar
from qd.show.crossed import ARRIVED, Rate, count_rates, draw_crossing
from qd.show.elites import OpenedRun, open_run
from qd.show.recordings import Cross, Recordings, on_elite
from qd.show.report.evaluation import compare_controllers, write_rounds
from qd.show.report.page import Table, check_page, figure_source, publish_page
from qd.show.report.pictures import explain_missing_pictures, find_failure, find_same_moment, render_close_pictures
from qd.show.report.search import collect_content
from qd.workers.evaluator import check_policy, resolve_device
from sim.controllers.spec import resolve_policy
from sim.files.provenance import without_machine
from sim.recording.recorder import Recording

_OTHER_CAUSES = 3  # beside those of the first pictures, of which one terrain each is shown


def write_report(
    run: Path | None = None,
    *,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
    out: Path | None = None,
    num_elites: int = 3,
    tables: Path | None = None,
    episodes: int = 20,
    device: str | None = None,
    cross: Cross | None = None,
) -> Path:
    """Writes the page about a search, or about the rounds of a hardening; returns its file, *.html.

    The run is a directory of either, or an archive file; the newest search of the robot, else its published archive.
    ``num_elites`` of the worst terrains are shown close up, with another controller beside; ``tables`` of an evaluation
    are shown if their file is given.
    """
    if run is not None and (run / ROUNDS_FILE).exists():
        return write_rounds(run, robot, out)
    opened_run = open_run(robot, run, space=space)
    archive, minima = opened_run.archive, read_minimal(opened_run.folder, opened_run.archive)
    half_width = opened_run.robot.footprint[1]
    ranking = rank(archive, opened_run.space, minima, half_width=half_width, judged=True)
    missing = list[str]()
    if not len(ranking):
        raise ValueError(f"{opened_run.path} must have valid elites to report on, got none: let its search go on")
    crosser = resolve_policy(policy or opened_run.as_searched()[0], opened_run.robot)
    suffix = "" if policy is None else opened_run.suffix(crosser)
    out = out or folder_for(opened_run.path, opened_run.robot.name) / f"report{suffix}.html"
    check_page(out)
    compared = None
    if tables is not None:
        about = {"file": without_machine(str(tables)), "searched": archive.policy_sha256}
        compared = compare_controllers(read_tables(tables, opened_run.robot), **about)
    content = collect_content(opened_run, ranking, minima, crosser, is_searched=not suffix)
    heads = [n for n in ranking.worst(num_elites) if ranking.failing[ranking.find_row(n)]]
    heads = heads or ranking.worst(num_elites)
    causes = {ranking.causes[ranking.find_row(number)] for number in heads}
    firsts = [int(ranking.numbers[rows[0]]) for cause, rows in ranking.by_cause().items() if cause not in causes]
    others, cases = firsts[:_OTHER_CAUSES], {}
    if reason := _why_not_crossed(opened_run, policy, device):
        missing.append(reason)
    else:
        no_pictures = explain_missing_pictures()
        recordings = Recordings(opened_run.robot, device=resolve_device(device), cross=cross)
        cases = cross_cases(
            opened_run, ranking, crosser, heads, others, recordings, episodes=episodes, pictured=not no_pictures
        )
        missing += [no_pictures] if no_pictures else []
        for number, case in cases.items():
            case["film"] = opened_run.command("film", elite=number, policy=policy)
        missing += [f"All crossings of elite {n} were invalid this time." for n in (*heads, *others) if n not in cases]
    return publish_page(
        out, "search.html", **content, missing=missing, compared=compared,
        heads=[cases[number] for number in heads if number in cases],
        others=[cases[number] for number in others if number in cases],
    )  # fmt: skip


def _why_not_crossed(opened_run: OpenedRun, policy: str | None, device: str | None) -> str:
    """Why the search's controller can cross nothing, empty if it can; one that was asked for must be able to."""
    try:
        check_policy(opened_run.policy(policy), opened_run.robot, resolve_device(device))
    except ValueError as error:
        if policy is not None:
            raise
        return f"No terrain is crossed, since the search's controller cannot be loaded: {error}. Name it with --policy."
    return ""


def cross_cases(
    opened_run: OpenedRun,
    ranking: Ranking,
    policy: str,
    heads: Sequence[int],
    others: Sequence[int],
    recordings: Recordings,
    *,
    episodes: int,
    pictured: bool,
) -> dict[int, dict[str, Any]]:
    """Lets a controller cross elites and takes their pictures, by number; one without a valid episode is left out.

    ``heads`` are crossed by another controller too, if they have a certificate; ``others`` are shown in short. What the
    template takes of each: its number, name and verdict, the ``source`` of the picture at the moment of failure
    ``time_s`` [s], empty without pictures, the ``conditions`` in words, who crosses ``beside`` it, if anybody, the
    source of the ``figure`` with paths and profile, empty in short, and the table of its ``rates``.
    """
    files, cases = opened_run.certifiers(), dict[int, dict[str, Any]]()
    names = {number: name for number in heads if (name := opened_run.certifier(number)) is not None}
    crossings = [(number, policy) for number in (*heads, *others)]
    crossings += [(number, files[name]) for number, name in names.items()]
    wanted = [on_elite(opened_run.archive, number, policy=who, replicas=episodes) for number, who in crossings]
    recorded = dict(zip(crossings, recordings.all_of(wanted), strict=True))
    with Bar("drawing", len(heads) + len(others)) as bar:
        for done, number in enumerate((*heads, *others), 1):
            name = names.get(number)
            other = None if name is None else (name, recorded[number, files[name]])
            case = _case(opened_run, ranking, number, recorded[number, policy], other, number in heads, pictured)
            cases |= {number: case} if case else {}
            bar.move_to(done)
    return cases


def _case(
    opened_run: OpenedRun,
    ranking: Ranking,
    number: int,
    recording: Recording,
    other: tuple[str, Recording] | None,
    whole: bool,
    pictured: bool,
) -> dict[str, Any] | None:
    archive = opened_run.archive
    scales = dict(zip(archive.penalties, archive.scales, strict=True))
    if (failure := find_failure(recording, scales)) is None:
        return None
    moments = [failure] if other is None else [failure, find_same_moment(failure, other[1], scales)]
    sources = render_close_pictures(opened_run.robot, moments) if pictured else [""] * len(moments)
    beside = None
    if other is not None:
        rate = count_rates(other[1])[ARRIVED]
        beside = {"name": other[0], "source": sources[1], "time_s": moments[1].time_s, "rate": rate}
    arrived, row = count_rates(recording)[ARRIVED], ranking.find_row(number)
    title = f"{archive.robot}, elite {number} of {len(archive):,}: {arrived.count} crossings"
    return {
        "number": number,
        "name": ranking.name(row),
        "verdict": VERDICTS[int(ranking.verdict[row])],
        "source": sources[0],
        "time_s": failure.time_s,
        "conditions": opened_run.space.condition_text(archive.genes[number]),
        "beside": beside,
        "figure": figure_source(draw_crossing(recording, title)) if whole else "",
        "rates": _rates(ranking, archive, row, arrived),
    }


def _rates(ranking: Ranking, archive: Archive, row: int, arrived: Rate) -> Table:
    """Who reaches the goal how often: here, when the elite was found or judged, and under other conditions."""
    number = int(ranking.numbers[row])
    tries = "fresh tries" if ranking.is_fresh[row] else "tries of the search"
    rates = {"for this page": arrived, tries: Rate(ranking.hits("goal_rate", row), int(ranking.counted[row]))}
    rates |= {who: Rate(*rate) for who, rate in further_rates(archive, number).items()}
    rows = [[name, f"{rate.hits} of {rate.count}", rate.limits] for name, rate in rates.items()]
    return Table(head=["goal reached", "", "95 % interval"], rows=rows)
