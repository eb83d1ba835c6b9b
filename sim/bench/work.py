"""What a kernel cannot do without, counted from the state it works on: bytes it must move, arithmetic it must do.

Bytes: each input that the result depends on once, each output once; a node of the ground once an environment, though
neighbours may find it in a cache. Flops: additions, multiplications, divisions and comparisons of the formulas as one
would write them with everything hoisted that is the same for a terrain, row or environment, so that recomputing counts
against a kernel, not for it. Special functions: exponentials and logarithms, a power being one of each.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kernels.penalties import PENALTIES
from kernels.super_gaussian import LOWER, NEGLIGIBLE, UPPER
from sim.bench.checks import Truth
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


def rasterise_work(scene: Scene) -> Work:
    """A node and bump: two rotated, scaled coordinates (7), two comparisons.

    Within reach of the bump two powers, one exponential, and six more flops for signs, product and sum.
    """
    genes, nodes = scene.genes_on_device.numpy(), scene.cfg.num_terrains * NUM_ROWS * NUM_COLS
    pairs = nodes * genes.shape[1] // len(LOWER)
    near = _share_within_reach(genes) * pairs
    return Work(bytes=_FLOAT * (genes.size + nodes), flops=9 * pairs + round(6 * near), specials=round(5 * near))


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
    envs, points = scene.cfg.num_envs, scene.robot.num_scan_points
    return Work(bytes=_FLOAT * envs * (points * (3 + 1) + 7 + 1), flops=22 * envs * points)


def observation_work(scene: Scene) -> Work:
    """The scan, the joint coordinates and velocities, command and action; three vectors turned into the base (100)."""
    envs, scan, joints = scene.cfg.num_envs, scan_work(scene), scene.robot.num_joints
    read, written = (2 * joints + 6) + 3 + joints, 12 + 3 * joints
    flops = scan.flops + envs * (100 + 3 * joints)
    return Work(bytes=scan.bytes + _FLOAT * envs * (read + written), flops=flops)


def penalties_work(scene: Scene) -> Work:
    """Base state, command, forces and flag read, six sums read and written; two vectors turned, ten flops a geom."""
    envs, geoms = scene.cfg.num_envs, len(scene.robot.geom_names)
    values = 4 + 6 + 3 + 3 * geoms + 1 + 2 * len(PENALTIES)
    return Work(bytes=_FLOAT * envs * values, flops=envs * (80 + 10 * geoms))


def geom_forces_work(scene: Scene) -> Work:
    """The solver's contacts read, the forces written; 18 flops a contact: a vector turned, added."""
    contacts = min(int(scene.rollout.sim.solver_contacts.count.numpy()[0]), scene.rollout.sim.solver_contacts.capacity)
    forces = 3 * _FLOAT * scene.cfg.num_envs * len(scene.robot.geom_names)
    return Work(bytes=contacts * _SOLVER_CONTACT + forces, flops=18 * contacts)
