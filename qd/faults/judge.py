"""Judging: which elites of a search are faults of its controller.

An elite is the best of many noisy evaluations and flatters itself; 40 fresh episodes do not. Those that fail by them
are crossed with contact resolved, and by other controllers (:mod:`qd.faults.numbers` says what follows). Which episodes
those are follows from the run's seed and from what names an elite, its cell and the iteration that found it. Crossings
are kept in the run, so that a judging that was stopped finds them when it is run again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.marks import hash_elites, read_trained_on
from qd.faults.families import causes_of, elites_of, families_of
from qd.faults.numbers import EPISODES, FRESH_EPISODES, OF_VARIED, fault_numbers, found_numbers, fresh_numbers
from qd.search.archive import ARCHIVE_FILE, Archive, FreshValues, goal_rates, read_archive, write_archive
from qd.search.directory import METRICS_FILE, SUMMARY_FILE, RunDirectory, check_config, check_space, claimed
from qd.search.fitness import BIT_EPISODES, FAILING_GOAL_RATE, FitnessCfg, evaluation_of
from qd.search.settings import SearchCfg, as_settings, find_policy, is_searched
from qd.show import figures
from qd.workers.cross import Crossings, How
from qd.workers.evaluator import Compute, check_policy
from sim.controllers.spec import ControllerSpec, controller_hash, controller_identity, resolve_policy, weights_file
from sim.files.atomic import read_json, to_json, write_atomically
from sim.robots.find import robot_of
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout, RolloutResult
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.registry import get_space, load_space
from sim.terrains.spaces.under_conditions import varied_genes, varied_name

Stage = Literal["fresh", "resolved", "others", "varied"]
"""Fresh episodes of all elites; of those that fail, crossings with contact resolved, and by other controllers; of
faults, crossings under varied conditions."""
CROSSINGS_FOLDER = "crossings"
"""Folder of a run that keeps what was crossed to judge it."""
CERTIFIERS_FOLDER = "certifiers"
"""Folder of a run that holds its own certifiers, such as its specialist, ``<name>.pt``."""

FRESH_STREAM = 1
"""Of the seeds of fresh episodes."""
_CONFIRM_STREAM, _CERTIFY_STREAM, _CERTIFY_RESOLVED_STREAM, _VARY_STREAM = 5, 6, 7, 8


def elite_seeds(archive: Archive, seed: int, times: int = 1, *, stream: int) -> NDArray[np.uint32]:
    """Seeds of episodes on N elites, which follow from what names an elite: its cell and the iteration that found it.

    A ``stream`` sets apart what must not share its episodes. Those of an elite in succession, shape (N * times,).
    """
    names = zip(archive.iteration.tolist(), archive.cell.tolist(), strict=True)
    rows = [np.random.SeedSequence([seed, *name], spawn_key=(stream,)).generate_state(times) for name in names]
    return np.concatenate([np.zeros(0, np.uint32), *rows]).astype(np.uint32)


def fresh_values(archive: Archive, result: RolloutResult, fitness: FitnessCfg) -> FreshValues:
    """What 40 fresh episodes on every elite of an archive say, which are drawn apart from the search's own."""
    cells = archive.cells
    fresh = evaluation_of(result, cells, fitness)
    collided = (result.base_collision & ~result.invalid)[:, :BIT_EPISODES].any(axis=1)
    cell = cells.cell_of(fresh.ratios, collided)
    reproduced = fresh.valid & cells.are_neighbours(archive.cell, cell)
    return FreshValues(**{**vars(fresh), "cell": cell}, reproduced=reproduced)


def outcome_counts(result: RolloutResult) -> NDArray[np.int64]:
    """Episodes of each terrain by :data:`qd.search.archive.OUTCOMES`, shape (num_terrains, 4)."""
    goal, collided, invalid = (
        flags.sum(axis=1) for flags in (result.reached_goal, result.base_collision, result.invalid)
    )
    return np.stack([goal, collided, result.invalid.shape[1] - goal - collided - invalid, invalid], axis=1)


@dataclass(frozen=True, kw_only=True)
class Search:
    """A search whose elites are judged."""

    run: Path
    cfg: SearchCfg
    robot: RobotCfg
    policy: str
    """The controller that was searched, as :func:`sim.controllers.loaders.load_policy` takes it."""
    space: TerrainSpace
    """What genes mean, with its code where it is now."""

    def read_archive(self) -> Archive:
        """Its archive, which must be of the settings beside it."""
        archive = read_archive(self.run)
        check_config(archive, self.cfg, self.run)
        check_space(archive, None)
        return archive


def find_search(run: Path, *, robot: str | None = None, policy: str | None = None, space: str | None = None) -> Search:
    """The search of a run, with its robot, controller and terrain space as they are now.

    What has moved or is code must be named: a robot's settings file, a controller, a terrain space.
    """
    cfg = RunDirectory(run).read_cfg()
    if space is not None:
        load_space(space)  # one of a user's own, which the run's name then finds
    robot_cfg = robot_of(as_settings(cfg), robot, run)
    controller = find_policy(run, cfg, robot_cfg) if policy is None else resolve_policy(policy, robot_cfg)
    if not is_searched(cfg, controller, robot_cfg):
        raise ValueError(f"policy must be the controller that was searched, {cfg.policy}, got {policy}: leave it out")
    return Search(run=run, cfg=cfg, robot=robot_cfg, policy=controller, space=get_space(cfg.space, cfg.space_sha256))


def controllers_in(folder: Path) -> dict[str, str]:
    """Certifiers of a folder by name: descriptions, ``<name>.toml``, and weights that are not of one, ``<name>.pt``."""
    described = sorted(folder.glob("*.toml"))
    weights = sorted({*folder.glob("*.pt")} - {*map(weights_file, described)})
    return {file.stem: str(file) for file in sorted([*weights, *described])}


def certifiers_of(search: Search) -> dict[str, str]:
    """Certifiers of a search by name: the robot's panel and the run's own, without the controller that was searched."""
    certifiers = controllers_in(search.robot.panel) | controllers_in(search.run / CERTIFIERS_FOLDER)
    return {name: file for name, file in certifiers.items() if not is_searched(search.cfg, file, search.robot)}


def check_certifiers(certifiers: Mapping[str, str], search: Search, device: str) -> None:
    """Tries each certifier on the robot; refuses the searched controller, which cannot certify itself."""
    for name, policy in certifiers.items():
        if controller_hash(policy) is None:
            raise ValueError(
                f"certifier {name} must have a file, by whose hash certificates name it, got {policy}, where there is "
                "none: give the path of one"
            )
        if is_searched(search.cfg, policy, search.robot):
            raise ValueError(f"certifier {name} must be another controller than the searched one, got {policy}")
        try:
            check_policy(policy, search.robot, device)
        except ValueError as error:
            raise ValueError(f"certifier {name} does not fit {search.robot.name}: {error}") from error


def check_varied(search: Search, device: str) -> None:
    """Builds a simulation of one robot under varied conditions; a ValueError if it cannot have any."""
    under = load_space(varied_name(search.space))
    Rollout(search.robot, search.policy, num_terrains=1, num_replicas=1, device=device, space=under)


def confirm(archive: Archive, rows: NDArray[np.int64], search: Search, crossings: Crossings) -> Archive:
    """The archive, which has fresh values, after its controller has crossed some elites with contact resolved."""
    faults = archive.counts
    counts = _cross(archive, rows, search, crossings, search.policy, "resolved", _CONFIRM_STREAM, "contact resolved")
    return replace(archive, faults=replace(faults, resolved_outcomes=_put(faults.resolved_outcomes, rows, counts)))


def certify(
    archive: Archive, rows: NDArray[np.int64], certifiers: Mapping[str, str], search: Search, crossings: Crossings
) -> Archive:
    """The archive after other controllers have crossed some elites, at the search's settings and with contact resolved.

    A terrain that a controller crosses less than half of the time at the search's settings is not crossed with contact
    resolved, since it cannot get a certificate. Counts of a certifier that is not asked stay, those of another
    controller of the same name go.
    """
    faults = archive.counts
    searched = dict(zip(faults.certifiers, faults.certifier_outcomes.swapaxes(0, 1), strict=True))
    resolved = dict(zip(faults.certifiers, faults.certifier_resolved_outcomes.swapaxes(0, 1), strict=True))
    hashes = dict(zip(faults.certifiers, faults.certifier_sha256, strict=True))
    for name, policy in certifiers.items():
        digest = str(controller_hash(policy))
        if hashes.get(name) != digest:
            searched[name] = resolved[name] = np.zeros_like(faults.resolved_outcomes)
            faults = replace(faults, varied_outcomes=None, certifier_varied_outcomes=None)  # of other columns
        counts = _cross(archive, rows, search, crossings, policy, "searched", _CERTIFY_STREAM, name)
        crossed = rows[goal_rates(counts) >= FAILING_GOAL_RATE]
        label = f"{name}, contact resolved"
        finer = _cross(archive, crossed, search, crossings, policy, "resolved", _CERTIFY_RESOLVED_STREAM, label)
        hashes[name], searched[name] = digest, _put(searched[name], rows, counts)
        resolved[name] = _put(_put(resolved[name], rows, 0), crossed, finer)
    if hashes:
        faults = replace(
            faults,
            certifiers=tuple(hashes),
            certifier_sha256=tuple(hashes.values()),
            certifier_outcomes=np.stack([*searched.values()], axis=1),
            certifier_resolved_outcomes=np.stack([*resolved.values()], axis=1),
        )
    return replace(archive, faults=faults)


def vary(archive: Archive, certifiers: Mapping[str, str], search: Search, crossings: Crossings) -> Archive:
    """The archive after its controller, and those that certify them, have crossed its faults under varied conditions.

    All cross each fault under the same 20 draws, an episode each.
    """
    faults, space = archive.counts, search.space
    under = load_space(varied_name(space))

    rows = np.flatnonzero(archive.is_fault)
    seeds = elite_seeds(archive, search.cfg.seed, EPISODES, stream=_VARY_STREAM).reshape(-1, EPISODES)[rows]
    drawn = [varied_genes(space, archive.genes[row], of_row) for row, of_row in zip(rows, seeds, strict=True)]
    genes = np.array(drawn, np.float32).reshape(len(rows), EPISODES, under.num_genes)

    def counts_of(policy: str, which: NDArray[np.bool_], label: str) -> NDArray[np.int64]:
        result = crossings.cross(
            policy, genes[which].reshape(-1, under.num_genes), seeds[which].ravel(), replicas=1, space=under.name,
            label=f"{label}, varied conditions", invalid_ok=True,
        )  # fmt: skip
        return outcome_counts(result).reshape(-1, EPISODES, 4).sum(axis=1)

    now = {name: str(controller_hash(policy)) for name, policy in certifiers.items()}
    known = zip(faults.certifiers, faults.certifier_sha256, faults.certificates()[rows].T, strict=True)
    if lost := [name for name, digest, certifies in known if certifies.any() and now.get(name) != digest]:
        raise ValueError(
            f"certifiers must be those that certify faults of {search.run}, got none or another file for "
            f"{', '.join(lost)}: name them by --certifiers, or judge --stages others again"
        )
    counts = counts_of(search.policy, np.ones(len(rows), bool), "searched")
    by_searched = _put(np.zeros_like(faults.resolved_outcomes), rows, counts)
    by_others = np.zeros_like(faults.certifier_outcomes)
    for column, name in enumerate(faults.certifiers):
        certified = faults.certificates()[rows, column]
        if certified.any():
            by_others[rows[certified], column] = counts_of(certifiers[name], certified, name)
    archive = replace(archive, faults=replace(faults, varied_outcomes=by_searched, certifier_varied_outcomes=by_others))
    print(f"{archive.robust.sum()} of {len(rows)} faults are robust: faults under varied conditions, too.", flush=True)
    return archive


def _cross(
    archive: Archive, rows: NDArray[np.int64], search: Search, crossings: Crossings, policy: str, how: How, stream: int,
    label: str,
) -> NDArray[np.int64]:  # fmt: skip
    """Outcomes of 20 episodes on some elites, shape (len(rows), 4)."""
    seeds = elite_seeds(archive, search.cfg.seed, stream=stream)[rows]
    result = crossings.cross(
        policy, archive.genes[rows], seeds, replicas=EPISODES, space=search.space.name, how=how, label=label,
        invalid_ok=True,
    )  # fmt: skip
    return outcome_counts(result)


def _put(counts: NDArray[np.int64], rows: NDArray[np.int64], values: NDArray[np.int64] | int) -> NDArray[np.int64]:
    """Counts with other values in some rows."""
    counts = counts.copy()
    counts[rows] = values
    return counts


def seen_by(archive: Archive, families: NDArray[np.int64], certifiers: Mapping[str, str]) -> NDArray[np.bool_] | None:
    """Whether each certifier of a judged archive has trained on kin of each elite, shape (N, C).

    None if the training record of one of them is not at hand.
    """
    marks, columns = np.array(hash_elites(archive.genes)), []
    for name in archive.counts.certifiers:
        if (policy := certifiers.get(name)) is None:
            return None
        trained_on, files = read_trained_on(policy), ControllerSpec.parse(policy).files
        if not trained_on and not any(file.with_suffix(".train.json").is_file() for file in files):
            return None
        columns.append(np.isin(families, families[np.isin(marks, [*trained_on])]))
    return np.stack(columns, axis=1) if columns else None


def judge(
    run: Path,
    *,
    compute: Compute,
    stages: Sequence[Stage] = ("fresh", "resolved", "others"),
    certifiers: Mapping[str, str] | None = None,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
) -> Archive:
    """Judges the elites of a search in stages, and writes the run's archive, numbers and figures after each.

    ``certifiers`` are other controllers by name, those of :func:`certifiers_of` if None; robot, policy and space are
    as :func:`find_search` takes them.
    """
    search = find_search(run, robot=robot, policy=policy, space=space)
    check_policy(search.policy, search.robot, compute.device)
    certifiers = certifiers_of(search) if certifiers is None else certifiers
    if {"others", "varied"} & {*stages}:
        check_certifiers(certifiers, search, compute.device)
    if "varied" in stages and len(stages) > 1:  # or it would be found out after hours
        check_varied(search, compute.device)
    calls_of = {"others": 2 * len(certifiers), "varied": 1 + len(certifiers)}
    calls = sum(calls_of.get(stage, 1) for stage in stages)
    with claimed(run), Crossings(search.robot, compute, cache=run / CROSSINGS_FOLDER, calls=calls) as crossings:
        archive = search.read_archive()
        if archive.fresh is None and "fresh" not in stages:
            raise ValueError(f"{run} must have fresh episodes of its elites, got none: begin with the stage fresh")
        before = stages[: stages.index("varied")] if "varied" in stages else ()
        if "varied" in stages and "others" not in before and (archive.faults is None or "fresh" in before):
            raise ValueError(f"{run} must have faults, got none judged: begin with the stages resolved, others")
        for stage in stages:
            failing = np.flatnonzero(archive.failing)
            if stage == "fresh":
                found, seeds = archive, elite_seeds(archive, search.cfg.seed, stream=FRESH_STREAM)
                result = crossings.cross(
                    search.policy, archive.genes, seeds, replicas=FRESH_EPISODES, space=search.space.name,
                    label="fresh episodes",
                )  # fmt: skip
                archive = archive.corrected_by(fresh_values(archive, result, search.cfg.fitness))
                if len(found) and not np.array_equal(found.cell, archive.cell):
                    print(f"Elites of {run} are numbered anew: by their fresh episodes, the hardest first.", flush=True)
            elif stage == "others":
                archive = certify(archive, failing, certifiers, search, crossings)
            elif stage == "varied":
                archive = vary(archive, certifiers, search, crossings)
            else:
                archive = confirm(archive, failing, search, crossings)
            if stage in ("fresh", stages[0]):
                families = families_of(archive.genes, search.space)
                causes = causes_of(elites_of(archive), archive, search.space)
                archive = replace(archive, family=families, cause=causes)
            origin = compute.origin(search.cfg.seed) | controller_identity(search.robot, search.policy)
            _write(archive, search, certifiers, {stage: origin})
    return archive


def _write(archive: Archive, search: Search, certifiers: Mapping[str, str], by: dict[str, Any]) -> None:
    """Writes archive, numbers and figures of a run."""
    file = search.run / SUMMARY_FILE
    assert archive.fresh is not None and archive.family is not None
    seen = None if archive.faults is None else seen_by(archive, archive.family, certifiers)
    numbers = read_json(file) if file.exists() else {}
    numbers = {name: value for name, value in numbers.items() if name not in OF_VARIED}
    metrics = RunDirectory(search.run).read_metrics() if (search.run / METRICS_FILE).exists() else []
    if len(metrics) >= archive.iterations:  # a search that was stopped has not written its numbers
        numbers |= found_numbers(archive, metrics[: archive.iterations])
    numbers |= fresh_numbers(archive, archive.fresh) | fault_numbers(archive, archive.family, seen)
    numbers["judged_by"] = numbers.get("judged_by", {}) | by
    write_archive(search.run / ARCHIVE_FILE, archive)
    write_atomically(file, to_json(numbers))
    if metrics:
        figures.write_figures(search.run, archive, metrics)
