"""How a controller walks over level ground: what a search of a user's robot needs, and the time that a crossing gets.

Where it does not, every terrain stops it: measured first and once, beside the penalty scales as ``<name>.level.json``.
"""

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np

from qd.search.directory import RUNS
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser
from qd.workers.pipeline import Engine
from sim.controllers.spec import controller_identity, crosser_name
from sim.crossing import CrossingCfg
from sim.files.atomic import read_json, to_json, write_atomically
from sim.files.command import command_line
from sim.files.settings import read_toml
from sim.robots.robot import RobotCfg
from sim.robots.user import write_setting
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.terrains import Terrains

MIN_GOAL_RATE = 0.9  # share of episodes on level ground that reach the goal, below which a controller does not walk
_EPISODES = 20
_MIN_SPEED = 0.15  # a slower controller does not walk, whatever its time [m/s]
_SPARE_TIME = 1.25  # a crossing gets so many times what it takes on level ground
_DISTANCE = math.dist(CrossingCfg.start, CrossingCfg.goal)
_ENGINES: dict[str, tuple[Engine, str]] = {"searched": ("search", ""), "mujoco_c": ("mujoco_c_search", "_mujoco_c")}


def measure_level_ground(crosser: Crosser, policy: str, *, mujoco_c: bool = False) -> dict[str, Any]:
    """How a controller walks over level ground here, ``searched``, and if asked in MuJoCo C, ``mujoco_c``.

    Each has valid ``episodes``, the share ``goal`` that reaches it, ``speed`` toward the goal [m/s], and ``height`` of
    the base at the end [m]; all are 0 without a valid episode. What is known of a user's robot is read from its file.
    """
    robot = crosser.robot
    file, identity = robot.home / f"{crosser_name(robot, policy)}.level.json", controller_identity(robot, policy)
    is_stored = robot.settings_file is not None and identity["policy_sha256"] is not None
    stored: dict[str, Any] = read_json(file) if is_stored and file.exists() else {}
    stored = stored if identity.items() <= stored.items() else {**identity}
    level = Terrains(heights=np.zeros((1, NUM_ROWS, NUM_COLS), np.float32), seeds=np.zeros(1, int))
    walks: dict[str, dict[str, float]] = {}
    for name, (engine, suffix) in [*_ENGINES.items()][: 1 + mujoco_c]:
        keys = {key: f"flat_{key}{suffix}" for key in ("episodes", "goal", "speed", "height")}
        if keys["episodes"] not in stored:
            cross = {"replicas": _EPISODES, "engine": engine, "label": "level ground", "invalid_ok": True}
            result = crosser.cross(policy, level, **cross)
            valid = ~result.invalid
            end = result.final_position[valid]
            covered = _DISTANCE - np.linalg.norm(end[:, :2] - CrossingCfg.goal, axis=1)
            columns = (result.reached_goal[valid], covered / result.duration_s[valid], end[:, 2])
            means = [float(values.mean()) if valid.any() else 0.0 for values in columns]
            stored |= zip(keys.values(), [int(valid.sum()), *means], strict=True)
            if is_stored:
                write_atomically(file, to_json({**crosser.compute.origin(0), **stored}))
        walks[name] = {key: stored[column] for key, column in keys.items()}
    return walks


def give_time(robot: RobotCfg, policy: str, compute: Compute) -> RobotCfg:
    """The robot of a robot.toml with the time that a crossing needs, written there; a time that the user wrote stands.

    That is 1.25 times 12 m at its speed toward the goal on level ground, at least 20 s; nothing if it does not walk.
    """
    file = robot.settings_file
    if file is None or file.suffix != ".toml":
        return robot
    is_ours = re.search(rf"^max_duration_s = .*# {_DISTANCE:g} m at", file.read_text(encoding="utf-8"), re.MULTILINE)
    if "max_duration_s" in read_toml(file) and not is_ours:
        return robot
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        speed = measure_level_ground(crosser, policy)["searched"]["speed"]
    needed = math.ceil(10.0 * _SPARE_TIME * _DISTANCE / max(speed, _MIN_SPEED)) / 10.0
    needed = max(needed, RobotCfg.max_duration_s)
    if speed < _MIN_SPEED or abs(needed - robot.max_duration_s) < 0.02 * needed:
        return robot
    reason = f"{_DISTANCE:g} m at {speed:.3f} m/s, times {_SPARE_TIME:g}"
    write_setting(file, "max_duration_s", needed, reason)
    print(f"A crossing gets another time: {file} now has max_duration_s = {needed:g}, {reason}.", flush=True)
    return replace(robot, max_duration_s=needed)


def report_level_ground(robot: RobotCfg, policy: str | None, compute: Compute, *, must_walk: bool = False) -> None:
    """Prints how a user's robot crosses level ground; a ValueError if it ``must_walk`` and does so in under 90 %."""
    if robot.settings_file is None:
        return
    policy = policy or str(robot.policy_file)
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        walked = measure_level_ground(crosser, policy)["searched"]
    goals = round(walked["goal"] * walked["episodes"])
    speeds = f"in {robot.max_duration_s:g} s, at {walked['speed']:.3f} of {robot.speed:g} m/s"
    text = f"{robot.name} on level ground: {goals} of {_EPISODES} reach the goal {speeds}"
    if must_walk and goals < MIN_GOAL_RATE * _EPISODES:
        check = command_line("check", robot=robot.spec, policy=None if policy == str(robot.policy_file) else policy)
        remedy = f"`{check}` says why; or set max_duration_s or speed in {robot.settings_file}, or --skip-level-ground"
        raise ValueError(f"{policy} must cross level ground, else every terrain stops it. {text}: {remedy}")
    print(f"{text}{'. It does not walk' * (goals < MIN_GOAL_RATE * _EPISODES)}.", flush=True)
