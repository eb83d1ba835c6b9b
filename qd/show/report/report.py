"""One page about a run, with its figures beside it."""

from dataclasses import replace
from pathlib import Path

from qd.groups import elites_of, rank
from qd.run.directory import ROUNDS_FILE
from qd.run.settings import find_policy
from qd.show.crossed import crossed_of
from qd.show.recordings import Cross, Recordings, on_elite
from qd.show.report import elites, evaluation, minimal, search
from qd.show.report.material import Material, Shown, gather
from qd.show.report.page import Section, publish_page
from qd.show.report.rounds import write_rounds
from qd.workers.evaluator import check_policy, resolve_device
from sim.files.records import without_machine

_CHAPTERS = {
    ("What breaks the controller", "outcome"): search.outcome_section,
    ("The smallest terrains that still break it", "minimal"): minimal.minimal_section,
    ("Terrains worth a look", "terrains"): elites.detail_section,
    ("Failure modes", "modes"): elites.modes_section,
    ("The search", "search"): search.curves_section,
    ("The archive", "archive"): search.archive_section,
    ("Controllers compared", "tables"): evaluation.tables_section,
    ("All elites", "all"): elites.all_section,
    ("Where this comes from", "origin"): search.origin_section,
}


def write_report(
    run: Path | None = None,
    *,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
    out: Path | None = None,
    num_elites: int = 5,
    episodes: int = 20,
    device: str | None = None,
    cross: Cross | None = None,
) -> Path:
    """Writes the page about a search, or about the rounds of a hardening; returns its file.

    Args:
        run: Directory of either, or an archive file; the newest search of the robot, else its published archive.
        robot: Name or settings file of the robot.
        policy: The controller to cross with; the search's if None.
        space: A user's own terrain space that the run names.
        out: File to write, *.html.
        num_elites: How many of the worst and of the most reproducible elites to show.
        episodes: Crossings of each.
        device: Warp device name.
        cross: Crosses terrains; by default the simulation.
    """
    if run is not None and (run / ROUNDS_FILE).exists():
        return write_rounds(run, robot, out)
    material = gather(robot, run, policy=policy, space=space, out=out)
    if not len(elites_of(material.archive, judged=True)):
        raise ValueError(f"{material.run} must have elites to report on, got only invalid ones: let its search go on")
    ranking = rank(material.archive, material.space, judged=True)
    shown = Shown(
        material=material,
        ranking=ranking,
        worst=ranking.worst(num_elites),
        steady=ranking.elites.most_reproducible(num_elites),
        episodes=episodes,
    )
    shown = _with_crossings(shown, resolve_device(device), cross)
    sections = [Section(*name, blocks) for name, make in _CHAPTERS.items() if (blocks := make(shown))]
    return publish_page(material.out, f"How {material.archive.robot} breaks", _lead(shown), sections)


def _with_crossings(shown: Shown, device: str, cross: Cross | None) -> Shown:
    """Crosses the elites to be shown."""
    material, archive = shown.material, shown.material.archive
    if reason := _why_not_crossed(material, device):
        return replace(shown, not_crossed=reason)
    recordings = Recordings(material.robot, device=device, cross=cross)
    wanted = [
        on_elite(archive, number, policy=material.policy, replicas=shown.episodes, label=None)
        for number in shown.numbers
    ]
    crossed = [crossed_of(recording, archive.penalties, archive.scales) for recording in recordings.all_of(wanted)]
    return replace(shown, crossed=dict(zip(shown.numbers, crossed, strict=True)))


def _why_not_crossed(material: Material, device: str) -> str:
    """Why the search's controller can cross nothing, empty if it can; one that was asked for must be able to."""
    try:
        if material.named_policy is None and material.search is not None:
            find_policy(material.run, material.search, material.robot)
        check_policy(material.policy, material.robot, device)
    except ValueError as error:
        if material.named_policy is not None:
            raise
        return f"Left out: the controller of the search cannot be loaded: {error}. Name one with --policy"
    return ""


def _lead(shown: Shown) -> str:
    """What stands under the title; another controller than was searched is named here."""
    lead, material = search.lead_words(shown), shown.material
    if material.named_policy is None:
        return lead
    other = without_machine(material.policy)
    return f"{lead} The crossings shown are of another controller than was searched: {other}."
