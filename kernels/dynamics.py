"""Poses, inertias and forces of a robot's bodies and joints, by 16 threads of a GPU or one of a CPU.

mujoco_warp needs some thirty kernels a step for them, each over all robots, through global memory: half of a step at
20,000 robots. Here half a warp works on one robot and keeps everything in shared memory. The algorithms are
mujoco_warp's, so that results agree to rounding: composite rigid bodies for the inertia, recursive Newton-Euler for
the bias forces (Featherstone, *Rigid Body Dynamics Algorithms*, 2008, chapters 5 and 6), affine actuators.
"""

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from kernels.launch import fill_snippet, launch_lanes

LANES = 16  # two robots a warp: few bodies of a robot are at the same depth
_BODY = Path(__file__).with_suffix(".cu")


@wp.struct
class Tree:
    """Bodies, joints and actuators of a model: mujoco_warp's arrays under its names, and four of our own.

    Arrays of two or more dimensions have a row for each world, or one for all.
    """

    body_order: wp.array[int]
    """Bodies level by level, without the world."""
    body_level: wp.array[int]
    """Level of each of them; a body on the world has 0."""
    roots: wp.array[int]
    """Bodies at the root of a tree."""
    dof_actuator: wp.array[int]
    """Actuator of each dof, -1 for none."""
    body_parentid: wp.array[int]
    body_rootid: wp.array[int]
    body_jntadr: wp.array[int]
    body_jntnum: wp.array[int]
    jnt_type: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]
    dof_bodyid: wp.array[int]
    dof_jntid: wp.array[int]
    M_hinit_i: wp.array[int]
    M_colind: wp.array[int]
    gravity: wp.array[wp.vec3]
    body_pos: wp.array2d[wp.vec3]
    body_quat: wp.array2d[wp.quat]
    """wxyz, as all quaternions here."""
    body_ipos: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.quat]
    body_mass: wp.array2d[float]
    body_inertia: wp.array2d[wp.vec3]
    body_subtreemass: wp.array2d[float]
    jnt_pos: wp.array2d[wp.vec3]
    jnt_axis: wp.array2d[wp.vec3]
    qpos0: wp.array2d[float]
    qpos_spring: wp.array2d[float]
    jnt_stiffness: wp.array2d[float]
    dof_armature: wp.array2d[float]
    dof_damping: wp.array2d[float]
    jnt_actfrclimited: wp.array[bool]
    jnt_actfrcrange: wp.array2d[wp.vec2]
    actuator_gainprm: wp.array3d[float]
    actuator_biastype: wp.array[int]
    actuator_biasprm: wp.array3d[float]
    actuator_gear: wp.array2d[wp.spatial_vector]
    actuator_ctrllimited: wp.array[bool]
    actuator_ctrlrange: wp.array2d[wp.vec2]
    actuator_forcelimited: wp.array[bool]
    actuator_forcerange: wp.array2d[wp.vec2]


@wp.struct
class Robots:
    """State of every world under mujoco_warp's names; :func:`find_dynamics` writes the arrays from ``xpos`` on."""

    parked: wp.array[int]
    """Worlds are left out where it is 2."""
    strength: wp.array[float]
    """Factor of the actuators' forces and of their limits; empty where it is 1."""
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    ctrl: wp.array2d[float]
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    subtree_com: wp.array2d[wp.vec3]
    """Mass centres of the trees, at their roots alone."""
    cdof: wp.array2d[wp.spatial_vector]
    """Motion of each dof, rotation first, at the mass centre of its tree."""
    M: wp.array2d[float]
    qfrc_actuator: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    """All forces but those of constraints."""
    slope: wp.array2d[float]
    """Loss of a dof's force per speed of that dof; an actuator at its force limit adds none."""


@dataclass(frozen=True, kw_only=True)
class TreeSizes:
    """Sizes of a model, which its kernel is compiled for."""

    bodies: int
    coordinates: int
    dofs: int
    actuators: int
    levels: int
    inertia: int
    """Stored entries of the inertia."""

    @property
    def shared_floats(self) -> int:
        """Floats of shared memory that a robot needs."""
        floats = 32 * self.bodies + self.coordinates + 13 * self.dofs + self.actuators
        return -(-floats // 4) * 4  # robots of a block lie behind each other, and vectors are read whole


@cache
def _kernel(sizes: TreeSizes, codes: tuple[tuple[str, Any], ...]) -> Any:
    snippet = fill_snippet(_BODY, num_floats=sizes.shared_floats, lanes=LANES, **asdict(sizes), **dict(codes))

    @wp.func_native(snippet=snippet)
    def find_one(tree: Tree, robots: Robots, thread: int): ...

    @wp.kernel(module="unique", enable_backward=False)
    def find_all(tree: Tree, robots: Robots):
        """Grid (num_worlds * lanes,)."""
        find_one(tree, robots, wp.tid())

    return find_all


def find_dynamics(tree: Tree, robots: Robots, sizes: TreeSizes, codes: dict[str, Any]) -> None:
    """Compute poses, inertias and all forces but those of constraints, of every world.

    The shared memory of ``sizes`` must pass :func:`kernels.launch.fits_block` with ``LANES``. ``codes`` are the
    solver's numbers of the joint types, by their names in dynamics.cu.
    """
    kernel = _kernel(sizes, tuple(codes.items()))
    launch_lanes(kernel, len(robots.qpos), [tree, robots], lanes=LANES, device=robots.qpos.device)
