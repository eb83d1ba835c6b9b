"""Why a controller does not walk: robots side by side, each with one thing of the contract changed, and what is best.

A contract is what controller.toml and robot.toml say. Networks walk best by that which they were trained with.
"""

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.workers.compute import Compute
from sim.controllers.described import ROW_SCALES, ControllerCfg, Described, Term, read_controller
from sim.controllers.formats.source import collapse
from sim.controllers.spec import weights_file
from sim.files.settings import to_toml
from sim.robots.compiled import read_drives, read_robot_file, robot_spec
from sim.robots.robot import RobotCfg
from sim.trials import MEASURES, Variant, walk_variants

_FIRST_S, _SECOND_S = 3.6, 4.5  # time that robots walk in the two rounds [s]
_KEPT = 16  # changes in the second round
_EPISODES = {"cuda": (4, 16), "cpu": (1, 4)}  # of each change in the two rounds
_UNLIKELY = re.compile(r"command x \(| and \w+ x|signs of (.|...) of")  # of two things, and axes that no turn makes
_LEAST_GAIN = 0.03  # of the score for which a change is named
_WEIGHTS = {"roll_pitch_rate": 0.2, "tilt": 2.0, "action_rate": 0.4, "action": 0.05, "power": 0.4}
"""Chosen on errors planted into Go2 (robot_lab), B2, Go1 and ANYmal, on no other robot."""
_FACTORS = (0.05, 0.25, 0.5, 2.0, 4.0, 20.0, -1.0)
_ALL_PAIRS = 16  # joints up to which all pairs of them are swapped
_LIMB = re.compile(r"(?i)(?<![a-z])(fl|fr|rl|rr|hl|hr|lf|rf|lh|rh|left|right|l|r)(?![a-z])")
_GAINS = ("stiffness", "damping", "armature")


class Change(NamedTuple):
    """One thing of a contract that may be otherwise, and how robots walk with it."""

    text: str
    variant: Variant
    score: float = 0.0
    measures: NDArray[np.float64] = np.zeros(len(MEASURES))


def write_out(cfg: ControllerCfg, robot: RobotCfg) -> ControllerCfg:
    """The description with what it leaves out: joints, pose, and a number for each column and joint."""
    joints = cfg.joints or robot.joint_names
    for k, width in enumerate(Described(cfg, robot, "controller.toml").widths):
        cfg = _scale_term(cfg, k, np.ones(width))
    scale = _times(cfg.action_scale, np.ones(len(joints)))
    default = cfg.default or _select(robot.default_joint_pos, robot, joints)
    return replace(cfg, joints=joints, default=default, action_scale=scale)


def propose_changes(base: Variant) -> list[Change]:
    """Changes of one thing each, without those that change nothing; the description of ``base`` is written out."""
    descriptions = (*_change_terms(base.controller), *_change_actions(base.controller, base.robot))
    variants = [(text, replace(base, controller=cfg)) for text, cfg in descriptions]
    changes: dict[str, Change] = {repr(base): Change("nothing", base)}
    for text, variant in (*variants, *_change_drives(base)):
        changes.setdefault(repr(variant), Change(text, variant))
    return [*changes.values()][1:]


def _times(values: Any, factors: Any) -> tuple[float, ...]:
    return tuple((np.array(values, float) * factors + 0.0).tolist())


def _select(pose: Sequence[float], robot: RobotCfg, joints: Sequence[str]) -> tuple[float, ...]:
    return tuple(float(pose[robot.joint_names.index(name)]) for name in joints)


def _scale_term(cfg: ControllerCfg, k: int, factors: Any) -> ControllerCfg:
    terms = list(cfg.observation)
    terms[k] = replace(terms[k], scale=_times(terms[k].scale, factors))
    return replace(cfg, observation=tuple(terms))


def _change_terms(cfg: ControllerCfg) -> Iterator[tuple[str, ControllerCfg]]:
    """Scales, signs and order of terms, and of the history."""
    for k, term in enumerate(cfg.observation):
        factors: list[Any] = [*_FACTORS] if term.term not in ("gravity", "clock", "constant") else []
        if term.term == "command":  # as legged_gym scales it
            turns = [name == "yaw_rate" for name in (term.order or "v_x v_y yaw_rate").split()]
            factors += [tuple(np.where(turns, *pair).tolist()) for pair in ((0.25, 2.0), (4.0, 0.5))]
        for factor in factors:
            yield f"{term.term} x {factor}", _scale_term(cfg, k, factor)
        if term.term in ("lin_vel", "ang_vel", "gravity"):
            for signs in itertools.product((1.0, -1.0), repeat=3):
                axes = "".join(axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0.0)
                yield f"signs of {axes} of {term.term}", _scale_term(cfg, k, signs)
    for i, j in itertools.combinations(range(len(cfg.observation)), 2):
        terms = list(cfg.observation)
        terms[i], terms[j] = terms[j], terms[i]
        yield f"order of {terms[j].term} and {terms[i].term}", replace(cfg, observation=tuple(terms))
    for name, value in (("newest", "first"), ("newest", "last"), ("by", "row"), ("by", "term"), ("fill", "first")):
        if cfg.history is not None and not (name == "by" and len({term.history for term in cfg.observation}) > 1):
            yield f"history.{name}", replace(cfg, history=replace(cfg.history, **{name: value}))


def _change_actions(cfg: ControllerCfg, robot: RobotCfg) -> Iterator[tuple[str, ControllerCfg]]:
    """Scale, delay and pose of actions, and the order and directions of joints."""
    joints, count = list(cfg.joints or ()), len(cfg.joints or ())
    default, scale = cfg.default or (), cfg.action_scale
    for factor in (0.25, 0.5, 2.0, 4.0, -1.0):
        yield f"action_scale x {factor}", replace(cfg, action_scale=_times(scale, factor))
    for steps in range(3):
        yield "action_delay_steps", replace(cfg, action_delay_steps=steps)
    home = read_robot_file(robot.model_file).home
    for pose in filter(None, (robot.default_joint_pos, home, (0.0,) * robot.num_joints)):
        yield "default", replace(cfg, default=_select(pose, robot, joints))
    for j, joint in enumerate(joints):
        flip = np.where(np.arange(count) == j, -1.0, 1.0)
        yield f"sign of the action of {joint}", replace(cfg, action_scale=_times(scale, flip))
        turned = replace(cfg, action_scale=_times(scale, flip), default=_times(default, flip))
        for k, term in enumerate(cfg.observation):
            if term.term in ("joint_pos", "joint_vel") and term.joints is None:
                turned = _scale_term(turned, k, flip)
                yield f"sign of {term.term} of {joint}", _scale_term(cfg, k, flip)
        yield f"direction of {joint}", turned
    limbs = [match[0] if (match := _LIMB.search(name)) else "" for name in joints]
    kinds = [_LIMB.sub("", name) for name in joints]
    for i, j in itertools.combinations(range(count), 2):
        if count <= _ALL_PAIRS or kinds[i] == kinds[j] or limbs[i] == limbs[j]:
            names = [*joints[:i], joints[j], *joints[i + 1 : j], joints[i], *joints[j + 1 :]]
            yield f"order of {joints[i]} and {joints[j]}", replace(cfg, joints=tuple(names))
    by_kind, by_limb = ([groups.index(group) for group in groups] for groups in (kinds, limbs))
    for keys in (by_kind, by_limb, joints):
        yield "order of joints", replace(cfg, joints=tuple(joints[j] for j in np.argsort(keys, kind="stable")))
    different = [*dict.fromkeys(filter(None, limbs))]
    for permuted in itertools.permutations(different) if len(different) <= 4 else ():
        others = dict(zip(different, permuted, strict=True))
        names = [_LIMB.sub(lambda match, others=others: others[match[0]], name) for name in joints]
        if set(names) == set(joints):
            yield "order of limbs", replace(cfg, joints=tuple(names))


def _change_drives(base: Variant) -> Iterator[tuple[str, Variant]]:
    """Gains and delay of drives, and time steps."""
    robot = base.robot
    gains = _read_gains(robot)
    for changed, factor in itertools.product((*_GAINS, "stiffness and damping"), (0.5, 2.0)):
        names = changed.split(" and ")
        if all(gains[name].any() for name in names):
            factors = [factor if name in names else 1.0 for name in _GAINS]
            yield f"{changed} x {factor}", replace(base, gains=_times(base.gains, factors))
    for steps in (0, max(robot.decimation // 2, 1), robot.decimation, 2 * robot.decimation):
        yield "drive_delay_steps", replace(base, robot=replace(robot, drive_delay_steps=steps))
    for decimation in (robot.decimation / 2.0, 2.0 * robot.decimation):
        if decimation == int(decimation):
            yield "decimation", replace(base, robot=replace(robot, decimation=int(decimation)))


def _read_gains(robot: RobotCfg) -> dict[str, NDArray[np.float64]]:
    """Of each joint, by the names of :data:`_GAINS`; an actuator network has none but armature."""
    model = robot_spec(robot).compile()
    drives = read_drives(model)
    return dict(zip(_GAINS, (drives.stiffness, drives.damping, model.dof_armature[6:]), strict=True))


def rank_changes(base: Variant, weights: Path, *, device: str) -> list[Change]:
    """Lets robots walk with each change, and longer with the best; those, the best first, ``nothing`` among them."""
    base = replace(base, controller=write_out(base.controller, base.robot))
    changes = [Change("nothing", base), *propose_changes(base)]
    timed = zip((_FIRST_S, _SECOND_S), _EPISODES["cuda" if device.startswith("cuda") else "cpu"], strict=True)
    for seed, (seconds, episodes) in enumerate(timed):
        least = sorted(change.score for change in changes)[-_KEPT:][0]
        changes = [change for change in changes if change.score >= least or change.variant == base]
        variants = [change.variant for change in changes]
        walks = walk_variants(variants, weights, device=device, seconds=seconds, replicas=episodes, seed=seed)
        for k, (change, walk) in enumerate(zip(changes, walks, strict=True)):
            score = score_walks(walk, base.robot) - 0.02 * bool(_UNLIKELY.search(change.text))
            changes[k] = change._replace(score=score, measures=np.nan_to_num(walk).mean(axis=0))
    return sorted(changes, key=lambda change: -change.score)


def score_walks(walks: NDArray[np.float64], robot: RobotCfg) -> float:
    """How well episodes walk, by their measures (num_episodes, num_measures); more is better."""
    weights = {**_WEIGHTS, "velocity_error": 1.0 / robot.speed}
    costs = sum(weight * walks[:, MEASURES.index(name)] for name, weight in weights.items())
    return float(np.mean(-5.0 * (1.0 - walks[:, 0]) - np.nan_to_num(costs, nan=8.0)))


def explain_walk(robot: RobotCfg, policy: str, compute: Compute) -> None:
    """Prints which change of the contract makes a controller walk best, and the line that makes it."""
    path = Path(policy)
    is_data = path.suffix == ".toml"
    weights = weights_file(path) if is_data else path
    if weights is None or not weights.is_file():
        print(f"What is wrong can be found of a controller.toml or of weights, got {policy}.")
        return
    base = Variant(controller=read_controller(path) if is_data else describe_row(robot), robot=robot)
    print("\n".join(describe_ranked(base, rank_changes(base, weights, device=compute.device))), flush=True)


def describe_row(robot: RobotCfg) -> ControllerCfg:
    """The description of weights that see the robot's row (docs/controllers.md)."""
    terms = [Term(term=name, scale=scale) for name, scale in ROW_SCALES.items()]
    if robot.scan_x and robot.scan_y:
        terms.append(Term(term="scan", order="y fastest", offset=0.5, clip=1.0, scale=5.0))
    return ControllerCfg(policy="", action_scale=robot.action_scale, action_clip=100.0, observation=tuple(terms))


def describe_ranked(base: Variant, ranked: list[Change]) -> Iterator[str]:
    """Lines about the best changes: what to write where, and how robots walk with each."""
    now = next(change for change in ranked if change.text == "nothing")
    best = [change for change in ranked if change is not now][:3]
    if best[0].score < now.score + _LEAST_GAIN:
        yield "No change of one thing of its contract makes it walk better. The nearest:"
    else:
        yield f"It walks best with another {best[0].text}: {describe_setting(base, best[0].variant)}"
    for change in [*best, now]:
        numbers = dict(zip(MEASURES, change.measures, strict=True))
        walks = f"{numbers['speed']:.2f} m/s of {base.robot.speed:g}, error {numbers['velocity_error']:.2f} m/s, alive"
        setting = "" if change is now else f"; {describe_setting(base, change.variant)}"
        yield f"  {change.text}: {walks} {numbers['alive']:.0%} of the time, score {change.score:.2f}{setting}"


def describe_setting(base: Variant, variant: Variant) -> str:
    """The lines to write where a variant differs from the base, and the file."""
    gains = _read_gains(base.robot)
    factors = zip(_GAINS, variant.gains, base.gains, strict=True)
    settings = {name: _shorten(gains[name] * factor) for name, factor, former in factors if factor != former}
    settings |= _differences(base.robot, variant.robot)
    if settings:
        return "in robot.toml write " + " and ".join(f"{name} = {to_toml(value)}" for name, value in settings.items())
    before = write_out(base.controller, base.robot)
    changed = _differences(before, variant.controller)
    terms = enumerate(zip(changed.pop("observation", before.observation), before.observation, strict=True), 1)
    lines = [f"as term {k} of observation {to_toml(_plain(term))}" for k, (term, former) in terms if term != former]
    lines += [f"{name} = {to_toml(value)}" for name, value in _plain(changed).items()]
    return f"in controller.toml write {' and '.join(lines)}"


def _differences(before: Any, after: Any) -> dict[str, Any]:
    return {name: value for name, value in vars(after).items() if value != getattr(before, name)}


def _plain(value: Any) -> Any:
    """A term, a history or settings as a table, without what is left out."""
    if is_dataclass(value):
        defaults = {field.name: field.default for field in fields(value)}
        return {name: item for name, item in _plain(vars(value)).items() if item != defaults[name]}
    if isinstance(value, dict):
        return {name: _shorten(item) if name.endswith("scale") else _plain(item) for name, item in value.items()}
    return value


def _shorten(values: Any) -> Any:
    """One number in place of as many equal ones."""
    return collapse([float(f"{value:.6g}") for value in np.ravel(values)])
