"""Whether anybody crosses what stops the searched controller: labels, from which a surrogate learns what earns less.

After iterations 1, 2, 4, 8 and so on, the robot's panel crosses failing elites that are drawn at random. Where none of
it arrives, the searched controller tries random ways near the line (:mod:`qd.faults.steer`). That it arrives, however
far from the line, is no certificate; but where the panel does not cross it hardly ever does.
"""

from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from qd.faults.searches import controllers_in
from qd.faults.steer import LINE_M, SteerCfg, cross_ways, draw_ways, first_ways
from qd.search.scheduler import Scheduler
from qd.search.settings import SearchCfg, is_searched
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.registry import get_space
from sim.terrains.terrains import Terrains

MOST = 500
"""Elites that are labelled after an iteration."""
EPISODES, WAYS = 4, 8
"""Of each controller of the panel, and of the searched one."""


class Labeller(ExitStack):
    """Finds out for a search whether anybody crosses its failing elites; on a GPU its simulations stay open."""

    def __init__(self, cfg: SearchCfg, robot: RobotCfg, policy: str, compute: Compute) -> None:
        super().__init__()
        if compute.on_ray:  # whose workers have the searched controller alone
            compute = Compute.resolve()
        self._cfg, self._robot, self._policy = cfg, robot, policy
        panel = controllers_in(robot.panel).values()
        self._panel = [file for file in panel if not is_searched(cfg, file, robot)]
        for file in self._panel:
            check_policy(file, robot, compute.device)
        self._on_gpu = compute.on_gpu
        self._crossers = defaultdict[str, Crosser](lambda: self.enter_context(Crosser(robot, compute)))

    def label(self, scheduler: Scheduler, iteration: int, show: Callable[[str], None]) -> dict[str, int]:
        """Tells the search which of some elites somebody crosses; how many they are, and what that took in episodes.

        ``show`` gets a line that says how far that is.
        """
        counts = {"labelled": 0, "labelled_crossed": 0, "label_episodes": 0}
        if iteration & (iteration - 1):
            return counts
        rng = np.random.default_rng(np.random.SeedSequence([self._cfg.seed, iteration], spawn_key=(Stream.CROSSED,)))
        rows, genes, goal_rate = scheduler.ask_crossed(MOST, rng)
        space = get_space(self._cfg.space, self._cfg.space_sha256)
        seeds = rng.integers(2**32, size=len(rows), dtype=np.uint32)
        terrains = Terrains(genes=genes, seeds=seeds, space=space)
        crossed = goal_rate > 0.0
        for number, file in enumerate([*self._panel, None]):
            left = np.flatnonzero(~crossed)

            def move(share: float, number: int = number) -> None:
                share = (number + share) / (len(self._panel) + 1)
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
