"""A robot's step: its contact problem is put together, solved and acted on by 32 threads of a GPU, or one of a CPU.

mujoco_warp takes some ninety kernels a step for it, each over all robots, and hands rows of constraints, gradient,
Hessian and search direction from one to the next through global memory. A walking robot has two contacts and mostly is
done after one or two iterations. Here a warp takes one robot: it makes the rows of its contacts, joint limits and joint
friction in shared memory, iterates until that robot is done, and moves it on. Matrices are factorised in registers.

Constraints, algorithm, tests of convergence and line search are those of MuJoCo and mujoco_warp (Todorov, "Convex and
analytically-invertible dynamics with contacts and constraints", ICRA 2014; primal form, elliptic cones), so that steps
agree to rounding. Only the Hessian of a contact on the side of its cone is put together in another way: its C is
positive semidefinite, so that J^T C J is a sum of squares of combinations of the contact's rows (solver.cu,
``add_contacts``).
"""

from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from kernels import lanes
from kernels.contact import Contacts, Surfaces, vec5
from kernels.dynamics import Robots

LANES = 32
_REGISTERS = 96  # a thread, so that 20 robots find room on a multiprocessor
_CHUNK = 4
"""Contacts whose part of the Hessian is summed at once."""
_SHARED_WORDS = 1792  # of a robot, so that 32 find room; contacts beyond these are in global memory
_LEAST_KEPT = 8  # contacts in shared memory, also of a large robot


_BODY = Path(__file__).with_suffix(".cu")


@wp.struct
class Problem:
    """Model and contacts of every robot. Arrays of a model of shape (1, ...) hold for all, else for one each."""

    most_iterations: int
    most_line_iterations: int
    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    impratio_invsqrt: wp.array[float]
    timestep: wp.array[float]
    joint_type: wp.array[int]
    joint_qpos: wp.array[int]
    joint_dof: wp.array[int]
    joint_limited: wp.array[bool]
    joint_range: wp.array2d[wp.vec2]
    joint_margin: wp.array2d[float]
    joint_solref: wp.array2d[wp.vec2]
    joint_solimp: wp.array2d[vec5]
    dof_joint: wp.array[int]
    dof_weight: wp.array2d[float]
    """MuJoCo's ``invweight0``, of dofs and below of bodies."""
    dof_solref: wp.array2d[wp.vec2]
    """Of friction in the joints."""
    dof_solimp: wp.array2d[vec5]
    frictionloss: wp.array2d[float]
    body_root: wp.array[int]
    body_weight: wp.array2d[wp.vec2]
    is_ancestor: wp.array2d[int]
    """Whether a body, in rows, moves with a dof."""
    surfaces: Surfaces
    inertia_row: wp.array[int]
    """Rows, then columns, of the numbers kept of the inertia."""
    inertia_col: wp.array[int]
    contacts: Contacts
    others: wp.array2d[float]
    """Room for the contacts that do not fit into shared memory, shape (num_worlds, :attr:`Sizes.other_words`)."""
    qacc_warmstart: wp.array2d[float]
    iterations: wp.array[int]
    overflow: wp.array[int]


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """What a model's kernel is made for."""

    dofs: int
    contacts: int
    """Most contacts of a robot."""
    dimensions: int
    """Most rows of a contact."""
    inertia: int
    """Numbers kept of an inertia."""
    losses: bool
    """Whether there is friction in any joint."""

    @property
    def stride(self) -> int:
        """Words from row to row of a matrix: whole vectors of four, an odd number, so that 8 rows meet in no bank."""
        return 4 * (-(-self.dofs // 4) | 1)

    @property
    def _contact_words(self) -> int:
        return _fours(self.dimensions * (self.stride + 5) + 1)

    @property
    def _other_words(self) -> int:
        matrices = (self.dofs + 1 + _CHUNK * self.dimensions) * self.stride
        return matrices + _fours(_CHUNK * self.dimensions**2)

    @property
    def kept(self) -> int:
        """Contacts in shared memory."""
        return min(self.contacts, max(_LEAST_KEPT, (_SHARED_WORDS - self._other_words) // self._contact_words))

    @property
    def words(self) -> int:
        """Words of shared memory that a robot needs."""
        return self._other_words + self.kept * self._contact_words

    @property
    def other_words(self) -> int:
        """Words of global memory that a robot needs."""
        return (self.contacts - self.kept) * self._contact_words


def _fours(words: int) -> int:
    return -(-words // 4) * 4


@cache
def _kernel(sizes: Sizes, codes: tuple[tuple[str, Any], ...]) -> Any:
    values = {"chunk": _CHUNK, "kept": sizes.kept, "stride": sizes.stride} | asdict(sizes) | dict(codes)
    snippet = lanes.snippet(_BODY, words=sizes.words, lanes=LANES, **values | {"losses": str(sizes.losses).lower()})

    @wp.func_native(snippet=snippet)
    def step_one(robots: Robots, problem: Problem, thread: int): ...

    options = {"fast_math": True}  # approximate division and roots; slopes below rounding end a line search anyway

    @wp.kernel(module="unique", enable_backward=False, module_options=options, cuda_max_registers=_REGISTERS)
    def step_all(robots: Robots, problem: Problem):
        """Grid (num_worlds * lanes,)."""
        step_one(robots, problem, wp.tid())

    return step_all


def step_robots(robots: Robots, problem: Problem, sizes: Sizes, codes: dict[str, Any]) -> None:
    """Moves every robot on by a step, under the forces ``qfrc_smooth`` and those of its constraints.

    It writes ``qpos``, ``qvel`` and the warm start of the next step, the contacts' forces, the number of iterations,
    and the bits of what overflowed. The words of the sizes must :func:`kernels.lanes.fits` with ``LANES``. ``codes``
    are MuJoCo's numbers, by their names in solver.cu: of a free joint, of the bits, of the limits of impedances, and
    the least divisor.
    """
    kernel, num_worlds = _kernel(sizes, tuple(codes.items())), robots.qvel.shape[0]
    lanes.launch(kernel, num_worlds, [robots, problem], lanes=LANES, device=robots.qvel.device)
