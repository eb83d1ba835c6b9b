"""Faults: terrains that the controller does not cross although they can be crossed.

An elite fails by its 40 fresh episodes. It is confirmed if it fails with contact resolved too, and certified if another
controller crosses it, at the search's settings and with contact resolved. A fault is both. A terrain without a
certificate is not known to be passable.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.archive import ARCHIVE_FILE, OUTCOMES, Archive, FaultCounts, goal_rates, write_archive
from qd.fitness import FAILING_GOAL_RATE
from qd.fresh import Open, elite_seeds
from qd.run.directory import SUMMARY_FILE, RunDirectory
from qd.run.progress import share_bar
from qd.workers.evaluator import EvaluatorCfg, origin_of, parse_workers, pipeline_of
from qd.workers.invalid import invalid_reasons, invalid_words
from sim.files.atomic import to_json, write_atomically
from sim.files.intervals import rate_words, wilson_interval
from sim.policy.spec import certifier_hash, controller_hash

if TYPE_CHECKING:
    from sim.rollout import RolloutResult

EPISODES = 20
"""Episodes of each kind that an elite is judged by."""

_CONFIRM_STREAM, _CERTIFY_STREAM, _CERTIFY_RESOLVED_STREAM, _MUJOCO_C_STREAM = 5, 6, 7, 8
_LOT = {"cuda": 800, "cpu": 1}  # terrains of a worker between two saves; two lots fill a GPU with 32,000 robots
_MUJOCO_C_LOT = 4  # likewise of a process


@dataclass(frozen=True, kw_only=True)
class Work:
    """Where elites are crossed, and what becomes of it."""

    evaluator: EvaluatorCfg
    """Controller, robot and device; how many terrains at once follows from the device."""
    open_evaluator: Open
    """Opens what crosses terrains."""
    seed: int
    """The search's; the episodes are drawn apart from the search's own and from the fresh ones."""
    save: Callable[[Archive], object]
    """Writes what is known so far; called after each lot."""


class _Column(NamedTuple):
    """Which of the counts."""

    name: str
    """Array of :class:`qd.archive.FaultCounts`."""
    place: int | None = None
    """Of the certifier."""
    who: str = "the controller"
    """Who crosses."""

    def of(self, archive: Archive) -> NDArray[np.int64]:
        """Its counts, shape (N, 4)."""
        counts = getattr(archive.faults or FaultCounts.none_of(len(archive)), self.name)
        return counts if self.place is None else counts[:, self.place]

    def missing(self, archive: Archive, chosen: Sequence[int]) -> NDArray[np.int64]:
        """Those of some elites that were not crossed yet."""
        numbers = np.array(chosen, dtype=np.int64)
        return numbers[self.of(archive)[numbers].sum(axis=1) == 0]

    def filled(self, archive: Archive, numbers: NDArray[np.int64], counts: NDArray[np.int64]) -> Archive:
        """The archive with the counts of some more elites."""
        faults = archive.faults or FaultCounts.none_of(len(archive))
        values = getattr(faults, self.name).copy()
        values[numbers if self.place is None else (numbers, self.place)] = counts
        return replace(archive, faults=replace(faults, **{self.name: values}))


def outcome_counts(result: "RolloutResult | Any") -> NDArray[np.int64]:
    """Episodes of each terrain by :data:`qd.archive.OUTCOMES`, shape (num_terrains, 4)."""
    return _counts(goal=result.reached_goal, base_collision=result.base_collision, invalid=result.invalid)


def _counts(**flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Episodes by outcome, of flags of shape (num_terrains, num_episodes); where none is set, it is another."""
    counts = {name: flag.sum(axis=1) for name, flag in flags.items()}
    counts["other"] = (~np.any([*flags.values()], axis=0)).sum(axis=1)
    return np.stack([counts[name] for name in OUTCOMES], axis=1).astype(np.int64)


def confirm(archive: Archive, chosen: Sequence[int], work: Work) -> Archive:
    """Lets the controller cross failing elites with contact resolved; those that it has crossed so are left out.

    Args:
        archive: With fresh values.
        chosen: Numbers of the elites.
        work: With the controller that was searched.

    Returns:
        The archive with its counts.
    """
    return _crossed(archive, chosen, _Column("resolved_outcomes"), work, _CONFIRM_STREAM, resolved=True)


def confirm_in_mujoco_c(archive: Archive, chosen: Sequence[int], most: int, work: Work) -> Archive:
    """Lets the controller cross some failing elites in plain MuJoCo C, with contact resolved there too.

    The episodes begin as those of :func:`confirm` do. Which elites are drawn follows from the seed; of more, those that
    were crossed before are some.

    Args:
        archive: With fresh values.
        chosen: Numbers of the elites to draw from.
        most: How many to cross.
        work: With the controller that was searched.

    Returns:
        The archive with its counts.
    """
    column = _Column("mujoco_c_outcomes")
    order = elite_seeds(archive, work.seed, stream=_MUJOCO_C_STREAM)
    drawn = sorted(chosen, key=lambda number: (int(order[number]), number))[:most]
    missing = column.missing(archive, drawn)
    processes = parse_workers(work.evaluator.workers).num_processes
    for first in range(0, len(missing), _MUJOCO_C_LOT * processes):
        part = missing[first : first + _MUJOCO_C_LOT * processes]
        archive = column.filled(archive, part, _counts_in_mujoco_c(archive, part, work, processes))
        work.save(archive)
    return archive


def certify(archive: Archive, chosen: Sequence[int], certifiers: Mapping[str, str], work: Work) -> Archive:
    """Lets other controllers cross failing elites, at the search's settings and with contact resolved.

    What a controller has crossed before is left out. A terrain that it crosses less than half of the time at the
    search's settings is not crossed with contact resolved, since it cannot get a certificate.

    Args:
        archive: With fresh values.
        chosen: Numbers of the elites.
        certifiers: Controllers by name.
        work: Where; its controller does not matter.

    Returns:
        The archive with its counts.

    Raises:
        ValueError: As of :func:`with_certifiers`.
    """
    faults = with_certifiers(archive.faults or FaultCounts.none_of(len(archive)), certifiers)
    archive = replace(archive, faults=faults)
    for policy in certifiers.values():
        place = faults.certifier_sha256.index(str(controller_hash(policy)))
        own = replace(work, evaluator=replace(work.evaluator, policy=policy))
        kinds = ("certifier_outcomes", "certifier_resolved_outcomes")
        searched, resolved = (_Column(kind, place, faults.certifiers[place]) for kind in kinds)
        archive = _crossed(archive, chosen, searched, own, _CERTIFY_STREAM)
        crosses = goal_rates(searched.of(archive)) >= FAILING_GOAL_RATE
        worth = [number for number in chosen if crosses[number]]
        archive = _crossed(archive, worth, resolved, own, _CERTIFY_RESOLVED_STREAM, resolved=True)
    return archive


def is_judged(archive: Archive, certifiers: Mapping[str, str]) -> bool:
    """Whether nothing is left to be crossed of all failing elites for :func:`confirm`, and by all for :func:`certify`.

    Args:
        archive: With fresh values.
        certifiers: Controllers by name.

    Raises:
        ValueError: As of :func:`with_certifiers`.
    """
    faults = archive.faults
    asked = with_certifiers(faults or FaultCounts.none_of(len(archive)), certifiers).certifiers
    if faults is None or faults.certifiers != asked:
        return False
    failing = np.flatnonzero(archive.failing).tolist()
    left = [_Column("resolved_outcomes").missing(archive, failing)]
    for policy in certifiers.values():
        place = faults.certifier_sha256.index(str(controller_hash(policy)))
        searched, resolved = (_Column(kind, place) for kind in ("certifier_outcomes", "certifier_resolved_outcomes"))
        crosses = goal_rates(searched.of(archive)) >= FAILING_GOAL_RATE
        left += [searched.missing(archive, failing)]
        left += [resolved.missing(archive, [number for number in failing if crosses[number]])]
    return not any(map(len, left))


def certificate_seeds(archive: Archive, seed: int) -> NDArray[np.uint32]:
    """Seeds of the episodes at the search's settings that certificates are of, shape (N,)."""
    return elite_seeds(archive, seed, stream=_CERTIFY_STREAM)


def with_certifiers(faults: FaultCounts, certifiers: Mapping[str, str]) -> FaultCounts:
    """Fault counts with a column for each controller; one that is there under another name keeps that.

    Args:
        faults: The counts.
        certifiers: Controllers by name.

    Raises:
        ValueError: If one has no hash, or the counts of its name are of another controller.
    """
    for name, policy in certifiers.items():
        digest = certifier_hash(name, policy)
        if digest in faults.certifier_sha256:
            continue
        if name in faults.certifiers:
            there = faults.certifier_sha256[faults.certifiers.index(name)]
            raise ValueError(
                f"certifier {name} must be the controller whose certificates the archive has under that name (SHA-256 "
                f"{there[:12]}), got {policy} ({digest[:12]}): give it another name"
            )
        nothing = np.zeros((len(faults.resolved_outcomes), 1, len(OUTCOMES)), np.int64)
        faults = replace(
            faults,
            certifiers=(*faults.certifiers, name),
            certifier_sha256=(*faults.certifier_sha256, digest),
            certifier_outcomes=np.concatenate([faults.certifier_outcomes, nothing], axis=1),
            certifier_resolved_outcomes=np.concatenate([faults.certifier_resolved_outcomes, nothing], axis=1),
        )
    return faults


def known_names(archive: Archive, certifiers: Mapping[str, str]) -> dict[str, str]:
    """Controllers by the names that an archive has or would have them under; errors as of :func:`with_certifiers`."""
    faults = with_certifiers(archive.faults or FaultCounts.none_of(len(archive)), certifiers)
    names = dict(zip(faults.certifier_sha256, faults.certifiers, strict=True))
    return {names[str(controller_hash(policy))]: policy for policy in certifiers.values()}


def _crossed(
    archive: Archive, chosen: Sequence[int], column: _Column, work: Work, stream: int, *, resolved: bool = False
) -> Archive:
    """Fills a column for some elites, lot by lot."""
    missing = column.missing(archive, chosen)
    if not len(missing):
        return archive
    what = f"{column.who}{' with contact resolved' * resolved}"
    cfg = replace(work.evaluator, num_terrains=len(missing), num_replicas=EPISODES, lots=1, resolved=resolved)
    lot = _LOT[cfg.device.partition(":")[0]] * cfg.num_workers
    cfg = replace(cfg, num_terrains=min(len(missing), 2 * lot))
    seeds, reasons = elite_seeds(archive, work.seed, stream=stream)[missing], dict[str, int]()
    print(f"Elites to be crossed {EPISODES} times each by {what}: {len(missing):,}", flush=True)
    with work.open_evaluator(cfg) as evaluate, share_bar(f"by {what}") as progress:
        for part, result in pipeline_of(evaluate).in_lots(archive.genes[missing], seeds, lot, progress):
            archive = column.filled(archive, missing[part], outcome_counts(result))
            for reason, count in invalid_reasons(result).items():
                reasons[reason] = reasons.get(reason, 0) + count
            work.save(archive)
    words = invalid_words(dict(sorted(reasons.items(), key=lambda one: -one[1])), EPISODES * len(missing))
    if words is not None:
        tqdm.write(f"{what}: {words}", file=sys.stderr)
    return archive


def _counts_in_mujoco_c(archive: Archive, numbers: NDArray[np.int64], work: Work, processes: int) -> NDArray[np.int64]:
    """Outcomes of elites in plain MuJoCo C, shape (len(numbers), 4)."""
    from kernels.episode import Outcome
    from sim.mujoco_c.crossing import cross_terrains
    from sim.robots.find import get_robot
    from sim.spaces.registry import get_space

    crossings = dict(cross_terrains(
        get_robot(work.evaluator.robot), work.evaluator.policy, archive.genes[numbers],
        elite_seeds(archive, work.seed, stream=_CONFIRM_STREAM)[numbers],
        space=get_space(archive.space, archive.space_sha256), num_episodes=EPISODES, device=work.evaluator.device,
        processes=processes, resolved=True,
    ))  # fmt: skip
    outcome = np.array([crossings[number].outcome for number in range(len(numbers))])
    return _counts(
        goal=outcome == Outcome.GOAL,
        base_collision=outcome == Outcome.BASE_COLLISION,
        invalid=outcome == Outcome.INVALID,
    )


def fault_numbers(archive: Archive) -> dict[str, Any]:
    """The numbers of faults, as ``archive.json`` has them; None of what nobody looked at."""
    faults, failing = archive.faults, archive.failing
    known = faults is not None and bool(faults.certifiers)
    numbers: dict[str, Any] = {
        "failing": None if archive.fresh is None else int(failing.sum()),
        "confirmed": None,
        "certified": int(archive.certified.sum()) if known else None,
        "faults": None,
        "panel": list(faults.certifiers) if faults is not None else [],
    }
    if numbers["failing"] == 0:  # nobody had to cross anything
        numbers |= dict.fromkeys(("confirmed", "certified", "faults"), 0)
    if faults is None:
        return numbers
    resolved, in_c = faults.resolved_outcomes.any(axis=1), faults.mujoco_c_outcomes.any(axis=1) & failing
    if resolved.any():
        numbers["confirmed"] = int(archive.confirmed.sum())
    if known and resolved.any():
        numbers["faults"] = int((archive.confirmed & archive.certified).sum())
    numbers["crossed_resolved"] = int((resolved & failing).sum())
    numbers["mujoco_c"] = {
        "crossed": int(in_c.sum()),
        "failing": int((goal_rates(faults.mujoco_c_outcomes[in_c]) < FAILING_GOAL_RATE).sum()),
    }
    found = faults.certificates() & failing[:, None]
    numbers["certificates"] = [
        {
            "controller": name,
            "policy_sha256": digest,
            "crossed": int((faults.certifier_outcomes[:, place].any(axis=1) & failing).sum()),
            "certified": int(found[:, place].sum()),
        }
        for place, (name, digest) in enumerate(zip(faults.certifiers, faults.certifier_sha256, strict=True))
    ]
    return numbers


def any_of(names: Sequence[str]) -> str:
    """Names in words: ``a, b or c``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


def fault_words(archive: Archive, *, what: str = "failing elite") -> list[str]:
    """What is known of the failing elites, in sentences; nothing where none was crossed under other conditions.

    Args:
        archive: The elites.
        what: What one of them is called.
    """
    faults, numbers = archive.faults, fault_numbers(archive)
    if faults is None:
        return []
    told = []
    if numbers["crossed_resolved"]:
        again = rate_words(numbers["confirmed"], numbers["crossed_resolved"])
        failing, crossed = numbers["failing"], numbers["crossed_resolved"]
        told.append(
            f"Of {failing:,} {what}{'s' * (failing != 1)} {crossed:,} {'was' if crossed == 1 else 'were'} "
            f"crossed with contact resolved: {again} confirmed, since under half of the robots arrive there too."
        )
    if numbers["mujoco_c"]["crossed"]:
        there = rate_words(numbers["mujoco_c"]["failing"], numbers["mujoco_c"]["crossed"])
        told.append(f"In plain MuJoCo C {there} of those crossed there fail.")
    if faults.certifiers:
        who, rest = any_of(faults.certifiers), int((archive.failing & ~archive.certified).sum())
        if numbers["faults"] is not None:
            found = "fault: a terrain" if numbers["faults"] == 1 else "faults: terrains"
            told.append(f"{numbers['faults']:,} {found} that {who} crosses and this controller does not.")
        waiting = int((archive.certified & ~faults.resolved_outcomes.any(axis=1)).sum())
        if waiting:
            told.append(f"{waiting:,} that {who} crosses {'is' if waiting == 1 else 'are'} still to be confirmed.")
        told.append(f"{rest:,} {what}{' is' if rest == 1 else 's are'} not known to be passable.")
    return told


def rate_of(counts: NDArray[np.int64]) -> dict[str, Any]:
    """Goal rate of episodes, shape (4,), with its 95 % interval (Wilson); a rate of None: too many are invalid."""
    valid, rate = int(counts.sum() - counts[OUTCOMES.index("invalid")]), float(goal_rates(counts))
    interval = [round(limit, 4) for limit in wilson_interval(int(counts[0]), valid)]
    return {"goal_rate": None if np.isnan(rate) else rate, "goal_interval": interval, "valid_episodes": valid}


def judgement(archive: Archive, number: int) -> dict[str, Any]:
    """What is known of an elite under other conditions, as JSON values; None of what nobody looked at.

    Returns:
        ``resolved``: rate of the controller with contact resolved; ``certificates``: of each controller that certifies
        it name, hash, and rates at the ``searched`` settings and with contact ``resolved``.
    """
    faults = archive.faults or FaultCounts.none_of(len(archive))
    crossed = faults.resolved_outcomes[number]
    kinds = {"searched": faults.certifier_outcomes, "resolved": faults.certifier_resolved_outcomes}
    return {
        "resolved": rate_of(crossed) if crossed.any() else None,
        "certificates": [
            {"controller": name, "policy_sha256": digest}
            | {kind: rate_of(counts[number, column]) for kind, counts in kinds.items()}
            for column, (name, digest) in enumerate(zip(faults.certifiers, faults.certifier_sha256, strict=True))
            if faults.certificates()[number, column]
        ],
    }


def elite_words(archive: Archive, number: int) -> list[str]:
    """What is known of one elite, in sentences; nothing where nobody crossed it under other conditions."""
    faults = archive.faults
    if faults is None:
        return []
    kinds = {
        "With contact resolved": faults.resolved_outcomes[number],
        "In MuJoCo C": faults.mujoco_c_outcomes[number],
    }
    for place, name in enumerate(faults.certifiers):
        kinds[name] = faults.certifier_outcomes[number, place]
        kinds[f"{name} with contact resolved"] = faults.certifier_resolved_outcomes[number, place]
    known = [f"{what}: {_goals(counts)} reach the goal." for what, counts in kinds.items() if counts.any()]
    if not known:
        return []
    told = known
    by = [name for name, certifies in zip(faults.certifiers, faults.certificates()[number], strict=True) if certifies]
    if not archive.failing[number]:
        told.append("It does not fail by its fresh episodes.")
    elif by:
        kind = "a fault" if archive.confirmed[number] else "certified but not confirmed"
        crosses = f"{' and '.join(by)} cross{'es' * (len(by) == 1)}"
        told.append(f"It is {kind}: a terrain that {crosses} and this controller does not.")
    else:
        told.append(f"It is {'' if archive.confirmed[number] else 'not '}confirmed, and not known to be passable.")
    return told


def _goals(counts: NDArray[np.int64]) -> str:
    return rate_words(int(counts[0]), int(counts.sum() - counts[OUTCOMES.index("invalid")]))


def saving(run: RunDirectory, by: dict[str, Any] | None = None) -> Callable[[Archive], None]:
    """What writes archive and numbers of a run, each atomically.

    Args:
        run: The run directory, claimed.
        by: Provenance, under the keys :data:`qd.run.directory.JUDGED_BY`.
    """

    def save(archive: Archive) -> None:
        write_archive(run.path / ARCHIVE_FILE, archive)
        numbers = run.read_summary() | fault_numbers(archive) | (by or {})
        write_atomically(run.path / SUMMARY_FILE, to_json(numbers))

    return save


def confirm_all(
    run: RunDirectory, archive: Archive, evaluator: EvaluatorCfg, open_evaluator: Open, seed: int
) -> Archive:
    """Confirms all failing elites at the end of a search.

    Args:
        run: The run directory, claimed.
        archive: With fresh values, as the directory has it.
        evaluator: As of the search.
        open_evaluator: Opens what crosses terrains.
        seed: The search's.
    """
    by = {"confirmed_by": origin_of(evaluator.device, seed, evaluator.workers)}
    work = Work(evaluator=evaluator, open_evaluator=open_evaluator, seed=seed, save=saving(run, by))
    return confirm(archive, np.flatnonzero(archive.failing).tolist(), work)
