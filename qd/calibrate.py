"""Penalty scales: what each raw penalty comes to where a crossing fails, so that the six can be added and compared.

The scale of a penalty is its mean over those episodes on hard-random terrains that did not reach the goal: one typical
failure costs about 1 of each kind. Scales are measured once with the shipped controller, before any search, and never
tuned on an archive.
"""

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
from sim.terrains.spaces.base import MOST_HEIGHT
from sim.terrains.spaces.registry import at_height
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains

_ENOUGH = 200  # failing episodes that scales are means over; with fewer, even of the most terrains, all episodes are
_MOST = 5  # times as many terrains as to begin with
_FEW = 30  # of those episodes, how many at least a penalty should occur in
_HEIGHTS = (0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, MOST_HEIGHT)
"""Heights to choose from [m]."""
_CROSSED = 0.8  # share of episodes that should reach the goal
_TRIED = 100  # hard-random terrains at a height, one episode each: terrains differ more than their episodes


def fitting_height(crosser: Crosser, policy: str) -> tuple[float, float]:
    """The largest height [m] at which a controller crosses 80 % of hard-random terrains, and how many it does there.

    Terrain of the shipped heights is for robots half a metre high: a smaller one, or one that learned to walk on flat
    ground, fails everywhere on it, and a search says nothing. The least height is 2 cm.
    """
    genes = SUPER_GAUSSIAN.hard_random(_TRIED, 0)
    seeds = np.random.SeedSequence(0).generate_state(_TRIED, np.uint32)
    low, high, shares = 0, len(_HEIGHTS), dict[float, float]()
    while low < high:  # those before low are crossed, those from high on are not; the highest first
        middle = high - 1 if high == len(_HEIGHTS) else (low + high) // 2
        height = _HEIGHTS[middle]
        terrains = Terrains(genes=genes, seeds=seeds, space=at_height(SUPER_GAUSSIAN, height))
        result = crosser.cross(policy, terrains, replicas=1, label=f"hard-random terrains of height {height:g} m")
        refuse_all_invalid(result)
        shares[height] = reached = float(result.reached_goal[~result.invalid].mean())
        print(f"Height {height:g} m: {reached:.0%} of episodes reach the goal.", flush=True)
        low, high = (middle + 1, high) if reached >= _CROSSED else (low, middle)
    return (height := _HEIGHTS[max(low - 1, 0)]), shares[height]


def calibrate(robot: RobotCfg, policy: str, *, compute: Compute, terrains: int, replicas: int) -> dict[str, Any]:
    """Measures the penalty scales of a robot with a controller and writes them where a search reads them.

    Terrains of a user's robot are of the height that fits (:func:`fitting_height`). So many hard-random ``terrains``
    are crossed to begin with. As many again are drawn until 200 episodes have missed the goal, up to five times as
    many. With fewer failing episodes even then, all episodes give the scales. A penalty that never occurred is a
    ValueError, once the others' scales are written; one of a robot.toml, whose penalties are all that could occur, has
    the scale 1. Returns the content of the file.
    """
    space, out, most = SUPER_GAUSSIAN, robot.scales_file, _MOST * terrains
    prepare_output(out)
    # Both are drawn row by row: of 5,000 the first 1,000 are those that 1,000 would be.
    genes = space.hard_random(most, 0)
    seeds = np.random.SeedSequence(0).generate_state(most, np.uint32)
    results: list[RolloutResult] = []
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        if robot.settings_file is not None:
            space = at_height(space, fitting_height(crosser, policy)[0])
        for first in range(0, most, terrains):
            rows = slice(first, first + terrains)
            drawn = Terrains(genes=genes[rows], seeds=seeds[rows], space=space)
            label = f"hard-random terrains from {first + 1:,}"
            results.append(crosser.cross(policy, drawn, replicas=replicas, label=label))
            result = join_results(results, join=1)
            if (count := _failing(result).sum()) >= _ENOUGH:
                break
            print(f"{count} of {result.invalid.size} episodes did not reach the goal.", flush=True)
    origin = {**compute.origin(0), **controller_identity(robot, policy), "space": space.name}
    crossing = asdict(CrossingCfg()) | {"speed": robot.speed, "max_duration_s": robot.max_duration_s}
    report = {**origin, "crossing": crossing, **measured(result)}
    absent = [name for name in robot.penalties if name not in report["scales"]]
    if absent and robot.settings_file is not None and robot.settings_file.suffix == ".toml":
        print(f"{', '.join(absent)} never occurred, and is left as it is: its scale is 1.")
        report["scales"] |= dict.fromkeys(absent, 1.0)
        absent = []
    _print_scales(report)
    write_atomically(out, to_json(report))
    print(f"Written to {out}.")
    if absent:
        raise ValueError(
            f"penalties must occur in the episodes that scales are means over, got 0 of {', '.join(absent)}: leave "
            f"them out of the robot's penalties, for which the scales in {out} fit"
        )
    return report


def _failing(result: RolloutResult) -> NDArray[np.bool_]:
    """Episodes that are valid and did not reach the goal, shape (T, R)."""
    return ~result.invalid & ~result.reached_goal


def measured(result: RolloutResult) -> dict[str, Any]:
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


def _print_scales(report: dict[str, Any]) -> None:
    failing, valid = report["failing_episodes"], report["episodes"] - report["invalid_episodes"]
    count = failing if report["scaled_by"] == "failing" else valid
    about = f"{report['terrains']} terrains ({failing} of {valid} valid episodes did not reach the goal)"
    print(f"Means over {count} {report['scaled_by']} episodes on {about}:")
    for name, scale in report["scales"].items():
        hits = round(report["share_of_episodes_with"][name] * count)
        print(f"  {name:<14}{scale:12.4f}{f'  (in {hits} episodes alone)' if hits < _FEW else ''}")
