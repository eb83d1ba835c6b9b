"""A robot's step: its constraints are set up, solved and applied by 32 threads of a GPU, or one of a CPU.

mujoco_warp takes some ninety kernels a step for it, each over all robots, and passes rows of constraints, gradient,
Hessian and search direction through global memory. A walking robot has two contacts and mostly needs one or two
iterations. Here a warp works on one robot: it makes the rows of its contacts, joint limits and joint friction in shared
memory, iterates until that robot has converged, and moves it on. Matrices are factorised in registers.

Constraints, algorithm, tests of convergence and line search are those of MuJoCo and mujoco_warp (Todorov, "Convex and
analytically-invertible dynamics with contacts and constraints", ICRA 2014; primal form, elliptic cones), so that steps
agree to rounding. Only the Hessian of a contact on the side of its cone is computed in another way: its C is positive
semidefinite, so that J^T C J is a sum of squares of combinations of the contact's rows (solver.cu, ``add_contacts``).
"""

import math
from collections import Counter
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from kernels.contact import Contacts, Surfaces, vec5
from kernels.dynamics import Robots
from kernels.launch import fill_snippet, launch_lanes

LANES = 32
_REGISTERS = 96  # a thread, so that 20 robots fit on a multiprocessor
_CHUNK = 4  # contacts whose terms of the Hessian are summed at once
_SHARED_FLOATS = 1792  # a robot, so that 32 robots fit; further contacts are in global memory
_MIN_SHARED_CONTACTS = 7
_BODY = Path(__file__).with_suffix(".cu")


@wp.struct
class Problem:
    """Model and contacts of every robot: mujoco_warp's arrays under its names where there is no line.

    Arrays of two or more dimensions have a row for each world, or one for all.
    """

    iterations: int
    ls_iterations: int
    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    impratio_invsqrt: wp.array[float]
    timestep: wp.array[float]
    jnt_type: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]
    jnt_limited: wp.array[int]
    jnt_range: wp.array2d[wp.vec2]
    jnt_margin: wp.array2d[float]
    jnt_solref: wp.array2d[wp.vec2]
    jnt_solimp: wp.array2d[vec5]
    dof_jntid: wp.array[int]
    dof_invweight0: wp.array2d[float]
    dof_solref: wp.array2d[wp.vec2]
    dof_solimp: wp.array2d[vec5]
    dof_frictionloss: wp.array2d[float]
    body_rootid: wp.array[int]
    body_invweight0: wp.array2d[wp.vec2]
    body_isdofancestor: wp.array2d[int]
    M_hinit_i: wp.array[int]
    M_colind: wp.array[int]
    surfaces: Surfaces
    contacts: Contacts
    spilled_contacts: wp.array2d[float]
    """Contacts that do not fit into shared memory, shape (num_worlds, :attr:`Sizes.global_floats`)."""
    qacc_warmstart: wp.array2d[float]
    solver_niter: wp.array[int]
    overflow: wp.array[int]


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of a model, which its kernel is compiled for."""

    parents: tuple[int, ...]
    """Of each degree of freedom the one before it on its branch, or -1."""
    dimensions: int
    """Rows of the largest contact."""
    inertia: int
    """Stored entries of the inertia."""
    losses: bool
    """Whether there is friction in any joint."""
    capacity: int
    """Contacts that a robot has room for."""

    @property
    def dofs(self) -> int:
        """Degrees of freedom."""
        return len(self.parents)

    @property
    def elimination(self) -> list[list[tuple[int, int]]]:
        """Steps of a factorisation: ends of branches, each with its parent if no branch is left on that, or -1."""
        steps, left = [], set(range(self.dofs))
        while left:
            on = Counter(self.parents[k] for k in left)
            ends = sorted(k for k in left if k not in on)
            parents = [self.parents[k] if on[self.parents[k]] == 1 else -1 for k in ends]
            steps.append([*zip(ends, parents, strict=True)])
            left -= {*ends, *parents}
        return steps

    @property
    def part_rows(self) -> int:
        """Rows for a chunk of contacts, or for two steps of a factorisation in turn."""
        return max(_CHUNK * self.dimensions, *(end for _, end in self._place_rows()))

    def _place_rows(self) -> list[tuple[int, int]]:
        """First row and end of the rows of each branch in turn: no step has those of the step before it."""
        sizes = [[1 + (parent >= 0) for _, parent in step] for step in self.elimination]
        begins = 0, max(map(sum, sizes[::2]))
        ends = [begins[s % 2] + np.cumsum(step) for s, step in enumerate(sizes)]
        rows = zip((size for step in sizes for size in step), np.concatenate(ends).tolist(), strict=True)
        return [(end - size, end) for size, end in rows]

    def describe_elimination(self) -> dict[str, Any]:
        """:attr:`elimination` as solver.cu has it, with the rows that a step writes, and who is above whom."""
        steps = self.elimination
        above = []
        for parent in self.parents:
            above.append([int(j == parent or (parent >= 0 and above[parent][j])) for j in range(self.dofs)])
        ends, nexts = zip(*(chain for step in steps for chain in step), strict=True)
        lists = {
            "parents": self.parents,
            "step": [s for s, step in enumerate(steps) for _ in step],
            "ends": ends,
            "nexts": nexts,
            "rows": [first for first, _ in self._place_rows()],
            "leaves": [int(k not in self.parents) for k in range(self.dofs)],
            "above": ["{" + ", ".join(map(str, row)) + "}" for row in above],
        }
        texts = {name: ", ".join(map(str, values)) for name, values in lists.items()}
        return texts | {"steps": len(steps), "chains": len(ends)}

    @property
    def stride(self) -> int:
        """Floats from row to row of a matrix: an odd number of vectors of four, so that 8 rows share no memory bank."""
        return 4 * (-(-self.dofs // 4) | 1)

    @property
    def _floats_per_contact(self) -> int:
        return 4 * math.ceil((self.dimensions * (self.stride + 5) + 2) / 4)

    @property
    def _matrix_floats(self) -> int:
        rows = self.dofs + 1 + self.part_rows
        return rows * self.stride + 4 * math.ceil(_CHUNK * self.dimensions**2 / 4)

    @property
    def shared_contacts(self) -> int:
        """Contacts in shared memory."""
        room = (_SHARED_FLOATS - self._matrix_floats) // self._floats_per_contact
        return max(_MIN_SHARED_CONTACTS, room)

    @property
    def shared_floats(self) -> int:
        """Floats of shared memory that a robot needs."""
        return self._matrix_floats + self.shared_contacts * self._floats_per_contact

    @property
    def global_floats(self) -> int:
        """Floats of global memory that a robot needs, at least 1."""
        return max(1, (self.capacity - self.shared_contacts) * self._floats_per_contact)


@cache
def _kernel(sizes: Sizes, codes: tuple[tuple[str, Any], ...]) -> Any:
    conditions = {"losses": sizes.losses, "spills": sizes.capacity > sizes.shared_contacts}
    values = asdict(sizes) | dict(codes) | {name: str(holds).lower() for name, holds in conditions.items()}
    values |= {"chunk": _CHUNK, "num_shared": sizes.shared_contacts, "stride": sizes.stride, "dofs": sizes.dofs}
    values |= {"part_rows": sizes.part_rows} | sizes.describe_elimination()
    snippet = fill_snippet(_BODY, num_floats=sizes.shared_floats, lanes=LANES, **values)

    @wp.func_native(snippet=snippet)
    def step_one(robots: Robots, problem: Problem, thread: int): ...

    options = {"fast_math": True}  # approximate division and roots; slopes below rounding end a line search anyway

    @wp.kernel(module="unique", enable_backward=False, module_options=options, cuda_max_registers=_REGISTERS)
    def step_all(robots: Robots, problem: Problem):
        """Grid (num_worlds * lanes,)."""
        step_one(robots, problem, wp.tid())

    return step_all


def step_robots(robots: Robots, problem: Problem, sizes: Sizes, codes: dict[str, Any]) -> None:
    """Move every robot on by a step, under the forces ``qfrc_smooth`` and those of its constraints.

    It writes ``qpos``, ``qvel``, the warm start of the next step, the contacts' forces, the number of iterations and
    the overflow bits. The shared memory of ``sizes`` must pass :func:`kernels.launch.fits_block` with ``LANES``.
    ``codes`` are MuJoCo's numbers, by their names in solver.cu: the type of a free joint, overflow bits, limits of
    impedances, the smallest divisor.
    """
    kernel = _kernel(sizes, tuple(codes.items()))
    launch_lanes(kernel, len(robots.qvel), [robots, problem], lanes=LANES, device=robots.qvel.device)
