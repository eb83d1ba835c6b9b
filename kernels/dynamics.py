"""Poses, inertias and forces of a robot's bodies and joints, found from beginning to end by 16 threads of a GPU.

mujoco_warp finds them in some thirty kernels a step, each over all robots, through global memory: half of a step at
20,000 robots. Here half a warp takes one robot and keeps all in shared memory; on a CPU one thread does. The algorithms
are mujoco_warp's, so that results agree to rounding: composite rigid bodies for the inertia, recursive Newton-Euler for
the bias forces (Featherstone, *Rigid Body Dynamics Algorithms*, 2008, chapters 5 and 6), affine actuators.
"""

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from kernels import lanes

LANES = 16  # two robots a warp: few of their bodies are equally deep
_BODY = Path(__file__).with_suffix(".cu")


@wp.struct
class Tree:
    """The bodies of a model and how they are joined. Of shape (1, ...) it holds for all worlds, else for one each."""

    level: wp.array[int]
    """Where each level of the trees begins in ``order``, shape (num_levels + 1,)."""
    order: wp.array[int]
    """Bodies but the world, level by level."""
    roots: wp.array[int]
    parent: wp.array[int]
    root: wp.array[int]
    joint: wp.array[int]
    """First joint of each body."""
    num_joints: wp.array[int]
    joint_type: wp.array[int]
    joint_body: wp.array[int]
    joint_qpos: wp.array[int]
    joint_dof: wp.array[int]
    dof_body: wp.array[int]
    dof_joint: wp.array[int]
    dof_parent: wp.array[int]
    inertia_start: wp.array[int]
    """Where the row of each dof begins in the numbers kept of the inertia; then how many it has."""
    inertia_count: wp.array[int]
    gravity: wp.array[wp.vec3]
    body_pos: wp.array2d[wp.vec3]
    body_quat: wp.array2d[wp.quat]
    body_ipos: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.quat]
    body_mass: wp.array2d[float]
    body_inertia: wp.array2d[wp.vec3]
    subtree_mass: wp.array2d[float]
    joint_pos: wp.array2d[wp.vec3]
    joint_axis: wp.array2d[wp.vec3]
    qpos0: wp.array2d[float]
    rest: wp.array2d[float]
    """Where springs rest, as ``qpos``."""
    stiffness: wp.array2d[float]
    """Of the spring of each joint."""
    armature: wp.array2d[float]
    damping: wp.array2d[float]
    joint_force_limited: wp.array[bool]
    """Whether the force of the actuators on a joint is limited, to ``joint_force_range``."""
    joint_force_range: wp.array2d[wp.vec2]
    actuator: wp.array[int]
    """Actuator of each dof, -1 for none."""
    gain: wp.array3d[float]
    biased: wp.array[bool]
    bias: wp.array3d[float]
    """Force of an actuator with a control of 0: this + this times length + this times velocity."""
    gear: wp.array2d[wp.spatial_vector]
    control_limited: wp.array[bool]
    control_range: wp.array2d[wp.vec2]
    force_limited: wp.array[bool]
    force_range: wp.array2d[wp.vec2]


@wp.struct
class Robots:
    """State of every world; from ``xpos`` on, what is found."""

    parked: wp.array[int]
    """Where it is 2 nothing is done."""
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    control: wp.array2d[float]
    strength: wp.array[float]
    """Factor of the actuators' forces and of their limits; empty where it is 1."""
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    """wxyz, as all quaternions here."""
    subtree_com: wp.array2d[wp.vec3]
    """Mass centres of the trees, at their roots alone."""
    cdof: wp.array2d[wp.spatial_vector]
    """Motion of each dof, rotation first, at the mass centre of its tree."""
    inertia: wp.array2d[float]
    qfrc_actuator: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    """All forces but those of constraints."""
    slope: wp.array2d[float]
    """What a dof's force loses per speed of that dof; 0 of an actuator's at the limit of its force."""


@dataclass(frozen=True, kw_only=True)
class TreeSizes:
    """What a model's kernel is made for."""

    bodies: int
    dofs: int
    joints: int
    levels: int

    @property
    def words(self) -> int:
        """Words of memory that a robot needs."""
        return 35 * self.bodies + 6 * self.dofs


@cache
def _kernel(sizes: TreeSizes, codes: tuple[tuple[str, Any], ...]) -> Any:
    snippet = lanes.snippet(_BODY, words=sizes.words, lanes=LANES, **asdict(sizes), **dict(codes))

    @wp.func_native(snippet=snippet)
    def find_one(tree: Tree, robots: Robots, thread: int): ...

    @wp.kernel(module="unique", enable_backward=False)
    def find_all(tree: Tree, robots: Robots):
        """Grid (num_worlds * lanes,)."""
        find_one(tree, robots, wp.tid())

    return find_all


def find_dynamics(tree: Tree, robots: Robots, sizes: TreeSizes, codes: dict[str, Any]) -> None:
    """Poses, inertias and all forces but those of constraints, of every world: the arrays from ``xpos`` on.

    The words of the sizes must :func:`kernels.lanes.fits` with ``LANES``. ``codes`` are the solver's numbers of the
    types of joints, by their names in dynamics.cu.
    """
    kernel = _kernel(sizes, tuple(codes.items()))
    num_worlds = robots.qpos.shape[0]
    lanes.launch(kernel, num_worlds, [tree, robots], lanes=LANES, device=robots.qpos.device)
