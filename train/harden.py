"""Harden a controller: rounds of search and training, until a search no longer finds what breaks it.

Every step is a run of its own under the directory of the hardening, search-0, tune-1 and so on, and goes on if stopped.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from qd.evaluate.evaluate import cross_sets, evaluate, fill_sizes
from qd.evaluate.level import report_level_ground
from qd.evaluate.sets import MIN_ELITES, Purpose, TerrainSet, generated_set, make_sets, paper_terrains
from qd.evaluate.tables import show_table, terrain_rates
from qd.faults.judge import judge
from qd.faults.numbers import EPISODES
from qd.search.archive import read_archive
from qd.search.crossed import usual_crossed
from qd.search.directory import ROUNDS_FILE, RunDirectory, claimed, read_robot_archive
from qd.search.loop import search
from qd.search.settings import SearchCfg, differences, preset
from qd.workers.compute import Compute, check_policy
from sim.controllers.spec import controller_identity
from sim.files.atomic import is_leftover, read_json, to_json, write_atomically
from sim.files.command import Interrupted
from sim.files.intervals import format_value
from sim.files.settings import check_settings
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.registry import load_space, space_at
from train.cfg import FinetuneCfg, HardenCfg, RoundEvaluationCfg, RunCfg
from train.finetune import finetune, train_specialist
from train.ppo.checkpoint import CHECKPOINT, read_start

MOST_LOST = 0.01
"""How much of its goal rate on hand-crafted and on hard-random terrains a controller may lose against the base."""
FIXED_SETS = ("hand_crafted", "hard_random")
"""Sets that every controller is evaluated on, beside the archives."""
_GPU_EPISODES = 400_000
_SEEDS = 100  # of searches and trainings, apart between hardenings of one seed and the next
_COUNTS = (
    "terrains_evaluated", "episodes", "elites", "elites_reproduced", "corrected_elites", "families", "failing",
    "failing_families", "failing_distinct", "confirmed", "certified", "faults", "faults_panel", "fault_families",
    "faults_distinct", "strong", "faults_fdr", "certifiers",
)  # fmt: skip


def harden(
    robot: RobotCfg, cfg: HardenCfg, run_dir: Path, compute: Compute, *, certifiers: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Searches for what breaks a controller, trains it on all that was found, and searches again, for some rounds.

    Each training is on hand-crafted terrains and on the archives of all searches so far. Its controller is kept if
    validation terrains speak for it; else the next round goes on with the controller before.

    ``certifiers`` are controllers by name that judge the searches; those of :func:`qd.faults.judge.judge` if None.
    Returns the content of ``rounds.json``: the counts of all searches, which trainings were kept and why, and tables.
    """
    hardening = _Hardening(robot, cfg, run_dir, compute, certifiers)
    content = hardening.content
    hardening.search_cfg(0, cfg.policy)  # refuses what no search can be
    try:
        with claimed(run_dir):
            write_atomically(run_dir / ROUNDS_FILE, to_json(content))  # by which the directory is known
            for number in range(cfg.rounds + 1):
                if number:
                    hardening.train(number)
                hardening.search(number)
                hardening.evaluate()
    except KeyboardInterrupt:
        raise Interrupted(f"Stopped; what is done is kept, and the same command goes on in {run_dir}.") from None
    goal, limits = content["tables"]["goal"], content["tables"]["intervals"]["goal"]
    counts = ("elites", "failing", "confirmed", "faults", "faults_panel")
    rows = []
    for row in content["rounds"]:
        name = row["controller"]
        cells = ("-" if row[count] is None else f"{row[count]:,}" for count in counts)
        rates = (format_value(goal[fixed].get(name), limits[fixed].get(name)) for fixed in FIXED_SETS)
        rows.append((name, *cells, *rates))
    show_table("Rounds", ["controller", *counts, *(f"goal on {name}" for name in FIXED_SETS)], rows)
    print(f"The hardened controller: {hardening.policies[f'round-{cfg.rounds}']}")
    return content


class _Hardening:
    def __init__(
        self, robot: RobotCfg, cfg: HardenCfg, path: Path, compute: Compute, certifiers: Mapping[str, str] | None
    ) -> None:
        check_settings(cfg)
        base = cfg.policy or str(robot.policy_file)
        read_start(Path(base), robot)
        check_policy(base, robot, compute.device)
        report_level_ground(robot, base, compute, must_walk=True)
        tune = cfg.sized_tune(robot, compute.device)
        tune.check(robot)
        full = (paper_terrains(robot.name), EPISODES)
        terrains, episodes = cfg.evaluation.terrains or None, cfg.evaluation.episodes or None
        terrains, episodes = fill_sizes(compute, terrains, episodes, full=full, small=(24, 4))
        self.cfg = replace(cfg, tune=tune, evaluation=RoundEvaluationCfg(terrains=terrains, episodes=episodes))
        self.robot, self.path, self.compute, self.certifiers = robot, path, compute, certifiers
        self.space = space_at(load_space(cfg.space), None, robot)
        how: dict[str, Any] = {"robot": robot, "compute": compute, "episodes": episodes, "cache": path / "crossings"}
        self.crossing = how
        self.policies = {"base": base}  # after each round so far
        self.start = cfg.policy  # of the next training: the base, or the last checkpoint kept, with its critic
        self.rows: list[dict[str, Any]] = []
        self.choices: dict[str, dict[str, Any]] = {}
        self.content = self._read_content(base)

    def _read_content(self, base: str) -> dict[str, Any]:
        """What ``rounds.json`` has, or is to begin with."""
        identity = controller_identity(self.robot, base)
        settings = json.loads(to_json({**asdict(self.cfg), **identity}))  # as they are read again
        del settings["rounds"]
        file = self.path / ROUNDS_FILE
        if file.exists():
            content = read_json(file)
            if different := differences(content.get("settings", {}), settings):
                raise ValueError(f"{self.path} holds a hardening of other settings: {', '.join(different)}: give those")
            done = len(content["rounds"]) - 1
            if self.cfg.rounds < done:
                raise ValueError(f"rounds must be at least {done}, which {self.path} has done, got {self.cfg.rounds}")
            return content
        if self.path.is_dir() and not all(map(is_leftover, self.path.iterdir())):
            raise ValueError(f"{self.path} must be empty or hold a hardening, got neither: give another directory")
        origin = self.compute.origin(self.cfg.seed)
        return {**origin, "robot": self.robot.name, "settings": settings, "rounds": [], "choices": {}}

    def _seed(self, number: int) -> int:
        """Seed of a round, from 100 on: controllers are tested on elites of searches with seeds 0, 1 and so on."""
        return _SEEDS * (self.cfg.seed + 1) + number

    def _searches(self) -> list[Path]:
        """Searches so far with enough elites to train on some and hold out others; the first must have."""
        runs = [self.path / row["search"] for row in self.rows]
        counts = [len(read_archive(run)) for run in runs]
        if counts[0] < MIN_ELITES:
            rule = f"{runs[0]} must have found at least {MIN_ELITES} elites to train on, got {counts[0]}"
            raise ValueError(f"{rule}: give more --search.episodes and another directory")
        return [run for run, count in zip(runs, counts, strict=True) if count >= MIN_ELITES]

    def train(self, number: int) -> None:
        """Trains on the archives of all searches so far, and goes on with the new controller if it is better."""
        run, searches = self.path / f"tune-{number}", self._searches()
        print(f"\n=== round-{number}: training, in {run}", flush=True)
        base = self.policies["base"]
        # Noise of the actions grows in a training: each begins with that of the base.
        recipe = replace(self.cfg.tune.recipe, noise_of=base if self.start != self.cfg.policy else None)
        drawn = {"archive": tuple(map(str, searches)), "space": self.space.name}
        cfg = replace(self.cfg.tune, seed=self._seed(number), policy=self.start, recipe=recipe, **drawn)
        after = str(finetune(self.robot, cfg, run, RunCfg(device=self.compute.device)))
        controllers = {"base": base, "before": [*self.policies.values()][-1], "after": after}
        sets = self._sets(searches, "validation")
        results = cross_sets(controllers, sets, reward=True, note=", validation", **self.crossing)
        goal: dict[str, dict[str, float]] = {}
        for when in controllers:
            rates = {name: terrain_rates(results[name][when])["goal"] for name in sets}
            # Elites of all archives are one set, since a small archive has few for validation.
            rates["elites"] = np.concatenate([rates.pop(search.name) for search in searches])
            goal[when] = {name: float(np.nanmean(values)) for name, values in rates.items()}
        choice = {**verdict(**goal), "goal": goal}
        self.choices[run.name] = choice
        print(f"{run.name} is {'kept' if choice['kept'] else 'not kept'}: {choice['why']}", flush=True)
        if choice["kept"]:
            self.start = str(run / CHECKPOINT)
        self.policies[f"round-{number}"] = controllers["after" if choice["kept"] else "before"]

    def _sets(self, searches: Sequence[Path], purpose: Purpose) -> dict[str, TerrainSet]:
        """The fixed sets, and for each search, by its name, the elites that no training draws."""
        terrains = self.cfg.evaluation.terrains
        archives = {run.name: read_robot_archive(self.robot, run, self.space.name) for run in searches}
        return {
            **make_sets(FIXED_SETS, terrains, 0, space=self.space, purpose=purpose),
            **{name: generated_set(archive, terrains, 0, purpose) for name, archive in archives.items()},
        }

    def search(self, number: int) -> None:
        """Searches for what breaks the controller of a round, and counts its faults."""
        run, (name, policy) = self.path / f"search-{number}", [*self.policies.items()][-1]
        print(f"\n=== {name}: search, in {run}", flush=True)
        cfg = self.search_cfg(number, self.cfg.policy if policy == self.policies["base"] else policy)
        search(cfg, run, self.compute, robot=self.robot)
        settings: dict[str, Any] = {"compute": self.compute, "robot": self.robot.spec, "space": self.space.name}
        if self.cfg.specialists and judge(run, stages=("fresh",), **settings).failing.any():
            specialist = replace(FinetuneCfg.specialist(self.robot), space=self.space.name)
            train_specialist(self.robot, run, specialist, RunCfg(device=self.compute.device))
        judge(run, certifiers=self.certifiers, **settings)
        counts, identity = RunDirectory(run).read_summary(), controller_identity(self.robot, policy)
        tuned = f"tune-{number}" if number else None
        row = {"controller": name, **{key: identity[key] for key in ("policy", "policy_sha256")}}
        row |= {"tuned": tuned, "kept": tuned and self.choices[tuned]["kept"], "search": run.name}
        self.rows.append(row | {key: counts.get(key) for key in _COUNTS})

    def search_cfg(self, number: int, policy: str | None) -> SearchCfg:
        """The search of a round against a controller, the robot's own if None."""
        on_cuda, size = self.compute.device.startswith("cuda"), self.cfg.search
        named = size.preset or ("wide" if on_cuda else "small")
        cfg = preset(named, self.robot, policy, space=self.space.name, space_sha256=self.space.sha256)
        usual = _GPU_EPISODES if on_cuda else cfg.iterations * cfg.episodes_per_iteration
        iterations = -(-(size.episodes or usual) // cfg.episodes_per_iteration)
        run = RunDirectory(self.path / f"search-{number}")
        crossed = usual_crossed(cfg.scheduler, self.robot, self.space)
        if run.exists():  # it goes on as it was begun
            crossed = run.read_cfg().fitness.crossed
        fitness = replace(cfg.fitness, crossed=crossed)
        return replace(cfg, seed=self._seed(number), iterations=iterations, fitness=fitness)

    def evaluate(self) -> None:
        """Evaluates all controllers so far, and writes ``rounds.json`` where these rounds are not all in it."""
        if len(self.rows) < len(self.content["rounds"]):
            return
        tables = evaluate(self.policies, self._sets(self._searches(), "test"), **self.crossing)
        self.content |= {"rounds": self.rows, "choices": self.choices, "tables": dict(tables)}
        write_atomically(self.path / ROUNDS_FILE, to_json(self.content))


def verdict(base: dict[str, float], before: dict[str, float], after: dict[str, float]) -> dict[str, Any]:
    """Whether to keep the controller ``after`` a training, by goal rates of validation sets, and their mean."""
    scores = {"before": fmean(before.values()), "after": fmean(after.values())}
    why = f"its goal rate on validation is {scores['after']:.3f}, before {scores['before']:.3f}"
    lost = {name: base[name] - after[name] for name in FIXED_SETS if base[name] - after[name] > MOST_LOST + 1e-9}
    why += "".join(f"; on {name} it is {points:.3f} below the base's" for name, points in lost.items())
    return {"kept": not lost and scores["after"] >= scores["before"], "why": why, "score": scores}
