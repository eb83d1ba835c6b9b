"""Our solver of contacts within mujoco_warp's step, for every model that fits it.

mujoco_warp has no hook for another solver, so this takes the place of one function of the pinned version;
tests/kernels/test_solver.py holds the two against each other.
"""

from typing import Any

from mujoco_warp._src import solver

from kernels.solver import fits, solve_contacts

solve_theirs = solver.solve


def _solve(m: Any, d: Any) -> None:
    if fits(m, d):
        solve_contacts(m, d)
    else:
        solve_theirs(m, d)


def use_own_solver(wanted: bool = True) -> None:
    """Make steps that are captured from now on solve contacts in one kernel, or as mujoco_warp does."""
    solver.solve = _solve if wanted else solve_theirs
