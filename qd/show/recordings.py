"""Recorded crossings of the elites of a run, or of heights: the episodes of ``make replay``, with every step kept."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive, read_archive
from qd.run.directory import directory_of, newest_or_published
from qd.run.settings import refuse_unnamed_code
from qd.show.own_terrain import own_seeds
from qd.show.replay import REPLAY_STREAM, as_searched, check_penalties
from qd.workers.evaluator import episode_seeds
from sim.policy.spec import spec_of

if TYPE_CHECKING:
    from sim.recording.recorder import Recording
    from sim.robots.robot import RobotCfg
    from sim.rollout import RolloutResult


@dataclass(frozen=True, kw_only=True)
class Found:
    """An archive and where it lies."""

    run: Path
    """What was given: a run directory or an archive file."""
    archive: Archive
    robot: "RobotCfg"
    """Whose archive it is."""

    @property
    def folder(self) -> Path:
        """The directory."""
        return directory_of(self.run)


def archive_of_robot(named: "RobotCfg | str", run: Path | None) -> Found:
    """The archive of a run, the robot's newest one, else its published one, if none is given.

    Args:
        named: The robot, as the command line names it or as settings.
        run: Run directory or archive file.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged or of another robot.
    """
    from sim.robots.robot import get_robot, robot_of

    run = run or newest_or_published(get_robot(named))
    archive = read_archive(run)
    robot = robot_of(archive.robot, named, run)
    check_penalties(archive, robot, run)
    return Found(run=run, archive=archive, robot=robot)


def policy_of(found: Found, robot: "RobotCfg", given: str | None) -> str:
    """The controller to cross an archive's terrains with: the one given, or that of the search.

    Raises:
        ValueError: If the config of the run is not that of its archive.
    """
    searched, _ = as_searched(found.run, found.archive)
    refuse_unnamed_code(searched, given, found.run)
    return spec_of(given or searched, robot)


def record_elites(
    found: Found,
    elites: Sequence[int],
    *,
    device: str,
    policy: str | None = None,
    episodes: int = 20,
    replicas: Sequence[int] | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> tuple["RolloutResult", "Recording"]:
    """Crosses some elites again, all at once, and records the episodes; those of ``make replay`` with the same numbers.

    Args:
        found: Their archive.
        elites: Their numbers.
        device: Warp device name.
        policy: Controller other than the one the archive was made with.
        episodes: Episodes of each.
        replicas: Which of them to record; all.
        seed: Of the episodes.
        progress: Called with the share that is done.

    Returns:
        As :func:`sim.recording.recorder.record`; a terrain an elite, in the order given.

    Raises:
        ValueError: If the controller cannot be loaded or does not fit the robot, or a number is out of range.
    """
    robot = found.robot
    return _record(
        robot,
        found.archive.genes[list(elites)],
        np.concatenate([episode_seeds(seed, elite, 1, stream=REPLAY_STREAM) for elite in elites]),
        policy=policy_of(found, robot, policy),
        labels=[f"elite {elite} of {len(found.archive):,} of {found.folder}" for elite in elites],
        device=device, episodes=episodes, replicas=replicas, seed=seed, progress=progress,
    )  # fmt: skip


def record_heights(
    robot: "RobotCfg",
    heights: NDArray[np.float32],
    *,
    label: str,
    policy: str,
    device: str,
    episodes: int = 20,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> tuple["RolloutResult", "Recording"]:
    """Crosses a terrain given by its heights and records the episodes.

    Args:
        robot: Robot settings.
        heights: [m], shape (NUM_ROWS, NUM_COLS).
        label: What the terrain is, in words.
        policy: The controller.
        device: Warp device name.
        episodes: How many.
        seed: Of the episodes.
        progress: Called with the share that is done.

    Returns:
        As :func:`sim.recording.recorder.record`, of one terrain.

    Raises:
        ValueError: If the controller cannot be loaded or does not fit the robot, or a number is out of range.
    """
    return _record(
        robot, heights[None], own_seeds(seed), policy=policy, labels=[label], device=device, episodes=episodes,
        replicas=None, seed=seed, progress=progress,
    )  # fmt: skip


def _record(
    robot: "RobotCfg",
    terrains: NDArray[np.float32],
    seeds: NDArray[np.uint32],
    *,
    policy: str,
    labels: Sequence[str],
    device: str,
    episodes: int,
    replicas: Sequence[int] | None,
    seed: int,
    progress: Callable[[float], None] | None,
) -> tuple["RolloutResult", "Recording"]:
    from sim.recording.recorder import record
    from sim.rollout import Rollout

    if episodes < 1 or seed < 0:
        raise ValueError(f"episodes must be at least 1 and seed at least 0, got {episodes} and {seed}")
    rollout = Rollout(robot, policy, num_terrains=len(terrains), num_replicas=episodes, device=device)
    return record(
        rollout, terrains, seeds, policy=policy, replicas=replicas, labels=labels, seed=seed, progress=progress
    )  # fmt: skip
