"""One page about a run: what is known of it, and robots that cross its worst terrains for the page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qd.evaluate.tables import read_tables
from qd.faults.families import VERDICTS, Ranking
from qd.faults.numbers import further_rates
from qd.search.archive import Archive
from qd.search.directory import ROUNDS_FILE, output_folder
from qd.search.progress import Bar
from qd.show.crossed import ARRIVED, Rate, count_rates, draw_crossing
from qd.show.elites import OpenedRun, open_run
from qd.show.recordings import Cross, Recordings, request_elite
from qd.show.report.evaluation import compare_controllers, write_rounds
from qd.show.report.page import Table, check_page, encode_figure, publish_page
from qd.show.report.pictures import explain_missing_pictures, find_failure, find_same_moment, render_close_pictures
from qd.show.report.search import collect_content
from qd.workers.compute import check_policy, choose_device
from sim.controllers.spec import resolve_policy
from sim.files.provenance import without_machine
from sim.recording.recorder import Recording

_OTHER_CAUSES = 3  # beside those of the first pictures; one terrain of each is shown


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
    archive = opened_run.archive
    ranking = opened_run.rank(judged=True)
    if not len(ranking):
        raise ValueError(f"{opened_run.path} must have valid elites to report on, got none: let its search go on")
    controller = resolve_policy(policy or opened_run.as_searched()[0], opened_run.robot)
    suffix = "" if policy is None else opened_run.suffix(controller)
    out = out or output_folder(opened_run.path, opened_run.robot.name) / f"report{suffix}.html"
    check_page(out)
    compared = None
    if tables is not None:
        file = without_machine(str(tables))
        compared = compare_controllers(read_tables(tables, opened_run.robot), file=file, searched=archive.policy_sha256)
    content = collect_content(opened_run, ranking, controller, is_searched=not suffix)
    heads, others = _choose_elites(ranking, num_elites)
    cases: dict[int, dict[str, Any]] = {}
    missing = [_explain_no_crossings(opened_run, policy, device)]
    if not missing[0]:
        missing = [explain_missing_pictures()]
        recordings = Recordings(opened_run.robot, device=choose_device(device), cross=cross)
        cases = cross_cases(
            opened_run, ranking, controller, heads, others, recordings, episodes=episodes, pictured=not missing[0]
        )
        for number in (*heads, *others):
            if number in cases:
                cases[number]["film"] = opened_run.command("film", elite=number, policy=policy)
            else:
                missing.append(f"All crossings of elite {number} were invalid this time.")
    return publish_page(
        out, "search.html", **content, missing=[*filter(None, missing)], compared=compared,
        heads=[cases[number] for number in heads if number in cases],
        others=[cases[number] for number in others if number in cases],
    )  # fmt: skip


def _choose_elites(ranking: Ranking, num_elites: int) -> tuple[list[int], list[int]]:
    """The worst elites, failing ones if there are any, and the worst of some other causes."""
    rows = ranking.order()[:num_elites]
    failing = rows[ranking.failing[rows]]
    rows = failing if len(failing) else rows
    causes = {ranking.causes[row] for row in rows}
    others = [members[0] for cause, members in ranking.by_cause().items() if cause not in causes][:_OTHER_CAUSES]
    numbers = ranking.numbers
    return numbers[rows].tolist(), [int(numbers[row]) for row in others]


def _explain_no_crossings(opened_run: OpenedRun, policy: str | None, device: str | None) -> str:
    """Why the search's controller cannot cross terrains, empty if it can; a controller of the user must be able to."""
    try:
        check_policy(opened_run.policy(policy), opened_run.robot, choose_device(device))
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

    ``heads`` are crossed by their best certifier too, if they have one; ``others`` are shown in short.
    """
    files = opened_run.certifiers()
    certifiers = {number: name for number in heads if (name := opened_run.certifier(number)) is not None}
    crossings = [(number, policy) for number in (*heads, *others)]
    crossings += [(number, files[name]) for number, name in certifiers.items()]
    requests = [request_elite(opened_run.archive, number, policy=who, replicas=episodes) for number, who in crossings]
    recorded = dict(zip(crossings, recordings.record(requests), strict=True))
    cases = {}
    with Bar("drawing", len(heads) + len(others)) as bar:
        for done, number in enumerate((*heads, *others), 1):
            name = certifiers.get(number)
            ghost = None if name is None else (name, recorded[number, files[name]])
            case = _make_case(opened_run, ranking, number, recorded[number, policy], ghost, pictured)
            if case is not None:
                cases[number] = case
                if number in heads:
                    title = f"{opened_run.archive.robot}, elite {number} of {len(opened_run.archive):,}"
                    figure = draw_crossing(recorded[number, policy], f"{title}: {case['rate'].count} crossings")
                    case["figure"] = encode_figure(figure)
            bar.move_to(done)
    return cases


def _make_case(
    opened_run: OpenedRun,
    ranking: Ranking,
    number: int,
    recording: Recording,
    ghost: tuple[str, Recording] | None,
    pictured: bool,
) -> dict[str, Any] | None:
    """What the template takes of an elite; ``source`` is a picture at ``time_s`` [s], empty without pictures."""
    archive = opened_run.archive
    failure = find_failure(recording, opened_run.scales)
    if failure is None:
        return None
    moments = [failure] if ghost is None else [failure, find_same_moment(failure, ghost[1], opened_run.scales)]
    sources = render_close_pictures(opened_run.robot, moments) if pictured else [""] * len(moments)
    beside = None
    if ghost is not None:
        rate = count_rates(ghost[1])[ARRIVED]
        beside = {"name": ghost[0], "source": sources[1], "time_s": moments[1].time_s, "rate": rate}
    row = ranking.find_row(number)
    rate = count_rates(recording)[ARRIVED]
    return {
        "number": number,
        "name": ranking.name(row),
        "verdict": VERDICTS[int(ranking.verdict[row])],
        "source": sources[0],
        "time_s": failure.time_s,
        "conditions": opened_run.space.condition_text(archive.genes[number]),
        "beside": beside,
        "figure": "",
        "rate": rate,
        "rates": _list_rates(ranking, archive, row, rate),
    }


def _list_rates(ranking: Ranking, archive: Archive, row: int, arrived: Rate) -> Table:
    """How often controllers reach the goal: now, when the elite was found or judged, and under other conditions."""
    tries = "fresh tries" if ranking.is_fresh[row] else "tries of the search"
    rates = {"for this page": arrived, tries: Rate(ranking.hits("goal_rate", row), int(ranking.counted[row]))}
    rates |= {label: Rate(*rate) for label, rate in further_rates(archive, int(ranking.numbers[row])).items()}
    rows = [[label, f"{rate.hits} of {rate.count}", rate.limits] for label, rate in rates.items()]
    return Table(head=["goal reached", "", "95 % interval"], rows=rows)
