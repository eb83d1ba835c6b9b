"""Whether a robot and its controller are read correctly: it stands, and walks equally in both simulators."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qd.calibrate import calibrate, find_fitting_height
from qd.evaluate.dose import measure_dose
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from qd.workers.pipeline import Engine
from sim.controllers.spec import crosser_name
from sim.crossing import CrossingCfg
from sim.files.atomic import write_atomically
from sim.files.templates import open_templates
from sim.robots.describe import describe_model, describe_standing
from sim.robots.find import read_penalty_scales
from sim.robots.robot import RobotCfg
from sim.robots.stand import Standing, stand, standing_mistakes
from sim.robots.user import describe_inferred
from sim.terrains.doses import parse_doses
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.terrains import Terrains

_WALKS = 8  # episodes on flat ground in each simulator
_APART = 0.05  # share by which speeds may differ
_MAX_CONTACTS = 1_000  # a robot that has more is refused
_TEMPLATES = open_templates(Path(__file__).parent / "templates")
_RISES = (0.02, 0.04, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3)  # of kerbs and stairs [m]


def check_robot(robot: RobotCfg, policy: str | None = None, *, compute: Compute) -> bool:
    """Prints what a robot's files hold, whether it stands and walks, and which obstacles it crosses.

    Without ``policy`` it walks by the controller beside its settings. Returns whether nothing has to be mended and it
    walks equally in both simulators.
    """
    policy = policy or str(robot.policy_file)
    if has_controller := policy != str(robot.policy_file) or Path(policy).exists():
        check_policy(policy, robot, compute.device)
    print("\n\n".join(filter(None, (describe_inferred(robot), describe_model(robot)))), flush=True)
    robot, standing = _with_room(robot, compute.device, 3.0)
    print(describe_standing(robot, standing), flush=True)
    if not has_controller:
        expected = f"{policy} or a controller.toml beside {robot.settings_file}" if robot.settings_file else policy
        print(f"Without a controller, expected at {expected} or named by --policy, this is all.")
        return not [*standing_mistakes(robot, standing)]
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        if not _report_walk(robot, walk(crosser, policy)):
            return False
        height, share = find_fitting_height(crosser, policy)
    doses = parse_doses([f"{name}={','.join(map(str, _RISES))}" for name in ("step_up", "stairs_up")], ())
    name = crosser_name(robot, policy)
    out = RUNS / f"{name}-check" / "dose.json"
    dose = measure_dose(robot, {name: policy}, doses, compute=compute, terrains=4, episodes=2, seed=0, out=out)
    stairs, kerb = (_half_label(dose, name) for name in ("stairs_up", "step_up"))
    print(f"Half get over a kerb {kerb}, stairs {stairs}", end="; ")
    print(f"{share:.0%} cross hard-random terrains at --height {height:g}.")
    return not [*standing_mistakes(robot, standing)]


def ensure_ready(robot: RobotCfg, policy: str | None, compute: Compute) -> RobotCfg:
    """A user's robot with room for its contacts and the scales of its penalties; a shipped robot has both.

    Where scales are missing or older than the robot's settings or model, the given controller measures them, and they
    are written beside the settings.
    """
    if robot.settings_file is None:
        return robot
    try:
        read_penalty_scales(robot)
    except ValueError:
        policy = policy or str(robot.policy_file)
        check_policy(policy, robot, compute.device)
        print(f"There are no penalty scales of robot '{robot.name}' as it is: they are measured first.", flush=True)
        robot, _ = _with_room(robot, compute.device, 1.0)
        terrains = 1_000 if compute.device.startswith("cuda") else 100
        calibrate(robot, policy, compute=compute, terrains=terrains, replicas=4)
    return robot


def _with_room(robot: RobotCfg, device: str, seconds: float) -> tuple[RobotCfg, Standing]:
    """The robot with room for the contacts of the dropped ones, written into its settings where these are data."""
    larger = robot
    while (standing := stand(larger, device=device, seconds=seconds)).overflowed:
        if larger.nconmax >= _MAX_CONTACTS:
            raise ValueError(
                f"robot '{robot.name}' has more than {larger.nconmax} contacts: let fewer geoms touch anything"
            )
        larger = replace(larger, nconmax=2 * larger.nconmax)
    if larger is robot:
        return robot, standing
    larger = replace(robot, nconmax=max(robot.nconmax, int(np.ceil(1.5 * standing.contacts))))
    file = robot.settings_file
    if file is None or file.suffix != ".toml":
        print(f"It has too little room for contacts: write nconmax = {larger.nconmax} into its settings.", flush=True)
    else:
        text = re.sub(r"^nconmax\s*=.*\n?", "", file.read_text(), flags=re.MULTILINE)
        write_atomically(file, f"nconmax = {larger.nconmax}\n{text}".encode())
        print(f"It had too little room for contacts: {file} now has nconmax = {larger.nconmax}.", flush=True)
    return larger, standing


def walk(crosser: Crosser, policy: str, seed: int = 0) -> dict[str, dict[str, float]]:
    """How a controller walks over flat ground here, ``searched``, and in MuJoCo C, ``mujoco_c``, at the same steps.

    Each has ``episodes`` that are valid, the share ``goal`` of them that reach it, ``speed`` from the start to the end
    [m/s], and ``height`` of the base at the end [m].
    """
    flat = Terrains(heights=np.zeros((1, NUM_ROWS, NUM_COLS), np.float32), seeds=np.array([seed]))
    engines: dict[str, Engine] = {"searched": "search", "mujoco_c": "mujoco_c_search"}
    walks = {}
    for name, engine in engines.items():
        result = crosser.cross(policy, flat, replicas=_WALKS, engine=engine, label="flat ground", invalid_ok=True)
        valid = ~result.invalid
        end = result.final_position[valid]
        speed = np.linalg.norm(end[:, :2] - CrossingCfg.start, axis=1) / result.duration_s[valid]
        numbers = {"goal": result.reached_goal[valid], "speed": speed, "height": end[:, 2]}
        means = {key: float(values.mean()) if valid.any() else 0.0 for key, values in numbers.items()}
        walks[name] = {"episodes": int(valid.sum()), **means}
    return walks


def _report_walk(robot: RobotCfg, walks: dict[str, dict[str, float]]) -> bool:
    """Prints how it walks in both simulators; returns whether it does, and at the same speed."""
    slow, fast = sorted(walk["speed"] for walk in walks.values())
    reaches_goal = min(walk["goal"] for walk in walks.values()) >= FAILING_GOAL_RATE
    agree = fast - slow <= _APART * fast
    text = _TEMPLATES.get_template("walking.txt").render(
        robot=robot, walks=walks, reaches_goal=reaches_goal, agree=agree, tolerance=_APART
    )
    print(text.rstrip(), flush=True)
    return reaches_goal and agree


def _half_label(dose: dict[str, Any], element: str) -> str:
    """The rise up to which half of the robots get over an obstacle: ``of 6 cm``."""
    (half,) = (half["value"] for half in dose["half"] if half["element"] == element)
    if half is not None:
        return f"of {100 * half:.0f} cm"
    first = next(row["goal_rate"] for row in dose["dose"] if row["element"] == element)
    over = first is not None and first >= FAILING_GOAL_RATE
    return f"of over {100 * _RISES[-1]:.0f} cm" if over else f"of less than {100 * _RISES[0]:.0f} cm"
