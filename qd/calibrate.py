"""Penalty scales: the mean of each raw penalty where a crossing fails, so that penalties can be added and compared.

The scale of a penalty is its mean over those episodes on hard-random terrains that did not reach the goal: one typical
failure costs about 1 of each kind. Scales are measured once with the shipped controller, before any search, and never
tuned on an archive.
"""

from bisect import bisect_left
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.search.directory import RUNS
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser
from qd.workers.invalid import refuse_all_invalid
from qd.workers.shards import join_results
from sim.controllers.spec import controller_identity
from sim.crossing import CrossingCfg
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.robots.robot import RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.spaces.base import MAX_HEIGHT
from sim.terrains.spaces.registry import at_height
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains

_ENOUGH = 200  # failing episodes that scales are means over; if there are fewer, all episodes are
_MAX_ROUNDS = 5  # how often as many terrains as at first are crossed
_HEIGHTS = (0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, MAX_HEIGHT)  # to choose from [m]
_CROSSED = 0.8  # share of episodes that should reach the goal
_TRIED = 100  # hard-random terrains at a height, one episode each: terrains differ more than their episodes


def find_fitting_height(crosser: Crosser, policy: str) -> tuple[float, float]:
    """The largest height [m] at which a controller crosses 80 % of hard-random terrains, and the share at that height.

    Terrain of the shipped heights is for robots half a metre high: a smaller one, or one that learned to walk on flat
    ground, fails everywhere on it, and a search says nothing. The least height is 2 cm.
    """
    genes = SUPER_GAUSSIAN.hard_random(_TRIED, 0)
    seeds = np.random.SeedSequence(0).generate_state(_TRIED, np.uint32)
    shares = dict[float, float]()

    def fails(height: float) -> bool:
        terrains = Terrains(genes=genes, seeds=seeds, space=at_height(SUPER_GAUSSIAN, height))
        result = crosser.cross(policy, terrains, replicas=1, label=f"hard-random terrains of height {height:g} m")
        refuse_all_invalid(result)
        shares[height] = float(result.reached_goal[~result.invalid].mean())
        print(f"Height {height:g} m: {shares[height]:.0%} of episodes reach the goal.", flush=True)
        return shares[height] < _CROSSED

    highest = last = len(_HEIGHTS) - 1
    if fails(_HEIGHTS[last]):
        highest = bisect_left(_HEIGHTS, True, hi=last, key=fails) - 1
    height = _HEIGHTS[max(highest, 0)]
    return height, shares[height]


def calibrate(robot: RobotCfg, policy: str, *, compute: Compute, terrains: int, replicas: int) -> dict[str, Any]:
    """Measures the penalty scales of a robot with a controller and writes them where a search reads them.

    Terrains of a user's robot are of the height that fits (:func:`find_fitting_height`). ``terrains`` hard-random ones
    are crossed in each of up to five rounds, until 200 episodes have missed the goal. If fewer miss it, all episodes
    give the scales. A penalty that never occurred is a ValueError, once the others' scales are written; but in a
    robot.toml, which names all that could occur, it has the scale 1. Returns the content of the file.
    """
    space, out, count = SUPER_GAUSSIAN, robot.scales_file, _MAX_ROUNDS * terrains
    prepare_output(out)
    # Both are drawn row by row, so the first 1,000 of 5,000 are those that a draw of 1,000 gives.
    genes = space.hard_random(count, 0)
    seeds = np.random.SeedSequence(0).generate_state(count, np.uint32)
    results: list[RolloutResult] = []
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        if robot.settings_file is not None:
            space = at_height(space, find_fitting_height(crosser, policy)[0])
        for first in range(0, count, terrains):
            rows = slice(first, first + terrains)
            drawn = Terrains(genes=genes[rows], seeds=seeds[rows], space=space)
            label = f"hard-random terrains from {first + 1:,}"
            results.append(crosser.cross(policy, drawn, replicas=replicas, label=label))
            result = join_results(results, join=1)
            if (num_failing := _failing(result).sum()) >= _ENOUGH:
                break
            print(f"{num_failing} of {result.invalid.size} episodes did not reach the goal.", flush=True)
    origin = {**compute.origin(0), **controller_identity(robot, policy), "space": space.name}
    crossing = asdict(CrossingCfg()) | {"speed": robot.speed, "max_duration_s": robot.max_duration_s}
    report = {**origin, "crossing": crossing, **measure_scales(result)}
    absent = [name for name in robot.penalties if name not in report["scales"]]
    if absent and robot.settings_file is not None and robot.settings_file.suffix == ".toml":
        print(f"{', '.join(absent)} never occurred: its scale is 1.")
        report["scales"] |= dict.fromkeys(absent, 1.0)
        absent = []
    print(f"Means over {report['scaled_by']} episodes, {report['failing_episodes']} of {report['episodes']} fail:")
    for name, scale in report["scales"].items():
        print(f"  {name:<14}{scale:12.4f}  (in {report['share_of_episodes_with'][name]:.1%} of them)")
    write_atomically(out, to_json(report))
    print(f"Written to {out}.")
    if absent:
        raise ValueError(
            f"penalties must occur in some episode, got 0 of {', '.join(absent)}: leave them out of the robot's "
            f"penalties; the scales in {out} are of the others"
        )
    return report


def _failing(result: RolloutResult) -> NDArray[np.bool_]:
    """Episodes that are valid and did not reach the goal, shape (T, R)."""
    return ~result.invalid & ~result.reached_goal


def measure_scales(result: RolloutResult) -> dict[str, Any]:
    """The scales and what they are means over, as JSON values; a penalty that never occurs has no scale."""
    failing, valid = _failing(result), ~result.invalid
    by_failing = int(failing.sum()) >= _ENOUGH
    rows = np.asarray(result.penalties, np.float64)[failing if by_failing else valid]
    means = dict(zip(result.penalty_names, rows.mean(axis=0).tolist(), strict=True))
    shares = (rows > 0.0).mean(axis=0).tolist()
    return {
        "terrains": len(valid),
        "episodes": int(valid.size),
        "invalid_episodes": int(valid.size - valid.sum()),
        "failing_episodes": int(failing.sum()),
        "scaled_by": "failing" if by_failing else "all",
        "scales": {name: mean for name, mean in means.items() if mean},
        "share_of_episodes_with": dict(zip(result.penalty_names, shares, strict=True)),
    }
