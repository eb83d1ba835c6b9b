"""One page about a run."""

from pathlib import Path

from qd.archive import ARCHIVE_FILE
from qd.evaluate.tables import read_tables
from qd.groups import elites_of, rank
from qd.minimise import read_minimal
from qd.run.directory import CONFIG_FILE, ROUNDS_FILE, folder_for
from qd.show.elites import OpenedRun, open_run
from qd.show.recordings import Cross, Recordings
from qd.show.report.cases import cross_cases
from qd.show.report.evaluation import compared_of
from qd.show.report.page import check_page, publish_page
from qd.show.report.pictures import why_no_pictures
from qd.show.report.rounds import write_rounds
from qd.show.report.search import content_of
from qd.workers.evaluator import check_policy, resolve_device
from sim.files.records import without_machine
from sim.policy.spec import spec_of

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
    opened_run = _opened(robot, run, space)
    archive, minima = opened_run.archive, read_minimal(opened_run.folder, opened_run.archive)
    crosser = spec_of(policy or opened_run.as_searched()[0], opened_run.robot)
    suffix = "" if policy is None else opened_run.suffix(crosser)
    out = out or folder_for(opened_run.path, opened_run.robot.name) / f"report{suffix}.html"
    check_page(out)
    compared = None
    if tables is not None:
        about = {"file": without_machine(str(tables)), "searched": archive.policy_sha256}
        compared = compared_of({**read_tables(tables, opened_run.robot)}, **about)
    ranking, missing = rank(archive, opened_run.space, minima, judged=True), list[str]()
    content = content_of(opened_run, ranking, minima, crosser, is_searched=policy is None)
    heads = [n for n in ranking.worst(num_elites) if ranking.elites.failing[ranking.elites.place_of(n)]]
    heads = heads or ranking.worst(num_elites)
    causes = {ranking.causes[ranking.elites.place_of(number)] for number in heads}
    firsts = [int(ranking.elites.numbers[rows[0]]) for cause, rows in ranking.by_cause().items() if cause not in causes]
    others, cases = firsts[:_OTHER_CAUSES], {}
    if reason := _why_not_crossed(opened_run, policy, device):
        missing.append(reason)
    else:
        no_pictures = why_no_pictures()
        recordings = Recordings(opened_run.robot, device=resolve_device(device), cross=cross)
        cases = cross_cases(
            opened_run, ranking, crosser, heads, others, recordings, episodes=episodes, pictured=not no_pictures
        )
        missing += [no_pictures] if no_pictures else []
        missing += [f"All crossings of elite {n} were invalid this time." for n in (*heads, *others) if n not in cases]
    return publish_page(
        out, "search.html", **content, missing=missing, compared=compared,
        heads=[cases[number] for number in heads if number in cases],
        others=[cases[number] for number in others if number in cases],
    )  # fmt: skip


def _opened(robot: str | None, run: Path | None, space: str | None) -> OpenedRun:
    """The run, which must have elites to report on."""
    if run is not None and (run / CONFIG_FILE).exists() and not (run / ARCHIVE_FILE).exists():
        raise ValueError(f"{run} must hold a search that has ended an iteration, got no {ARCHIVE_FILE}: let it go on")
    opened_run = open_run(robot, run, space=space)
    if not len(elites_of(opened_run.archive, judged=True)):
        raise ValueError(f"{opened_run.path} must have valid elites to report on, got none: let its search go on")
    return opened_run


def _why_not_crossed(opened_run: OpenedRun, policy: str | None, device: str | None) -> str:
    """Why the search's controller can cross nothing, empty if it can; one that was asked for must be able to."""
    try:
        check_policy(opened_run.policy(policy), opened_run.robot, resolve_device(device))
    except ValueError as error:
        if policy is not None:
            raise
        return f"No terrain is crossed, since the search's controller cannot be loaded: {error}. Name it with --policy."
    return ""
