"""A recorded log of a controller, played through its contract: what its network sees or does first differs where."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from sim.controllers.described import ROW_SCALES, Described
from sim.controllers.loaders import load_policy
from sim.controllers.runner import reset_all
from sim.files.npz import check_shapes, read_arrays
from sim.robots.robot import RobotCfg

_NEEDS = {"scan": ("scan",), "last_action": ("action",), "lin_vel": ("lin_vel", "ang_vel"), "clock": (), "constant": ()}
_MEASURED = {name: scale for name, scale in ROW_SCALES.items() if name != "last_action"}  # what a log may hold
_TOLERANCE = 2e-3  # of numbers that took another road, relative to their size, at least 1


def read_log(file: Path, robot: RobotCfg) -> dict[str, torch.Tensor]:
    """Arrays of a log by name, of shape (num_steps, width): an npz, or a csv with columns ``joint_pos_0``, ..."""
    shapes = {name: ("steps", robot.num_joints if name.startswith("joint") else 3) for name in _MEASURED}
    shapes |= {"observation": ("steps", "columns"), "action": ("steps", "actions")}
    try:
        if file.suffix == ".csv":
            header = file.read_text(encoding="utf-8").partition("\n")[0].strip().split(",")
            columns = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2).T
            parts = [name.strip().rpartition("_") for name in header]
            order = sorted(range(len(parts)), key=lambda k: int(parts[k][2]))
            names = [parts[k][0] for k in order]
            log = {name: columns[[k for k in order if parts[k][0] == name]].T for name in dict.fromkeys(names)}
        else:
            log = read_arrays(file)
        if "observation" not in log or not log.keys() <= shapes.keys():
            raise ValueError(f"it must have observation, and some of {', '.join(shapes)}, got {', '.join(log)}")
        check_shapes(log, shapes)
        if not len(log["observation"]) or not all(np.isfinite(values).all() for values in log.values()):
            raise ValueError("it must have steps, and finite numbers alone")
        return {name: torch.as_tensor(np.asarray(values, np.float32)) for name, values in log.items()}
    except Exception as error:  # a damaged file can fail with anything
        raise ValueError(f"{file} must be a log, an npz or csv (docs/controllers.md): {error}") from None


def _label_columns(controller: Described) -> list[str]:
    """What each column of the network is: ``joint_pos FL_hip``, ``ang_vel 2, 3 steps before``."""
    cfg, moved = controller.cfg, controller.cfg.joints or controller.robot.joint_names
    blocks: list[list[list[str]]] = []  # of each term, its columns at each step
    for term, width, length in zip(cfg.observation, controller.widths, controller.lengths, strict=True):
        names = (term.joints or moved) if term.term.startswith("joint") else range(width)
        ages = ["", *(f", {age} steps before" for age in range(1, length))]
        ages = ages[::-1] if cfg.history and cfg.history.newest == "last" else ages
        blocks.append([[f"{term.term} {name}{age}" for name in names] for age in ages])
    if cfg.history and cfg.history.by == "row":
        blocks = [list(rows) for rows in zip(*blocks, strict=True)]
    return [label for block in blocks for row in block for label in row]


@torch.inference_mode()
def compare_log(file: Path, policy: str, robot: RobotCfg) -> list[str]:
    """The first differences, as lines, between a contract and a log of every control step from an episode's start."""
    controller = load_policy(policy, robot, "cpu")
    if not isinstance(controller, Described):
        raise ValueError(f"--trace needs a controller.toml, whose columns have names, got {policy}")
    log = read_log(file, robot)
    for name, width in {"observation": controller.observation_size, "action": controller.num_actions}.items():
        if name in log and log[name].shape[1] != width:
            return [f"{name} has {log[name].shape[1]} columns, those of {policy} are {width}"]
    observation = log["observation"]
    quantities: list[torch.Tensor] = []
    for name, scale in _MEASURED.items():
        width = robot.num_joints if name.startswith("joint") else 3
        zeros = torch.tensor(robot.default_joint_pos if name == "joint_pos" else 0.0)
        quantities.append((log.get(name, torch.zeros(len(observation), width)) - zeros) * torch.tensor(scale))
    row = torch.cat(quantities, dim=1)
    rows = torch.nn.functional.pad(row, (0, robot.observation_size - row.shape[1])).split(1)
    rebuilt, answers = [], []
    reset_all(controller, 1)
    for row, seen, done in zip(rows, observation.split(1), log.get("action", observation).split(1), strict=True):
        rebuilt.append(controller.observe(row))
        answers.append(controller.network(seen).clone())
        controller.act(done if "action" in log else answers[-1])
    labels = _label_columns(controller)
    names = [label.partition(" ")[0] for label in labels]
    if unknown := [name for name in names if not log.keys() >= {*_NEEDS.get(name, (name,))}]:
        print(f"Not compared, since {file.name} lacks what they are made of: {', '.join(dict.fromkeys(unknown))}.")
    seen = torch.where(torch.tensor([name in unknown for name in names]), observation, torch.cat(rebuilt))
    if len(unknown) == len(names) and "action" not in log:
        return [f"{file} has nothing to compare with {policy}: give it what joints and base measured, or actions"]
    lines = _compare("observation", seen, observation, labels)
    if "action" in log:
        lines += _compare("action", torch.cat(answers), log["action"], controller.cfg.joints or robot.joint_names)
    return lines


def _compare(name: str, ours: torch.Tensor, theirs: torch.Tensor, labels: Sequence[str]) -> list[str]:
    differs = (ours - theirs).abs() > _TOLERANCE * theirs.abs().clamp(min=1.0)
    if not differs.any():
        return []
    step, column = torch.nonzero(differs)[0].tolist()
    our, their = float(ours[step, column]), float(theirs[step, column])
    ratio = our / their if their else 0.0
    same = ratio and torch.allclose(ours[:, column], ratio * theirs[:, column], rtol=_TOLERANCE, atol=_TOLERANCE)
    values = f"{their:.4g} in the log, {our:.4g} by the contract, off by {our - their:.4g}"
    line = f"{name} {column} ({labels[column]}) at step {step}: {values}; {int(differs.any(0).sum())} columns differ"
    return [line + f"; it is {ratio:.4g} times the log's at every step" * bool(same)]
