"""Whether a robot and its controller are read correctly, and the scales by which its penalties are added and compared.

The scale of a penalty is its mean over those episodes on hard-random terrains that did not reach the goal: one typical
failure costs about 1 of each kind. Scales are measured once, before any search, and never tuned on an archive.
"""

import math
from bisect import bisect_left
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from qd.evaluate.dose import measure_dose, parse_doses
from qd.evaluate.level import MIN_GOAL_RATE, give_time, measure_level_ground, report_level_ground
from qd.search.directory import RUNS
from qd.why import explain_walk
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from qd.workers.invalid import refuse_all_invalid
from sim.controllers.spec import controller_identity, crosser_name
from sim.crossing import CrossingCfg, resolved
from sim.files.atomic import prepare_output, read_json, to_json, write_atomically
from sim.files.templates import open_templates
from sim.robots.find import STRAY, read_penalty_scales
from sim.robots.robot import RobotCfg
from sim.robots.user import describe_inferred, write_setting
from sim.rollout import Rollout, RolloutResult
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.base import MAX_HEIGHT
from sim.terrains.spaces.registry import at_height, get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import GroundMaps, Terrains

if TYPE_CHECKING:
    from sim.robots.stand import Standing

_APART = 0.05  # share by which speeds may differ
_OFF = 0.1  # share of its command by which a speed may miss it
_MAX_CONTACTS = 1_000  # a robot that has more is refused
_TEMPLATES = open_templates(Path(__file__).parent / "templates")
_RISES = (0.02, 0.04, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3)  # of kerbs and stairs [m]
_ENOUGH = 200  # failing episodes that scales are means over; if there are fewer, all episodes are
_MAX_ROUNDS = 5  # how often as many terrains as at first are crossed
_HEIGHTS = (0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, MAX_HEIGHT)  # to choose from [m]
_CROSSED = 0.8  # share of episodes that should reach the goal
_ROUTES, _STRAY_SHARE = 100, 0.99  # on level ground, and the share of their displacements that is no straying
_TRIED = 100  # hard-random terrains at a height, one episode each: terrains differ more than their episodes


def check_robot(robot: RobotCfg, policy: str | None = None, *, compute: Compute, why: bool = False) -> bool:
    """Prints what a robot's files hold, how it stands and walks, and what it crosses; returns whether all is well.

    If it walks badly, or with ``why``, the change of its contract is named with which it walks best.
    """
    from sim.robots.stand import describe_model  # loads Newton, which takes seconds

    policy = policy or str(robot.policy_file)
    if has_controller := policy != str(robot.policy_file) or Path(policy).exists():
        check_policy(policy, robot, compute.device)
    print("\n\n".join(filter(None, (describe_inferred(robot), describe_model(robot)))), flush=True)
    standing = _stand_with_room(robot, compute.device, 3.0)
    robot = standing.robot
    print(standing.describe(), flush=True)
    if not has_controller:
        expected = f"{policy} or a controller.toml beside {robot.settings_file}" if robot.settings_file else policy
        print(f"Without a controller, expected at {expected} or named by --policy, this is all.")
        return not standing.mistakes
    robot = give_time(robot, policy, compute)
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        walks = measure_level_ground(crosser, policy, mujoco_c=True)
        slow, fast = sorted(walk["speed"] for walk in walks.values())
        reaches_goal = min(walk["goal"] for walk in walks.values()) >= MIN_GOAL_RATE
        agree = fast - slow <= _APART * fast
        content = {"robot": robot, "walks": walks, "reaches_goal": reaches_goal, "agree": agree, "tolerance": _APART}
        print(_TEMPLATES.get_template("walking.txt").render(content).rstrip(), flush=True)
        if why or not (reaches_goal and agree) or abs(slow - robot.speed) > _OFF * robot.speed:
            explain_walk(robot, policy, compute)
        if not (reaches_goal and agree):
            return False
        height, share = find_fitting_height(crosser, policy)
    doses = parse_doses([f"{name}={','.join(map(str, _RISES))}" for name in ("step_up", "stairs_up")], ())
    name = crosser_name(robot, policy)
    out = RUNS / f"{name}-check" / "dose.json"
    dose = measure_dose(robot, {name: policy}, doses, compute=compute, terrains=4, episodes=2, seed=0, out=out)
    stairs, kerb = (_half_label(dose, name) for name in ("stairs_up", "step_up"))
    print(f"Half get over a kerb {kerb}, stairs {stairs}", end="; ")
    print(f"{share:.0%} cross hard-random terrains at --height {height:g}.")
    return not standing.mistakes


def ensure_ready(robot: RobotCfg, policy: str | None, compute: Compute, *, skip_level_ground: bool = False) -> RobotCfg:
    """A user's robot with room for contacts, time for a crossing, and penalty scales; a shipped robot has all.

    Scales that are missing or older than its settings or model are measured with the given controller, and written. A
    controller that does not cross level ground is refused before, unless ``skip_level_ground``.
    """
    if robot.settings_file is None:
        return robot
    policy = policy or str(robot.policy_file)
    try:
        read_penalty_scales(robot)
    except ValueError:
        check_policy(policy, robot, compute.device)
        robot = give_time(_stand_with_room(robot, compute.device, 1.0).robot, policy, compute)
        report_level_ground(robot, policy, compute, must_walk=not skip_level_ground)
        print(f"There are no penalty scales of robot '{robot.name}' as it is: they are measured first.", flush=True)
        calibrate(robot, policy, compute=compute, terrains=4_000 if compute.on_gpu else 400, replicas=1)
    else:
        report_level_ground(robot, policy, compute, must_walk=not skip_level_ground)
    return robot


def ensure_stray(robot: RobotCfg, policy: str | None, compute: Compute) -> None:
    """Measures how far routes may be missed, and writes it to the penalty scales, if they do not say it."""
    content = read_json(robot.scales_file)
    missing = {key: is_resolved for is_resolved, key in STRAY.items() if key not in content}
    if missing:
        print(f"How well robot '{robot.name}' follows commands on level ground is measured first.", flush=True)
        policy = policy or str(robot.policy_file)
        measured = {key: measure_stray(robot, policy, compute.device, resolve=by) for key, by in missing.items()}
        write_atomically(robot.scales_file, to_json(content | measured | {"stray_routes": _ROUTES}))


def measure_stray(robot: RobotCfg, policy: str, device: str, *, resolve: bool = False) -> float:
    """How far displacements over two seconds are from those commanded on level ground [m]: 99 % are nearer.

    They are of hard-random routes, one episode each, at every control step before it ends; in the search's physics or,
    to ``resolve`` contact, in finer one.
    """
    solver = None
    if resolve:
        robot, solver = resolved(robot)
    space = get_space(f"{SUPER_GAUSSIAN.name}+command")
    rows = space.condition_rows(space.hard_random(_ROUTES, 0))
    ground = replace(GroundMaps.plain(_ROUTES), conditions=rows)
    seeds = np.random.SeedSequence(0).generate_state(_ROUTES, np.uint32)
    terrains = Terrains(heights=np.zeros((_ROUTES, NUM_ROWS, NUM_COLS), np.float32), seeds=seeds, ground=ground)
    how: Any = {"num_terrains": _ROUTES, "replicas": 1, "cfg": CrossingCfg(stray_m=math.inf), "with_conditions": True}
    rollout, errors = Rollout(robot, policy, device=device, solver=solver, **how), list[NDArray[np.float32]]()
    assert rollout.trail is not None
    trail = rollout.trail

    def watch(after: bool) -> None:
        if not after:
            error, running = trail.error.numpy(), rollout.outcome.numpy() == Outcome.RUNNING
            errors.append(error[running & (error > 0.0)])

    rollout.watch = watch
    rollout.evaluate(terrains)
    if not sum(map(len, errors)):
        raise ValueError(
            f"robot '{robot.name}' must stay up for two seconds on level ground to follow routes, got none"
        )
    return float(np.quantile(np.concatenate(errors), _STRAY_SHARE))


def _stand_with_room(robot: RobotCfg, device: str, seconds: float) -> "Standing":
    """Stands the robot with room for the dropped ones' contacts, which is written into settings that are data."""
    from sim.robots.stand import stand

    tried = robot
    while (standing := stand(tried, device=device, seconds=seconds)).overflowed:
        if tried.nconmax >= _MAX_CONTACTS:
            problem = f"has more than {tried.nconmax} contacts: let fewer geoms touch anything"
            raise ValueError(f"robot '{robot.name}' {problem}")
        tried = replace(tried, nconmax=2 * tried.nconmax)
    if tried is robot:
        return standing
    larger = replace(robot, nconmax=max(robot.nconmax, int(np.ceil(1.5 * standing.contacts))))
    file = robot.settings_file
    if file is None or file.suffix != ".toml":
        print(f"It has too little room for contacts: write nconmax = {larger.nconmax} into its settings.", flush=True)
    else:
        write_setting(file, "nconmax", larger.nconmax)
        print(f"It had too little room for contacts: {file} now has nconmax = {larger.nconmax}.", flush=True)
    return replace(standing, robot=larger)


def _half_label(dose: dict[str, Any], element: str) -> str:
    """The rise up to which half of the robots get over an obstacle: ``of 6 cm``."""
    (half,) = (half for half in dose["half"] if half["element"] == element)
    if half["value"] is not None:
        return f"of {100 * half['value']:.0f} cm"
    bounds = {"first": f"less than {100 * _RISES[0]:.0f} cm", "last": f"over {100 * _RISES[-1]:.0f} cm"}
    return f"of {bounds.get(half['beyond'], 'unknown height, since episodes are invalid')}"


def find_fitting_height(crosser: Crosser, policy: str, *, room: int = 0) -> tuple[float, float]:
    """The largest height [m] at which a controller crosses 80 % of hard-random terrains, and the share at that height.

    ``room`` is for terrains of a later call, as :meth:`qd.workers.crosser.Crosser.cross` has it.
    On terrain of the shipped heights a small robot, or one that learned on flat ground, would fail everywhere.
    """
    shares = dict[float, float]()

    def fails(height: float) -> bool:
        label = f"hard-random terrains of height {height:g} m"
        result = crosser.cross(policy, _draw_terrains(_TRIED, height), replicas=1, label=label, room=room)
        refuse_all_invalid(result)
        shares[height] = float(result.reached_goal[~result.invalid].mean())
        print(f"Height {height:g} m: {shares[height]:.0%} of episodes reach the goal.", flush=True)
        return shares[height] < _CROSSED

    last = len(_HEIGHTS) - 1
    highest = bisect_left(_HEIGHTS, True, hi=last, key=fails) - 1 if fails(_HEIGHTS[last]) else last
    height = _HEIGHTS[max(highest, 0)]
    return height, shares[height]


def _draw_terrains(count: int, height: float | None) -> Terrains:
    """Hard-random terrains of one space, for one simulation; the first ones of more are those of fewer."""
    seeds = np.random.SeedSequence(0).generate_state(count, np.uint32)
    genes = SUPER_GAUSSIAN.hard_random(count, 0)
    return Terrains(genes=genes if height is None else SUPER_GAUSSIAN.scaled(genes, height / MAX_HEIGHT), seeds=seeds)


def calibrate(robot: RobotCfg, policy: str, *, compute: Compute, terrains: int, replicas: int) -> dict[str, Any]:
    """Measures the penalty scales of a robot with a controller and writes them where a search reads them; returns all.

    ``terrains`` hard-random ones, for a user's robot of the height that fits, are crossed in each of up to five rounds,
    until 200 episodes have missed the goal. If fewer miss it, all episodes give the scales. A penalty that never
    occurred is a ValueError, once the others' are written; but in a robot.toml, which names all, its scale is 1.
    """
    out = robot.scales_file
    prepare_output(out)
    results: list[RolloutResult] = []
    with Crosser(robot, compute, cache=RUNS / "crossings") as crosser:
        room = terrains if replicas == 1 else 0
        height = None if robot.settings_file is None else find_fitting_height(crosser, policy, room=room)[0]
        drawn = _draw_terrains(_MAX_ROUNDS * terrains, height)
        for first in range(0, len(drawn), terrains):
            label = f"hard-random terrains from {first + 1:,}"
            results.append(crosser.cross(policy, drawn[first : first + terrains], replicas=replicas, label=label))
            scales = measure_scales(RolloutResult.join(results))
            if scales["failing_episodes"] >= _ENOUGH:
                break
            print("{failing_episodes} of {episodes} episodes did not reach the goal.".format(**scales), flush=True)
    report = {
        **compute.origin(0),
        **controller_identity(robot, policy),
        "space": at_height(SUPER_GAUSSIAN, height or MAX_HEIGHT).name,
        "crossing": asdict(CrossingCfg()) | {"speed": robot.speed, "max_duration_s": robot.max_duration_s},
        **scales,
    }
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
        remedy = f"leave them out of the robot's penalties; the scales in {out} are of the others"
        raise ValueError(f"penalties must occur in some episode, got 0 of {', '.join(absent)}: {remedy}")
    return report


def measure_scales(result: RolloutResult) -> dict[str, Any]:
    """The scales and what they are means over, as JSON values; a penalty that never occurs has no scale."""
    valid = ~result.invalid
    failing = valid & ~result.reached_goal
    by_failing = int(failing.sum()) >= _ENOUGH
    rows = np.asarray(result.penalties, np.float64)[failing if by_failing else valid]
    means = dict(zip(result.penalty_names, rows.mean(axis=0).tolist(), strict=True))
    return {
        "terrains": len(valid),
        "episodes": int(valid.size),
        "invalid_episodes": int(valid.size - valid.sum()),
        "failing_episodes": int(failing.sum()),
        "scaled_by": "failing" if by_failing else "all",
        "scales": {name: mean for name, mean in means.items() if mean},
        "share_of_episodes_with": dict(zip(result.penalty_names, (rows > 0.0).mean(axis=0).tolist(), strict=True)),
    }
