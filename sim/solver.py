"""What is ours within a physics step: dynamics, and constraints with the move, in a kernel each, for models that fit.

Any other model takes mujoco_warp's step. tests/sim/test_solver.py holds ours against theirs.
"""

from typing import Any

import mujoco_warp
import numpy as np
import warp as wp
from mujoco_warp._src import types
from numpy.typing import NDArray

from kernels import dynamics, lanes, solver
from kernels.conditions import BASE, VariedRobots
from kernels.contact import Contacts, Surfaces
from kernels.coordinates import SolverContacts, ask_forces, tell_contacts
from kernels.dynamics import Robots, Tree, TreeSizes, find_dynamics
from kernels.solver import Problem, Sizes, step_robots

_JOINT_CODES = {name.lower(): types.JointType[name].value for name in ("FREE", "SLIDE", "HINGE")}
_CODES = {
    "free": types.JointType.FREE.value,
    "too_many": types.OverflowType.ITERATIONS.value,
    "too_many_on_line": types.OverflowType.LS_ITERATIONS.value,
    "too_many_contacts": types.OverflowType.NARROWPHASE.value,
    "minval": types.MJ_MINVAL,
    "least_imp": types.MJ_MINIMP,
    "most_imp": types.MJ_MAXIMP,
}


def mix_surfaces(m: Any, geoms: NDArray[Any], ground: int) -> Surfaces:
    """Surfaces of the solver's geoms ``geoms``, shape (num_shapes,), on that of the ground, as MuJoCo mixes two geoms.

    It is what mujoco_warp's ``contact_params`` makes of a pair.
    """
    of_all = {name: alike(getattr(m, f"geom_{name}")).numpy() for name in ("solmix", "friction", "solref", "solimp")}
    (solmix, friction, solref, solimp), (solmix_0, friction_0, solref_0, solimp_0) = (
        [values[:, which] for values in of_all.values()] for which in (geoms, [ground])
    )
    priority, condim = m.geom_priority.numpy(), m.geom_condim.numpy()
    above, below = priority[geoms] > priority[ground], priority[geoms] < priority[ground]
    equal = np.where(solmix + solmix_0 < types.MJ_MINVAL, 0.5, solmix / np.maximum(solmix + solmix_0, types.MJ_MINVAL))
    share = np.where(above, 1.0, np.where(below, 0.0, equal))[..., None]
    above, below = above[:, None], below[:, None]
    friction = np.where(above, friction, np.where(below, friction_0, np.maximum(friction, friction_0)))
    mixed = share * solref + (1.0 - share) * solref_0
    timed = (solref[..., :1] > 0.0) & (solref_0[..., :1] > 0.0)
    dims = np.maximum(condim[geoms], condim[ground])
    dims = np.where(above[:, 0], condim[geoms], np.where(below[:, 0], condim[ground], dims))
    surfaces = Surfaces()
    with wp.ScopedDevice(m.geom_condim.device):
        surfaces.geom = wp.array(geoms, dtype=int)
        surfaces.body = wp.array(m.geom_bodyid.numpy()[geoms], dtype=int)
        surfaces.condim = wp.array(dims, dtype=int)
        surfaces.friction = wp.array(np.maximum(friction[..., [0, 0, 1, 2, 2]], types.MJ_MINMU), dtype=types.vec5)
        surfaces.solref = wp.array(np.where(timed, mixed, np.minimum(solref, solref_0)), dtype=wp.vec2)
        surfaces.solimp = wp.array(share * solimp + (1.0 - share) * solimp_0, dtype=types.vec5)
    return surfaces


def alike(array: Any) -> Any:
    """An array over worlds; its first row where all are the same, so that robots read the same memory."""
    if array.shape[0] == 1 or array.strides[0] == 0:
        return array[:1]
    values = array.numpy()
    return array[:1] if (values == values[:1]).all() else array


def sizes_of(m: Any, contacts: Contacts) -> Sizes:
    """Sizes of mujoco_warp's model with room for so many contacts, for the kernel."""
    return Sizes(
        dofs=m.nv,
        contacts=contacts.shape.shape[1],
        dimensions=max(3, int(m.nmaxcondim)),
        inertia=m.M_colind.shape[0],
        losses=bool((m.dof_frictionloss.numpy() > 0.0).any()),
    )


def fits(m: Any, contacts: Contacts) -> bool:
    """Whether :class:`Dynamics` takes this model: robots of joints and position actuators, and nothing else."""
    flags = types.DisableBit
    needed = flags.GRAVITY | flags.SPRING | flags.DAMPER | flags.ACTUATION | flags.CLAMPCTRL | flags.CONSTRAINT
    needed |= flags.FRICTIONLOSS | flags.LIMIT | flags.CONTACT | flags.WARMSTART | flags.REFSAFE
    joints, actuated = m.jnt_type.numpy(), m.actuator_trnid.numpy()[:, 0]
    free, bodies = joints == types.JointType.FREE, m.jnt_bodyid.numpy()
    misfits = (
        m.opt.run_collision_detection or m.flg_surfacevel or any(vars(m.callback).values()) or m.nsensor,
        m.opt.integrator != types.IntegratorType.IMPLICITFAST or m.opt.disableflags & needed,
        m.opt.solver != types.SolverType.NEWTON or m.opt.cone != types.ConeType.ELLIPTIC,
        m.opt.enableflags or m.opt.noslip_iterations or not m.opt.iterations or not m.nv,
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
    room = lanes.fits(tree_sizes_of(m).words, dynamics.LANES) and lanes.fits(sizes_of(m, contacts).words, solver.LANES)
    return room and not any(misfits)


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
    """A physics step's dynamics, of a model and its data, in two kernels, before and after contacts are found.

    Forces from outside (``qfrc_applied``, ``xfrc_applied``) are left out. Numbers of the model may change if they do so
    in all worlds alike, or were not the same in all; its arrays may not be replaced.
    """

    def __init__(self, m: Any, d: Any, contacts: Contacts, surfaces: Surfaces, parked: Any) -> None:
        """For a model that :func:`fits`, and its contacts, whose forces are written; some worlds may be parked."""
        self._tree_sizes, self._sizes, self.surfaces = tree_sizes_of(m), sizes_of(m, contacts), surfaces
        self._num_worlds = d.nworld
        order, levels = _levels(m)
        actuator = np.full(m.nv, -1, np.int32)
        actuator[m.jnt_dofadr.numpy()[m.actuator_trnid.numpy()[:, 0]]] = np.arange(m.nactuator)
        limited = np.isin(np.arange(m.njnt), m.jnt_limited_slide_hinge_adr.numpy())
        tree, problem, robots = self._tree, self._problem, self._robots = Tree(), Problem(), Robots()
        with wp.ScopedDevice(d.qpos.device):
            tree.level, tree.order, tree.actuator = (wp.array(x, dtype=int) for x in (levels, order, actuator))
            tree.roots = wp.array(np.unique(m.body_rootid.numpy()[1:]).astype(np.int32), dtype=int)
            tree.biased = wp.array(m.actuator_biastype.numpy() == types.BiasType.AFFINE, dtype=bool)
            problem.joint_limited = wp.array(limited, dtype=bool)
            robots.slope = wp.zeros((d.nworld, m.nv), dtype=float)
            problem.others = wp.zeros((d.nworld, max(1, self._sizes.other_words)), dtype=float)
        for struct, names in ((tree, _OF_TREE), (problem, _OF_PROBLEM)):
            for name, of_model in names.items():
                array = getattr(m, of_model)
                over_worlds = array.ndim > 1 and of_model not in _NOT_OVER_WORLDS
                setattr(struct, name, alike(array) if over_worlds else array)
        tree.gravity = m.opt.gravity
        tree.gain, tree.bias = _floats(alike(m.actuator_gainprm)), _floats(alike(m.actuator_biasprm))
        problem.most_iterations, problem.most_line_iterations = m.opt.iterations, m.opt.ls_iterations
        for name in ("tolerance", "ls_tolerance", "impratio_invsqrt", "timestep"):
            setattr(problem, name, getattr(m.opt, name))
        for name in ("qpos", "qvel", "xpos", "xquat", "subtree_com", "cdof", "qfrc_actuator", "qfrc_smooth"):
            setattr(robots, name, getattr(d, name))
        robots.control, robots.inertia, robots.parked = d.ctrl, d.M, parked
        problem.contacts, problem.surfaces = contacts, surfaces
        problem.qacc_warmstart, problem.iterations, problem.overflow = d.qacc_warmstart, d.solver_niter, d.overflow

    def vary_bases(self) -> VariedRobots:
        """Gives each world a base and motors of its own, for :func:`kernels.conditions.begin_conditions`."""
        tree, robots, varied = self._tree, self._robots, VariedRobots()
        with wp.ScopedDevice(robots.qpos.device):
            for name in _BASE_BY_MODEL:
                array = getattr(tree, name)
                rows = np.broadcast_to(array.numpy(), (self._num_worlds, *array.numpy().shape[1:]))
                setattr(tree, name, wp.array(rows, dtype=array.dtype))
                setattr(varied, name, getattr(tree, name))
                setattr(varied, _BASE_BY_MODEL[name], wp.array(rows[:, BASE], dtype=array.dtype))
            robots.strength = varied.strength = wp.ones(self._num_worlds, dtype=float)
        return varied

    def find(self) -> None:
        """Poses, inertias and all forces but those of constraints, from ``qpos``, ``qvel`` and ``ctrl``."""
        find_dynamics(self._tree, self._robots, self._tree_sizes, _JOINT_CODES)

    def step(self) -> None:
        """Constraints, contacts among them, and the move to the next state."""
        step_robots(self._robots, self._problem, self._sizes, _CODES)


_OF_TREE = {
    "parent": "body_parentid", "root": "body_rootid", "joint": "body_jntadr", "num_joints": "body_jntnum",
    "joint_type": "jnt_type", "joint_body": "jnt_bodyid", "joint_qpos": "jnt_qposadr", "joint_dof": "jnt_dofadr",
    "dof_body": "dof_bodyid", "dof_joint": "dof_jntid", "dof_parent": "dof_parentid", "inertia_start": "M_rowadr",
    "inertia_count": "M_rownnz", "body_pos": "body_pos", "body_quat": "body_quat", "body_ipos": "body_ipos",
    "body_iquat": "body_iquat", "body_mass": "body_mass", "body_inertia": "body_inertia",
    "subtree_mass": "body_subtreemass", "joint_pos": "jnt_pos", "joint_axis": "jnt_axis", "qpos0": "qpos0",
    "rest": "qpos_spring", "stiffness": "jnt_stiffness", "armature": "dof_armature", "damping": "dof_damping",
    "joint_force_limited": "jnt_actfrclimited", "joint_force_range": "jnt_actfrcrange", "gear": "actuator_gear",
    "control_limited": "actuator_ctrllimited", "control_range": "actuator_ctrlrange",
    "force_limited": "actuator_forcelimited", "force_range": "actuator_forcerange",
}  # fmt: skip
_OF_PROBLEM = {
    "joint_type": "jnt_type", "joint_qpos": "jnt_qposadr", "joint_dof": "jnt_dofadr", "joint_range": "jnt_range",
    "joint_margin": "jnt_margin", "joint_solref": "jnt_solref", "joint_solimp": "jnt_solimp", "dof_joint": "dof_jntid",
    "dof_weight": "dof_invweight0", "dof_solref": "dof_solref", "dof_solimp": "dof_solimp",
    "frictionloss": "dof_frictionloss", "body_root": "body_rootid", "body_weight": "body_invweight0",
    "is_ancestor": "body_isdofancestor", "inertia_row": "M_hinit_i", "inertia_col": "M_colind",
}  # fmt: skip
"""Arrays of mujoco_warp's model by their names in :class:`Tree` and :class:`Problem`."""
_BASE_BY_MODEL = {
    "body_mass": "base_mass", "subtree_mass": "total_mass", "body_ipos": "base_centre", "body_iquat": "base_frame",
    "body_inertia": "base_inertia",
}  # fmt: skip
_NOT_OVER_WORLDS = ("body_isdofancestor", "actuator_forcerange")
"""Of arrays with several dimensions: what a drive writes anew in each step may come to differ."""


class TheirDynamics:
    """The same by mujoco_warp's own step, of any model."""

    def __init__(self, m: Any, d: Any, contacts: Contacts, surfaces: Surfaces, ground: int) -> None:
        self._model, self._data, self._contacts, self._surfaces = m, d, contacts, surfaces
        theirs = self._theirs = SolverContacts()
        theirs.count, theirs.efc_force, theirs.overflow = d.nacon, d.efc.force, d.overflow
        theirs.too_many, theirs.ground = types.OverflowType.NARROWPHASE.value, ground
        for name in ("worldid", "geom", "dist", "pos", "frame", "dim", "friction", "solref", "solimp", "efc_address"):
            setattr(theirs, name, getattr(d.contact, name))
        d.contact.type.fill_(int(types.ContactType.CONSTRAINT))
        theirs.slot = wp.zeros(contacts.shape.shape, dtype=int, device=d.qpos.device)

    def find(self) -> None:
        """Poses alone."""
        mujoco_warp.kinematics(self._model, self._data)

    def step(self) -> None:
        """All of the step, poses once more."""
        tell_contacts(self._contacts, self._surfaces, self._theirs)
        mujoco_warp.step(self._model, self._data)
        ask_forces(self._theirs, self._contacts)


def dynamics_of(m: Any, d: Any, contacts: Contacts, parked: Any, geoms: NDArray[Any], ground: int) -> Any:
    """:class:`Dynamics` where the model lets it, else :class:`TheirDynamics`.

    Worlds where ``parked``, int (num_worlds,), is 2 may be left out. ``geoms`` are the solver's of a robot's shapes,
    (num_shapes,), the same in all worlds, and ``ground`` is that of the ground.
    """
    surfaces = mix_surfaces(m, geoms, ground)
    if fits(m, contacts):
        return Dynamics(m, d, contacts, surfaces, parked)
    return TheirDynamics(m, d, contacts, surfaces, ground)
