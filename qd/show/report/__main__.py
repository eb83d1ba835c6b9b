"""``python -m qd.show.report --robot anymal``: one page about a run, with its figures beside it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from qd.run.cli import naming_what_is_next, run_command
from qd.show.report.changes import Change, Changes, changes_of
from qd.show.report.crossings import Place, Record, Wanted, cross_all, recorder
from qd.show.report.elite_sections import all_section, detail_section, modes_section
from qd.show.report.elites import elites_of, most_reproducible, worst
from qd.show.report.material import HtmlReportCfg, Material, gather
from qd.show.report.modes import find_modes
from qd.show.report.outcomes import Crossed, crossed_of
from qd.show.report.page import Section, pictures_of, render
from qd.show.report.search_sections import (
    archive_section,
    curves_section,
    origin_section,
    outcome_section,
    pairs_section,
)
from qd.show.report.shown import Shown, counted
from qd.show.report.table_sections import before_after_section, tables_section
from qd.workers.evaluator import check_policy, resolve_device
from sim.files.atomic import write_atomically
from sim.policy.spec import controller_hash, spec_of

MAX_BYTES = 15_000_000
"""Most that a page may weigh."""


def html_report(cfg: HtmlReportCfg, *, make_recorder: Callable[[Place], Record] = recorder) -> Path:
    """The command; returns the page.

    Args:
        cfg: What to report on.
        make_recorder: Makes what crosses terrains.

    Raises:
        FileNotFoundError: If there is no run, or no tables where they were said to be.
        ValueError: If something is not as it must be; raised before any long work.
        Interrupted: On Ctrl-C; what was crossed is kept.
    """
    material = gather(cfg)
    elites = elites_of(material.archive)
    if not len(elites):
        raise ValueError(
            f"{material.run} must have elites to report on, got {len(material.archive)} whose fresh episodes are all "
            f"invalid: let its search go on with `make archive RESUME={material.run} ITERATIONS=...`"
        )
    shown = Shown(
        material=material,
        elites=elites,
        modes=find_modes(elites),
        worst=worst(elites, cfg.elites),
        steady=most_reproducible(elites, cfg.elites),
    )
    with naming_what_is_next("what was crossed is kept", lambda: "The same command goes on"):
        shown = _with_crossings(shown, make_recorder)
    return _write(shown)


def _with_crossings(shown: Shown, make_recorder: Callable[[Place], Record]) -> Shown:
    """Crosses the elites to be shown, and the terrains to be shown before and after."""
    material = shown.material
    device = resolve_device(material.cfg.device)
    if reason := _uncrossable(material, device):
        changes = None if material.tables is None else Changes(reason="The controller of the search cannot be loaded.")
        return replace(shown, changes=changes, not_crossed=reason)
    place = Place(
        robot=material.robot,
        device=device,
        episodes=material.cfg.episodes,
        folder=material.out.with_name(f"{material.out.stem}-recordings"),
    )
    cross = make_recorder(place)
    wanted = [_elite_wanted(material, number) for number in shown.numbers]
    found = [_crossed(material, recording) for recording in cross_all(wanted, place, cross)]
    crossed = dict(zip(shown.numbers, found, strict=True))
    if material.tables is None:
        return replace(shown, crossed=crossed)
    changes = changes_of(material.tables, material.tables_file, material.robot)
    return replace(shown, crossed=crossed, changes=changes, pairs=_pairs(material, changes, place, cross))


def _uncrossable(material: Material, device: str) -> str:
    """Why the search's controller can cross nothing, empty if it can; one that was asked for must be able to."""
    if material.is_unnamed_code:
        return (
            f"Left out: the run was searched with the controller {material.searched}, which is code, and no code runs "
            f"that the command line does not name: name it with POLICY={material.searched}"
        )
    try:
        check_policy(material.policy, material.robot, device)
    except ValueError as error:
        if material.cfg.policy is not None:
            raise
        return f"Left out: the controller of the search cannot be loaded: {error}. Name one with POLICY="
    return ""


def _elite_wanted(material: Material, number: int) -> Wanted:
    label = f"elite {number} of {material.archive.robot}"
    return Wanted(label=label, genes=material.archive.genes[number], number=number, policy=material.policy)


def _crossed(material: Material, recording: object) -> Crossed:
    return crossed_of(recording, material.archive.penalties, material.archive.scales)  # pyright: ignore


def _pairs(material: Material, changes: Changes, place: Place, cross: Record) -> dict[Change, tuple[Crossed, Crossed]]:
    """What the two controllers of each change make of its terrain."""
    if changes.archive is None or changes.policies is None:
        return {}
    wanted = [
        Wanted(
            label=f"elite {change.number} with {who}",
            genes=changes.archive.genes[change.number],
            number=change.number,
            policy=spec_of(changes.policies[who], material.robot),
        )
        for change in changes.chosen
        for who in (change.before, change.after)
    ]
    found = [_crossed(material, recording) for recording in cross_all(wanted, place, cross)]
    return dict(zip(changes.chosen, zip(found[::2], found[1::2], strict=True), strict=True))


def _sections(shown: Shown) -> list[Section]:
    makers = (outcome_section, curves_section, archive_section, pairs_section, modes_section, detail_section,
              tables_section, before_after_section, all_section, origin_section)  # fmt: skip
    return [section for make in makers if (section := make(shown)) is not None]


def _lead(material: Material) -> str:
    """What stands under the title; a controller that is no longer the one searched is named here."""
    lead = f"Made from {material.run} by faultline, which searches terrains that break a legged robot's controller."
    search = material.search
    if material.cfg.policy is not None:
        return f"{lead} The crossings shown are of another controller than was searched: {material.policy}."
    if search is not None and search.policy_sha256 not in (None, controller_hash(material.policy)):
        return f"{lead} The controller's file has changed since the search: the crossings shown are of the present one."
    return lead


def _write(shown: Shown) -> Path:
    """Writes figures and page, the page last: it is whole or as it was."""
    material = shown.material
    sections = _sections(shown)
    page = render(f"How {material.archive.robot} breaks: a search's report", _lead(material), sections)
    if len(page) > MAX_BYTES:
        raise ValueError(
            f"the page would have {len(page):,} bytes, at most {MAX_BYTES:,} are allowed: show fewer --elites"
        )
    figures = material.out.with_name(f"{material.out.stem}-figures")
    figures.mkdir(exist_ok=True)
    pictures = pictures_of(sections)
    for shot in pictures:
        write_atomically(figures / shot.name, shot.png)
    write_atomically(material.out, page)
    print(f"{counted(len(pictures), 'figure')} under {figures}")
    print(f"Report: {material.out} ({len(page) / 1e6:.1f} MB; opens in a browser, without a network)")
    return material.out


if __name__ == "__main__":
    run_command(HtmlReportCfg, html_report)
