"""``faultline report``: one page about a run, with its figures beside it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from qd.run.directory import ROUNDS_FILE
from qd.run.settings import own_policy
from qd.workers.evaluator import check_policy, resolve_device
from sim.files.command import InSpace, OnDevice, Who, naming_what_is_next
from sim.files.records import without_machine
from sim.files.settings import check, setting
from sim.policy.spec import spec_of

if TYPE_CHECKING:
    from qd.archive import Archive
    from qd.show.crossed import Crossed
    from qd.show.recordings import Cross, Recordings
    from qd.show.report.material import Material, Shown
    from qd.show.report.tables import Change, Changes


@dataclass(frozen=True, kw_only=True)
class Report(Who, OnDevice, InSpace):
    """Write one HTML page about a run, with its figures beside it; it opens from disk, without a network.

    Robots cross the elites that it shows again, 20 times each. The crossings are kept under runs/recordings, so the
    same command goes on after a stop.
    """

    run: Path | None = None
    """Run directory; the newest of this robot under runs/, else its published archive. Of a `faultline harden` the page
    is about its rounds, and nothing is crossed."""
    tables: Path | None = None
    """File of the evaluation tables; results/<robot>/tables.json if it is there."""
    out: Path | None = None
    """Page to write, *.html; report.html in the run, or of published results in runs/<robot>-published; with another
    controller report-<its name>.html."""
    format: Literal["html", "pdf"] = "html"
    """pdf: a short form for print, *.pdf in place of *.html: what fails in which ways, and minimal terrains. A browser
    prints it, Chromium or Chrome."""
    elites: int = setting(5, least=1, most=10)
    """How many of the worst and of the most reproducible elites to show, with one of each failure mode."""
    episodes: int = setting(20, least=1, most=100)
    """Crossings of each elite shown."""

    def execute(self) -> None:
        """Writes the page."""
        html_report(self)


def html_report(cfg: Report, *, cross: "Cross | None" = None) -> Path:
    """Writes the page; returns its file.

    Args:
        cfg: What to report on.
        cross: Crosses terrains; by default the simulation.

    Raises:
        FileNotFoundError: If there is no run, or no tables where they were said to be.
        ValueError: If something is not as it must be; raised before any long work.
        Interrupted: On Ctrl-C; what was crossed is kept.
    """
    from qd.groups import elites_of, rank
    from qd.show.elites import Found
    from qd.show.report.material import Shown, gather
    from qd.show.report.rounds import rounds_report

    check(cfg)
    if cfg.run is not None and (cfg.run / ROUNDS_FILE).exists():
        return rounds_report(cfg.run, cfg.robot, cfg.out)
    material = gather(cfg)
    if not len(elites_of(material.archive, judged=True)):
        raise ValueError(
            f"{material.run} must have elites to report on, got {len(material.archive)} whose fresh episodes are all "
            f"invalid: {Found(run=material.run, archive=material.archive, robot=material.robot).go_on}"
        )
    ranking = rank(material.archive, material.space, judged=True)
    shown = Shown(
        material=material,
        ranking=ranking,
        worst=ranking.worst(cfg.elites),
        steady=ranking.elites.most_reproducible(cfg.elites),
    )
    with naming_what_is_next("what was crossed is kept", lambda: "The same command goes on"):
        shown = _with_crossings(shown, cross)
    return _write(shown)


def _with_crossings(shown: "Shown", cross: "Cross | None") -> "Shown":
    """Crosses the elites to be shown, and the terrains to be shown before and after."""
    from qd.show.recordings import Recordings
    from qd.show.report.tables import changes_of

    material = shown.material
    device = resolve_device(material.cfg.device)
    if reason := _uncrossable(material, device):
        no_changes = "" if material.tables is None else "The controller of the search cannot be loaded."
        return replace(shown, no_changes=no_changes, not_crossed=reason)
    recordings = Recordings(material.robot, device=device, cross=cross)
    wanted = [(number, material.policy, None) for number in shown.numbers]
    crossed = _crossings(material, recordings, material.archive, wanted)
    shown = replace(shown, crossed=dict(zip(shown.numbers, crossed, strict=True)))
    if material.tables is None:
        return shown
    try:
        changes = changes_of(material.tables, material.tables_file, material.robot)
    except ValueError as error:
        return replace(shown, no_changes=without_machine(str(error)))
    return replace(shown, changes=changes, pairs=_pairs(material, changes, recordings))


def _uncrossable(material: "Material", device: str) -> str:
    """Why the search's controller can cross nothing, empty if it can; one that was asked for must be able to."""
    if material.is_unnamed_code:
        return (
            f"Left out: the run was searched with the controller {material.searched}, which is code, and no code runs "
            f"that the command line does not name: name it with --policy {material.searched}"
        )
    try:
        if material.cfg.policy is None and material.search is not None:
            own_policy(material.run, material.search, material.robot)
        check_policy(material.policy, material.robot, device)
    except ValueError as error:
        if material.cfg.policy is not None:
            raise
        return f"Left out: the controller of the search cannot be loaded: {error}. Name one with --policy"
    return ""


def _crossings(
    material: "Material", recordings: "Recordings", archive: "Archive", wanted: Sequence[tuple[int, str, str | None]]
) -> "list[Crossed]":
    """Crossings of elites of an archive, each given by its number, the controller and a label."""
    from qd.show.crossed import crossed_of
    from qd.show.recordings import on_elite

    asked = [
        on_elite(archive, number, policy=policy, replicas=material.cfg.episodes, label=label)
        for number, policy, label in wanted
    ]
    penalties, scales = material.archive.penalties, material.archive.scales
    return [crossed_of(recording, penalties, scales) for recording in recordings.all_of(asked)]


def _pairs(
    material: "Material", changes: "Changes", recordings: "Recordings"
) -> "dict[Change, tuple[Crossed, Crossed]]":
    """What the two controllers of each change make of its terrain."""
    wanted = [
        (change.number, spec_of(changes.policies[who], material.robot), f"elite {change.number} with {who}")
        for change in changes.chosen
        for who in (change.before, change.after)
    ]
    found = _crossings(material, recordings, changes.archive, wanted)
    return dict(zip(changes.chosen, zip(found[::2], found[1::2], strict=True), strict=True))


def _lead(shown: "Shown") -> str:
    """What stands under the title; another controller than was searched is named here."""
    from qd.show.report.search import lead_words

    lead, material = lead_words(shown), shown.material
    if material.cfg.policy is not None:
        who = without_machine(material.policy)
        return f"{lead} The crossings shown are of another controller than was searched: {who}."
    return lead


def _write(shown: "Shown") -> Path:
    """Writes figures and page."""
    from qd.show.report import elites, evaluation, minimal, search
    from qd.show.report.page import Section, publish_page, render
    from qd.show.report.pdf import print_page

    material = shown.material
    short = {
        ("What breaks the controller", "outcome"): search.outcome_section,
        ("The smallest terrains that still break it", "minimal"): minimal.minimal_section,
        ("Failure modes", "modes"): elites.modes_section,
        ("Where this comes from", "origin"): search.origin_section,
    }
    chapters = (
        short
        if material.cfg.format == "pdf"
        else {
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
    )
    sections = [Section(*name, blocks) for name, make in chapters.items() if (blocks := make(shown))]
    title = f"How {material.archive.robot} breaks"
    if material.cfg.format == "pdf":
        print_page(render(title, _lead(shown), sections), material.out)
        print(f"Report: {material.out} (short form)")
        return material.out
    return publish_page(material.out, title, _lead(shown), sections, remedy="show fewer --elites")
