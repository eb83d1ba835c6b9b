"""Whether anybody crosses what stops the searched controller: labels, from which a surrogate learns what earns less.

After iterations 1, 2, 4, 8 and so on, failing elites are drawn at random. Somebody crosses one if the searched
controller has reached its goal before, or does by random ways near the line (:mod:`qd.faults.steer`), or a controller
of the robot's panel does in at least half of a few episodes. That is no certificate.
"""

from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from kernels.episode import Kind
from qd.faults.searches import check_fits, controllers_in
from qd.faults.steer import LINE_M, SteerCfg, cross_ways, draw_ways, first_ways
from qd.search.directory import Metrics
from qd.search.presets import SchedulerCfg
from qd.search.scheduler import Scheduler
from qd.search.settings import SearchCfg, is_searched
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from sim.controllers.spec import controller_hash
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.terrains import Terrains

MOST = 500
"""Elites that are labelled after an iteration, and no more than it has terrains."""
EPISODES, WAYS = 4, 8
"""Of each controller of the panel, and of the searched one."""
USUAL = 0.95
"""How much less what nobody crosses is worth in a search of a robot with a panel (results/make/crossed.py)."""


def usual_crossed(scheduler: SchedulerCfg, robot: RobotCfg, space: TerrainSpace) -> float:
    """The default of ``--fitness.crossed``; 0 without a panel, whose certificates were measured, and of crossings."""
    is_known = scheduler.learns_crossed and space.asks == Kind.CROSS and controllers_in(robot.panel)
    return USUAL if is_known else 0.0


class Labeller(ExitStack):
    """Finds out for a search whether anybody crosses its failing elites; on a GPU its simulations stay open."""

    def __init__(self, cfg: SearchCfg, robot: RobotCfg, policy: str, compute: Compute, metrics: Metrics) -> None:
        """A search goes on with the panel that it began with, as its ``metrics`` have it."""
        super().__init__()
        if compute.on_ray:  # whose workers go on with the search
            compute = Compute.resolve() if compute.on_gpu else Compute()
        self._cfg, self._robot, self._policy = cfg, robot, policy
        panel = {name: file for name, file in controllers_in(robot.panel).items() if not is_searched(cfg, file, robot)}
        for name, file in panel.items():
            check_fits(name, file, robot, compute.device)
        steers = cfg.terrain_space.asks == Kind.CROSS
        self._walkers = [*panel.values(), *([None] if steers else [])]  # None is the searched controller
        if not self._walkers:
            raise ValueError(f"fitness.crossed needs another controller in {robot.panel}, got none: give 0")
        self._hashes = {name: controller_hash(file) for name, file in panel.items()}
        if metrics and (before := metrics[-1]["panel"]) != self._hashes:
            names = ", ".join(sorted({*before} | {*self._hashes})) or "none"
            raise ValueError(f"the panel in {robot.panel} must be that of the search, got others: {names}: put it back")
        self._on_gpu = compute.on_gpu
        self._crossers = defaultdict[str, Crosser](lambda: self.enter_context(Crosser(robot, compute)))

    def label(self, scheduler: Scheduler, iteration: int, show: Callable[[str], None]) -> dict[str, Any]:
        """Tells the search which of some elites somebody crosses; how many they are, and what that took in episodes."""
        counts: dict[str, Any] = {"labelled": 0, "labelled_crossed": 0, "label_episodes": 0, "panel": self._hashes}
        if iteration & (iteration - 1):
            return counts
        rng = np.random.default_rng(np.random.SeedSequence([self._cfg.seed, iteration], spawn_key=(Stream.CROSSED,)))
        rows, genes, goal_rate = scheduler.ask_crossed(min(MOST, self._cfg.scheduler.num_terrains), rng)
        seeds = rng.integers(2**32, size=len(rows), dtype=np.uint32)
        terrains = Terrains(genes=genes, seeds=seeds, space=self._cfg.terrain_space)
        crossed = goal_rate > 0.0
        for number, file in enumerate(self._walkers):
            left = np.flatnonzero(~crossed)

            def move(share: float, number: int = number) -> None:
                share = (number + share) / len(self._walkers)
                show(f"iteration {iteration}: does anybody cross what stops the robot? {share:.0%}")

            crosser = self._crossers[file or "" if self._on_gpu else ""]
            how = {"label": "labels", "progress": move, "room": MOST}
            if file is not None:
                result = crosser.cross(file, terrains[left], replicas=EPISODES, invalid_ok=True, **how)
                crossed[left] = 2 * result.reached_goal.sum(axis=1) >= EPISODES
            else:
                steer = SteerCfg(samples=WAYS)
                ways = draw_ways(*first_ways(len(left), self._robot, self._policy, LINE_M, steer), rng, steer)
                result = cross_ways(crosser, self._policy, terrains[left], ways, seeds[left], **how)
                crossed[left] = result.reached_goal.any(axis=1)
            counts["label_episodes"] += result.outcome.size
        scheduler.tell_crossed(rows, crossed)
        return counts | {"labelled": len(rows), "labelled_crossed": int(crossed.sum())}
