"""Makes a pack of a judged search: terrains spread over the causes on which its controller fails.

Every terrain is a fault or a *near-fault*: under :data:`NEAR_GOAL_RATE` of the robots reach the goal in 40 fresh
episodes, and it is known to be passable, since another controller is certified on it or the searched one crosses it in
at least half of its episodes. A terrain that nobody is known to cross is in no pack.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.evaluate import cross_sets, crossings_folder
from qd.evaluate.pack import (
    PACK_FILE,
    TERRAINS_FILE,
    Entry,
    add_rates,
    pack_set,
    round_heights,
    show_pack_rates,
    summarise_rates,
    write_terrains,
)
from qd.evaluate.sets import hash_elites, read_trained_on
from qd.faults.families import VERDICTS, find_families, find_verdicts, rank
from qd.faults.numbers import EPISODES, SPECIALIST, fresh_counts, judgement, rate_numbers, read_minimal
from qd.faults.searches import Search, find_certifiers
from qd.search.archive import Archive
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from sim.controllers.spec import controller_identity, describe_controllers, is_same_controller
from sim.files.atomic import prepare_output
from sim.files.command import publish
from sim.terrains.bank import make_heights

NEAR_GOAL_RATE = 0.75
"""Goal rate of the searched controller from which on a terrain is no near-fault."""
_SPREAD_OVER = ("family", "cause", "kind")


def make_pack(
    search: Search,
    controllers: Mapping[str, str],
    *,
    compute: Compute,
    size: int = 100,
    episodes: int = EPISODES,
    seed: int = 0,
    out: Path | None = None,
) -> dict[str, Any]:
    """Chooses terrains of a judged search, lets controllers cross them, and writes the pack; returns its JSON values.

    Without ``controllers`` (policies by name) these are the shipped one and the run's certifiers. The searched one is
    always among them. There are ``size`` terrains, fewer if the run has fewer, and ``episodes`` on each, which ``seed``
    draws. Without ``out`` the folder lies under runs/.
    """
    archive = _read_judged(search)
    robot = search.robot
    controllers = {**(controllers or {"base": str(robot.policy_file), **find_certifiers(search)})}
    if not any(is_same_controller(search.policy, policy) for policy in controllers.values()):
        controllers = {"searched": search.policy, **controllers}
    for policy in controllers.values():
        check_policy(policy, robot, compute.device)
    entries, genes, not_passable = find_candidates(archive, search)
    trained_on = set[str]().union(*(read_trained_on(file) for name, file in controllers.items() if name != SPECIALIST))
    hashes = hash_elites(archive.genes)
    untrained = [index for index, entry in enumerate(entries) if hashes[entry["elite"]] not in trained_on]
    chosen = [untrained[index] for index in choose_terrains([entries[index] for index in untrained], size)]
    if not chosen:
        raise ValueError(
            f"{search.run} must have faults or near-faults that no controller but a specialist was trained on, "
            f"got none and {not_passable} that nobody crosses"
        )
    print(f"{len(chosen)} of {len(untrained)} faults and near-faults; {not_passable} more that nobody crosses.")
    chosen_genes = np.array([genes[index] for index in chosen], np.float32)
    heights = round_heights(make_heights(chosen_genes, search.space))
    out = out or RUNS / f"{robot.name}-pack"
    prepare_output(out / TERRAINS_FILE)

    def make_report() -> dict[str, Any]:
        terrains = {"pack": pack_set(heights, len(heights), seed)}
        results = cross_sets(controllers, terrains, robot, compute, episodes, cache=crossings_folder(robot))
        crossed = add_rates([entries[index] for index in chosen], results["pack"])
        return {
            **compute.origin(seed),
            **controller_identity(robot, search.policy),
            "space": search.cfg.space,
            "space_sha256": search.cfg.space_sha256,
            "episodes": episodes,
            "searched": next(name for name, policy in controllers.items() if is_same_controller(policy, search.policy)),
            "iterations": archive.iterations,
            "certifiers": list(archive.certifiers),
            "candidates": len(untrained),
            "not_known_to_be_passable": not_passable,
            "controllers": describe_controllers(controllers, robot),
            "rates": {name: summarise_rates(crossed, name, seed) for name in controllers},
            "terrains_sha256": write_terrains(out, heights, chosen_genes),
            "terrains": crossed,
        }

    return publish(out / PACK_FILE, make_report, _show_pack)


def _read_judged(search: Search) -> Archive:
    """The archive of a search of heights alone; refuses one that is not judged by all stages that a pack needs."""
    if search.space.ground or search.space.conditions:
        raise ValueError(
            f"a pack holds heights alone, got terrains of {search.space.name}, which have ground or conditions of "
            "their own"
        )
    archive = search.read_archive()
    crossed = archive.resolved_outcomes.any(axis=1) & archive.certifier_outcomes.any(axis=(1, 2))
    if archive.fresh is None or (archive.failing & ~crossed).any():
        raise ValueError(
            f"{search.run} must have its failing elites crossed with contact resolved and by other controllers, got "
            f"{(archive.failing & crossed).sum()} of {archive.failing.sum()}: run `faultline judge` on it first"
        )
    return archive


def find_candidates(archive: Archive, search: Search) -> tuple[list[Entry], list[NDArray[np.float32]], int]:
    """The faults and near-faults of a run: elites as they are, and minimal terrains that lack some of their parts.

    Returns an entry and the genes of each, and how many more terrains fail that nobody is known to cross.
    """
    assert archive.fresh is not None
    space = search.space
    minima = read_minimal(search.run, archive)
    rate = archive.fresh.goal_rate
    verdicts = find_verdicts(archive)
    near = np.flatnonzero(archive.fresh.valid & (rate < NEAR_GOAL_RATE))
    families = dict(zip(near.tolist(), find_families(archive.genes[near], space).tolist(), strict=True))
    causes = rank(archive, space, minima, half_width=search.robot.half_width).causes if len(near) else ()
    entries: list[Entry] = []
    genes: list[NDArray[np.float32]] = []
    not_passable = 0

    def add(number: int, parts: list[int] | None, row: NDArray[np.float32], verdict: str, **numbers: Any) -> None:
        entry = {
            "name": f"elite-{number}{'' if parts is None else '-minimal'}",
            "kind": "elite" if parts is None else "minimal",
            "elite": number,
            "cell": int(archive.cell[number]),
            "iteration": int(archive.iteration[number]),
            "parts": parts,
            "verdict": "fault" if verdict == "fault" else "near-fault",
            "cause": causes[number] or None,
            "family": families[number],
        }
        entries.append(entry | numbers)
        genes.append(row)

    for number in near.tolist():
        if archive.certified[number] or rate[number] >= FAILING_GOAL_RATE:
            searched = rate_numbers(fresh_counts(archive, number))
            verdict = VERDICTS[verdicts[number]]
            add(number, None, archive.genes[number], verdict, searched=searched, **judgement(archive, number))
        else:
            not_passable += 1
    for minimal in minima.numbers["elites"] if minima else ():
        number = minimal["elite"]
        if not archive.failing[number] or len(minimal["bumps"]) == minimal["of"]:
            continue  # with all its parts it is the elite itself
        if minima and minimal["certificates"]:
            numbers = {"searched": {key: minimal[key] for key in ("goal_rate", "goal_interval", "valid_episodes")}}
            numbers |= {key: minimal[key] for key in ("resolved", "certificates")}
            add(number, minimal["bumps"], minima.genes[number], minimal["verdict"], **numbers)
        else:
            not_passable += 1
    return entries, genes, not_passable


def choose_terrains(entries: Sequence[Entry], size: int) -> list[int]:
    """Indices of some candidates, so that each beginning of the list is spread as well as can be.

    Next comes a fault before a near-fault, then one of the family that was chosen least often, of the cause that was,
    of the kind (elite or minimal) that was, and then the one with the lowest goal rate.
    """
    left = list(range(len(entries)))
    chosen: list[int] = []
    counts = Counter[Any]()

    def priority(index: int) -> tuple[Any, ...]:
        entry = entries[index]
        chosen_alike = (counts[name, entry[name]] for name in _SPREAD_OVER)
        goal_rate = entry["searched"]["goal_rate"]
        return entry["verdict"] != "fault", *chosen_alike, goal_rate, entry["elite"], entry["kind"]

    while left and len(chosen) < size:
        best = min(left, key=priority)
        left.remove(best)
        chosen.append(best)
        counts.update((name, entries[best][name]) for name in _SPREAD_OVER)
    return chosen


def _show_pack(report: dict[str, Any]) -> None:
    """Prints the rates of a pack's controllers, as ``pack.json`` has them."""
    verdicts = Counter(entry["verdict"] for entry in report["terrains"])
    title = ", ".join(f"{verdict}: {count} terrains" for verdict, count in verdicts.items())
    show_pack_rates(title, report["rates"])
