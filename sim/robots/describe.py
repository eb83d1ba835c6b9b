"""What a robot's files hold and how it stood, as text for a terminal; ``templates`` has the sentences."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import newton
import numpy as np

from sim.files.templates import open_templates
from sim.robots.model import build_robot
from sim.robots.probes import measure_extents
from sim.robots.robot import RobotCfg
from sim.robots.stand import Standing, standing_mistakes
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank

_TEMPLATES = open_templates(Path(__file__).parent / "templates")
_NEAR_LOWEST = 0.015  # geoms so near to the lowest one touch the ground [m]
_TURN = 2.0 * np.pi
_FREE = 1e3  # a joint with a wider range has none [rad]
_NO_EFFORT_LIMIT = 1e5  # more is no limit [N m]
_NUM_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2}
_REACHES = (0.05, 5.0)  # farthest point of a robot from its base [m]
_MASSES = (0.1, 1000.0)  # [kg]


def describe_model(robot: RobotCfg) -> str:
    """Joints and geoms of a robot as the solver holds them, and numbers that look like other units."""
    builder = build_robot(robot)
    sim = Simulation(robot, TerrainBank(1, device="cpu"), np.zeros(1, dtype=int))
    return (
        _TEMPLATES.get_template("model.txt")
        .render(
            robot=robot,
            mass=float(sim.solver.mj_model.body_subtreemass[0]),
            num_bodies=builder.body_count,
            joints=_align([*_joint_rows(robot, sim)]),
            geoms=_align([*_geom_rows(robot, sim, builder)]),
            warnings=dict(_unit_warnings(robot, builder)),
        )
        .rstrip()
    )


def _joint_rows(robot: RobotCfg, sim: Simulation) -> Iterator[Sequence[str]]:
    """Heads and a row a joint; a joint without a drive follows another."""
    model: Any = sim.solver.mj_model
    motors = np.zeros((model.nu, 0)) if sim.motors is None else sim.motors.numpy()[:, 1:]
    heads = "joint", "default", "range [rad]", "kp", "kd", "effort", "armature", "damping", "friction"
    yield *heads, *("saturation", "speed limit [rad/s]")[: motors.shape[1]]
    drives = {int(joint): k for k, joint in enumerate(model.actuator_trnid[:, 0])}
    for k, (name, angle) in enumerate(zip(robot.joint_names, robot.default_joint_pos, strict=True), start=1):
        low, high = model.jnt_range[k]
        effort = float(model.jnt_actfrcrange[k, 1])
        kp = kd = 0.0
        text = "follows"
        limits = ["-"] * motors.shape[1]
        if (drive := drives.get(k)) is not None:
            kp = model.actuator_gainprm[drive, 0]
            kd = 0.0 - model.actuator_biasprm[drive, 2]
            if model.actuator_forcelimited[drive]:
                effort = min(effort, model.actuator_forcerange[drive, 1])
            text = f"{effort:g}" if effort < _NO_EFFORT_LIMIT else "free"
            limits = [f"{limit:g}" for limit in motors[drive]]
        span = f"{low:.2f} to {high:.2f}" if model.jnt_limited[k] else "free"
        dof = int(model.jnt_dofadr[k])
        armature, damping, friction = model.dof_armature[dof], model.dof_damping[dof], model.dof_frictionloss[dof]
        gains = f"{kp:g}", f"{kd:g}", text, f"{armature:.3g}", f"{damping:g}", f"{friction:g}"
        yield name, f"{angle:.3f}", span, *gains, *limits


def _geom_rows(robot: RobotCfg, sim: Simulation, builder: newton.ModelBuilder) -> Iterator[Sequence[str]]:
    """Heads and a row a geom."""
    model: Any = sim.solver.mj_model
    yield "geom", "role", "body", "shape", "size [m]", "friction", "time constant [s]"
    roles = {name: role for role in ("base", "foot", "limb") for name in getattr(robot, f"{role}_geoms")}
    for k, name in enumerate(builder.shape_label):
        geom = int(sim.geom_of_shape[k])
        shape = newton.GeoType(builder.shape_type[k]).name.lower()
        size = " ".join(f"{length:.3g}" for length in model.geom_size[geom][: _NUM_SIZES.get(shape, 3)])
        contact = f"{model.geom_friction[geom, 0]:g}", f"{model.geom_solref[geom, 0]:g}"
        yield name, roles.get(name, "-"), builder.body_label[builder.shape_body[k]], shape, size, *contact


def _align(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines with columns of equal width, the first one to the left."""
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [f"{name:{first}}  {'  '.join(map(str.rjust, cells, widths))}" for name, *cells in rows]


def _unit_warnings(robot: RobotCfg, builder: Any) -> Iterator[tuple[str, Any]]:
    """Names of warnings with the numbers that no legged robot has in metres, kilograms and radians."""
    masses = np.array(builder.body_mass)
    ((_, reach),) = measure_extents(builder, [robot.default_joint_pos])
    if not _REACHES[0] <= reach <= _REACHES[1]:
        yield "reach", reach
    if not _MASSES[0] <= masses.sum() <= _MASSES[1]:
        yield "mass", masses.sum()
    gyration = np.sqrt([np.linalg.eigvalsh(np.reshape(row, (3, 3)))[-1] for row in builder.body_inertia] / masses)
    if (gyration > reach).any():
        yield "gyration", [f"{builder.body_label[k]} ({gyration[k]:.3g} m)" for k in np.flatnonzero(gyration > reach)]
    angles = zip(robot.joint_names, robot.default_joint_pos, strict=True)
    if turned := [f"{name} ({angle:g})" for name, angle in angles if abs(angle) > _TURN]:
        yield "angles", turned
    low, high = (np.array(limits[6:]) for limits in (builder.joint_limit_lower, builder.joint_limit_upper))
    span = high - low
    is_wide = (span > 2.0 * _TURN) & (span < _FREE) & (np.maximum(abs(low), abs(high)) > 2.0 * _TURN)
    if is_wide.any():
        yield "ranges", [f"{robot.joint_names[k]} ({low[k]:g} to {high[k]:g})" for k in np.flatnonzero(is_wide)]


def describe_standing(robot: RobotCfg, standing: Standing) -> str:
    """How the robot stood, and what has to be mended."""
    on_ground = min(standing.bottoms.values()) + _NEAR_LOWEST
    geoms = [name for name, bottom in standing.bottoms.items() if bottom < on_ground and name not in robot.geom_names]
    return (
        _TEMPLATES.get_template("standing.txt")
        .render(robot=robot, standing=standing, mistakes=[*standing_mistakes(robot, standing)], roleless=geoms)
        .rstrip()
    )
