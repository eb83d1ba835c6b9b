"""The kernels under test as the simulation launches them, each with its counterpart, its check and its work.

Work is what a kernel cannot do without, counted from the state it works on. Bytes: each input that the result depends
on once, each output once; a node of the ground once an environment, though neighbours may find it in a cache. Flops:
additions, multiplications, divisions and comparisons of the formulas, with everything hoisted that is the same for a
terrain, row or environment, so that recomputing counts against a kernel. Special functions: exponentials and
logarithms, a power being one of each.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from kernels.observation import ANG_VEL_SCALE, LIN_VEL_SCALE, Noise, write_observation, write_scan
from kernels.penalties import BASE, FOOT, LIMB, PENALTIES, add_penalties
from kernels.super_gaussian import LOWER, NEGLIGIBLE, UPPER, rasterise
from sim.bench import counterparts
from sim.bench.checks import Truth
from sim.bench.counterparts import collide, make_tables
from sim.bench.scene import Scene
from sim.terrain import NUM_COLS, NUM_ROWS, SPACING

_FLOAT = 4
_FLOPS_PER_TRIANGLE = 60
"""Six dot products, the differences they need, and the comparisons up to an edge (Ericson's nearest point)."""
_FLOPS_PER_PROBE = 30
"""Turning a probe into the world, and the signs and sizes of its distance."""
_RECORD = (2 + 5 * 3 + 2) * _FLOAT
"""Two shapes, five vectors, two margins."""
_SOLVER_CONTACT = (1 + 2 + 9 + 1 + 3 + 1) * _FLOAT
"""World, geoms, frame, first row, three forces, column."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """What must be done in one launch."""

    bytes: int
    flops: int
    specials: int = 0


def _share_within_reach(genes: NDArray) -> float:
    """Share of pairs of a node and a bump where the bump adds anything in single precision, of a sample of terrains."""
    y, x = np.mgrid[0:NUM_ROWS, 0:NUM_COLS] * SPACING
    within = []
    for bump in genes[:: max(1, len(genes) // 8)].reshape(-1, len(LOWER)):
        values = LOWER + (np.clip(bump, -1.0, 1.0) + 1.0) / 2.0 * (UPPER - LOWER)
        mu_x, mu_y, sigma_x, sigma_y, p_x, p_y, theta, _ = values
        u = np.abs(np.cos(theta) * (x - mu_x) - np.sin(theta) * (y - mu_y)) / sigma_x
        v = np.abs(np.sin(theta) * (x - mu_x) + np.cos(theta) * (y - mu_y)) / sigma_y
        within.append(((u < NEGLIGIBLE ** (0.5 / p_x)) & (v < NEGLIGIBLE ** (0.5 / p_y))).mean())
    return float(np.mean(within))


def contact_work(scene: Scene, truth: Truth) -> Work:
    """Poses, probes, ground under the probes that could touch, and records; two triangles a cell under such a probe.

    The ground is counted in the environments the oracle looks at and scaled up to all.
    """
    sim = scene.rollout.sim
    reached = [truth.reached_cells(int(env)) for env in truth.envs]
    scale = sim.num_envs / len(reached)
    cells = scale * sum(cells for cells, _ in reached)
    nodes = scale * sum(nodes for _, nodes in reached)
    probes = sim.probes.position.shape[0]
    poses = 7 * len(np.unique(sim.probes.strip_body.numpy()))
    contacts = int(sim.contact_count.numpy()[0])
    read = _FLOAT * (sim.num_envs * (poses + 1) + nodes + 3 * probes)
    return Work(
        bytes=round(read + contacts * _RECORD),
        flops=round(2 * _FLOPS_PER_TRIANGLE * cells + _FLOPS_PER_PROBE * probes * sim.num_envs),
    )


def scan_work(scene: Scene) -> Work:
    """A point: three nodes read, one value written; rotation (8), cell and interpolation (10), clip (4)."""
    envs, points = scene.num_envs, scene.robot.num_scan_points
    return Work(bytes=_FLOAT * envs * (points * (3 + 1) + 7 + 1), flops=22 * envs * points)


CONTROL_STEPS_PER_ITERATION = 1000
"""Terrains are rasterised once for crossings of so many control steps."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One kernel under test."""

    name: str
    launch: Callable[[], None]
    """Launches it in its production form."""
    output: Any
    """Warp array that it writes; cleared before a check."""
    counterpart: Callable[..., Any]
    """The same work in torch."""
    arguments: tuple[Any, ...]
    """What the counterpart is called with."""
    check: Callable[[str, Any], None]
    """Holds an output, as ``read`` or ``read_torch`` gives it, against the oracle; first the name of the variant."""
    work: Work
    per_control_step: float
    """Launches a control step."""
    part_of: str | None = None
    """Kernel that contains its work, so that the two are not to be added."""
    read: Callable[[], Any] | None = None
    """What it wrote; if left out, ``output`` as it is."""
    read_torch: Callable[[Any], Any] = lambda tensor: tensor.cpu().numpy()
    """The same of what the counterpart returned."""

    def check_ours(self) -> None:
        """Launches it and holds its output against the oracle."""
        self.output.zero_()
        self.launch()
        self.check("kernel", self.read() if self.read else self.output.numpy())

    def check_torch(self, who: str, outputs: Any) -> None:
        """Holds what the counterpart returned against the oracle; ``who`` names the variant."""
        self.check(who, self.read_torch(outputs))


def _rasterise_case(scene: Scene, truth: Truth) -> Case:
    genes = wp.array(scene.genes[: scene.num_terrains], dtype=float)
    heights = wp.zeros((scene.num_terrains, NUM_ROWS, NUM_COLS), dtype=float)  # the ground under the robots stays
    where = wp.to_torch(genes).device
    lower, upper = (torch.tensor(bounds, dtype=torch.float32, device=where) for bounds in (LOWER, UPPER))
    x, y = (torch.arange(count, device=where) * SPACING for count in (NUM_COLS, NUM_ROWS))
    # A node and bump: two rotated, scaled coordinates (7), two comparisons; within reach of the bump two powers, one
    # exponential, and six more flops for signs, product and sum.
    pairs = heights.size * genes.shape[1] // len(LOWER)
    near = _share_within_reach(scene.genes[: scene.num_terrains]) * pairs
    work = Work(bytes=_FLOAT * (genes.size + heights.size), flops=9 * pairs + round(6 * near), specials=round(5 * near))
    return Case(
        name="rasterise",
        launch=lambda: rasterise(genes, SPACING, heights),
        output=heights,
        counterpart=counterparts.rasterise,
        arguments=(wp.to_torch(genes), lower, upper, x, y),
        check=truth.check_rasterise,
        work=work,
        per_control_step=1.0 / CONTROL_STEPS_PER_ITERATION,
    )


Contacts = tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]
"""Contact records: environment and probe of each, and what :meth:`Truth.check_contact` takes."""
_RECORDED = ("point0", "point1", "normal", "offset1")


def kernel_contacts(scene: Scene) -> Contacts:
    """The records of the contact kernel."""
    sim: Any = scene.rollout.sim
    count = int(sim.contact_count.numpy()[0])
    if count > sim.contact_capacity:
        raise ValueError(f"{count} contacts do not fit in {sim.contact_capacity}: raise the robot's nconmax")
    records = {name: getattr(sim.contact_records, name).numpy()[:count].copy() for name in _RECORDED}
    shape = sim.contact_records.shape1.numpy()[:count] - sim.layout.first_shape
    env, shape = np.divmod(shape, sim.layout.shapes_per_env)
    lengths = np.diff(sim.probes.strip_start.numpy())
    shape_of_probe = np.repeat(sim.probes.strip_shape.numpy(), lengths)
    # A record names its shape and the centre: among the shape's probes, the one that stands there.
    away = np.abs(records["point1"][:, None] - sim.probes.position.numpy()[None]).sum(2)
    probe = np.argmin(np.where(shape_of_probe == shape[:, None], away, np.inf), axis=1)
    return env, probe, records


def _torch_contacts(outputs: tuple[torch.Tensor, ...]) -> Contacts:
    """The records of the counterpart, which has a slot for each that there may be."""
    probe, *values = (output.cpu().numpy() for output in outputs)
    exists = probe >= 0
    records = {name: value[exists] for name, value in zip(_RECORDED, values, strict=True)}
    return np.nonzero(exists)[0], probe[exists], records


def _contact_case(scene: Scene, truth: Truth) -> Case:
    sim: Any = scene.rollout.sim
    body_q = wp.to_torch(sim.body_q).view(sim.num_envs, -1, 7)
    probes = [getattr(sim.probes, name).numpy() for name in ("position", "strip_start", "strip_radius", "strip_body")]
    tables = make_tables(*probes, spacing=SPACING, device=body_q.device)
    return Case(
        name="contact",
        launch=sim.collide,
        output=sim.contact_count,
        read=lambda: kernel_contacts(scene),
        counterpart=collide,
        arguments=(body_q, wp.to_torch(sim.terrain_of_env), wp.to_torch(sim.bank.heights), SPACING, tables),
        read_torch=_torch_contacts,
        check=lambda who, contacts: truth.check_contact(who, *contacts),
        work=contact_work(scene, truth),
        per_control_step=scene.robot.decimation,
    )


def _scan_case(scene: Scene, truth: Truth) -> Case:
    sim = scene.rollout.sim
    out = wp.zeros((scene.num_envs, scene.robot.num_scan_points), dtype=float)
    arrays = (sim.joint_q, sim.terrain_of_env, sim.bank.heights, sim.sensors.scan_x, sim.sensors.scan_y)
    return Case(
        name="scan",
        launch=lambda: write_scan(sim.joint_q, sim.terrain_of_env, sim.bank.terrain, sim.sensors, out),
        output=out,
        counterpart=counterparts.scan,
        arguments=(*map(wp.to_torch, arrays), SPACING),
        check=truth.check_scan,
        work=scan_work(scene),
        per_control_step=1.0,
        part_of="observation",
    )


def _observation_case(scene: Scene, truth: Truth) -> Case:
    sim = scene.rollout.sim
    out = wp.zeros((scene.num_envs, scene.robot.observation_size), dtype=float)
    seed = wp.zeros(1, dtype=int)
    state = (sim.joint_q, sim.joint_qd, scene.command, scene.last_action, sim.terrain_of_env)
    arrays = (*state, sim.bank.heights, sim.sensors.scan_x, sim.sensors.scan_y, sim.sensors.default_joint_pos)
    tensors = [wp.to_torch(array) for array in arrays]

    def constant(*values: float) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=tensors[0].device)

    scale = constant(LIN_VEL_SCALE, LIN_VEL_SCALE, ANG_VEL_SCALE)
    # The scan; joint coordinates and velocities, command and action read; three vectors turned into the base (100).
    scan, joints = scan_work(scene), scene.robot.num_joints
    values = (2 * joints + 6) + 3 + joints + (12 + 3 * joints)
    flops = scan.flops + scene.num_envs * (100 + 3 * joints)
    return Case(
        name="observation",
        launch=lambda: write_observation(*state, sim.bank.terrain, sim.sensors, Noise(), seed, out),
        output=out,
        counterpart=counterparts.observation,
        arguments=(*tensors, constant(*sim.sensors.base_com), constant(0.0, 0.0, -1.0), scale, SPACING),
        check=truth.check_observation,
        work=Work(bytes=scan.bytes + _FLOAT * scene.num_envs * values, flops=flops),
        per_control_step=1.0,
    )


def _penalties_case(scene: Scene, truth: Truth) -> Case:
    sim, robot = scene.rollout.sim, scene.robot
    sums = wp.zeros((scene.num_envs, len(PENALTIES)), dtype=float)
    counted = wp.ones(scene.num_envs, dtype=int)
    roles = sim.geom_role.numpy()
    joint_q, joint_qd, command, force = map(wp.to_torch, (sim.joint_q, sim.joint_qd, scene.command, sim.geom_force))
    feet, others = (torch.tensor(np.flatnonzero(roles & role), device=force.device) for role in (FOOT, BASE | LIMB))
    base_com = torch.tensor(list(sim.sensors.base_com), dtype=torch.float32, device=force.device)
    limits = (robot.contact_force_limit, robot.physics_dt)
    # Base state, command, forces and flag read, six sums read and written; two vectors turned, ten flops a geom.
    geoms = len(robot.geom_names)
    values = 4 + 6 + 3 + 3 * geoms + 1 + 2 * len(PENALTIES)
    return Case(
        name="penalties",
        launch=lambda: add_penalties(
            sim.joint_q, sim.joint_qd, sim.sensors.base_com, scene.command, sim.geom_force, sim.geom_role, *limits,
            counted, sums,
        ),
        output=sums,
        counterpart=counterparts.penalties,
        arguments=(
            joint_q, joint_qd, base_com, command, force, feet, others, wp.to_torch(counted),
            torch.zeros_like(wp.to_torch(sums)), *limits,
        ),
        check=truth.check_penalties,
        work=Work(bytes=_FLOAT * scene.num_envs * values, flops=scene.num_envs * (80 + 10 * geoms)),
        per_control_step=robot.decimation,
    )  # fmt: skip


def _geom_forces_case(scene: Scene, truth: Truth) -> Case:
    sim: Any = scene.rollout.sim
    names = ("count", "world", "geom", "frame", "efc_address", "efc_force")
    tensors = [wp.to_torch(getattr(sim.solver_contacts, name)) for name in names]
    # The solver's contacts read, the forces written; 18 flops a contact: a vector turned, added.
    count = min(int(sim.solver_contacts.count.numpy()[0]), sim.solver_contacts.capacity)
    forces = 3 * _FLOAT * sim.geom_force.size
    return Case(
        name="contact_forces",
        launch=sim.read_geom_forces,
        output=sim.geom_force,
        counterpart=counterparts.geom_forces,
        arguments=(*tensors, wp.to_torch(sim.column_of_geom), len(sim.geom_names)),
        check=truth.check_geom_forces,
        work=Work(bytes=count * _SOLVER_CONTACT + forces, flops=18 * count),
        per_control_step=scene.robot.decimation,
    )


def make_cases(scene: Scene, truth: Truth) -> list[Case]:
    """All kernels under test, on one scene."""
    makers = (_rasterise_case, _contact_case, _scan_case, _observation_case, _penalties_case, _geom_forces_case)
    with wp.ScopedDevice(scene.rollout.sim.device):
        return [make(scene, truth) for make in makers]
