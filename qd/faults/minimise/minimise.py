"""Minimal terrains of a run: found, judged like elites, written, read and said."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from qd.faults.causes import effects_of
from qd.faults.families import elites_of, verdict_of, verdicts_of
from qd.faults.judge import CROSSINGS_FOLDER, certifiers_of, certify, check_certifiers, confirm, find_search
from qd.faults.minimise.results import MINIMAL_FILE, NUMBERS_FILE, MinimalTerrains, read_minimal
from qd.faults.minimise.subsets import Case, How, Minimal, Trial, case_of, genes_of, take_apart
from qd.faults.numbers import judgement, rate_of
from qd.search.archive import OUTCOMES, Archive, goal_rates
from qd.search.directory import claimed
from qd.show.figures import draw_minimal, save_figure
from qd.workers.cross import Crossings
from qd.workers.evaluator import Compute, check_policy
from sim.controllers.spec import controller_identity
from sim.files.atomic import to_json, write_atomically
from sim.files.command import choose_elites
from sim.files.npz import npz_bytes
from sim.terrains.bank import heights_of
from sim.terrains.spaces.base import TerrainSpace

FIGURE_FILE = "minimal.png"

_MOST_ELITES = {"cuda": 200, "cpu": 3}  # that are taken where none are named


def minimise(
    run: Path,
    *,
    compute: Compute,
    elite: str | None = None,
    how: How | None = None,
    judged: bool = False,
    certifiers: Mapping[str, str] | None = None,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
) -> MinimalTerrains | None:
    """Finds minimal terrains of failing elites of a run and writes them beside those that it has of other elites.

    Elites are named by numbers, or ``all``; by default they are 200 on a GPU and 3 on the CPU, faults first, then
    confirmed, certified and other failing ones. They must have fresh episodes. ``judged`` says whether the minimal
    terrains are crossed with contact resolved and by certifiers too; all else is as :func:`qd.faults.judge.judge` takes
    it. Returns what the run has now; None without a failing elite.
    """
    search = find_search(run, robot=robot, policy=policy, space=space)
    check_policy(search.policy, search.robot, compute.device)
    certifiers = certifiers_of(search) if certifiers is None else certifiers
    if judged:
        check_certifiers(certifiers, search, compute.device)
    half_width = search.robot.footprint[1]
    kind = compute.device.partition(":")[0]
    with claimed(run), Crossings(search.robot, compute, cache=run / CROSSINGS_FOLDER) as crossings:
        archive = search.read_archive()
        numbers = _failing(archive, elite, run, _MOST_ELITES[kind])
        on_gpu = kind == "cuda"
        cases = {n: case_of(archive, n, search.space, half_width, how, on_gpu=on_gpu) for n in numbers}
        minima = take_apart(archive, cases, search, crossings)
        elites = _as_elites(archive, minima, search.space)
        if judged:
            rows = np.arange(len(elites))
            elites = certify(confirm(elites, rows, search, crossings), rows, certifiers, search, crossings)
        before = read_minimal(run, archive)
        entries = {} if before is None else {entry["elite"]: entry for entry in before.numbers["elites"]}
        genes = {} if before is None else dict(before.genes)
        for place, (number, minimal) in enumerate(minima.items()):
            entry = _entry(archive, number, cases[number], minimal, search.space, half_width)
            entries[number] = entry | {"verdict": verdict_of(elites, place), **judgement(elites, place)}
            genes[number] = elites.genes[place]
        if not numbers:
            print(f"{run}: none of {len(archive):,} elites fails.")
        if not entries:
            return None
        ordered = [entries[number] for number in sorted(entries)]
        origin = compute.origin(search.cfg.seed) | controller_identity(search.robot, search.policy)
        space_named = {"space": search.cfg.space, "space_sha256": search.cfg.space_sha256}
        content = {**origin, **space_named, **_totals(ordered), "elites": ordered}
        arrays = {name: np.array(value) for name, value in space_named.items() if value is not None}
        arrays |= {"elite": np.array(sorted(genes)), "genes": np.array([genes[number] for number in sorted(genes)])}
        write_atomically(run / MINIMAL_FILE, npz_bytes(arrays))
        write_atomically(run / NUMBERS_FILE, to_json(content))
        save_figure(run / FIGURE_FILE, draw_minimal(search.cfg.robot, content, genes, search.space))
    found = MinimalTerrains(numbers=content, genes=genes)
    for number in minima:
        print(f"Elite {number}: {found.words(number)}.")
    print(f"Numbers: {run / NUMBERS_FILE}\nFigure: {run / FIGURE_FILE}")
    return found


def _failing(archive: Archive, elite: str | None, run: Path, most: int) -> list[int]:
    """Numbers of the failing elites that are named, or of some: faults first."""
    if archive.fresh is None:
        raise ValueError(f"{run} must have fresh episodes of its elites, got none: let `faultline judge` cross them")
    failing = np.flatnonzero(archive.failing).tolist()
    if elite is None:
        verdict = verdicts_of(archive)
        return sorted(sorted(failing, key=lambda number: -verdict[number])[:most])
    if elite.strip() == "all":
        return failing
    numbers = choose_elites(elite, range(len(archive)), f"{run} has no elite")
    if crossed := [number for number in numbers if number not in failing]:
        worst = [number for number in elites_of(archive).by_severity().tolist() if number in failing]
        known = f"{len(failing)} fail, the worst are {', '.join(map(str, worst[:5]))}" if worst else "none fails"
        raise ValueError(f"elite must name failing elites of {run}, got {', '.join(map(str, crossed))}: {known}")
    return numbers


def _as_elites(archive: Archive, minima: Mapping[int, Minimal], space: TerrainSpace) -> Archive:
    """Minimal terrains as elites whose fresh episodes are their own; of the rest only the names hold."""
    rows = archive.rows(np.array([*minima], np.int64))
    assert rows.fresh is not None
    counts = np.array([minimal.counts for minimal in minima.values()], np.int64).reshape(-1, len(OUTCOMES))
    genes = [genes_of(archive.genes[number], Trial(minimal.parts), space) for number, minimal in minima.items()]
    fresh = replace(
        rows.fresh,
        goal_rate=goal_rates(counts),
        episodes=counts.sum(axis=1),
        invalid_episodes=counts[:, OUTCOMES.index("invalid")],
    )
    return replace(rows, genes=np.array(genes, np.float32).reshape(rows.genes.shape), fresh=fresh, faults=None)


def _entry(archive: Archive, number: int, case: Case, minimal: Minimal, space: TerrainSpace, half_width: float) -> dict:
    """A minimal terrain as ``minimal.json`` has it, without what others make of it."""
    words = space.parts(archive.genes[number])
    scales = (1.0, minimal.scale or 1.0)
    genes = [genes_of(archive.genes[number], Trial(minimal.parts, scale), space) for scale in scales]
    effects = effects_of(genes[0], minimal.parts, space)
    shapes = {part: effects.shape(place, half_width) for place, part in enumerate(minimal.parts)}
    cause = minimal.cause({part: abs(shape.height_m) for part, shape in shapes.items()})
    whole, scaled = heights_of(np.array(genes), space)
    without = {str(part): rate_of(counts) for part, counts in minimal.without.items()}
    return {
        "elite": number,
        "cell": int(archive.cell[number]),
        "iteration": int(archive.iteration[number]),
        "bumps": list(minimal.parts),
        "words": [words[part] for part in minimal.parts],
        "of": len(case.parts),
        "how": case.how,
        "subsets_crossed": minimal.subsets,
        **rate_of(minimal.counts),
        "without": {part: rate["goal_rate"] for part, rate in without.items()},
        "without_intervals": {part: rate["goal_interval"] for part, rate in without.items()},
        "cause": None if cause is None else {"bump": cause, **asdict(shapes[cause])},
        "scale": minimal.scale,
        "passing_scale": minimal.passing_scale,
        "height_m": round(float(np.abs(whole).max()), 4),
        "margin_m": None if minimal.scale is None else round(float(np.abs(whole - scaled).max()), 4),
        "scales": [{"scale": scale, **rate_of(counts)} for scale, counts in sorted(minimal.scales.items())],
    }


def _totals(entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How many minimal terrains there are of each kind."""
    sizes = [len(entry["bumps"]) for entry in entries]
    margins = [entry["margin_m"] for entry in entries if entry["margin_m"] is not None]
    causes = Counter(entry["cause"]["kind"] for entry in entries if entry["cause"])
    verdicts = Counter(entry["verdict"] for entry in entries)
    judged = any(entry["resolved"] for entry in entries)
    certifiers = {certificate["controller"] for entry in entries for certificate in entry["certificates"]}
    return {
        "minimal": len(entries),
        "bumps_histogram": {str(size): count for size, count in sorted(Counter(sizes).items())},
        "bumps_median": float(np.median(sizes)) if sizes else None,
        "margin_m_median": float(np.median(margins)) if margins else None,
        "causes": dict(sorted(causes.items(), key=lambda pair: (-pair[1], pair[0]))),
        "confirmed": verdicts["confirmed"] + verdicts["fault"] if judged else None,
        "certified": verdicts["certified"] + verdicts["fault"] if judged else None,
        "faults": verdicts["fault"] if judged else None,
        "certifiers": sorted(certifiers),
    }
