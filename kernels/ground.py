"""What the ground is like: friction and softness of patches, from genes to the contacts on them.

A map divides the terrain into 4 x 8 patches of 2 m x 2 m, row along y, column along x. Patches at the edge go on beyond
it. Friction is a factor: that of the contacts of a robot on any other ground is multiplied by it. Softness is the time
constant of a contact [s], critically damped, at MuJoCo's constant impedance: at rest a body sinks in by a depth that
grows with the time constant's square.
"""

import warp as wp

from kernels.launch import kernel_over

ROWS, COLS = 4, 8
"""Patches along y and along x."""
PATCH = wp.constant(2.0)
"""Side of a patch [m]."""
NUM_PATCHES = ROWS * COLS
"""Genes of a map: the first row of patches, at y = 0 m to 2 m, comes first."""
PATCHES = (ROWS, COLS)
"""Shape of a map."""
MIN_FRICTION = wp.constant(0.15)
"""Factor of a gene of -1; a gene of 1 changes nothing."""
MIN_TIME_CONSTANT_S, MAX_TIME_CONSTANT_S = wp.constant(0.01), wp.constant(0.06)
"""Limits of a soft patch [s]: of a gene just above -1, and of 1. A gene of -1 is firm ground."""
FIRM = wp.constant(0.0)
"""Time constant of ground that leaves contacts as stiff as the robot's file has them."""


@wp.struct
class Ground:
    """Maps of all terrains."""

    friction: wp.array3d[float]
    """Factor of the friction, shape (num_terrains, 4, 8)."""
    time_constant: wp.array3d[float]
    """Contact time constant [s], ``FIRM`` for the robot's own; shape (num_terrains, 4, 8)."""
    factor: wp.array[float]
    """Factor of all friction on a terrain, shape (num_terrains,)."""


@wp.func
def patch_at(x: float, y: float) -> wp.vec2i:
    """Row and column of the patch under world-local (x, y) [m]."""
    row = wp.clamp(int(wp.floor(y / PATCH)), 0, ROWS - 1)
    col = wp.clamp(int(wp.floor(x / PATCH)), 0, COLS - 1)
    return wp.vec2i(row, col)


@wp.func
def _share(gene: float) -> float:
    return (wp.clamp(gene, -1.0, 1.0) + 1.0) * 0.5


@kernel_over("friction_out")
def decode_friction(genes: wp.array2d[float], friction_out: wp.array3d[float]):
    """Grid (num_terrains, 4, 8): genes, shape (num_terrains, 32), as a map of friction, linear from the least to 1."""
    t, row, col = wp.tid()
    missing = 1.0 - _share(genes[t, row * COLS + col])
    friction_out[t, row, col] = 1.0 - missing * (1.0 - MIN_FRICTION)


@kernel_over("time_constant_out")
def decode_softness(genes: wp.array2d[float], time_constant_out: wp.array3d[float]):
    """Grid (num_terrains, 4, 8): genes as time constants [s]; equal steps are equal ratios."""
    t, row, col = wp.tid()
    share = _share(genes[t, row * COLS + col])
    tau = FIRM
    if share > 0.0:
        tau = MIN_TIME_CONSTANT_S * wp.pow(MAX_TIME_CONSTANT_S / MIN_TIME_CONSTANT_S, share)
    time_constant_out[t, row, col] = tau


def make_ground(num_terrains: int, device: str) -> Ground:
    """Maps of ground that changes nothing."""
    ground = Ground()
    ground.friction = wp.ones((num_terrains, ROWS, COLS), dtype=float, device=device)
    ground.time_constant = wp.zeros((num_terrains, ROWS, COLS), dtype=float, device=device)
    ground.factor = wp.ones(num_terrains, dtype=float, device=device)
    return ground
