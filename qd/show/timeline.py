"""Which robot runs which episode when: what the queue of episodes is for, in a figure."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qd.archive import read_archive
from qd.show.figures import save_figure
from sim.files.atomic import prepare_output
from sim.robots.robot import RobotCfg, get_robot
from sim.rollout import Rollout
from sim.space import SUPER_GAUSSIAN, TerrainSpace, get_space

_ROBOTS, _TERRAINS, _REPLICAS = 8, 20, 2
_SEED = 3


class _Timeline:
    """Notes the episode of every robot at every control step (:class:`sim.rollout.Watcher`)."""

    def __init__(self, rollout: Rollout) -> None:
        self._rollout = rollout
        self.rows: list[NDArray[np.int32]] = []

    def before_step(self) -> None:
        """Adds a row."""
        self.rows.append(np.array(self._rollout.state.episode.numpy()))

    def after_step(self) -> None:
        """Adds nothing."""


def _terrains(run: Path | None) -> tuple[NDArray[np.float32], TerrainSpace]:
    """Genes of elites from all ranks of a run, or of hard-random terrains, and what they mean."""
    if run is None:
        return SUPER_GAUSSIAN.hard_random(_TERRAINS, _SEED), SUPER_GAUSSIAN
    archive = read_archive(run)
    genes = archive.genes[np.linspace(0, len(archive) - 1, _TERRAINS).astype(int)]
    return genes, get_space(archive.space, archive.space_sha256, file=run)


def _run(
    robot: RobotCfg, genes: NDArray[np.float32], space: TerrainSpace, device: str, *, queued: bool
) -> NDArray[np.int32]:
    """Episode of each robot at each control step, -1 where it waits, shape (steps, robots)."""
    num_terrains = _TERRAINS if queued else _ROBOTS // _REPLICAS
    rollout = Rollout(
        robot, robot.policy_file, num_terrains=num_terrains, num_replicas=_REPLICAS, num_envs=_ROBOTS, device=device,
        space=space,
    )  # fmt: skip
    seeds, timeline, rows = np.arange(_TERRAINS, dtype=np.uint32), _Timeline(rollout), []
    for first in range(0, _TERRAINS, num_terrains):
        own = slice(first, first + num_terrains)
        rollout.evaluate(genes[own], seeds[own], watcher=timeline)
        taken = np.array(timeline.rows)
        timeline.rows.clear()
        ended = int(np.flatnonzero((taken >= 0).any(axis=1))[-1]) + 1
        rows.append(np.where(taken >= 0, taken + first * _REPLICAS, -1)[:ended])
    return np.concatenate(rows)


def draw_timeline(file: Path, robot: str, run: Path | None, device: str) -> None:
    """Cross some terrains without and with the queue, and draw both.

    Args:
        file: Picture to write.
        robot: Name of the robot.
        run: Whose elites are crossed; hard-random terrains if None.
        device: Warp device name.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    prepare_output(file)
    cfg, (genes, space) = get_robot(robot), _terrains(run)
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    both = figure.subplots(2, 1, sharex=True)
    titles = (False, "one lot after the other"), (True, "a queue")
    for axes, (queued, title) in zip(both, titles, strict=True):
        rows = _run(cfg, genes, space, device, queued=queued)
        for env, episodes in enumerate(rows.T):
            cuts = np.flatnonzero(np.diff(episodes, prepend=-2, append=-2))
            for begin, end in pairwise(cuts.tolist()):
                if episodes[begin] >= 0:
                    color = colormaps["tab20"](int(episodes[begin]) // _REPLICAS)
                    width = (end - begin) * cfg.control_dt
                    axes.barh(env + 1, width, left=begin * cfg.control_dt, color=color, edgecolor="white", height=0.8)
        total_s, idle = len(rows) * cfg.control_dt, float((rows < 0).mean())
        axes.set_title(f"{title}: {total_s:.0f} s, {idle:.0%} waiting", loc="left", fontsize=10)
        axes.set_ylabel("robot")
        axes.set_yticks(range(1, _ROBOTS + 1))
        axes.invert_yaxis()
    both[1].set_xlabel("simulated time [s]")
    save_figure(file, figure)
    print(f"Figure: {file}")
