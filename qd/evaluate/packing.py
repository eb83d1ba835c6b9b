"""How packs are made (:mod:`qd.evaluate.pack`): of terrains of judged searches, which controllers cross."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.evaluate import cross_sets, crossings_folder
from qd.evaluate.pack import (
    NEAR_GOAL_RATE,
    PACK_FILE,
    TERRAINS_FILE,
    Entry,
    add_rates,
    count_trained,
    pack_set,
    round_heights,
    show_pack_rates,
    summarise_rates,
    write_terrains,
)
from qd.evaluate.sets import elites_sha256, hash_elites, read_trained_on
from qd.faults.families import VERDICTS, find_families, find_verdicts, kin_distances, rank
from qd.faults.numbers import EPISODES, SPECIALIST, fresh_counts, judgement, rate_numbers, read_minimal
from qd.faults.searches import Search, find_certifiers
from qd.search.archive import Archive
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from sim.controllers.spec import controller_identity, describe_controllers, is_same_controller
from sim.files.atomic import prepare_output, read_json
from sim.files.command import publish
from sim.terrains.bank import make_heights

_SPREAD_OVER = ("family", "cause", "kind")


class Candidate(NamedTuple):
    """A terrain that a pack may take."""

    entry: Entry
    genes: NDArray[np.float32]  # shape (num_genes,)
    of: NDArray[np.float32]  # genes of the elite that it is, or a part of


def make_pack(
    searches: Sequence[Search],
    controllers: Mapping[str, str],
    *,
    compute: Compute,
    apart_from: Sequence[Archive] = (),
    size: int = 100,
    episodes: int = EPISODES,
    seed: int = 0,
    licence: str = "",
    version: int | None = None,
    overwrite: bool = False,
    out: Path | None = None,
) -> dict[str, Any]:
    """Chooses terrains of judged searches, lets controllers cross them, and writes the pack; returns its JSON values.

    Without ``controllers`` (policies by name) these are the shipped one and the runs' certifiers. The searched one is
    always among them. There are ``size`` terrains, fewer if the runs have fewer, and ``episodes`` on each, which
    ``seed`` draws; none of them is kin of an elite of ``apart_from``, nor a part of such kin. Without ``version`` it is
    1, or the next of a pack that it is to ``overwrite``. Without ``out`` the folder lies under runs/.
    """
    search, robot = searches[0], searches[0].robot
    out = out or RUNS / f"{robot.name}-pack"
    former = read_json(out / PACK_FILE).get("version", 1) if (out / PACK_FILE).exists() else 0
    if former and not overwrite:
        raise ValueError(f"{out} has a pack, version {former}: give another --out, or --overwrite for the next version")
    _check_alike(searches)
    archives = [_read_judged(one) for one in searches]
    controllers = {**(controllers or {"base": str(robot.policy_file), **_name_certifiers(searches)})}
    if not any(is_same_controller(search.policy, policy) for policy in controllers.values()):
        controllers = {"searched": search.policy, **controllers}
    for policy in controllers.values():
        check_policy(policy, robot, compute.device)
    candidates, not_passable = find_candidates(searches, archives)
    others = [file for name, file in controllers.items() if not name.startswith(SPECIALIST)]
    trained_on = set[str]().union(*map(read_trained_on, others))
    candidates = [candidate for candidate in candidates if candidate.entry["mark"] not in trained_on]
    apart = drop_kin(candidates, apart_from, search)
    chosen = [apart[index] for index in choose_terrains([candidate.entry for candidate in apart], size)]
    if not chosen:
        rule = "must have faults or near-faults that no controller but a specialist was trained on"
        got = f"none, {len(candidates)} that are kin of --making.apart-from, and {not_passable} that nobody crosses"
        raise ValueError(f"{search.run} {rule}, got {got}")
    print(f"{len(chosen)} of {len(apart)} faults and near-faults; {not_passable} more that nobody crosses.")
    genes = np.array([candidate.genes for candidate in chosen], np.float32)
    heights = round_heights(make_heights(genes, search.space))
    prepare_output(out / TERRAINS_FILE)

    def make_report() -> dict[str, Any]:
        terrains = {"pack": pack_set(heights, len(heights), seed)}
        results = cross_sets(controllers, terrains, robot, compute, episodes, cache=crossings_folder(robot))
        crossed = add_rates([candidate.entry for candidate in chosen], results["pack"])
        described = describe_controllers(controllers, robot).items()
        return {
            **compute.origin(seed),
            **controller_identity(robot, search.policy),
            "version": version or 1 + former,
            "licence": licence or None,
            "space": search.cfg.space,
            "space_sha256": search.cfg.space_sha256,
            "episodes": episodes,
            "searched": next(name for name, policy in controllers.items() if is_same_controller(policy, search.policy)),
            "runs": [
                {"run": one.run.name, "seed": one.cfg.seed, "iterations": archive.iterations}
                | {"elites": len(archive), "elites_sha256": elites_sha256(archive)}
                for one, archive in zip(searches, archives, strict=True)
            ],
            "apart_from": [elites_sha256(archive) for archive in apart_from],
            "certifiers": sorted({name for archive in archives for name in archive.certifiers}),
            "candidates": len(apart),
            "not_known_to_be_passable": not_passable,
            "controllers": {
                name: about | {"trained_on": count_trained(crossed, controllers[name])} for name, about in described
            },
            "rates": {name: summarise_rates(crossed, name, seed) for name in controllers},
            "terrains_sha256": write_terrains(out, heights, genes),
            "terrains": crossed,
        }

    def show(report: dict[str, Any]) -> None:
        verdicts = Counter(entry["verdict"] for entry in report["terrains"])
        title = ", ".join(f"{verdict}: {count} terrains" for verdict, count in verdicts.items())
        show_pack_rates(title, report["rates"])

    return publish(out / PACK_FILE, make_report, show)


def _check_alike(searches: Sequence[Search]) -> None:
    """Refuses runs that cannot share a pack."""
    first, *others = searches
    for number, other in enumerate(others, 1):
        if other.run.resolve() in {one.run.resolve() for one in searches[:number]}:
            raise ValueError(f"runs of one pack must be different ones, got {other.run} twice: leave it out")
        spaces = [(one.cfg.space, one.cfg.space_sha256, one.robot) for one in (first, other)]
        if spaces[0] != spaces[1] or not is_same_controller(other.policy, first.policy):
            rule = f"runs of one pack must search one controller of one robot in one space, as {first.run} does"
            raise ValueError(f"{rule}, got {other.run} with {other.policy} in {other.cfg.space}: leave it out")


def _name_certifiers(searches: Sequence[Search]) -> dict[str, str]:
    """Certifiers of all runs by name, with the run's number behind the name of another controller."""
    named = dict[str, str]()
    for number, search in enumerate(searches):
        for name, file in find_certifiers(search).items():
            is_other = name in named and not is_same_controller(named[name], file)
            named[f"{name}-run-{number}" if is_other else name] = file
    return named


def drop_kin(candidates: Sequence[Candidate], apart_from: Sequence[Archive], search: Search) -> list[Candidate]:
    """Candidates that are no kin of an elite of some archives, nor parts of such kin."""
    for archive in apart_from:
        if (archive.space, archive.space_sha256) != (search.cfg.space, search.cfg.space_sha256):
            rule = f"archives to be apart from must be of the space {search.cfg.space}"
            raise ValueError(f"{rule}, got {archive.space}: leave it out")
    if not candidates or not apart_from:
        return [*candidates]
    own = np.array([genes for candidate in candidates for genes in (candidate.genes, candidate.of)], np.float32)
    others = np.concatenate([archive.genes for archive in apart_from])
    distances = kin_distances(np.concatenate([own, others]), search.space)[: len(own), len(own) :]
    is_kin = (distances < 1.0).any(axis=1).reshape(-1, 2).any(axis=1)
    print(f"{is_kin.sum()} of {len(candidates)} are kin of what controllers trained on.")
    return [candidates[row] for row in np.flatnonzero(~is_kin).tolist()]


def _read_judged(search: Search) -> Archive:
    """The archive of a search of heights alone; refuses one that is not judged by all stages that a pack needs."""
    if search.space.ground or search.space.has_conditions:
        got = f"terrains of {search.space.name}, which have ground or conditions of their own"
        raise ValueError(f"a pack holds heights alone, got {got}")
    archive = search.read_archive()
    crossed = archive.resolved_outcomes.any(axis=1) & archive.certifier_outcomes.any(axis=(1, 2))
    if archive.fresh is None or (archive.failing & ~crossed).any():
        rule = "must have its failing elites crossed with contact resolved and by other controllers"
        got = f"{(archive.failing & crossed).sum()} of {archive.failing.sum()}"
        raise ValueError(f"{search.run} {rule}, got {got}: run `faultline judge` on it first, with --certifiers")
    return archive


def find_candidates(searches: Sequence[Search], archives: Sequence[Archive]) -> tuple[list[Candidate], int]:
    """The faults and near-faults of runs: elites as they are, and minimal terrains that lack some of their parts.

    Families are those of the elites of all runs; a minimal terrain is of its elite's. An elite that several runs have
    counts once. Returns how many more terrains fail that nobody is known to cross, too.
    """
    near: list[NDArray[np.int64]] = []
    for archive in archives:
        assert archive.fresh is not None
        near.append(np.flatnonzero(archive.fresh.valid & (archive.fresh.goal_rate < NEAR_GOAL_RATE)))
    of_all = np.concatenate([archive.genes[rows] for archive, rows in zip(archives, near, strict=True)])
    families = find_families(of_all, searches[0].space) if len(of_all) else np.zeros(0, np.int64)
    by_run = np.split(families, np.cumsum([len(rows) for rows in near])[:-1])
    candidates, not_passable = dict[tuple[str, str], Candidate](), 0
    for run, (search, archive, rows, own) in enumerate(zip(searches, archives, near, by_run, strict=True)):
        of_run = {"run": run} if len(searches) > 1 else {}
        found, more = _candidates_of(search, archive, dict(zip(rows.tolist(), own.tolist(), strict=True)), of_run)
        not_passable += more
        for candidate in found:
            candidates.setdefault((candidate.entry["mark"], candidate.entry["kind"]), candidate)
    return [*candidates.values()], not_passable


def _candidates_of(
    search: Search, archive: Archive, families: Mapping[int, int], of_run: Mapping[str, int]
) -> tuple[list[Candidate], int]:
    """Those of one run, whose elites have ``families`` by number; entries have ``of_run``, too."""
    assert archive.fresh is not None
    minima, rate, witnesses = read_minimal(search.run, archive), archive.fresh.goal_rate, archive.witnesses
    half_width = search.robot.half_width
    causes = rank(archive, search.space, minima, half_width=half_width).causes if families else ()
    marks, verdicts = hash_elites(archive.genes), find_verdicts(archive)
    prefix = "".join(f"run-{number}-" for number in of_run.values())
    candidates: list[Candidate] = []
    not_passable = 0

    def add(number: int, parts: list[int] | None, row: NDArray[np.float32], verdict: str, **numbers: Any) -> None:
        entry = {
            "name": f"{prefix}elite-{number}{'' if parts is None else '-minimal'}",
            "kind": "elite" if parts is None else "minimal",
            "elite": number,
            "mark": marks[number],
            "cell": int(archive.cell[number]),
            "iteration": int(archive.iteration[number]),
            "parts": parts,
            "verdict": "fault" if verdict == "fault" else "near-fault",
            "cause": causes[number] or None,
            "family": families[number],
        }
        candidates.append(Candidate({**entry, **of_run, **numbers}, row, archive.genes[number]))

    for number in families:
        if archive.certified[number] or rate[number] >= FAILING_GOAL_RATE:
            numbers = {"searched": rate_numbers(fresh_counts(archive, number)), **judgement(archive, number)}
            if witnesses is not None and witnesses.on_line[number]:
                goals = witnesses.counts[number, :, 1]  # with both kinds of physics, steered
                numbers["witness"] = {"controller": str(witnesses.walker[number]), "limit_m": witnesses.limit_m}
                numbers["witness"] |= {"goals": goals[:, 0].tolist(), "episodes": goals[:, 3].tolist()}
            add(number, None, archive.genes[number], VERDICTS[verdicts[number]], **numbers)
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
    return candidates, not_passable


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
        alike = (counts[name, entry[name]] for name in _SPREAD_OVER)
        return entry["verdict"] != "fault", *alike, entry["searched"]["goal_rate"], entry["elite"], entry["kind"]

    while left and len(chosen) < size:
        best = min(left, key=priority)
        left.remove(best)
        chosen.append(best)
        counts.update((name, entries[best][name]) for name in _SPREAD_OVER)
    return chosen
