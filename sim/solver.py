"""What is ours within mujoco_warp's step: the solver of contacts, for every model that fits it, and poses found before.

mujoco_warp has no hooks for these, so they take the place of two functions of the pinned version.
tests/sim/test_solver.py holds the solvers against each other.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mujoco_warp._src import smooth, solver, types

from kernels.solver import Problem, Sizes, solve_problem

solve_theirs = solver.solve
find_poses = smooth.kinematics

_CODES = {state.name.lower(): state.value for state in types.ConstraintState} | {
    "elliptic": types.ConstraintType.CONTACT_ELLIPTIC.value,
    "too_many": types.OverflowType.ITERATIONS.value,
    "too_many_on_line": types.OverflowType.LS_ITERATIONS.value,
    "minval": types.MJ_MINVAL,
}


def sizes_of(m: Any, d: Any) -> Sizes:
    """Sizes of mujoco_warp's model and data, for the kernel."""
    dimensions = max(3, int(m.nmaxcondim))
    return Sizes(dofs=m.nv, rows=d.njmax, dimensions=dimensions, inertia=m.M_colind.shape[0])


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
        and sizes_of(m, d).fits
    )


def problem_of(m: Any, d: Any) -> Problem:
    """Arrays of mujoco_warp's model and data, under the kernel's names."""
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


def solve_contacts(m: Any, d: Any) -> None:
    """Joint accelerations and constraint forces of every world of a model that :func:`fits`, by our kernel."""
    solve_problem(problem_of(m, d), sizes_of(m, d), _CODES)


def _solve(m: Any, d: Any) -> None:
    if fits(m, d):
        solve_contacts(m, d)
    else:
        solve_theirs(m, d)


def use_own_solver(wanted: bool = True) -> None:
    """Make steps that are captured from now on solve contacts in one kernel, or as mujoco_warp does."""
    solver.solve = _solve if wanted else solve_theirs


def _find_poses_if_missing(m: Any, d: Any) -> None:
    if not getattr(d, "poses_are_found", False):
        find_poses(m, d)


smooth.kinematics = _find_poses_if_missing


@contextmanager
def poses_found(d: Any) -> Iterator[None]:
    """A step within it takes the poses of this data from :func:`find_poses`, called before, and does not find them."""
    d.poses_are_found = True
    try:
        yield
    finally:
        d.poses_are_found = False
