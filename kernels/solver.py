"""One robot's contact problem, solved from beginning to end by 32 threads of a GPU, or by one of a CPU.

mujoco_warp's Newton solver launches some seventy kernels a step, each over all robots, and hands gradient, Hessian and
search direction from one to the next through global memory. A walking robot has six to twenty rows of constraints and
mostly is done after one iteration. Here a warp takes one robot, keeps all but the constraint Jacobian in shared memory,
and iterates until that robot is done.

Algorithm, tests of convergence and line search are mujoco_warp's (Todorov, "Convex and analytically-invertible
dynamics with contacts and constraints", ICRA 2014; primal form, elliptic cones), so that iterates agree to rounding.
Only the Hessian of a contact on the side of its cone is put together in another way: its C is positive semidefinite,
so that J^T C J is a sum of squares of combinations of the contact's rows (solver.cu, ``find_direction``).
"""

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from kernels import lanes

_REGISTERS = 96  # a thread, so that 20 robots find room on a multiprocessor
_CHUNK = 16
"""Rows of constraints whose part of the Hessian is summed at once."""


_BODY = Path(__file__).with_suffix(".cu")


@wp.struct
class Problem:
    """Every world's contact problem, in the solver's arrays; world first, then rows or dofs."""

    most_iterations: int
    most_line_iterations: int
    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    impratio_invsqrt: wp.array[float]
    tri_row: wp.array[int]
    """Rows, then columns, of the upper triangle of a matrix of num_dofs x num_dofs."""
    tri_col: wp.array[int]
    inertia_row: wp.array[int]
    """Rows, then columns, of the numbers kept of the inertia."""
    inertia_col: wp.array[int]
    inertia: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    num_equalities: wp.array[int]
    """Rows of equalities; then come those of friction losses, then all others."""
    num_losses: wp.array[int]
    num_rows: wp.array[int]
    row_type: wp.array2d[int]
    row_id: wp.array2d[int]
    jacobian: wp.array3d[float]
    stiffness: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    num_contacts: wp.array[int]
    """Of all worlds, shape (1,)."""
    friction: wp.array[wp.types.vector(5, float)]
    condim: wp.array[int]
    address: wp.array2d[int]
    """First row of each contact in its world, in column 0; -1 where it found no room."""
    qacc: wp.array2d[float]
    momentum: wp.array2d[float]
    """Inertia times ``qacc``."""
    qfrc_constraint: wp.array2d[float]
    force: wp.array2d[float]
    state: wp.array2d[int]
    iterations: wp.array[int]
    overflow: wp.array[int]


@wp.struct
class Motion:
    """What a step needs once the accelerations are known."""

    timestep: wp.array[float]
    slope: wp.array2d[float]
    """What a dof's force loses per speed of that dof."""
    joint_type: wp.array[int]
    joint_qpos: wp.array[int]
    joint_dof: wp.array[int]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    most_contacts: int


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """What a model's kernel is made for."""

    dofs: int
    rows: int
    """Most rows of constraints of a world."""
    dimensions: int
    """Most rows of a contact."""
    inertia: int
    """Numbers kept of an inertia."""

    @property
    def words(self) -> int:
        """Words of memory that a robot needs."""
        stride = self.dofs | 1
        matrices = 2 * self.dofs * stride + _CHUNK * (stride + self.dimensions)
        return matrices + 5 * self.rows + 5 * self.dofs


@cache
def _kernel(sizes: Sizes, codes: tuple[tuple[str, Any], ...], step: bool) -> Any:
    values = {"step": int(step), "chunk": _CHUNK} | asdict(sizes) | dict(codes)
    snippet = lanes.snippet(_BODY, words=sizes.words, **values)

    @wp.func_native(snippet=snippet)
    def solve_one(problem: Problem, motion: Motion, thread: int): ...

    options = {"fast_math": True}  # approximate division and roots; slopes below rounding end a line search anyway

    @wp.kernel(module="unique", enable_backward=False, module_options=options, cuda_max_registers=_REGISTERS)
    def solve_all(problem: Problem, motion: Motion):
        """Grid (num_worlds * lanes,)."""
        solve_one(problem, motion, wp.tid())

    return solve_all


def solve_problem(problem: Problem, sizes: Sizes, codes: dict[str, Any], motion: Any = None) -> None:
    """Joint accelerations and constraint forces of every world, from a warm start.

    The problem's arrays are written from ``qacc`` on: of ``overflow`` bits are added. With a motion ``qpos`` and
    ``qvel`` are moved on by a step, and ``qacc_warmstart`` is written. The words of the sizes must
    :func:`kernels.lanes.fits`. ``codes`` are the solver's own numbers, by their names in solver.cu: of constraint
    states, of an elliptic contact's rows, of a free joint, of the bits in ``overflow``, and the least divisor.
    """
    kernel = _kernel(sizes, tuple(codes.items()), motion is not None)
    inputs, num_worlds = [problem, motion or Motion()], problem.qacc.shape[0]
    lanes.launch(kernel, num_worlds, inputs, words=sizes.words, device=problem.qacc.device)
