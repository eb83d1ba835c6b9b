"""Whether a robot stands, how many contacts it has when it lies, and what its files hold, as text of ``templates``."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from sim.crossing import CAPACITY_OVERFLOWS
from sim.files.templates import open_templates
from sim.robots.compiled import read_drives
from sim.robots.model import build_robot
from sim.robots.probes import measure_extents, start_height
from sim.robots.robot import RobotCfg
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank, make_heights
from sim.terrains.hand_crafted import SPACING
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

_GRAVITY = 9.81
_TERRAINS = 4
_CLEARANCE = 61  # nodes: a dropped robot starts above the highest ground 1.5 m round it
_UPRIGHT_DEG = 15.0
_STRAY = 0.1  # share of the weight that geoms without a role may carry
_SUNK = 0.005  # deeper than this in the ground at the start is a mistake [m]
_FALL = 0.1  # a start so much above the right one is a mistake [m]
_REST_S = 0.5  # the end of the time that a robot stands, at which it should rest
_RESTLESS = 0.1  # feet whose force changes by more than this share of the weight a step, on average, bounce
_TEMPLATES = open_templates(Path(__file__).parent / "templates")
_NEAR_LOWEST = 0.015  # geoms so near to the lowest one touch the ground [m]
_TURN = 2.0 * np.pi
_FREE = 1e3  # a joint with a wider range has none [rad]
_NO_EFFORT_LIMIT = 1e5  # more is no limit [N m]
_NUM_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2}
_REACHES = (0.05, 5.0)  # farthest point of a robot from its base [m]
_MASSES = (0.1, 1000.0)  # [kg]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a robot stood in its default pose, and how the dropped ones lay."""

    robot: RobotCfg
    height: tuple[float, float]  # height of the base at the start and at the end [m]
    right_height: float  # lowest height of the base at which no foot starts in the ground [m]
    bottoms: dict[str, float]  # lowest point of each geom at the start, over the ground [m]
    tilt_deg: float  # tilt of the base at the end
    joint_error: float  # largest distance of a joint from its default angle at the end [rad]
    lowest_geom: str  # at the start
    foot_gap: float  # height of the lowest foot over the ground at the start [m]; negative in the ground
    carried: dict[str, float]  # share of the weight on each touching geom, on average over the last half second
    restless: float  # how much the forces on its feet change from one physics step to the next in that time, in weights
    contacts: int  # largest number of contacts of a robot
    overflowed: bool  # whether there was too little room for contacts, at any time
    finite: bool  # whether all states are numbers at the end

    @property
    def stands(self) -> bool:
        """Whether it is upright, off its belly, and on the ground."""
        upright = self.finite and self.tilt_deg < _UPRIGHT_DEG and self.height[1] > 0.5 * self.height[0]
        return upright and self.stray < 0.5

    @property
    def stray(self) -> float:
        """Share of the weight that is on geoms without a role, or on nothing."""
        return 1.0 - sum(self.carried.values())

    @property
    def mistakes(self) -> list[str]:
        """Names of what has to be mended, as ``templates/standing.txt`` explains them."""
        height, end_height = self.height
        checks = {
            "sunk": self.foot_gap < -_SUNK,
            "falls": height > self.right_height + _FALL,
            "feet are not lowest": self.lowest_geom not in self.robot.foot_geoms,
            "weight without a role": self.finite and end_height > 0.5 * height and self.stray > _STRAY,
            "not finite": not self.finite,
            "bounces": self.stands and self.restless > _RESTLESS,
            "contacts": self.overflowed,
        }
        return [name for name, is_wrong in checks.items() if is_wrong]

    def describe(self) -> str:
        """How the robot stood, and what has to be mended."""
        on_ground = min(self.bottoms.values()) + _NEAR_LOWEST
        roleless = [name for name, z in self.bottoms.items() if z < on_ground and name not in self.robot.geom_names]
        return _TEMPLATES.get_template("standing.txt").render(standing=self, roleless=roleless).rstrip()


def stand(robot: RobotCfg, *, device: str, seconds: float = 3.0, drops: int = 32) -> Standing:
    """Stands one robot on flat ground for ``seconds`` and drops ``drops`` others in drawn poses on drawn terrains."""
    bank = TerrainBank(1 + _TERRAINS, device=device)
    rough = make_heights(SUPER_GAUSSIAN.hard_random(_TERRAINS, 0))
    heights = np.concatenate([np.zeros_like(rough[:1]), rough])
    bank.set_heights(heights)
    terrains = np.concatenate([[0], 1 + np.arange(drops) % _TERRAINS])
    sim = Simulation(robot, bank, terrains)
    start = np.zeros((1 + drops, 7 + robot.num_joints), dtype=np.float32)
    start[:, :3] = 8.0, 4.0, robot.default_base_height
    start[:, 6] = 1.0
    start[:, 7:] = robot.default_joint_pos
    sim.targets.assign(start)
    rng = np.random.default_rng(0)
    start[1:, :2] = rng.uniform([5.0, 2.0], [11.0, 6.0], (drops, 2))
    turns = rng.normal(size=(drops, 4))
    start[1:, 3:7] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    builder = build_robot(robot)
    ((bottoms, reach),) = measure_extents(builder, [robot.default_joint_pos])
    highest = maximum_filter(heights, size=(1, _CLEARANCE, _CLEARANCE))
    column, row = np.rint(start[1:, :2].T / SPACING).astype(int)
    start[1:, 2] = reach + highest[terrains[1:], row, column].astype(np.float64)
    sim.joint_q.assign(start)
    contacts, overflowed, forces = _let_fall(sim, seconds)
    end = sim.joint_q.numpy()[0].astype(np.float64)
    up = 1.0 - 2.0 * (end[3] ** 2 + end[4] ** 2)
    weight = float(sim.model.body_mass.numpy().sum()) * _GRAVITY
    on_feet = forces[:, [name in robot.foot_geoms for name in robot.geom_names]] / weight
    shares = zip(robot.geom_names, forces.mean(axis=0) / weight, strict=True)
    bottoms = {name: robot.default_base_height + bottom for name, bottom in bottoms.items()}
    return Standing(
        robot=robot,
        height=(robot.default_base_height, float(end[2])),
        right_height=start_height(robot, builder),
        bottoms=bottoms,
        lowest_geom=min(bottoms, key=bottoms.__getitem__),
        foot_gap=min(bottoms[name] for name in robot.foot_geoms),
        tilt_deg=float(np.degrees(np.arccos(np.clip(up, -1.0, 1.0)))),
        joint_error=float(np.abs(end[7:] - robot.default_joint_pos).max(initial=0.0)),
        carried={name: float(share) for name, share in shares if share > 1e-3},
        restless=float(np.abs(np.diff(on_feet, axis=0)).sum(axis=1).mean()),
        contacts=contacts,
        overflowed=overflowed,
        finite=bool(np.isfinite(sim.joint_q.numpy()).all() and np.isfinite(sim.joint_qd.numpy()).all()),
    )


def _let_fall(sim: Simulation, seconds: float) -> tuple[int, bool, NDArray[np.float64]]:
    """Largest number of contacts, overflow, and the first robot's vertical forces in the last steps [N]."""
    start = sim.joint_q.numpy().copy()

    def launch() -> None:
        sim.physics_step()
        sim.read_geom_forces()

    graph = sim.capture(launch)  # makes steps of its own
    sim.joint_q.assign(start)
    sim.joint_qd.zero_()
    sim.clear_solver(wp.ones(sim.num_envs, dtype=int, device=sim.device))
    contacts, overflowed = 0, False
    forces: list[NDArray[np.float32]] = []
    num_steps = max(1, round(seconds / sim.robot.physics_dt))
    num_at_rest = max(2, round(_REST_S / sim.robot.physics_dt))
    for step in range(num_steps):
        sim.launch(graph)
        if step >= num_steps - num_at_rest:
            forces.append(sim.geom_force.numpy()[0][:, 2].copy())
        if step % sim.robot.decimation == 0:
            contacts = max(contacts, int(sim.contacts.count.numpy().max()))
            overflowed |= bool((sim.overflow.numpy() & CAPACITY_OVERFLOWS).any())
    return contacts, overflowed, np.array(forces, dtype=np.float64)


def describe_model(robot: RobotCfg) -> str:
    """Joints and geoms of a robot as the solver holds them, and numbers that look like other units."""
    builder = build_robot(robot)
    sim = Simulation(robot, TerrainBank(1, device="cpu"), np.zeros(1, dtype=int))
    tables = {"joints": _align([*_joint_rows(robot, sim)]), "geoms": _align([*_geom_rows(robot, sim, builder)])}
    body = {"mass": float(sim.solver.mj_model.body_subtreemass[0]), "num_bodies": builder.body_count}
    warnings = dict(_unit_warnings(robot, builder))
    return _TEMPLATES.get_template("model.txt").render(robot=robot, warnings=warnings, **body, **tables).rstrip()


def _joint_rows(robot: RobotCfg, sim: Simulation) -> Iterator[Sequence[str]]:
    """Heads and a row a joint; a joint without a drive follows another."""
    model: Any = sim.solver.mj_model
    motors = np.zeros((model.nu, 0)) if sim.motors is None else sim.motors.numpy()[:, 1:]
    heads = "joint", "default", "range [rad]", "kp", "kd", "effort", "armature", "damping", "friction"
    yield *heads, *("saturation", "speed limit [rad/s]")[: motors.shape[1]]
    drives = read_drives(model)
    driven = model.actuator_trnid[:, 0].tolist()
    armature, damping, friction = (getattr(model, f"dof_{key}")[6:] for key in ("armature", "damping", "frictionloss"))
    for k, (name, angle) in enumerate(zip(robot.joint_names, robot.default_joint_pos, strict=True)):
        low, high = model.jnt_range[1 + k]
        span = f"{low:.2f} to {high:.2f}" if model.jnt_limited[1 + k] else "free"
        effort = f"{drives.effort[k]:g}" if drives.effort[k] < _NO_EFFORT_LIMIT else "free"
        limits = [f"{limit:g}" for limit in motors[driven.index(1 + k)]] if 1 + k in driven else ["-"] * len(motors.T)
        gains = ["net"] * 2 if robot.actuator_net else [f"{drives.stiffness[k]:g}", f"{0.0 + drives.damping[k]:g}"]
        gains.append(effort if 1 + k in driven else "follows")
        yield name, f"{angle:.3f}", span, *gains, f"{armature[k]:.3g}", f"{damping[k]:g}", f"{friction[k]:g}", *limits


def _geom_rows(robot: RobotCfg, sim: Simulation, builder: newton.ModelBuilder) -> Iterator[Sequence[str]]:
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
    is_wide = (high - low > 2.0 * _TURN) & (high - low < _FREE) & (np.maximum(abs(low), abs(high)) > 2.0 * _TURN)
    if is_wide.any():
        yield "ranges", [f"{robot.joint_names[k]} ({low[k]:g} to {high[k]:g})" for k in np.flatnonzero(is_wide)]
