"""What is ours within a physics step of mujoco_warp: dynamics and contacts in a kernel each, for every model that fits.

mujoco_warp has no hooks for its solver of contacts, so ours takes the place of a function of the pinned version.
tests/sim/test_solver.py holds ours against theirs.
"""

from typing import Any

import mujoco_warp
import numpy as np
import warp as wp
from mujoco_warp._src import constraint, solver, types

from kernels import lanes
from kernels.dynamics import Robots, Tree, TreeSizes, find_dynamics
from kernels.solver import Motion, Problem, Sizes, solve_problem

solve_theirs = solver.solve

_JOINT_CODES = {name.lower(): types.JointType[name].value for name in ("FREE", "SLIDE", "HINGE")}
_CODES = {state.name.lower(): state.value for state in types.ConstraintState} | {
    "elliptic": types.ConstraintType.CONTACT_ELLIPTIC.value,
    "free": types.JointType.FREE.value,
    "too_many": types.OverflowType.ITERATIONS.value,
    "too_many_on_line": types.OverflowType.LS_ITERATIONS.value,
    "too_many_rows": types.OverflowType.NEFC.value,
    "too_many_contacts": types.OverflowType.NARROWPHASE.value,
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
        and lanes.fits(sizes_of(m, d).words)
    )


def problem_of(m: Any, d: Any) -> Problem:
    """Arrays of mujoco_warp's model and data, under the kernel's names."""
    problem = Problem()
    problem.most_iterations, problem.most_line_iterations = m.opt.iterations, m.opt.ls_iterations
    problem.tolerance, problem.ls_tolerance = m.opt.tolerance, m.opt.ls_tolerance
    problem.impratio_invsqrt = m.opt.impratio_invsqrt
    problem.tri_row, problem.tri_col = m.dof_tri_row, m.dof_tri_col
    problem.inertia_row, problem.inertia_col, problem.inertia = m.M_hinit_i, m.M_colind, d.M
    problem.qacc_warmstart, problem.qfrc_smooth = d.qacc_warmstart, d.qfrc_smooth
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
    (solve_contacts if fits(m, d) else solve_theirs)(m, d)


def use_own_solver(wanted: bool = True) -> None:
    """Make steps that are captured from now on solve contacts in one kernel, or as mujoco_warp does."""
    solver.solve = _solve if wanted else solve_theirs


def fits_dynamics(m: Any, d: Any) -> bool:
    """Whether :class:`Dynamics` takes this model: robots of joints and position actuators, and nothing else."""
    flags = types.DisableBit
    unforced = flags.GRAVITY | flags.SPRING | flags.DAMPER | flags.ACTUATION | flags.CLAMPCTRL
    joints, actuated = m.jnt_type.numpy(), m.actuator_trnid.numpy()[:, 0]
    free, bodies = joints == types.JointType.FREE, m.jnt_bodyid.numpy()
    misfits = (
        m.opt.run_collision_detection or m.flg_surfacevel or any(vars(m.callback).values()) or m.nsensor,
        m.opt.integrator != types.IntegratorType.IMPLICITFAST or m.opt.disableflags & unforced,
        m.neq or m.ntendon or m.nflex or m.nmocap or m.nhistory or m.has_fluid or m.flg_adhesion,
        m.body_gravcomp.numpy().any() or m.body_freeadr.size,
        (joints == types.JointType.BALL).any() or (np.bincount(bodies, minlength=1)[bodies[free]] != 1).any(),
        m.jnt_stiffness.numpy()[:, free].any(),
        m.jnt_stiffnesspoly.numpy().any() or m.dof_dampingpoly.numpy().any(),
        not m.nactuator or len(set(actuated)) != len(actuated) or free[actuated].any(),
        (m.actuator_trntype.numpy() != types.TrnType.JOINT).any() or (m.actuator_ctrlnum.numpy() != 1).any(),
        m.actuator_dyntype.numpy().any() or (m.actuator_gaintype.numpy() != types.GainType.FIXED).any(),
        (m.actuator_biastype.numpy() > types.BiasType.AFFINE).any(),
    )
    return fits(m, d) and lanes.fits(tree_sizes_of(m).words) and not any(misfits)


def _levels(m: Any) -> tuple[np.ndarray, np.ndarray]:
    """Bodies but the world in order of depth, and where each depth begins."""
    parent = m.body_parentid.numpy()
    depth = np.zeros(m.nbody, int)
    for body in range(1, m.nbody):
        depth[body] = depth[parent[body]] + 1
    order = np.argsort(depth, kind="stable")[1:].astype(np.int32)
    return order, np.searchsorted(depth[order], np.arange(1, depth.max() + 2)).astype(np.int32)


def tree_sizes_of(m: Any) -> TreeSizes:
    """Sizes of mujoco_warp's model, for the kernel."""
    return TreeSizes(bodies=m.nbody, dofs=m.nv, joints=m.njnt, levels=len(_levels(m)[1]) - 1)


def _floats(array: Any) -> Any:
    """The same memory as numbers, shape (..., 10); the caller keeps the array."""
    return wp.array(ptr=array.ptr, dtype=float, shape=(*array.shape, 10), device=array.device)


class Dynamics:
    """A physics step's dynamics, of a model and its data, in two kernels around the constraints' rows.

    Forces from outside (``qfrc_applied``, ``xfrc_applied``) are left out. Numbers of the model may change, its arrays
    may not be replaced.
    """

    def __init__(self, m: Any, d: Any) -> None:
        """For a model that :func:`fits_dynamics`."""
        self._model, self._data = m, d
        order, levels = _levels(m)
        actuator = np.full(m.nv, -1, np.int32)
        actuator[m.jnt_dofadr.numpy()[m.actuator_trnid.numpy()[:, 0]]] = np.arange(m.nactuator)
        self._sizes = tree_sizes_of(m)
        device = d.qpos.device
        tree = self._tree = Tree()
        with wp.ScopedDevice(device):
            tree.level, tree.order, tree.actuator = (wp.array(x, dtype=int) for x in (levels, order, actuator))
            tree.roots = wp.array(np.unique(m.body_rootid.numpy()[1:]).astype(np.int32), dtype=int)
            tree.biased = wp.array(m.actuator_biastype.numpy() == types.BiasType.AFFINE, dtype=bool)
            self._slope = wp.zeros((d.nworld, m.nv), dtype=float)
        for name, of_model in _NAMES.items():
            setattr(tree, name, getattr(m, of_model))
        tree.gravity = m.opt.gravity
        tree.gain, tree.bias = _floats(m.actuator_gainprm), _floats(m.actuator_biasprm)
        robots = self._robots = Robots()
        for name in ("qpos", "qvel", "xpos", "xquat", "subtree_com", "cdof", "qfrc_actuator", "qfrc_smooth"):
            setattr(robots, name, getattr(d, name))
        robots.control, robots.inertia, robots.slope = d.ctrl, d.M, self._slope
        motion = self._motion = Motion()
        motion.timestep, motion.slope, motion.most_contacts = m.opt.timestep, self._slope, d.naconmax
        motion.joint_type, motion.joint_qpos, motion.joint_dof = m.jnt_type, m.jnt_qposadr, m.jnt_dofadr
        motion.qpos, motion.qvel = d.qpos, d.qvel

    def find(self) -> None:
        """Poses, inertias and all forces but those of constraints, from ``qpos``, ``qvel`` and ``ctrl``."""
        find_dynamics(self._tree, self._robots, self._sizes, _JOINT_CODES)

    def step(self) -> None:
        """Constraints, contacts among them, and the move to the next state."""
        m, d = self._model, self._data
        constraint.make_constraint(m, d)
        solve_problem(problem_of(m, d), sizes_of(m, d), _CODES, self._motion)


_NAMES = {
    "parent": "body_parentid", "root": "body_rootid", "joint": "body_jntadr", "num_joints": "body_jntnum",
    "joint_type": "jnt_type", "joint_body": "jnt_bodyid", "joint_qpos": "jnt_qposadr", "joint_dof": "jnt_dofadr",
    "dof_body": "dof_bodyid", "dof_joint": "dof_jntid", "dof_parent": "dof_parentid", "inertia_start": "M_rowadr",
    "inertia_count": "M_rownnz", "body_pos": "body_pos", "body_quat": "body_quat", "body_ipos": "body_ipos",
    "body_iquat": "body_iquat", "body_mass": "body_mass", "body_inertia": "body_inertia",
    "subtree_mass": "body_subtreemass", "joint_pos": "jnt_pos", "joint_axis": "jnt_axis", "qpos0": "qpos0",
    "rest": "qpos_spring", "stiffness": "jnt_stiffness", "armature": "dof_armature", "damping": "dof_damping",
    "joint_limited": "jnt_actfrclimited", "joint_range": "jnt_actfrcrange", "gear": "actuator_gear",
    "control_limited": "actuator_ctrllimited", "control_range": "actuator_ctrlrange",
    "force_limited": "actuator_forcelimited", "force_range": "actuator_forcerange",
}  # fmt: skip
"""Arrays of mujoco_warp's model by their names in :class:`kernels.dynamics.Tree`."""


class TheirDynamics:
    """The same by mujoco_warp's own step, of any model."""

    def __init__(self, m: Any, d: Any) -> None:
        self._model, self._data = m, d

    def find(self) -> None:
        """Poses alone."""
        mujoco_warp.kinematics(self._model, self._data)

    def step(self) -> None:
        """All of the step, poses once more."""
        mujoco_warp.step(self._model, self._data)


def dynamics_of(m: Any, d: Any) -> Dynamics | TheirDynamics:
    """Ours where the model lets it, else mujoco_warp's."""
    return Dynamics(m, d) if fits_dynamics(m, d) else TheirDynamics(m, d)
