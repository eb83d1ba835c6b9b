"""Faults in numbers, and in the words of docs/faults.md: failing elites, and their minimal terrains."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import false_discovery_control, hypergeom

from qd.search.archive import OUTCOMES, WITNESSES, Archive, FreshValues, goal_rates
from qd.search.fitness import FITNESS_FLOOR
from sim.crossing import CrossingCfg
from sim.files.atomic import read_json
from sim.files.intervals import RATES, bootstrap_interval, format_rate, format_value, wilson_interval
from sim.files.npz import read_arrays
from sim.files.templates import open_templates
from sim.rates import SUCCESS

FRESH_EPISODES = 40  # episodes that each elite is evaluated again with
EPISODES = 20  # episodes of an elite in each further stage of judging
SEARCHED = "searched"  # name of the searched controller among those that are steered
SPECIALIST = "specialist"  # so begin names of certifiers trained on what a search fails; all others form the panel

TEMPLATES = open_templates(Path(__file__).parent / "templates")  # texts about elites
_INVALID = OUTCOMES.index("invalid")
MAX_FALSE_DISCOVERIES = 0.05  # largest expected share of luck among what is significant (Benjamini and Hochberg 1995)
_COUNTS = (
    "confirmed", "certified", "faults", "faults_panel", "faults_controllers", "faults_witness", "fault_families",
    "fault_families_controllers", "strong", "faults_fdr",
)  # fmt: skip
_KINDS = {"searched": "", "resolved": " with contact resolved", "varied": " under varied conditions"}
FURTHER_NUMBERS = ("witnesses", "crossed_varied", "robust", "faults_mujoco_c", "likeliest")
"""Numbers of faults that an archive has only if they were crossed again, or its space has conditions."""
MINIMAL_FILE = "minimal.npz"
MINIMAL_NUMBERS_FILE = "minimal.json"
_ENTRY = ("elite", "cell", "iteration", "bumps", "words", "of", "goal_rate", "goal_interval", "cause", "margin_m")


def found_numbers(archive: Archive, metrics: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What a search found and how much it took, as ``archive.json`` has it; ``metrics`` has a row an iteration."""
    with_collision = int((archive.collision_rate > 0.0).sum())  # in any episode; the bit is of 20
    return {
        "iterations": archive.iterations,
        "terrains_evaluated": sum(row["terrains"] for row in metrics),
        "episodes": count_episodes(metrics),
        "elites": len(archive),
        "reachable_cells": archive.cells.num_cells,
        "reachable_coverage": archive.reachable_coverage,
        "qd_score": archive.qd_score,
        "mean_fitness": archive.mean_fitness,
        "with_collision": with_collision,
        "without_collision": len(archive) - with_collision,
        "wall_s": sum(row["wall_s"] for row in metrics),
        "invalid_episodes": sum(row["invalid_episodes"] for row in metrics),
    }


def count_episodes(metrics: Sequence[Mapping[str, Any]]) -> int:
    """Episodes of some iterations, with those that found out whether anybody crosses terrains."""
    return sum(row["episodes"] + row.get("label_episodes", 0) for row in metrics)


def fresh_numbers(archive: Archive, fresh: FreshValues) -> dict[str, Any]:
    """What fresh episodes say of an archive, as ``archive.json`` has it."""
    std = fresh.penalty_std[fresh.valid].sum(axis=1)
    corrected = fresh.corrected_elites()
    families = None if archive.family is None else archive.family[fresh.valid]
    return {
        "reevaluated": len(fresh.reproduced),
        "elites_reproduced": int(fresh.reproduced.sum()),
        "elites_same_cell": int((fresh.valid & (fresh.cell == archive.cell)).sum()),
        "mean_std": float(std.mean()) if len(std) else None,
        "mean_std_interval": bootstrap_interval(std, 0, families=families),
        "mean_fitness_corrected": float(fresh.fitness[fresh.valid].mean()) if len(std) else None,
        "corrected_elites": len(corrected),
        "corrected_coverage": len(corrected) / archive.cells.num_cells,
        "corrected_qd_score": float((fresh.fitness[corrected] - FITNESS_FLOOR).sum()),
    }


def fault_numbers(archive: Archive) -> dict[str, Any]:
    """The numbers of faults, as ``archive.json`` has them; None where nobody knows."""
    failing, names, witnesses = archive.failing, archive.certifiers, archive.witnesses

    def count_families(rows: NDArray[np.bool_]) -> int | None:
        return None if archive.family is None else len(np.unique(archive.family[rows]))

    numbers: dict[str, Any] = {
        "failing": None if archive.fresh is None else int(failing.sum()),
        **dict.fromkeys(_COUNTS, 0 if archive.fresh is not None and not failing.any() else None),
        "families": count_families(np.ones(len(archive), bool)),
        "failing_families": count_families(failing),
        "certifiers": list(names),
    }
    if not archive.is_judged or not failing.any():
        return numbers
    resolved = failing & archive.resolved_outcomes.any(axis=1)
    certificates = archive.certificates & failing[:, None]
    counts = {"crossed_resolved": resolved}
    if resolved.any():
        counts["confirmed"] = archive.confirmed
    crossed = archive.certifier_outcomes.any(axis=2) & failing[:, None]
    columns = (names, archive.certifier_sha256, crossed.sum(axis=0).tolist(), certificates.sum(axis=0).tolist())
    keys = ("controller", "policy_sha256", "crossed", "certified")
    numbers["certificates"] = [dict(zip(keys, row, strict=True)) for row in zip(*columns, strict=True)]
    if witnesses is not None:
        tried = witnesses.walker != ""
        found = {name: int((witnesses.kind == kind).sum()) for kind, name in enumerate(WITNESSES) if name}
        own = int((witnesses.on_line & (witnesses.walker == SEARCHED)).sum())
        numbers["witnesses"] = {"tried": int(tried.sum()), **found, "own_line": own, "limit_m": witnesses.limit_m}
    if names or witnesses is not None:
        counts["certified"] = archive.certified
    if (names or witnesses is not None) and resolved.any():
        in_panel = np.array([not name.startswith(SPECIALIST) for name in names], bool)
        is_fault, by_controllers = archive.is_fault, archive.certified_by_controllers
        counts |= {} if in_panel.all() and witnesses is None else {"faults": is_fault}
        counts |= {} if witnesses is None else {"faults_witness": is_fault & ~by_controllers}
        counts["faults_panel"] = is_fault & certificates[:, in_panel].any(axis=1)
        counts["faults_controllers"] = is_fault & by_controllers
        counts |= {"strong": archive.strong, "faults_fdr": is_fault & by_controllers & find_significant(archive)}
        numbers["fault_families"] = count_families(is_fault)
        numbers["fault_families_controllers"] = count_families(is_fault & by_controllers)
        if archive.varied is not None:
            counts["crossed_varied"] = is_fault & archive.varied.searched.any(axis=1)
            counts["robust"] = archive.robust
        if archive.mujoco_c is not None:
            tried = is_fault & archive.mujoco_c.searched.any(axis=1)
            strong = _share_held(archive, tried & archive.strong)
            numbers["faults_mujoco_c"] = _share_held(archive, tried) | {"strong": strong}
    return numbers | {name: int(mask.sum()) for name, mask in counts.items()}


def find_significant(archive: Archive) -> NDArray[np.bool_]:
    """Whether it is no luck that a certifier crosses a failing elite more often than the searched controller, (N,).

    By Fisher's exact test, one-sided, against both kinds of a certifier's episodes: the worse p, and of C certifiers
    the smallest p times C. Benjamini and Hochberg's procedure holds the share of false discoveries at 5 %.
    """
    both = np.stack([archive.certifier_outcomes, archive.certifier_resolved_outcomes])
    others = archive.resolved_outcomes[:, None]
    valid, other_valid = (counts.sum(axis=-1) - counts[..., _INVALID] for counts in (both, others))
    known = ~np.isnan(goal_rates(both) + goal_rates(others))
    worse = np.where(known, fisher_p(both[..., 0], valid, others[..., 0], other_valid), 1.0).max(axis=0)
    p = (worse * len(archive.certifiers)).min(axis=1, initial=1.0)
    significant = archive.failing
    significant[significant] = false_discovery_control(p[significant]) <= MAX_FALSE_DISCOVERIES
    return significant


def fisher_p(
    goals: NDArray[np.int64], valid: NDArray[np.int64], other_goals: NDArray[np.int64], other_valid: NDArray[np.int64]
) -> NDArray[np.float64]:
    """One-sided p (Fisher's exact test) that episodes reach the goal more often than others, of counts; 1 of none."""
    return np.nan_to_num(hypergeom.sf(goals - 1, valid + other_valid, goals + other_goals, valid), nan=1.0)


def _share_held(archive: Archive, tried: NDArray[np.bool_]) -> dict[str, Any]:
    """How many of the faults ``tried`` in MuJoCo C hold there, with the interval of their share over families."""
    holds, family = archive.holds_in_mujoco_c[tried], archive.family
    count, interval = int(holds.sum()), None
    if family is not None and len(np.unique(family[tried])) == len(holds):
        interval = wilson_interval(count, len(holds))
    elif family is not None:
        interval = bootstrap_interval(holds.astype(np.float64), 0, families=family[tried], bounds=RATES)
    return {"tried": len(holds), "hold": count, "interval": interval}


def count_faults(archive: Archive) -> int | None:
    """Faults by all certifiers, or by the panel where there is no specialist; None if nobody knows."""
    numbers = fault_numbers(archive)
    return numbers["faults_panel"] if numbers["faults"] is None else numbers["faults"]


def best_certifier(archive: Archive, number: int, among: Container[str] | None = None) -> str | None:
    """Name of the certifier that crosses an elite most often, of all or of some; None if none has a certificate."""
    if not archive.failing[number]:
        return None
    rates = goal_rates(archive.certifier_outcomes[number]) * archive.certificates[number]
    certifiers = dict(zip(archive.certifiers, rates.tolist(), strict=True))
    names = [name for name, rate in certifiers.items() if rate > 0.0 and (among is None or name in among)]
    return max(names, key=certifiers.__getitem__, default=None)


def _certifier_outcomes(archive: Archive) -> dict[str, NDArray[np.int64]]:
    """Outcomes of the certifiers by kind of episodes, shape (N, C, 4)."""
    varied = archive.varied and archive.varied.certifiers
    tables = (archive.certifier_outcomes, archive.certifier_resolved_outcomes, varied)
    return {kind: table for kind, table in zip(_KINDS, tables, strict=True) if table is not None}


def further_rates(archive: Archive, number: int) -> dict[str, tuple[int, int]]:
    """Further episodes on an elite that reached the goal, and valid ones, by controller and conditions."""
    counts = {"With contact resolved (steps of 1 ms)": archive.resolved_outcomes[number]}
    if archive.varied is not None:
        counts["Under varied conditions"] = archive.varied.searched[number]
    for column, name in enumerate(archive.certifiers):
        for kind, table in _certifier_outcomes(archive).items():
            counts[name + _KINDS[kind]] = table[number, column]
    return {label: (int(ends[0]), int(ends.sum() - ends[_INVALID])) for label, ends in counts.items() if ends.any()}


def describe_judgement(archive: Archive, number: int) -> list[str]:
    """What is known of an elite, in sentences; none where nobody crossed it under other conditions."""
    rates = {label: format_rate(*rate) for label, rate in further_rates(archive, number).items()}
    witness = describe_witness(archive, number)
    if not rates and not witness:
        return []
    passers = [*compress(archive.certifiers, archive.certificates[number].tolist())]
    about = {"archive": archive, "number": number, "success": SUCCESS[archive.terrain_space.asks]}
    about |= {"rates": rates, "witness": witness, "passers": passers}
    return TEMPLATES.get_template("elite.txt").render(about).splitlines()


def describe_witness(archive: Archive, number: int) -> str:
    """How a controller crosses an elite where it is steered, in a sentence; empty where no such way is known."""
    witnesses = archive.witnesses
    if witnesses is None or not (kind := WITNESSES[witnesses.kind[number]]):
        return ""
    column = len(WITNESSES) - 1 - int(witnesses.kind[number])
    goals, valid = witnesses.counts[number, 0, 1, [column, -1]].tolist()
    walker = str(witnesses.walker[number])
    about = {"kind": kind, "goals": goals, "valid": valid, "walker": "" if walker == SEARCHED else walker}
    return TEMPLATES.get_template("witness.txt").render(way=describe_way(witnesses.way[number]), **about)


def describe_way(way: NDArray[np.float32]) -> str:
    """What a way tells a robot to do, in words: how fast, slowest where, and where furthest from the straight line."""
    ends = np.linspace(CrossingCfg.start[0], CrossingCfg.goal[0], len(way) + 1)
    speed, offset = way[:, 0], way[:-1, 1]  # in the last segment the robot is sent to the goal
    slow, aside = int(speed.argmin()), int(np.abs(offset).argmax())
    places = [f"from x = {ends[k]:.0f} to {ends[k + 1]:.0f} m" for k in (slow, aside + 1)]  # an offset is for ahead
    is_even = speed.max() - speed.min() < 0.15
    words = f"at {np.median(speed):.1f} m/s{'' if is_even else f', slowed to {speed[slow]:.1f} m/s {places[0]},'}"
    side = f"{abs(offset[aside]):.1f} m to the {'left' if offset[aside] > 0 else 'right'} {places[1]}"
    return f"{words} and {side}" if abs(offset[aside]) >= 0.05 else words.rstrip(",")


def fresh_counts(archive: Archive, number: int) -> NDArray[np.int64]:
    """The fresh episodes of an elite by :data:`qd.search.archive.OUTCOMES`, shape (4,)."""
    fresh = archive.fresh
    assert fresh is not None
    valid = int(fresh.counted[number])
    goal, collided = (round(float(rate[number]) * valid) for rate in (fresh.goal_rate, fresh.collision_rate))
    return np.array([goal, collided, valid - goal - collided, int(fresh.invalid_episodes[number])])


def rate_numbers(counts: NDArray[np.int64]) -> dict[str, Any]:
    """Goal rate of episodes, shape (4,), with its 95 % interval (Wilson); None where too many are invalid."""
    valid = int(counts.sum() - counts[_INVALID])
    rate = float(goal_rates(counts))
    interval = [round(limit, 4) for limit in wilson_interval(int(counts[0]), valid)]
    return {"goal_rate": None if np.isnan(rate) else rate, "goal_interval": interval, "valid_episodes": valid}


def judgement(archive: Archive, number: int) -> dict[str, Any]:
    """What is known of an elite under other conditions, as JSON values; None where nobody looked.

    ``certificates`` has each certifier's name, hash, and rates at the search's settings and under these conditions.
    """
    resolved = archive.resolved_outcomes[number]
    varied = None if archive.varied is None else archive.varied.searched[number]
    under_varied = {} if varied is None or not varied.any() else {"varied": rate_numbers(varied)}
    return under_varied | {
        "resolved": rate_numbers(resolved) if resolved.any() else None,
        "certificates": [
            {"controller": name, "policy_sha256": digest}
            | {kind: rate_numbers(table[number, column]) for kind, table in _certifier_outcomes(archive).items()}
            for column, (name, digest) in enumerate(zip(archive.certifiers, archive.certifier_sha256, strict=True))
            if archive.certificates[number, column]
        ],
    }


@dataclass(frozen=True, kw_only=True)
class MinimalTerrains:
    """Minimal terrains of elites of an archive."""

    numbers: dict[str, Any]  # the content of minimal.json
    genes: dict[int, NDArray[np.float32]]  # by number of the elite, each of shape (num_genes,)

    def entry(self, number: int) -> dict[str, Any]:
        """The entry of an elite in ``minimal.json``."""
        return next(entry for entry in self.numbers["elites"] if entry["elite"] == number)

    def describe(self, number: int) -> str:
        """What is known of the minimal terrain of an elite, in a sentence."""
        entry = self.entry(number)
        rate = format_value(entry["goal_rate"], entry["goal_interval"], ".0%")
        return TEMPLATES.get_template("minimal.txt").render(entry=entry, rate=rate)


def read_minimal(folder: Path, archive: Archive) -> MinimalTerrains | None:
    """The minimal terrains in a run's folder that are of elites of the archive; None if there are none."""
    file = folder / MINIMAL_NUMBERS_FILE
    if not file.exists():
        return None
    try:
        numbers = read_json(file)
        arrays = read_arrays(folder / MINIMAL_FILE, ("elite", "genes"))
        entries, genes = numbers["elites"], arrays["genes"]
        shape = (len(entries), archive.genes.shape[1])
        if [entry["elite"] for entry in entries] != arrays["elite"].tolist() or genes.shape != shape:
            raise ValueError(f"{MINIMAL_NUMBERS_FILE} and {MINIMAL_FILE} are not of one another")
        if not all(set(_ENTRY) <= set(entry) for entry in entries):
            raise ValueError(f"expected {', '.join(_ENTRY)} of each")
    except Exception as error:  # a damaged zip archive can fail with anything
        rule = f"{file} and {MINIMAL_FILE} must be minimal terrains of the archive beside them"
        what = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"{rule}: {what}: remove both, or run `faultline minimise` again") from None
    # A search that went on may have found others of these numbers.
    names = [*zip(range(len(archive)), archive.cell.tolist(), archive.iteration.tolist(), strict=True)]
    named = [(entry["elite"], entry["cell"], entry["iteration"]) in names for entry in entries]
    numbers["elites"] = [*compress(entries, named)]
    genes_by_elite = {entry["elite"]: row for entry, row in zip(numbers["elites"], genes[named], strict=True)}
    return MinimalTerrains(numbers=numbers, genes=genes_by_elite) if any(named) else None
