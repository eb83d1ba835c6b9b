"""A study: several searches in one folder, whose terrains are crossed together so that a GPU is full.

Each is a run of the ordinary search, in a run directory of its own, which can be looked at and extended like any other.
The same command goes on where it was stopped.
"""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.archive import Archive
from qd.fresh import Open, drawn_elites, numbers_of, reevaluate
from qd.gate import Gate, open_gate
from qd.run.arguments import evaluator_of, own_file
from qd.run.directory import (
    CONFIG_FILE,
    RUNS,
    Metrics,
    RunDirectory,
    archive_of,
    claimed,
    episodes_in,
    origin_in,
    write_results,
)
from qd.run.progress import ProgressBar, share_bar
from qd.run.settings import SearchCfg, as_settings, moved_certifiers, moved_policy, policy_spec, refuse_changes
from qd.search import MOST_DRAWN, begin, crossed_iterations, looks_again, row_of
from qd.workers.evaluator import Evaluate, EvaluatorCfg, origin_of, worker_status
from sim.files.atomic import is_leftover
from sim.files.command import Where, Who, naming_what_is_next

if TYPE_CHECKING:
    from qd.scheduler import Scheduler
    from sim.robots.robot import RobotCfg


@dataclass(frozen=True, kw_only=True)
class StudyFlags(Who, Where):
    """The flags of every study."""

    preset: str | None = None
    """Size of the searches: wide or paper (for a GPU), or small; left out, paper on a GPU and small on the CPU."""
    run_dir: Path | None = None
    """The study's folder, new or to go on with; runs/<robot>-<the command's name>."""
    out: Path | None = None
    """Where to write the numbers, with a figure beside them; <the command's name>.json in that folder."""


LOOKS = (("#0072b2", "-"), ("#d55e00", "--"), ("#009e73", "-."), ("#cc79a7", ":"))
"""Colour and line of each search in a figure."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Searches of one robot against one controller, with equally many episodes a terrain."""

    path: Path
    """The study's folder."""
    out: Path
    """File of the numbers; the figure goes beside it."""
    runs: dict[str, SearchCfg]
    """Settings of each search, by the name of its folder."""
    evaluator: EvaluatorCfg
    """Crosses the terrains of all of them."""
    origin: dict[str, Any]
    """Provenance."""
    sampled: bool
    """Whether up to 200 drawn elites cross fresh episodes every so many iterations; else all do, and at the end too."""
    certifiers: dict[str, str] = field(default_factory=dict)
    """Controllers by name, the same in all searches for certified failures among them."""


def study_of(
    flags: StudyFlags,
    name: str,
    runs: dict[str, SearchCfg],
    robot: "RobotCfg",
    device: str,
    *,
    sampled: bool,
    moved: str | None = None,
    certifiers: dict[str, str] | None = None,
) -> Study:
    """A study whose controller was tried.

    Args:
        flags: Where to work and write.
        name: What the study is called: compare or ablation.
        runs: Settings of each search, by the name of its folder.
        robot: The robot.
        device: Warp device name.
        sampled: As of the field.
        moved: Where the controller is, if not where the settings say.
        certifiers: As of the field.

    Raises:
        ValueError: If the controller cannot be loaded or does not fit the robot.
    """
    cfg = next(iter(runs.values()))
    path = flags.run_dir or RUNS / f"{robot.name}-{name}"
    controller = moved or policy_spec(cfg, robot)
    if told := robot.scaled_by_another(controller):
        print(told)
    evaluator = evaluator_of(cfg, robot, controller, device, flags.workers, num_envs=flags.num_envs, runs=len(runs))
    by_groups: dict[int, int] = {}  # terrains under way in each lock-step
    for one in (own.scheduler for own in runs.values()):
        by_groups[one.groups] = by_groups.get(one.groups, 0) + one.num_terrains
    groups, terrains = max(by_groups.items(), key=lambda one: one[1])
    return Study(
        path=path,
        out=flags.out or path / f"{name}.json",
        runs=runs,
        evaluator=replace(evaluator, num_terrains=terrains, lots=groups),
        origin={**origin_of(device, cfg.seed, flags.workers), **own_file(robot)},
        sampled=sampled,
        certifiers=certifiers or {},
    )


@dataclass(kw_only=True)
class _Search:
    """One of the searches, as far as it is."""

    cfg: SearchCfg
    iterations: int
    """Of the study; the run may have more."""
    run: RunDirectory
    origin: dict[str, Any]
    search: "Scheduler"
    metrics: Metrics = field(default_factory=list)
    found: Archive | None = None

    @property
    def done(self) -> int:
        """Iterations done."""
        return len(self.metrics)

    @property
    def step(self) -> tuple[int, int]:
        """What searches must agree in to be crossed in lock-step: groups, and when elites cross fresh episodes."""
        return self.cfg.scheduler.groups, self.cfg.reevaluate_every

    def episodes_left(self, *rows: dict[str, Any]) -> int:
        """Episodes to be spent; none once it has made its iterations, or spent as many as they have of a plain one.

        Args:
            rows: Of iterations that are not among its metrics yet.
        """
        metrics, each = [*self.metrics, *rows], self.cfg.episodes_per_iteration
        left = self.iterations * each - sum(map(episodes_in, metrics))
        return left if len(metrics) < self.iterations and left >= each else 0


def run_study(study: Study, open_evaluator: Open) -> tuple[dict[str, Metrics], dict[str, Any]]:
    """Runs the iterations that are left of each search, and writes what each leaves to look at.

    Args:
        study: The study.
        open_evaluator: Opens what crosses the terrains.

    Returns:
        Rows of metrics by name, of the iterations asked for; and the provenance of the numbers.

    Raises:
        ValueError: If a run that is there has other settings, is damaged, or is at work.
        Interrupted: On Ctrl-C; all iterations that ended are saved.
        EvaluatorError: If a worker is lost; likewise.
    """
    with ExitStack() as claims:
        claims.enter_context(claimed(study.path))
        searches = {name: _opened(study, name, claims) for name in study.runs}
        left = sum(one.episodes_left() for one in searches.values())
        print(f"{len(searches)} searches in {study.path}: {left:,} episodes, and those of elites again", flush=True)
        with naming_what_is_next("finished iterations are saved", lambda: "The same command goes on"):
            gated = [one.cfg for one in searches.values() if one.cfg.certified_by]
            with ExitStack() as opened:
                evaluate = gate = None
                if left:
                    evaluate = opened.enter_context(open_evaluator(study.evaluator))
                if left and gated:
                    own = open_gate(gated[0], study.certifiers, study.evaluator, open_evaluator, runs=len(gated))
                    gate = opened.enter_context(own)
                for one in searches.values():
                    one.run.write_config(one.cfg, one.origin)
                if evaluate is not None:
                    _lock_step(list(searches.values()), evaluate, gate, sampled=study.sampled)
            for one in searches.values():
                found = one.run.with_fresh_values(archive_of(one.cfg, one.search, one.done))
                write_results(one.run, found, one.metrics, one.origin)
        metrics = {name: one.metrics[: study.runs[name].iterations] for name, one in searches.items()}
        return metrics, study.origin if left else _origin_of(list(searches.values()), study.origin)


_OF_CROSSINGS = ("commit", "device", "versions", "date")


def _origin_of(searches: Sequence[_Search], now: dict[str, Any]) -> dict[str, Any]:
    """Provenance of numbers for which nothing is crossed any more: of the first search's beginning, but the command."""
    began = searches[0].origin
    return {**now, **{name: began[name] for name in _OF_CROSSINGS if name in began}}


def _opened(study: Study, name: str, claims: ExitStack) -> _Search:
    """A search of a study, new or as far as it is, claimed until the end."""
    cfg, run = study.runs[name], RunDirectory(study.path / name)
    claims.enter_context(claimed(run.path))
    if (run.path / CONFIG_FILE).exists():
        there = run.read_cfg()
        if moved_policy(there, cfg.policy):
            cfg = replace(cfg, policy=there.policy)
        if moved_certifiers(there, cfg.certified_by, cfg.certifier_sha256):
            cfg = replace(cfg, certified_by=there.certified_by)
        refuse_changes(run.path, "run", as_settings(there), as_settings(cfg))
        origin, loaded = origin_in(run.read_config()), run.load(cfg)
    elif all(map(is_leftover, run.path.iterdir())):
        origin, loaded = {**study.origin, "seed": cfg.seed, "sessions": []}, None
    else:
        raise ValueError(f"{run.path} is not empty and holds no run: give another --run-dir")
    search, metrics = begin(cfg, study.evaluator.device, loaded)
    cfg = replace(cfg, iterations=max(cfg.iterations, len(metrics)))  # one that was extended alone is not shortened
    return _Search(
        cfg=cfg, iterations=study.runs[name].iterations, run=run, origin=origin, search=search, metrics=metrics
    )


def _lock_step(searches: Sequence[_Search], evaluate: Evaluate, gate: Gate | None, *, sampled: bool) -> None:
    """Runs the iterations that are left; searches behind the others, as after a kill, catch up first.

    Searches with certifiers end earlier than the others, with as many episodes. Those that cannot go in lock-step with
    the first ones come after them.
    """
    iterations = max(one.iterations for one in searches)
    with ProgressBar(iterations, min(one.done for one in searches)) as bar:
        while going := [one for one in searches if one.episodes_left()]:
            going = [one for one in going if one.step == going[0].step]
            done = min(one.done for one in going)
            active = [one for one in going if one.done == done]
            last = min(one.iterations for one in active)
            caught_up = min((one.done for one in going if one.done > done), default=last)
            left = range(done + 1, min(last, caught_up) + 1)
            gated = any(one.cfg.certified_by for one in active)
            _iterate(active, evaluate, gate if gated else None, left, bar, sampled=sampled)


def _iterate(
    active: Sequence[_Search],
    evaluate: Evaluate,
    gate: Gate | None,
    left: range,
    bar: ProgressBar,
    *,
    sampled: bool,
) -> None:
    """Some iterations of some searches, each saved, until one of them has spent its episodes."""
    began = time.perf_counter()
    states = [(one.cfg, one.search) for one in active]
    for iteration, found in crossed_iterations(states, left, evaluate, bar, gate):
        rows = []
        for one, crossed in zip(active, found, strict=True):
            one.found = archive_of(one.cfg, one.search, iteration)
            rows.append(row_of(one.cfg, one.found, crossed, iteration))
        ending = [not one.episodes_left(row) for one, row in zip(active, rows, strict=True)]
        every = looks_again(active[0].cfg, iteration)
        chosen = [k for k, ends in enumerate(ending) if every or (ends and not sampled)]
        if chosen:
            again = _elites_again([active[k] for k in chosen], evaluate, sampled)
            for k, numbers in zip(chosen, again, strict=True):
                rows[k] |= numbers
        ended = time.perf_counter()
        wall_s, began = ended - began, ended
        for one, row in zip(active, rows, strict=True):
            one.metrics.append({**row, "wall_s": wall_s / len(active), "episodes_per_s": episodes_in(row) / wall_s})
            assert one.found is not None
            one.run.save(one.cfg, one.search, one.metrics, one.found)
        best = max((one.metrics[-1] for one in active), key=lambda row: row["elites"])
        episodes = sum(map(episodes_in, rows))
        status = worker_status(evaluate)
        shown = {**best, "wall_s": wall_s, "episodes_per_s": episodes / wall_s}
        bar.show(shown, None if status is None else str(status))
        if any(ending):
            return


def _elites_again(active: Sequence[_Search], evaluate: Evaluate, sampled: bool) -> list[dict[str, Any]]:
    """What the elites of all searches are worth in fresh episodes, crossed together."""
    cfg, archives = active[0].cfg, [one.found for one in active if one.found is not None]
    seeds = [one.cfg.seed for one in active]
    if sampled:
        archives = [drawn_elites(found, MOST_DRAWN, seed) for found, seed in zip(archives, seeds, strict=True)]
    rows: dict[int, dict[str, Any]] = {}
    for fitness in dict.fromkeys(one.cfg.fitness for one in active):
        own = [k for k, one in enumerate(active) if one.cfg.fitness == fitness]
        with share_bar("fresh episodes") as progress:
            again = reevaluate(
                [archives[k] for k in own], evaluate, fitness, num_replicas=cfg.replicas,
                seeds=[seeds[k] for k in own], progress=progress,
            )  # fmt: skip
        rows |= {k: numbers_of(one, cfg.cells, sampled=sampled) for k, one in zip(own, again, strict=True)}
    return [rows[k] for k in range(len(active))]
