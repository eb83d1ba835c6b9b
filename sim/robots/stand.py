"""What a robot's files hold, whether it stands, and how many contacts it needs when it lies."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.bank import TerrainBank
from sim.robots.model import build_robot, geom_names, leaf_name
from sim.robots.probes import placed
from sim.robots.robot import RobotCfg
from sim.simulation import CAPACITY_OVERFLOWS, Simulation
from sim.space import SUPER_GAUSSIAN
from sim.terrain import SPACING

_GRAVITY = 9.81
_TERRAINS = 4
_ROOM = 1.5  # highest ground that a dropped robot could touch is looked for this far round it [m]
_UPRIGHT_DEG = 15.0
_SUNK = 0.005  # deeper than this in the ground at the start is a mistake [m]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a robot stood in its default pose, and how the dropped ones lay."""

    gap: float
    """Height of its lowest foot over the ground at the start [m]; below 0 it starts in the ground."""
    lowest: str
    """The geom that was lowest then."""
    height: tuple[float, float]
    """Of the base, at the start and at the end [m]."""
    tilt_deg: float
    """Of the base, at the end."""
    joint_error: float
    """Largest distance of a joint from its default angle at the end [rad]."""
    carried: dict[str, float]
    """Share of the weight that each touching geom carries, at the end."""
    contacts: float
    """Most contacts a robot, on average over all."""
    rows: int
    """Most constraint rows of a robot."""
    overflowed: bool
    """Whether a buffer of the solver was too small, at any time."""
    finite: bool
    """Whether all states are numbers at the end."""

    @property
    def stands(self) -> bool:
        """Whether it is upright, off its belly, and on the ground."""
        upright = self.finite and self.tilt_deg < _UPRIGHT_DEG and self.height[1] > 0.5 * self.height[0]
        return upright and sum(self.carried.values()) > 0.5


def stand(robot: RobotCfg, *, device: str, seconds: float = 3.0, drops: int = 32, seed: int = 0) -> Standing:
    """Stands one robot on flat ground for ``seconds`` and drops ``drops`` others in drawn poses on drawn terrains.

    Raises:
        ValueError: If settings and model do not agree.
    """
    rng = np.random.default_rng(seed)
    bank = TerrainBank(1 + _TERRAINS, device=device)
    genes = np.concatenate([np.zeros((1, SUPER_GAUSSIAN.num_genes)), SUPER_GAUSSIAN.hard_random(_TERRAINS, seed)])
    bank.set_genes(genes.astype(np.float32))
    heights = np.array(bank.heights.numpy())
    heights[0] = 0.0
    bank.set_heights(heights)
    sim = Simulation(robot, bank, np.concatenate([[0], 1 + np.arange(drops) % _TERRAINS]))
    q = np.zeros((1 + drops, 7 + robot.num_joints), dtype=np.float32)
    q[:, :3], q[:, 6], q[:, 7:] = (8.0, 4.0, robot.default_base_height), 1.0, robot.default_joint_pos
    sim.joint_q.assign(q)
    sim.targets.assign(q)
    sim.refresh()
    bottoms, reach = _extent(sim)
    q[1:, :2] = rng.uniform([5.0, 2.0], [11.0, 6.0], (drops, 2))
    turn = rng.normal(size=(drops, 4))
    q[1:, 3:7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    q[1:, 2] = [
        reach + _ground(heights[k], x, y) for k, (x, y) in zip(1 + np.arange(drops) % _TERRAINS, q[1:, :2], strict=True)
    ]
    sim.joint_q.assign(q)
    contacts, rows, overflowed = _let_fall(sim, seconds)
    return _judged(sim, robot, bottoms, contacts, rows, overflowed)


def _extent(sim: Simulation) -> tuple[dict[str, float], float]:
    """Lowest point of each geom of the first robot [m], and the farthest that any of it is from its base [m]."""
    names = geom_names(build_robot(sim.robot))
    starts, centres = sim.probes.strip_start.numpy(), sim.probes.position.numpy()
    bodies, shapes, radii = (getattr(sim.probes, f"strip_{name}").numpy() for name in ("body", "shape", "radius"))
    poses: Any = sim.body_q.numpy()
    bottoms: dict[str, float] = {}
    reach = 0.0
    for strip, radius in enumerate(radii):
        pose = wp.transform(*poses[bodies[strip]])
        for centre in centres[starts[strip] : starts[strip + 1]]:
            point = np.array(placed(pose, centre))
            name = names[shapes[strip]]
            bottoms[name] = min(bottoms.get(name, np.inf), float(point[2] - radius))
            reach = max(reach, float(np.linalg.norm(point - poses[0][:3]) + radius))
    return bottoms, reach


def _ground(heights: NDArray[np.float32], x: float, y: float) -> float:
    """Highest ground round a point [m]."""
    row, column, room = round(y / SPACING), round(x / SPACING), round(_ROOM / SPACING)
    return float(heights[max(row - room, 0) : row + room + 1, max(column - room, 0) : column + room + 1].max())


def _let_fall(sim: Simulation, seconds: float) -> tuple[float, int, bool]:
    """Most contacts a robot on average, most rows of one, and whether a buffer overflowed."""
    start = sim.joint_q.numpy().copy()

    def launch() -> None:
        sim.refresh()
        for _ in range(sim.robot.decimation):
            sim.physics_step()
        sim.read_geom_forces()

    graph = sim.capture(launch)  # makes steps of its own
    sim.joint_q.assign(start)
    sim.joint_qd.zero_()
    sim.clear_solver(wp.ones(sim.num_envs, dtype=int, device=sim.device))
    contacts, rows, overflowed = 0.0, 0, False
    for _ in range(round(seconds / sim.robot.control_dt)):
        sim.launch(graph)
        contacts = max(contacts, int(sim.contact_count.numpy()[0]) / sim.num_envs)
        rows = max(rows, int(sim.solver.mjw_data.nefc.numpy().max()))
        overflowed |= bool((sim.overflow.numpy() & CAPACITY_OVERFLOWS).any())
    return contacts, rows, overflowed or contacts > sim.robot.nconmax


def _judged(
    sim: Simulation, robot: RobotCfg, bottoms: dict[str, float], contacts: float, rows: int, overflowed: bool
) -> Standing:
    q = sim.joint_q.numpy()[0].astype(np.float64)
    weight = float(sim.model.body_mass.numpy()[: sim.layout.bodies_per_env].sum()) * _GRAVITY
    up = 1.0 - 2.0 * (q[3] ** 2 + q[4] ** 2)
    forces = dict(zip(sim.geom_names, sim.geom_force.numpy()[0][:, 2], strict=True))
    return Standing(
        gap=min(bottoms[name] for name in robot.foot_geoms),
        lowest=min(bottoms, key=lambda name: bottoms[name]),
        height=(robot.default_base_height, float(q[2])),
        tilt_deg=float(np.degrees(np.arccos(np.clip(up, -1.0, 1.0)))),
        joint_error=float(np.abs(q[7:] - robot.default_joint_pos).max(initial=0.0)),
        carried={name: float(force) / weight for name, force in forces.items() if force > 1e-3 * weight},
        contacts=contacts,
        rows=rows,
        overflowed=overflowed,
        finite=bool(np.isfinite(sim.joint_q.numpy()).all() and np.isfinite(sim.joint_qd.numpy()).all()),
    )


def describe_model(robot: RobotCfg) -> str:
    """Joints and geoms of a robot as they were read."""
    builder: Any = build_robot(robot)
    lines = [
        f"{robot.name}: {robot.model_file}",
        f"  {sum(builder.body_mass):.2f} kg in {builder.body_count} bodies, {robot.num_joints} joints, "
        f"{robot.observation_size} observations",
        f"  {'joint':22}{'default':>9}{'range [rad]':>18}{'kp':>8}{'kd':>7}{'armature':>10}",
    ]
    rows = zip(robot.joint_names, robot.default_joint_pos, *(
        getattr(builder, f"joint_{name}")[6:]
        for name in ("limit_lower", "limit_upper", "target_ke", "target_kd", "armature")
    ), strict=True)  # fmt: skip
    for name, angle, low, high, kp, kd, armature in rows:
        span = f"{low:.2f} to {high:.2f}" if high - low < 1e3 else "free"
        lines.append(f"  {name:22}{angle:9.3f}{span:>18}{kp:8g}{kd:7g}{armature:10.3g}")
    lines.append(f"  {'geom':22}{'role':>9}  {'body':18}friction")
    for name, body, friction in zip(geom_names(builder), builder.shape_body, builder.shape_material_mu, strict=True):
        roles = (("base", robot.base_geoms), ("foot", robot.foot_geoms), ("limb", robot.limb_geoms))
        role = next((kind for kind, names in roles if name in names), "-")
        lines.append(f"  {name:22}{role:>9}  {leaf_name(builder.body_label[body]):18}{friction:g}")
    return "\n".join(lines)


def describe_standing(robot: RobotCfg, found: Standing) -> tuple[str, bool]:
    """The findings in words, and whether nothing has to be mended."""
    carried = ", ".join(f"{name} {share:.0%}" for name, share in found.carried.items()) or "nothing"
    first, last = found.height
    lines = [
        f"On flat ground: base from {first:.3f} to {last:.3f} m, tilt {found.tilt_deg:.1f} degrees, joints at most "
        f"{found.joint_error:.3f} rad off; its weight is on {carried}",
        f"Dropped on rough ground: at most {found.contacts:.1f} contacts a robot on average (nconmax {robot.nconmax}) "
        f"and {found.rows} constraint rows (njmax {robot.njmax})",
    ]
    wrong = []
    if found.gap < -_SUNK:
        wrong.append(f"its feet start {-found.gap:.3f} m in the ground: default_base_height is that much too low")
    if found.lowest not in robot.foot_geoms:
        wrong.append(f"in the default pose {found.lowest} is lower than the feet")
    if not found.finite:
        wrong.append("states became not finite: gains too high for physics_dt, or too little armature?")
    if found.overflowed:
        wrong.append("a buffer of the solver was too small: raise nconmax and njmax above the numbers above")
    lines += [f"To mend: {text}" for text in wrong]
    lines.append(
        "It stands."
        if found.stands
        else "It does not stand by itself. A biped may fall; of others check gains, effort and default pose."
    )
    return "\n".join(lines), not wrong
