"""A recorded log of a controller, played through its contract: what its network sees or does first differs where."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kernels.observation import ANG_VEL_SCALE, JOINT_VEL_SCALE, LIN_VEL_SCALE
from sim.controllers.described import Described
from sim.controllers.loaders import load_policy
from sim.controllers.runner import reset_all
from sim.files.npz import check_shapes, read_arrays
from sim.robots.robot import RobotCfg

_NEEDS = {"scan": ("scan",), "last_action": ("action",), "lin_vel": ("lin_vel", "ang_vel"), "clock": (), "constant": ()}
_TOLERANCE = 2e-3  # of numbers that took another road, relative to their size, at least 1


def read_log(file: Path, robot: RobotCfg) -> dict[str, NDArray[np.float64]]:
    """Arrays of a log by name, of shape (num_steps, width): an npz, or a csv with columns ``joint_pos_0``, ..."""
    try:
        if file.suffix == ".csv":
            header = file.read_text(encoding="utf-8").partition("\n")[0].strip().split(",")
            values = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
            names = [name.strip().rpartition("_")[0] for name in header]
            log = {name: values[:, [k for k, other in enumerate(names) if other == name]] for name in names}
        else:
            log = {name: np.asarray(values, float) for name, values in read_arrays(file).items()}
        joints = ("steps", robot.num_joints)
        shapes = {"lin_vel": ("steps", 3), "ang_vel": ("steps", 3), "gravity": ("steps", 3), "command": ("steps", 3)}
        shapes |= {"observation": ("steps", "columns"), "action": ("steps", "actions")}
        shapes |= {"joint_pos": joints, "joint_vel": joints}
        if "observation" not in log or not log.keys() <= shapes.keys():
            raise ValueError(f"it must have observation, and some of {', '.join(shapes)}, got {', '.join(log)}")
        check_shapes(log, shapes)
    except Exception as error:  # a damaged file can fail with anything
        raise ValueError(f"{file} must be a log, an npz or csv (docs/controllers.md): {error}") from None
    return log


def print_differences(file: Path, policy: str, robot: RobotCfg) -> bool:
    """Prints what :func:`compare_log` says; returns whether something differs."""
    differences = compare_log(file, policy, robot)
    print("\n".join(differences) or f"{file} agrees with {policy}.")
    return bool(differences)


def _label_columns(controller: Described) -> list[str]:
    """What each column of the network is: ``joint_pos FL_hip``, ``ang_vel 2, 3 steps before``."""
    cfg, moved = controller.cfg, controller.cfg.joints or controller.robot.joint_names
    blocks: list[list[list[str]]] = []  # of each term, its columns at each step
    for term, width, length in zip(cfg.observation, controller.widths, controller.lengths, strict=True):
        names = (term.joints or moved) if term.term.startswith("joint") else tuple(map(str, range(width)))
        ages = [f", {age} steps before" if age else "" for age in range(length)]
        ages = ages[::-1] if cfg.history and cfg.history.newest == "last" else ages
        blocks.append([[f"{term.term} {name}{age}" for name in names] for age in ages])
    if cfg.history and cfg.history.by == "row":
        blocks = [list(rows) for rows in zip(*blocks, strict=True)]
    return [label for block in blocks for row in block for label in row]


@torch.inference_mode()
def compare_log(file: Path, policy: str, robot: RobotCfg) -> list[str]:
    """The first differences between a log and a contract, as lines; none if they agree as far as the log says.

    The log begins with an episode, and has every control step.
    """
    controller = load_policy(policy, robot, "cpu")
    if not isinstance(controller, Described):
        raise ValueError(f"--trace needs a controller.toml, whose columns have names, got {policy}")
    log = {name: torch.as_tensor(values, dtype=torch.float32) for name, values in read_log(file, robot).items()}
    observation = log["observation"]
    count, width = observation.shape
    if width != controller.observation_size:
        return [f"observation has {width} columns, those of {policy} are {controller.observation_size}"]
    if "action" in log and log["action"].shape[1] != controller.num_actions:
        return [f"action has {log['action'].shape[1]} columns, {policy} moves {controller.num_actions} joints"]
    joints, zeros = robot.num_joints, torch.zeros(count, robot.observation_size)
    pose = torch.tensor(robot.default_joint_pos)
    parts = (("lin_vel", LIN_VEL_SCALE, 3), ("ang_vel", ANG_VEL_SCALE, 3), ("gravity", 1.0, 3))
    rows = [log.get(name, zeros[:, :size]) * scale for name, scale, size in parts]
    rows.append(log.get("command", zeros[:, :3]) * torch.tensor([LIN_VEL_SCALE, LIN_VEL_SCALE, ANG_VEL_SCALE]))
    rows += [log.get("joint_pos", zeros[:, :joints]) - pose, log.get("joint_vel", zeros[:, :joints]) * JOINT_VEL_SCALE]
    row = torch.cat(rows, dim=1)
    row = torch.cat([row, zeros[:, row.shape[1] :]], dim=1)
    rebuilt, answers = torch.empty_like(observation), torch.zeros(count, controller.num_actions)
    reset_all(controller, 1)
    for step in range(count):
        rebuilt[step] = controller.observe(row[step : step + 1])[0]
        answers[step] = controller.network(observation[step : step + 1])[0]
        controller.act(log["action"][step : step + 1] if "action" in log else answers[step : step + 1])
    labels = _label_columns(controller)
    names = [label.partition(" ")[0] for label in labels]
    known = [all(need in log for need in _NEEDS.get(name, (name,))) for name in names]
    lines = []
    if unknown := [*dict.fromkeys(name for name, is_known in zip(names, known, strict=True) if not is_known)]:
        print(f"Not compared, since {file.name} lacks what they are made of: {', '.join(unknown)}.")
    compared = [("observation", rebuilt, observation, labels, torch.tensor(known))]
    if "action" in log:
        moved = [*(controller.cfg.joints or robot.joint_names)]
        compared.append(("action", answers, log["action"], moved, torch.ones(len(moved), dtype=torch.bool)))
    for what, ours, theirs, columns, mask in compared:
        differs = ((ours - theirs).abs() > _TOLERANCE * theirs.abs().clamp(min=1.0)) & mask
        if differs.any():
            step, column = (int(index) for index in torch.nonzero(differs)[0])
            size = (ours - theirs)[step, column]
            values = f"{theirs[step, column]:.4g} in the log, {ours[step, column]:.4g} by the contract"
            others = f"{int(differs.any(0).sum())} columns differ"
            ratio = ours[differs[:, column], column] / theirs[differs[:, column], column]
            if (ratio - ratio[0]).abs().max() < _TOLERANCE * ratio[0].abs():
                others += f"; it is {ratio[0]:.4g} times the log's at every step"
            lines.append(f"{what} {column} ({columns[column]}) at step {step}: {values}, off by {size:.4g}; {others}")
    return lines
