"""Numbers of a model that no robot can have, and drives that the simulation would not drive as the file says."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import newton
import numpy as np

_JOINT_COLUMNS = {
    "joint_limit_lower": "range",
    "joint_limit_upper": "range",
    "joint_target_ke": "kp",
    "joint_target_kd": "kv",
    "joint_armature": "armature",
    "joint_effort_limit": "largest torque",
}
_AT_LEAST_0 = ("joint_target_ke", "joint_target_kd", "joint_armature", "joint_effort_limit")


def number_problems(builder: newton.ModelBuilder, bodies: Sequence[str], joints: Sequence[str]) -> list[str]:
    """What is wrong with masses, frames and joints, one line each.

    Args:
        builder: The robot, of which every joint but the first has one degree of freedom.
        bodies: Names of its bodies.
        joints: Names of its joints but for that of its base.
    """
    light = [name for name, mass in zip(bodies, builder.body_mass, strict=True) if not 0.0 < mass < np.inf]
    problems = [f"every body must have a mass above 0, unlike {', '.join(light)}"] if light else []
    hollow = [name for name, inertia in zip(bodies, builder.body_inertia, strict=True)
              if name not in light and not _is_inertia(inertia)]  # fmt: skip
    if hollow:
        problems.append(f"every body must have an inertia above 0 about every axis, unlike {', '.join(hollow)}")
    lost = [name for name, com in zip(bodies, builder.body_com, strict=True) if not np.isfinite(np.array(com)).all()]
    lost += [
        name for name, pose in zip(joints, builder.joint_X_p[1:], strict=True) if not np.isfinite(np.array(pose)).all()
    ]
    if lost:
        problems.append(f"position and rotation must be numbers, unlike those of {', '.join(lost)}")
    return problems + _joint_problems(builder, joints)


def _is_inertia(inertia: Any) -> bool:
    matrix = np.array(inertia, dtype=np.float64).reshape(3, 3)
    return bool(np.isfinite(matrix).all()) and float(np.linalg.eigvalsh(matrix).min()) > 0.0


def _joint_problems(builder: newton.ModelBuilder, joints: Sequence[str]) -> list[str]:
    problems = []
    for column, what in _JOINT_COLUMNS.items():
        least = 0.0 if column in _AT_LEAST_0 else -np.inf
        values = zip(joints, getattr(builder, column)[6:], strict=True)
        wrong = [f"{name} ({value:g})" for name, value in values if not value >= least]
        if wrong:
            problems.append(f"{what} must be a number{', 0 or more' * (least == 0.0)}, got {', '.join(wrong)}")
    skew = [name for name, axis in zip(joints, builder.joint_axis[6:], strict=True)
            if not abs(np.linalg.norm(np.array(axis, dtype=np.float64)) - 1.0) < 1e-3]  # fmt: skip
    return [*problems, f"axis must be a direction, unlike that of {', '.join(skew)}"] if skew else problems


def drive_problems(builder: newton.ModelBuilder, root: ET.Element, joints: Sequence[str]) -> list[str]:
    """Drives and joints that MuJoCo would move otherwise than the simulation, one line each.

    Args:
        builder: The robot.
        root: Of its file.
        joints: Names of its joints.
    """
    attributes = {name: builder.custom_attributes[f"mujoco:{name}"].values for name in _ATTRIBUTES}
    sources, biases, gears, targets = (_listed(attributes[name]) for name in _ATTRIBUTES[:4])
    direct = newton.solvers.SolverMuJoCo.CtrlSource.CTRL_DIRECT
    driven = [int(target[0]) for target, source in zip(targets, sources, strict=True) if source != direct]
    refs: Any = attributes["dof_ref"] or {}
    found = {
        "an actuator that pulls by itself": [f"number {k}" for k, source in enumerate(sources)
                                             if source == direct and any(biases[k])],
        "a gear other than 1 on an actuator": [f"number {k}" for k, gear in enumerate(gears)
                                               if sources[k] != direct and gear[0] != 1.0],
        "an actuator with a timeconst": ["<position>"] * any(drive.get("timeconst") for drive in root.iter("position")),
        "more than one actuator on a joint": [name for k, name in enumerate(joints) if driven.count(6 + k) > 1],
        "a ref other than 0": [joints[dof - 6] for dof, ref in refs.items() if dof >= 6 and ref != 0.0],
    }  # fmt: skip
    return [
        f"{what} ({', '.join(names)}) is not understood: take it out (<position>, one a joint, and <motor> are)"
        for what, names in found.items()
        if names
    ]


def _listed(values: Any) -> list[Any]:
    return list(values or ())


_ATTRIBUTES = ("ctrl_source", "actuator_biasprm", "actuator_gear", "actuator_trnid", "dof_ref")
