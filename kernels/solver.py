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

from functools import cache
from pathlib import Path
from string import Template
from typing import Any

import warp as wp
from mujoco_warp._src import types

_WARP = 32
_BLOCK_FLOATS = 12 * 1024  # what a block may have without asking: 48 KiB
_REGISTERS = 96  # a thread, so that 20 robots find room on a multiprocessor
_CHUNK = 16
"""Rows of constraints whose part of the Hessian is summed at once."""


_SOURCE = Template(Path(__file__).with_suffix(".cu").read_text())


@wp.struct
class Problem:
    """What mujoco_warp's model and data hold of every world's contact problem, under the names of solver.cu."""

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
    qacc_smooth: wp.array2d[float]
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
    friction: wp.array[types.vec5]
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


def _problem(m: Any, d: Any) -> Problem:
    problem = Problem()
    problem.most_iterations, problem.most_line_iterations = m.opt.iterations, m.opt.ls_iterations
    problem.tolerance, problem.ls_tolerance = m.opt.tolerance, m.opt.ls_tolerance
    problem.impratio_invsqrt = m.opt.impratio_invsqrt
    problem.tri_row, problem.tri_col = m.dof_tri_row, m.dof_tri_col
    problem.inertia_row, problem.inertia_col, problem.inertia = m.M_hinit_i, m.M_colind, d.M
    problem.qacc_warmstart, problem.qacc_smooth, problem.qfrc_smooth = d.qacc_warmstart, d.qacc_smooth, d.qfrc_smooth
    problem.num_equalities, problem.num_losses, problem.num_rows = d.ne, d.nf, d.nefc
    problem.row_type, problem.row_id, problem.jacobian = d.efc.type, d.efc.id, d.efc.J
    problem.stiffness, problem.aref, problem.frictionloss = d.efc.D, d.efc.aref, d.efc.frictionloss
    problem.num_contacts, problem.friction, problem.condim = d.nacon, d.contact.friction, d.contact.dim
    problem.address = d.contact.efc_address
    problem.qacc, problem.momentum, problem.qfrc_constraint = d.qacc, d.efc.Ma, d.qfrc_constraint
    problem.force, problem.state = d.efc.force, d.efc.state
    problem.iterations, problem.overflow = d.solver_niter, d.overflow
    return problem


@cache
def _kernel(nv: int, rows: int, dim: int, inertia: int) -> tuple[Any, int]:
    """The kernel for models of these sizes, and how many robots a block of threads has."""
    floats = _floats(nv, rows, dim)
    robots = min(4, _BLOCK_FLOATS // floats)
    snippet = _SOURCE.substitute(
        nv=nv,
        rows=rows,
        dim=dim,
        inertia=inertia,
        chunk=_CHUNK,
        floats=floats,
        robots=robots,
        minval=types.MJ_MINVAL,
        elliptic=int(types.ConstraintType.CONTACT_ELLIPTIC),
        too_many=int(types.OverflowType.ITERATIONS),
        too_many_on_line=int(types.OverflowType.LS_ITERATIONS),
        **{state.name.lower(): state.value for state in types.ConstraintState},
    )

    @wp.func_native(snippet=snippet)
    def solve_one(problem: Problem, thread: int): ...

    options = {"fast_math": True}  # approximate division and roots; slopes below rounding end a line search anyway

    @wp.kernel(module="unique", enable_backward=False, module_options=options, cuda_max_registers=_REGISTERS)
    def solve_all(problem: Problem):
        """Grid (num_envs * 32,); of one thread a robot on a CPU."""
        solve_one(problem, wp.tid())

    return solve_all, robots


def _floats(nv: int, rows: int, dim: int) -> int:
    """Words of memory that a robot needs."""
    stride = nv | 1
    return 2 * nv * stride + _CHUNK * (stride + dim) + 5 * rows + 5 * nv


def _dim(m: Any) -> int:
    return max(3, int(m.nmaxcondim))


def fits(m: Any, d: Any) -> bool:
    """Whether :func:`solve_contacts` solves problems of this model: dense, elliptic cones, by Newton, and small."""
    return (
        m.opt.solver == types.SolverType.NEWTON
        and m.opt.cone == types.ConeType.ELLIPTIC
        and m.opt.integrator != types.IntegratorType.DISCRETE
        and not m.opt.enableflags & types.EnableBit.SLEEP
        and not m.opt.disableflags & types.DisableBit.WARMSTART
        and not m.is_sparse
        and m.opt.noslip_iterations == 0
        and m.opt.iterations > 0
        and m.nv > 0
        and d.njmax > 0
        and _floats(m.nv, d.njmax, _dim(m)) <= _BLOCK_FLOATS
    )


def solve_contacts(m: Any, d: Any) -> None:
    """Joint accelerations and constraint forces of every world, from a warm start, in place of ``mujoco_warp``'s solve.

    Args:
        m: mujoco_warp's model, one that :func:`fits`.
        d: Its data. Read are inertia, smooth forces and accelerations, warm start, contacts and constraint rows;
            written ``qacc``, ``qfrc_constraint``, ``efc.Ma``, ``efc.force``, ``efc.state``, ``solver_niter`` and the
            bits of the two caps on iterations in ``overflow``.
    """
    kernel, robots = _kernel(m.nv, d.njmax, _dim(m), m.M_colind.shape[0])
    lanes = 1 if d.qacc.device.is_cpu else _WARP
    wp.launch(kernel, dim=d.nworld * lanes, inputs=[_problem(m, d)], block_dim=robots * _WARP, device=d.qacc.device)
