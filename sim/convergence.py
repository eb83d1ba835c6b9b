"""An earlier look at who has converged, for mujoco_warp's Newton iterations.

The solver looks at the end of an iteration, when it has put together and factorised the Hessian of the next one. Of a
walking robot's steps the first iteration mostly is the last, so that every other Hessian is thrown away. Here the same
test is made on the gradient before the Hessian: the iterates are the solver's own, bit for bit on the CPU.

This wraps two functions of the pinned mujoco_warp, which has no hook for it; tests/sim/test_convergence.py notices if
they change.
"""

from typing import Any

from mujoco_warp._src import solver

from kernels.convergence import stop_converged

_iterate, _update_gradient = solver._solver_iteration, solver._update_gradient
_num_solving: list[Any] = []  # of the iteration that is being launched; empty before the first


def _iterate_stopping(m: Any, d: Any, ctx: Any, nsolving: Any, compact: bool = False) -> None:
    _num_solving.append(nsolving)
    try:
        _iterate(m, d, ctx, nsolving, compact=compact)
    finally:
        _num_solving.pop()


def _stop_then_update_gradient(m: Any, d: Any, ctx: Any, compact: bool = False) -> None:
    if _num_solving and m.opt.solver == solver.types.SolverType.NEWTON and not compact:
        stop_converged(
            m.nv, m.opt.tolerance, ctx.inertia_scale, d.efc.Ma, d.qfrc_smooth, d.qfrc_constraint, ctx.alpha,
            ctx.improvement, d.solver_niter, _num_solving[-1], ctx.done,
        )  # fmt: skip
    _update_gradient(m, d, ctx, compact=compact)


def stop_early(wanted: bool = True) -> None:
    """Make solvers that are captured from now on look early at who has converged, or late again."""
    solver._solver_iteration = _iterate_stopping if wanted else _iterate
    solver._update_gradient = _stop_then_update_gradient if wanted else _update_gradient
