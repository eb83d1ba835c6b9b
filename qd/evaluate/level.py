"""How a controller walks over level ground: what a search of a user's robot needs, and the time that a crossing gets.

Where a controller does not cross level ground, every terrain stops it, and a search says nothing. So it is measured
before anything else, once a robot and controller, and stored beside the penalty scales as ``<name>.level.json``.
"""

import math
from collections.abc import Sequence
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

MIN_GOAL_RATE = 0.9
"""Share of episodes on level ground that reach the goal, below which a controller does not walk."""
_EPISODES = 20
_MIN_SPEED = 0.15  # a slower controller does not walk, whatever its time [m/s]
_SPARE_TIME = 1.25  # a crossing gets so many times what it takes on level ground
_DISTANCE = math.dist(CrossingCfg.start, CrossingCfg.goal)
_ENGINES: dict[str, tuple[Engine, str]] = {"searched": ("search", ""), "mujoco_c": ("mujoco_c_search", "_mujoco_c")}
_KEYS = {"episodes": "episodes", "goal": "flat_goal", "speed": "flat_speed", "height": "flat_height"}
Walks = dict[str, dict[str, float]]
"""``episodes``, ``goal``, ``speed`` and ``height`` by simulator, ``searched`` or ``mujoco_c``, as :func:`walk` says."""


def walk(crosser: Crosser, policy: str, seed: int = 0, names: Sequence[str] = tuple(_ENGINES)) -> Walks:
    """How a controller walks over level ground here, ``searched``, and in MuJoCo C, ``mujoco_c``, at the same steps.

    Each has ``episodes`` that are valid, the share ``goal`` of them that reach it, ``speed`` toward the goal until the
    end [m/s], and ``height`` of the base at the end [m]; all are 0 without a valid episode.
    """
    level = Terrains(heights=np.zeros((1, NUM_ROWS, NUM_COLS), np.float32), seeds=np.array([seed]))
    walks: Walks = {}
    for name in names:
        engine, _ = _ENGINES[name]
        result = crosser.cross(policy, level, replicas=_EPISODES, engine=engine, label="level ground", invalid_ok=True)
        valid = ~result.invalid
        end = result.final_position[valid]
        covered = _DISTANCE - np.linalg.norm(end[:, :2] - CrossingCfg.goal, axis=1)
        speed = covered / result.duration_s[valid]
        numbers = {"goal": result.reached_goal[valid], "speed": speed, "height": end[:, 2]}
        means = {key: float(values.mean()) if valid.any() else 0.0 for key, values in numbers.items()}
        walks[name] = {"episodes": int(valid.sum()), **means}
    return walks


def measure_level_ground(crosser: Crosser, policy: str, *, mujoco_c: bool = False) -> Walks:
    """How the crosser's robot walks over level ground (:func:`walk`), in MuJoCo C too if ``mujoco_c``.

    What was measured of a user's robot as it is, under this controller, is read from its file; the rest is added to it.
    """
    robot = crosser.robot
    names = [*_ENGINES] if mujoco_c else ["searched"]
    stored = _read_stored(robot, policy)
    if missing := [name for name in names if f"flat_speed{_ENGINES[name][1]}" not in stored]:
        for name, numbers in walk(crosser, policy, names=missing).items():
            stored |= {f"{_KEYS[key]}{_ENGINES[name][1]}": value for key, value in numbers.items()}
        _store(robot, policy, {**crosser.compute.origin(0), **stored})
    return {name: {key: stored[f"{file_key}{_ENGINES[name][1]}"] for key, file_key in _KEYS.items()} for name in names}


def is_measured(robot: RobotCfg, policy: str) -> bool:
    """Whether a user's robot as it is was measured on level ground under this controller."""
    return bool(_read_stored(robot, policy))


def _read_stored(robot: RobotCfg, policy: str) -> dict[str, Any]:
    """The content of the file of a robot and controller; empty if there is none of them as they are."""
    file, identity = robot.home / f"{crosser_name(robot, policy)}.level.json", controller_identity(robot, policy)
    content = read_json(file) if robot.settings_file is not None and file.exists() else {}
    return content if content and all(content.get(key) == value for key, value in identity.items()) else {}


def _store(robot: RobotCfg, policy: str, numbers: dict[str, Any]) -> None:
    """Writes the file of a user's robot under a controller that has a hash."""
    identity = controller_identity(robot, policy)
    if robot.settings_file is not None and identity["policy_sha256"] is not None:
        file = robot.home / f"{crosser_name(robot, policy)}.level.json"
        write_atomically(file, to_json({**numbers, **identity, "max_duration_s": robot.max_duration_s}))


def give_time(robot: RobotCfg, policy: str, compute: Compute) -> RobotCfg:
    """A user's robot with as much time for a crossing as its controller needs, which is printed and written.

    That is 12 m at the speed toward the goal on level ground, times 1.25, and at least 20 s. A time that its settings
    say stands; Python is not written, and nothing is of a controller that does not walk.
    """
    file = robot.settings_file
    if file is None:
        return robot
    walked = _measure(robot, policy, compute)
    if walked["speed"] < _MIN_SPEED:
        print(f"It does not walk: under {_MIN_SPEED:g} m/s toward the goal on level ground.", flush=True)
        return robot
    needed = max(RobotCfg.max_duration_s, math.ceil(10.0 * _SPARE_TIME * _DISTANCE / walked["speed"]) / 10.0)
    reason = f"{_DISTANCE:g} m at {walked['speed']:.3f} m/s, times {_SPARE_TIME:g}"
    if needed <= robot.max_duration_s:
        return robot
    if file.suffix != ".toml" or "max_duration_s" in read_toml(file):
        if walked["goal"] < MIN_GOAL_RATE:
            print(f"It may need max_duration_s = {needed:g} in {file}: {reason}.", flush=True)
        return robot
    write_setting(file, "max_duration_s", needed, reason)
    print(f"A crossing gets more time: {file} now has max_duration_s = {needed:g}, {reason}.", flush=True)
    longer = replace(robot, max_duration_s=needed)
    if walked["goal"] == 1.0:  # in the time before, so that more changes no episode
        _store(longer, policy, _read_stored(robot, policy))
    return longer


def _measure(robot: RobotCfg, policy: str, compute: Compute) -> dict[str, float]:
    """The numbers of :func:`walk` here."""
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        return measure_level_ground(crosser, policy)["searched"]


def describe_level_ground(robot: RobotCfg, policy: str, compute: Compute) -> str:
    """How a robot crosses level ground: ``20 of 20 reach the goal in 20 s, at 0.741 of 0.75 m/s``."""
    walked = _measure(robot, policy, compute)
    goals = f"{round(walked['goal'] * walked['episodes'])} of {walked['episodes']} reach the goal"
    return f"{goals} in {robot.max_duration_s:g} s, at {walked['speed']:.3f} of {robot.speed:g} m/s"


def describe_failure(robot: RobotCfg, policy: str, compute: Compute) -> str | None:
    """How a user's robot crosses level ground, if it does so in under 90 % of episodes; None of others."""
    if robot.settings_file is None or _measure(robot, policy, compute)["goal"] >= MIN_GOAL_RATE:
        return None
    return describe_level_ground(robot, policy, compute)


def refuse_unless_walks(robot: RobotCfg, policy: str, compute: Compute) -> None:
    """Raises a ValueError if a user's robot crosses level ground in under 90 % of episodes."""
    if failure := describe_failure(robot, policy, compute):
        must = f"{policy} must cross level ground in {MIN_GOAL_RATE:.0%} of episodes, else every terrain stops it"
        check = command_line("check", robot=robot.spec, policy=None if policy == str(robot.policy_file) else policy)
        remedy = f"`{check}` says why; or set max_duration_s or speed in {robot.settings_file}, or --skip-level-ground"
        raise ValueError(f"{must}; got {failure}: {remedy}")
