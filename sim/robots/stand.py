"""What a robot's files hold, whether it stands, and how many contacts it needs when it lies."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.crossing import CAPACITY_OVERFLOWS
from sim.robots.model import build_robot
from sim.robots.probes import extents, start_height
from sim.robots.robot import RobotCfg
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank, heights_of
from sim.terrains.hand_crafted import SPACING
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

_GRAVITY = 9.81
_TERRAINS = 4
_ROOM = 1.5  # highest ground that a dropped robot could touch is looked for this far round it [m]
_UPRIGHT_DEG = 15.0
_STRAY = 0.1  # share of the weight that geoms without a role may carry
_LOW = 0.015  # geoms so near to the lowest one touch the ground [m]
_SUNK = 0.005  # deeper than this in the ground at the start is a mistake [m]
_FALL = 0.1  # a start so much above the right one is a mistake [m]
_REST_S = 0.5  # the end of the time that a robot stands, at which it should rest
_RESTLESS = 0.1  # feet whose force changes by more than this share of the weight a step, on average, bounce
_TURN = 2.0 * np.pi
_FREE = 1e3  # a joint with a wider range has none [rad]
_NO_EFFORT_LIMIT = 1e5  # more is no limit [N m]
_SIZES_OF = {"sphere": 1, "capsule": 2, "cylinder": 2}
_SIZES = (0.05, 5.0)  # farthest point of a robot from its base [m]
_MASSES = (0.1, 1000.0)  # [kg]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a robot stood in its default pose, and how the dropped ones lay."""

    height: tuple[float, float]
    """Of the base, at the start and at the end [m]."""
    tilt_deg: float
    """Of the base, at the end."""
    joint_error: float
    """Largest distance of a joint from its default angle at the end [rad]."""
    carried: dict[str, float]
    """Share of the weight that each touching geom carries, on average over the last half second."""
    restless: float
    """How much the forces on its feet change from one physics step to the next in that time, in weights."""
    contacts: int
    overflowed: bool
    """Whether there was too little room for contacts, at any time."""
    finite: bool
    """Whether all states are numbers at the end."""

    @property
    def stands(self) -> bool:
        """Whether it is upright, off its belly, and on the ground."""
        upright = self.finite and self.tilt_deg < _UPRIGHT_DEG and self.height[1] > 0.5 * self.height[0]
        return upright and sum(self.carried.values()) > 0.5


def stand(robot: RobotCfg, *, device: str, seconds: float = 3.0, drops: int = 32) -> Standing:
    """Stands one robot on flat ground for ``seconds`` and drops ``drops`` others in drawn poses on drawn terrains."""
    rng = np.random.default_rng(0)
    bank = TerrainBank(1 + _TERRAINS, device=device)
    rough = heights_of(SUPER_GAUSSIAN.hard_random(_TERRAINS, 0))
    heights = np.concatenate([np.zeros_like(rough[:1]), rough])
    bank.set_heights(heights)
    terrain_of_env = np.concatenate([[0], 1 + np.arange(drops) % _TERRAINS])
    sim = Simulation(robot, bank, terrain_of_env)
    q = np.zeros((1 + drops, 7 + robot.num_joints), dtype=np.float32)
    q[:, :3], q[:, 6], q[:, 7:] = (8.0, 4.0, robot.default_base_height), 1.0, robot.default_joint_pos
    sim.targets.assign(q)
    ((_, reach),) = extents(build_robot(robot), [robot.default_joint_pos])
    q[1:, :2] = rng.uniform([5.0, 2.0], [11.0, 6.0], (drops, 2))
    turn = rng.normal(size=(drops, 4))
    q[1:, 3:7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    q[1:, 2] = [reach + _ground(heights[k], x, y) for k, (x, y) in zip(terrain_of_env[1:], q[1:, :2], strict=True)]
    sim.joint_q.assign(q)
    contacts, overflowed, forces = _let_fall(sim, seconds)
    first = sim.joint_q.numpy()[0].astype(np.float64)
    weight = float(sim.model.body_mass.numpy()[: sim.body_q.shape[1]].sum()) * _GRAVITY
    up = 1.0 - 2.0 * (first[3] ** 2 + first[4] ** 2)
    on_feet = forces[:, [name in robot.foot_geoms for name in robot.geom_names]] / weight
    carried = zip(robot.geom_names, forces.mean(axis=0) / weight, strict=True)
    return Standing(
        height=(robot.default_base_height, float(first[2])),
        tilt_deg=float(np.degrees(np.arccos(np.clip(up, -1.0, 1.0)))),
        joint_error=float(np.abs(first[7:] - robot.default_joint_pos).max(initial=0.0)),
        carried={name: float(share) for name, share in carried if share > 1e-3},
        restless=float(np.abs(np.diff(on_feet, axis=0)).sum(axis=1).mean()),
        contacts=contacts,
        overflowed=overflowed,
        finite=bool(np.isfinite(sim.joint_q.numpy()).all() and np.isfinite(sim.joint_qd.numpy()).all()),
    )


def _ground(heights: NDArray[np.float32], x: float, y: float) -> float:
    """Highest ground round a point [m]."""
    row, column, room = round(y / SPACING), round(x / SPACING), round(_ROOM / SPACING)
    return float(heights[max(row - room, 0) : row + room + 1, max(column - room, 0) : column + room + 1].max())


def _let_fall(sim: Simulation, seconds: float) -> tuple[int, bool, NDArray[np.float64]]:
    """Most contacts of a robot, overflow, and the first robot's vertical forces in the last steps [N]."""
    start = sim.joint_q.numpy().copy()

    def launch() -> None:
        sim.physics_step()
        sim.read_geom_forces()

    graph = sim.capture(launch)  # makes steps of its own
    sim.joint_q.assign(start)
    sim.joint_qd.zero_()
    sim.clear_solver(wp.ones(sim.num_envs, dtype=int, device=sim.device))
    contacts, overflowed, forces = 0, False, []
    steps = max(1, round(seconds / sim.robot.physics_dt))
    for step in range(steps):
        sim.launch(graph)
        if step >= steps - max(2, round(_REST_S / sim.robot.physics_dt)):
            forces.append(sim.geom_force.numpy()[0][:, 2].copy())
        if step % sim.robot.decimation == 0:
            contacts = max(contacts, int(sim.contacts.count.numpy().max()))
            overflowed |= bool((sim.overflow.numpy() & CAPACITY_OVERFLOWS).any())
    return contacts, overflowed, np.array(forces, dtype=np.float64)


def describe_model(robot: RobotCfg) -> str:
    """Joints and geoms of a robot as the solver holds them, and numbers that look like other units."""
    builder: Any = build_robot(robot)
    sim = Simulation(robot, TerrainBank(1, device="cpu"), np.zeros(1, dtype=int))
    model: Any = sim.solver.mj_model
    delay = f"; a target counts {robot.drive_delay_steps} physics steps later" * bool(robot.drive_delay_steps)
    motors = np.zeros((model.nu, 0)) if sim.motors is None else sim.motors.numpy()[:, 1:]
    limits = ["saturation", "speed limit [rad/s]"][: motors.shape[1]]
    joints = [("joint", "default", "range [rad]", "kp", "kd", "effort", "armature", "damping", "friction", *limits)]
    drive_of = {int(joint): k for k, (joint, _) in enumerate(model.actuator_trnid)}
    for k, (name, angle) in enumerate(zip(robot.joint_names, robot.default_joint_pos, strict=True), start=1):
        drive, (low, high), dof = drive_of.get(k), model.jnt_range[k], int(model.jnt_dofadr[k])
        kp, kd, effort = 0.0, 0.0, float(model.jnt_actfrcrange[k, 1])
        if drive is not None:
            kp, kd = model.actuator_gainprm[drive, 0], 0.0 - model.actuator_biasprm[drive, 2]
            effort = min(effort, model.actuator_forcerange[drive, 1] if model.actuator_forcelimited[drive] else np.inf)
        most = "follows" if drive is None else f"{effort:g}" if effort < _NO_EFFORT_LIMIT else "free"
        span = f"{low:.2f} to {high:.2f}" if model.jnt_limited[k] else "free"
        passive = f"{model.dof_armature[dof]:.3g}", f"{model.dof_damping[dof]:g}", f"{model.dof_frictionloss[dof]:g}"
        limits = ["-" if drive is None else f"{limit:g}" for limit in motors[drive or 0]]
        joints.append((name, f"{angle:.3f}", span, f"{kp:g}", f"{kd:g}", most, *passive, *limits))
    geoms = [("geom", "role", "body", "shape", "size [m]", "friction", "time constant [s]")]
    for k, name in enumerate(builder.shape_label):
        geom, kind = int(sim.geom_of_shape[k]), newton.GeoType(builder.shape_type[k]).name.lower()
        role = next((role for role in ("base", "foot", "limb") if name in getattr(robot, f"{role}_geoms")), "-")
        size = " ".join(f"{length:.3g}" for length in model.geom_size[geom][: _SIZES_OF.get(kind, 3)])
        contact = f"{model.geom_friction[geom, 0]:g}", f"{model.geom_solref[geom, 0]:g}"
        geoms.append((name, role, builder.body_label[builder.shape_body[k]], kind, size, *contact))
    lines = [
        f"{robot.name}: {robot.model_file}",
        f"  {model.body_subtreemass[0]:.2f} kg in {builder.body_count} bodies, {robot.num_joints} joints, "
        f"{robot.observation_size} observations{delay}",
        *(_columns(joints) + _columns(geoms)),
        *(f"Warning: {text}" for text in _unit_warnings(robot, builder)),
    ]
    return "\n".join(lines)


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines with columns of equal width, the first one to the left."""
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [f"  {name:{first}}  {'  '.join(map(str.rjust, cells, widths))}" for name, *cells in rows]


def _unit_warnings(robot: RobotCfg, builder: newton.ModelBuilder) -> list[str]:
    """Numbers that no legged robot has in metres, kilograms and radians, one line each."""
    masses = np.array(builder.body_mass)
    ((_, reach),) = extents(builder, [robot.default_joint_pos])
    spread = np.sqrt([np.linalg.eigvalsh(np.reshape(inertia, (3, 3)))[-1] for inertia in builder.body_inertia] / masses)
    far = [f"{builder.body_label[k]} ({spread[k]:.3g} m)" for k in np.flatnonzero(spread > reach)]
    turned = [f"{name} ({angle:g})" for name, angle in zip(robot.joint_names, robot.default_joint_pos, strict=True)
              if abs(angle) > _TURN]  # fmt: skip
    spans = zip(robot.joint_names, builder.joint_limit_lower[6:], builder.joint_limit_upper[6:], strict=True)
    wide = [f"{name} ({low:g} to {high:g})" for name, low, high in spans if 2.0 * _TURN < high - low < _FREE
            and max(abs(low), abs(high)) > 2.0 * _TURN]  # fmt: skip
    findings = [
        (not _SIZES[0] <= reach <= _SIZES[1],
         f"it reaches {reach:.3g} m from its base: are lengths in the model in metres?"),
        (not _MASSES[0] <= masses.sum() <= _MASSES[1],
         f"it weighs {masses.sum():.3g} kg: are masses in the model in kilograms?"),
        (far, f"the radius of gyration of {', '.join(far)} is more than the robot's {reach:.3g} m: are inertias in "
              "kg m^2?"),
        (turned, f"default_joint_pos is beyond a full turn for {', '.join(turned)}: is it in radians?"),
        (wide, f"joints turn by more than two full turns: {', '.join(wide)}: are limits in radians?"),
    ]  # fmt: skip
    return [text for holds, text in findings if holds]


def describe_standing(robot: RobotCfg, standing: Standing) -> tuple[str, bool]:
    """The findings in words, and whether nothing has to be mended."""
    builder, (first, last) = build_robot(robot), standing.height
    ((bottoms, _),) = extents(builder, [robot.default_joint_pos])
    lowest, gap = min(bottoms, key=bottoms.__getitem__), first + min(bottoms[name] for name in robot.foot_geoms)
    roleless = [name for name, bottom in bottoms.items()
                if name not in robot.geom_names and bottom < bottoms[lowest] + _LOW]  # fmt: skip
    right_height, stray = start_height(robot, builder), 1.0 - sum(standing.carried.values())
    right = f"default_base_height {right_height:.3f} is right, got {first:g}"
    findings = [
        (gap < -_SUNK, f"its feet start {-gap:.3f} m in the ground: {right}"),
        (first > right_height + _FALL,
         f"it starts with its feet {gap:.3f} m over the ground and falls: {right}"),
        (lowest not in robot.foot_geoms, f"in the default pose {lowest} is lower than the feet"),
        (standing.finite and last > 0.5 * first and stray > _STRAY,
         f"geoms without a role carry {stray:.0%} of its weight: {', '.join(roleless)}?"),
        (not standing.finite,
         "states became not finite: gains too high for physics_dt, or too little armature?"),
        (standing.stands and standing.restless > _RESTLESS,
         f"its feet bounce at rest: the force on them changes by {standing.restless:.0%} of its weight from step to "
         "step: give the joints armature (a rotor's inertia, .01 kg m^2 for a dog of 13 kg), or a longer "
         "contact_time_constant_s"),
        (standing.overflowed, "there was too little room for contacts: raise nconmax above the number above"),
    ]  # fmt: skip
    mistakes = [f"To mend: {text}" for holds, text in findings if holds]
    carried = ", ".join(f"{name} {share:.0%}" for name, share in standing.carried.items()) or "nothing"
    falls = "It does not stand by itself. A biped may fall; of others check gains, effort and default pose."
    lines = [
        f"On flat ground: base from {first:.3f} to {last:.3f} m, tilt {standing.tilt_deg:.1f} degrees, joints at most "
        f"{standing.joint_error:.3f} rad off; its weight is on {carried}",
        f"Dropped on rough ground: at most {standing.contacts} contacts of a robot (nconmax {robot.nconmax})",
        *(mistakes or [falls] * (not standing.stands)),
        *["It stands."] * standing.stands,
    ]
    return "\n".join(lines), not mistakes
