"""Minimal terrains of a run: found, judged like elites, written and printed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.causes import find_effects
from qd.faults.families import VERDICTS, find_verdicts
from qd.faults.numbers import MINIMAL_FILE, MINIMAL_NUMBERS_FILE, MinimalTerrains, judgement, rate_numbers, read_minimal
from qd.faults.searches import Search, find_search
from qd.faults.stages import STAGES, Judging, open_judging
from qd.faults.subsets import Case, How, Trial, cut_genes, open_case, take_apart
from qd.search.archive import OUTCOMES, Archive, goal_rates, no_outcomes
from qd.show.figures import draw_minimal, save_figure
from qd.workers.compute import Compute
from sim.files.atomic import to_json, write_atomically
from sim.files.command import choose_elites, command_line
from sim.files.npz import npz_bytes
from sim.terrains.bank import make_heights
from sim.terrains.spaces.base import TerrainSpace

FIGURE_FILE = "minimal.png"


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
    with open_judging(search, compute, certifiers, ask=judged) as judging:
        archive = search.read_archive()
        numbers = sorted(_choose_failing(archive, elite, search, max_elites=200 if compute.on_gpu else 3))
        half_width = search.robot.half_width
        cases = {n: open_case(archive, n, search.space, half_width, how, on_gpu=compute.on_gpu) for n in numbers}
        take_apart(archive, cases, judging)
        elites = _as_elites(archive, cases, search.space)
        if judged:
            for stage in ("resolved", "others"):
                elites = STAGES[stage].run(elites, judging)
        if not numbers:
            print(f"{run}: none of {len(archive):,} elites fails.")
        verdicts = [VERDICTS[verdict] for verdict in find_verdicts(elites)]
        entries = {
            n: _entry(archive, n, cases[n], search) | {"verdict": verdicts[row], **judgement(elites, row)}
            for row, n in enumerate(numbers)
        }
        genes = dict(zip(numbers, elites.genes, strict=True))
        if stored := read_minimal(run, archive):
            entries = {entry["elite"]: entry for entry in stored.numbers["elites"]} | entries
            genes = stored.genes | genes
        if not entries:
            return None
        result = _write(judging, entries, genes)
    for number in numbers:
        verdict = f"; {entries[number]['verdict']}" if judged else ""
        print(f"Elite {number}: {result.describe(number)}{verdict}.")
    print(f"Numbers: {run / MINIMAL_NUMBERS_FILE}\nFigure: {run / FIGURE_FILE}")
    return result


def _write(
    judging: Judging, entries: Mapping[int, dict[str, Any]], genes: Mapping[int, NDArray[np.float32]]
) -> MinimalTerrains:
    """Writes numbers, genes and figure of all minimal terrains of a run."""
    search = judging.search
    ordered = [entries[number] for number in sorted(entries)]
    genes = {number: genes[number] for number in sorted(entries)}
    space = {"space": search.cfg.space, "space_sha256": search.cfg.space_sha256}
    content = {**judging.origin, **space, **_totals(ordered), "elites": ordered}
    arrays = {name: np.array(value) for name, value in space.items() if value is not None}
    arrays |= {"elite": np.array([*genes]), "genes": np.array([*genes.values()])}
    write_atomically(search.run / MINIMAL_FILE, npz_bytes(arrays))
    write_atomically(search.run / MINIMAL_NUMBERS_FILE, to_json(content))
    save_figure(search.run / FIGURE_FILE, draw_minimal(search.cfg.robot, content, genes, search.space))
    return MinimalTerrains(numbers=content, genes=genes)


def _choose_failing(archive: Archive, elite: str | None, search: Search, *, max_elites: int) -> list[int]:
    """Numbers of the failing elites that are named, or of some: faults first."""
    run = search.run
    if archive.fresh is None:
        command = command_line("judge", run=run, robot=search.robot.spec)
        raise ValueError(f"{run} must have fresh episodes of its elites, got none: run `{command}`")
    failing = np.flatnonzero(archive.failing).tolist()
    if elite is None:
        verdicts = find_verdicts(archive)
        return sorted(sorted(failing, key=lambda number: -verdicts[number])[:max_elites])
    if elite.strip() == "all":
        return failing
    numbers = choose_elites(elite, range(len(archive)), f"{run} has no elite")
    if crossed := [number for number in numbers if number not in failing]:
        named = ", ".join(map(str, crossed))
        raise ValueError(f"elite must name failing elites of {run}, got {named}: leave it out or try {failing[:5]}")
    return numbers


def _as_elites(archive: Archive, cases: Mapping[int, Case], space: TerrainSpace) -> Archive:
    """Minimal terrains as elites with their own genes and fresh episodes; of the rest only the names hold."""
    rows = archive.rows(np.array([*cases], np.int64))
    assert rows.fresh is not None
    counts = np.array([case.fresh for case in cases.values()], np.int64).reshape(-1, len(OUTCOMES))
    genes = [cut_genes(archive.genes[number], Trial(case.minimal), space) for number, case in cases.items()]
    episodes = {"episodes": counts.sum(axis=1), "invalid_episodes": counts[:, OUTCOMES.index("invalid")]}
    fresh = replace(rows.fresh, goal_rate=goal_rates(counts), **episodes)
    unjudged: dict[str, Any] = no_outcomes(len(rows)) | dict.fromkeys(("certifiers", "certifier_sha256"), ())
    unjudged |= dict.fromkeys(("varied_outcomes", "certifier_varied_outcomes"))
    return replace(rows, genes=np.array(genes, np.float32).reshape(rows.genes.shape), fresh=fresh, **unjudged)


def _entry(archive: Archive, number: int, case: Case, search: Search) -> dict[str, Any]:
    """A minimal terrain as ``minimal.json`` has it, without its verdict."""
    space = search.space
    descriptions = space.parts(archive.genes[number])
    genes = [cut_genes(archive.genes[number], Trial(case.minimal, scale), space) for scale in (1.0, case.scale or 1.0)]
    effects = find_effects(genes[0], case.minimal, space)
    half_width = search.robot.half_width
    shapes = {part: effects.shape(index, half_width) for index, part in enumerate(case.minimal)}
    cause = case.cause({part: abs(shape.height_m) for part, shape in shapes.items()})
    whole, scaled = make_heights(np.array(genes), space)
    without = {str(part): rate_numbers(counts) for part, counts in case.without.items()}
    subsets = {trial.parts for trial in case.counts if trial.scale == 1.0 and trial.parts != case.whole}
    scaled_counts = {trial.scale: counts for trial, counts in case.counts.items() if trial.scale < 1.0}
    return {
        "elite": number,
        "cell": int(archive.cell[number]),
        "iteration": int(archive.iteration[number]),
        "bumps": list(case.minimal),
        "words": [descriptions[part] for part in case.minimal],
        "of": len(case.parts),
        "how": case.how,
        "subsets_crossed": len(subsets),
        **rate_numbers(case.fresh),
        "without": {part: rate["goal_rate"] for part, rate in without.items()},
        "without_intervals": {part: rate["goal_interval"] for part, rate in without.items()},
        "cause": None if cause is None else {"bump": cause, **asdict(shapes[cause])},
        "scale": case.scale,
        "passing_scale": case.passing_scale,
        "height_m": round(float(np.abs(whole).max()), 4),
        "margin_m": None if case.scale is None else round(float(np.abs(whole - scaled).max()), 4),
        "scales": [{"scale": scale, **rate_numbers(scaled_counts[scale])} for scale in sorted(scaled_counts)],
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
