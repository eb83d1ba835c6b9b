"""The kernels as the simulation launches them, each with its counterpart in torch and the work it must do.

Work is what a kernel cannot do without. Bytes: each input that the result depends on once, each output once. Flops:
the formulas with everything hoisted that is the same for a terrain, row or environment, so that computing something
twice counts against a kernel. Special functions: exponentials and logarithms, a power being one of each.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from kernels.episode import command_goal
from kernels.observation import ANG_VEL_SCALE, LIN_VEL_SCALE, write_observation
from kernels.penalties import BASE, FOOT, LIMB, PENALTIES, add_penalties, penalty_columns
from kernels.super_gaussian import LOWER, NEGLIGIBLE, UPPER, rasterise
from sim.crossing import CrossingCfg, make_task
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.bench import counterparts
from tests.bench.ceiling import Work

FLOAT = 4
FLOPS_PER_TRIANGLE = 60  # six dot products, their differences, comparisons up to an edge (Ericson's nearest point)
FLOPS_PER_PROBE = 30  # turning a probe into the world, sign and size of its distance
CONTACT = (1 + 3 + 3 + 1 + 1 + 1) * FLOAT  # shape, point, normal, distance, friction, time constant
FORCE = (1 + 3) * FLOAT  # shape and force


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Robots in the middle of gene terrains, with a command and random actions; all on the device."""

    rollout: Rollout
    genes: np.ndarray  # (num_terrains, 64)
    command: Any  # (num_envs, 3)
    last_action: Any  # (num_envs, num_joints)


def build_scene(robot: RobotCfg, device: str, *, num_envs: int, num_terrains: int, walk_s: float, seed: int) -> Scene:
    """Lets robots walk for ``walk_s`` seconds by their shipped controller: at 0.75 m/s, the bumps begin after 2 m."""
    rollout = Rollout(
        robot, robot.policy_file, num_terrains=num_terrains, replicas=math.ceil(num_envs / num_terrains),
        num_envs=num_envs, device=device, cfg=CrossingCfg(),
    )  # fmt: skip
    genes = SUPER_GAUSSIAN.hard_random(num_terrains, seed)
    rollout.put(Terrains(genes=genes, seeds=np.arange(num_terrains)))
    for _ in range(round(walk_s / robot.control_dt)):
        rollout.control_step()
    sim = rollout.sim
    actions = np.random.default_rng(seed).normal(size=(num_envs, robot.num_joints)).astype(np.float32)
    with wp.ScopedDevice(device):
        command = wp.zeros((num_envs, 3), dtype=float)
        command_goal(sim.joint_q, wp.zeros(num_envs, dtype=int), make_task(rollout.cfg, robot), command)
        return Scene(rollout=rollout, genes=genes, command=command, last_action=wp.array(actions))


@dataclass(frozen=True, kw_only=True)
class Case:
    """One kernel, the same work in torch, and how near their results must be."""

    name: str
    launch: Callable[[], None]
    output: Any  # Warp array that it writes; cleared before a comparison
    counterpart: Callable[..., Any]
    arguments: tuple[Any, ...]  # of the counterpart
    work: Work
    atol: float
    rtol: float = 0.0
    undecided: float = 0.0  # share of values that may differ more: single precision may go either way there
    read: Callable[[], np.ndarray] | None = None  # what the kernel wrote; if left out, ``output`` as it is
    read_torch: Callable[[Any], np.ndarray] = lambda tensor: tensor.cpu().numpy()

    def compare(self, outputs: Any) -> None:
        """Refuses outputs of the counterpart that are not the kernel's: nothing may be timed then.

        NaN stands for what is absent.
        """
        self.output.zero_()
        self.launch()
        ours, theirs = self.read() if self.read else self.output.numpy(), self.read_torch(outputs)
        if ours.shape != theirs.shape:
            raise ValueError(f"{self.name}: torch gives shape {theirs.shape}, the kernel {ours.shape}")
        near = np.abs(ours - theirs) <= self.atol + self.rtol * np.abs(theirs)
        differing = ~near & ~(np.isnan(ours) & np.isnan(theirs))
        present = int((~np.isnan(theirs)).sum())
        # Of few contacts, one may be undecided.
        allowed = max(self.undecided * present, ours.shape[-1]) if self.undecided else 0
        if not present or differing.sum() > allowed:
            indices = map(tuple, np.argwhere(differing)[:3].tolist())
            first = ", ".join(f"{theirs[index]:.9g} and {ours[index]:.9g} at {index}" for index in indices)
            counts = f"of {present} values of torch {differing.sum()} differ"
            raise ValueError(f"{self.name}: {counts} from the kernel's: {first}")


def _share_within_reach(genes: np.ndarray) -> float:
    """Share of pairs of a node and a bump in which the bump adds anything in single precision, of a sample."""
    y, x = np.mgrid[0:NUM_ROWS, 0:NUM_COLS] * SPACING
    within = []
    for bump in genes[:: max(1, len(genes) // 8)].reshape(-1, len(LOWER)):
        values = LOWER + (np.clip(bump, -1.0, 1.0) + 1.0) / 2.0 * (UPPER - LOWER)
        mu_x, mu_y, sigma_x, sigma_y, p_x, p_y, theta, _ = values
        u = np.abs(np.cos(theta) * (x - mu_x) - np.sin(theta) * (y - mu_y)) / sigma_x
        v = np.abs(np.sin(theta) * (x - mu_x) + np.cos(theta) * (y - mu_y)) / sigma_y
        within.append(((u < NEGLIGIBLE ** (0.5 / p_x)) & (v < NEGLIGIBLE ** (0.5 / p_y))).mean())
    return float(np.mean(within))


def _rasterise_case(scene: Scene) -> Case:
    genes = wp.array(scene.genes, dtype=float)
    heights = wp.zeros((len(scene.genes), NUM_ROWS, NUM_COLS), dtype=float)  # the ground under the robots stays
    where = wp.to_torch(genes).device
    lower, upper = (torch.tensor(bounds, dtype=torch.float32, device=where) for bounds in (LOWER, UPPER))
    x, y = (torch.arange(count, device=where) * SPACING for count in (NUM_COLS, NUM_ROWS))
    # A node and bump: two rotated, scaled coordinates (7), two comparisons; within reach of the bump two powers, one
    # exponential, and six more flops for signs, product and sum.
    pairs = heights.size * genes.shape[1] // len(LOWER)
    near, moved = _share_within_reach(scene.genes) * pairs, FLOAT * (genes.size + heights.size)
    return Case(
        name="rasterise",
        launch=lambda: rasterise(genes, SPACING, heights),
        output=heights,
        counterpart=counterparts.rasterise,
        arguments=(wp.to_torch(genes), lower, upper, x, y),
        work=Work(bytes=moved, flops=9 * pairs + round(6 * near), specials=round(5 * near)),
        atol=2e-5,  # steep flanks cost single precision two digits
    )


def _body_q(sim: Any) -> torch.Tensor:
    """Poses at the beginning of the last step, (num_envs, num_bodies, 7), quaternions xyzw."""
    columns = sim.poses.column_of_body.numpy()
    turned = wp.to_torch(sim.poses.xquat)[:, columns]
    return torch.cat([wp.to_torch(sim.poses.xpos)[:, columns], turned[..., 1:], turned[..., :1]], dim=-1)


def _kernel_contacts(scene: Scene, tables: counterparts.ProbeTables) -> np.ndarray:
    """Contacts of the kernel by robot and probe, (num_envs, num_probes, 7), NaN where there is none.

    They are point, normal and distance, of one of the shape's probes.
    """
    sim: Any = scene.rollout.sim
    count, capacity = sim.contacts.count.numpy(), sim.contacts.shape.shape[1]
    if count.max() > capacity:
        raise ValueError(f"{count.max()} contacts of a robot do not fit in {capacity}: raise its nconmax")
    env, slot = np.nonzero(np.arange(capacity) < count[:, None])
    names = ("shape", "point", "normal", "distance")
    shape, point, normal, distance = (getattr(sim.contacts, name).numpy()[env, slot] for name in names)
    centres = counterparts.probe_centres(_body_q(sim), tables).cpu().numpy()
    radius, distance = tables.radius.cpu().numpy(), distance[:, None]
    # The point is half way between the surfaces, from where a radius and half of the distance lead to the centre.
    found = point[:, None] + normal[:, None] * (0.5 * distance + radius)[..., None]
    shape_of_probe = np.repeat(sim.probes.strip_shape.numpy(), np.diff(sim.probes.strip_start.numpy()))
    away = np.abs(found - centres[env]).sum(2)
    probe = np.argmin(np.where(shape_of_probe == shape[:, None], away, np.inf), axis=1)
    values = np.full((sim.num_envs, len(radius), 7), np.nan, np.float32)
    values[env, probe] = np.concatenate([point, normal, distance], axis=1)
    return values


def _torch_contacts(outputs: tuple[torch.Tensor, ...], num_probes: int) -> np.ndarray:
    """The same of the counterpart, which has a slot for each contact that there may be."""
    probe, *vectors = (output.cpu().numpy() for output in outputs)
    exists = probe >= 0
    contacts = np.concatenate([vector[exists] for vector in vectors], axis=1)
    values = np.full((len(probe), num_probes, contacts.shape[1]), np.nan, np.float32)
    values[np.nonzero(exists)[0], probe[exists]] = contacts
    return values


def _contact_case(scene: Scene) -> Case:
    sim: Any = scene.rollout.sim
    body_q = _body_q(sim)
    tables = counterparts.make_tables(sim.probes, SPACING, body_q.device)
    arguments = (body_q, wp.to_torch(sim.terrain_of_env), wp.to_torch(sim.bank.heights), SPACING, tables)
    num_probes, poses = len(tables.position), 7 * len(tables.body.unique())
    # Poses and probes read, contacts and their numbers written, and of each contact at least the four nodes of a cell:
    # two triangles.
    count = int(sim.contacts.count.numpy().sum())
    moved = FLOAT * (sim.num_envs * (poses + 2) + 3 * num_probes + 4 * count) + CONTACT * count
    return Case(
        name="contact",
        launch=sim.collide,
        output=sim.contacts.count,
        read=lambda: _kernel_contacts(scene, tables),
        counterpart=counterparts.collide,
        arguments=arguments,
        read_torch=lambda outputs: _torch_contacts(outputs, num_probes),
        work=Work(bytes=moved, flops=2 * FLOPS_PER_TRIANGLE * count + FLOPS_PER_PROBE * num_probes * sim.num_envs),
        atol=5e-4,
        undecided=0.01,  # probes that just touch, that are equally deep, or whose centre lies on the surface
    )


def _observation_case(scene: Scene) -> Case:
    sim, robot = scene.rollout.sim, scene.rollout.robot
    out = wp.zeros((sim.num_envs, robot.observation_size), dtype=float)
    seed = wp.zeros(1, dtype=int)
    step = sim.make_step(scene.command, scene.last_action)
    states = (sim.joint_q, sim.joint_qd, scene.command, scene.last_action, sim.terrain_of_env, sim.bank.heights)
    constants = (sim.sensors.scan_x, sim.sensors.scan_y, sim.sensors.default_joint_pos)
    tensors = [wp.to_torch(array) for array in (*states, *constants)]

    def constant(*values: float) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=tensors[0].device)

    scale = constant(LIN_VEL_SCALE, LIN_VEL_SCALE, ANG_VEL_SCALE)
    # A scan point: three nodes read, one value written; rotation (8), cell and interpolation (10), clip (4). Joint
    # coordinates and velocities, command and action read; three vectors turned into the base (100).
    points, joints = len(robot.scan_x) * len(robot.scan_y), robot.num_joints
    values = 4 * points + (7 + 1) + (2 * joints + 6) + 3 + joints + (12 + 3 * joints)
    flops = sim.num_envs * (22 * points + 100 + 3 * joints)
    return Case(
        name="observation",
        launch=lambda: write_observation(
            step, sim.terrain_of_env, sim.bank.terrain, sim.sensors, None, None, seed, out
        ),
        output=out,
        counterpart=counterparts.observation,
        arguments=(*tensors, constant(*sim.base_com), constant(0.0, 0.0, -1.0), scale, SPACING),
        work=Work(bytes=FLOAT * sim.num_envs * values, flops=flops),
        atol=5e-4,
        rtol=1e-5,
    )


def _penalties_case(scene: Scene) -> Case:
    sim, robot = scene.rollout.sim, scene.rollout.robot
    sums, counted = wp.zeros((sim.num_envs, len(PENALTIES)), dtype=float), wp.ones(sim.num_envs, dtype=int)
    roles = sim.geom_role.numpy()
    joint_q, joint_qd, command, force = map(wp.to_torch, (sim.joint_q, sim.joint_qd, scene.command, sim.geom_force))
    feet, others = (torch.tensor(np.flatnonzero(roles & role), device=force.device) for role in (FOOT, BASE | LIMB))
    base_com = torch.tensor(list(sim.base_com), dtype=torch.float32, device=force.device)
    step, columns = sim.make_step(scene.command, scene.last_action), penalty_columns(counterparts.PENALTIES)
    before = torch.zeros((sim.num_envs, len(columns)), device=force.device)
    state = (joint_q, joint_qd, base_com, command, force, feet, others)
    # Base state, command, forces and flag read, six sums read and written; two vectors turned, ten flops a geom.
    geoms = len(robot.geom_names)
    values = 4 + 6 + 3 + 3 * geoms + 1 + 2 * len(PENALTIES)
    return Case(
        name="penalties",
        launch=lambda: add_penalties(step, robot.physics_dt, counted, sums),
        output=sums,
        counterpart=counterparts.penalties,
        arguments=(*state, wp.to_torch(counted), before, robot.contact_force_limit, robot.physics_dt),
        work=Work(bytes=FLOAT * sim.num_envs * values, flops=sim.num_envs * (80 + 10 * geoms)),
        read=lambda: sums.numpy()[:, columns],
        atol=1e-6,
        rtol=5e-5,
    )


def _geom_forces_case(scene: Scene) -> Case:
    sim: Any = scene.rollout.sim
    contacts = sim.contacts
    tensors = [wp.to_torch(array) for array in (contacts.count, contacts.shape, contacts.force, sim.column_of_shape)]
    # Numbers, shapes and forces of contacts read, sums written; 3 flops a contact.
    count = int(np.minimum(contacts.count.numpy(), contacts.shape.shape[1]).sum())
    moved = FLOAT * (sim.num_envs + 3 * sim.geom_force.size) + FORCE * count
    return Case(
        name="contact_forces",
        launch=sim.read_geom_forces,
        output=sim.geom_force,
        counterpart=counterparts.geom_forces,
        arguments=(*tensors, len(sim.robot.geom_names)),
        work=Work(bytes=moved, flops=3 * count),
        atol=5e-3,
        rtol=2e-5,
    )


def make_cases(scene: Scene) -> dict[str, Case]:
    """All kernels on one scene, by name."""
    makers = (_rasterise_case, _contact_case, _observation_case, _penalties_case, _geom_forces_case)
    with wp.ScopedDevice(scene.rollout.sim.device):
        return {case.name: case for case in [make(scene) for make in makers]}
