"""Robot states, terrains and filled structs for kernel tests."""

import numpy as np
import warp as wp

from kernels.heightfield import Terrain, ceiling_shape, max_blocks

SPACING = 0.05


def filled(struct, **values):
    """A Warp struct with these values; arrays get the type that it names."""
    result = struct()
    for name, value in values.items():
        kind = struct.vars[name].type
        setattr(result, name, wp.array(value, dtype=kind.dtype) if hasattr(kind, "ndim") else value)
    return result


def make_terrain(grids, spacing=SPACING):
    terrain = filled(Terrain, heights=np.float32(grids), spacing=spacing)
    terrain.ceilings = wp.zeros(ceiling_shape(*np.shape(grids)), dtype=float)
    max_blocks(terrain.heights, terrain.ceilings)
    return terrain


def rough(nrow, ncol, size=0.2, seed=5):
    """A grid with no two nodes alike: cells as steep as 76 degrees."""
    return np.random.default_rng(seed).uniform(-size, size, (nrow, ncol)).astype(np.float32)


def random_states(num_envs, num_joints, seed=0, speed=2.0):
    """Joint coordinates and velocities of tumbling robots somewhere over a crossing, float32."""
    rng = np.random.default_rng(seed)
    joint_q = rng.uniform(-1, 1, (num_envs, 7 + num_joints))
    joint_q[:, :3] = rng.uniform([0, 0, 0.2], [16, 8, 1.0], (num_envs, 3))
    quaternion = rng.normal(size=(num_envs, 4))
    joint_q[:, 3:7] = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.float32(joint_q), np.float32(rng.uniform(-speed, speed, (num_envs, 6 + num_joints)))


def upright(num_envs, num_joints, x=2.0, y=4.0, z=0.6):
    """Robots at rest with level base, all joints 0, float32."""
    joint_q = np.zeros((num_envs, 7 + num_joints), np.float32)
    joint_q[:, :3] = x, y, z
    joint_q[:, 6] = 1
    return joint_q, np.zeros((num_envs, 6 + num_joints), np.float32)
