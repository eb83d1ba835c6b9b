"""The dynamics of a physics step: our two kernels for models that they support, mujoco_warp's step for all others.

tests/sim/test_solver.py compares the two.
"""

from types import SimpleNamespace
from typing import Any

import mujoco_warp
import numpy as np
import warp as wp
from mujoco_warp._src import types
from numpy.typing import NDArray

from kernels import dynamics, solver
from kernels.conditions import BASE, ForcedStep, VariedRobots
from kernels.contact import Contacts, Surfaces
from kernels.coordinates import SolverContacts, contacts_to_solver, forces_from_solver
from kernels.dynamics import Robots, Tree, TreeSizes, find_dynamics
from kernels.launch import fits_block, make_struct
from kernels.solver import Problem, Sizes, step_robots

_JOINT_CODES = {name.lower(): types.JointType[name].value for name in ("FREE", "SLIDE", "HINGE")}
_CODES = {
    "free": types.JointType.FREE.value,
    "too_many": types.OverflowType.ITERATIONS.value,
    "too_many_on_line": types.OverflowType.LS_ITERATIONS.value,
    "too_many_contacts": types.OverflowType.NARROWPHASE.value,
    "minval": types.MJ_MINVAL,
    "min_imp": types.MJ_MINIMP,
    "max_imp": types.MJ_MAXIMP,
}
_NOT_SHARED = ("body_isdofancestor", "actuator_forcerange")  # not over worlds; or written in every step


def mix_surfaces(m: Any, geoms: NDArray[Any], ground: int) -> Surfaces:
    """Contact parameters of the solver's ``geoms``, shape (num_shapes,), on the geom ``ground``.

    It mixes two geoms as MuJoCo and mujoco_warp's ``contact_params`` do.
    """

    def read_pair(name: str) -> tuple[Any, Any]:
        """Rows (num_worlds, num_shapes, width) of the geoms and of the ground."""
        values = _share_row(getattr(m, f"geom_{name}")).numpy()
        values = values.reshape(*values.shape[:2], -1)
        return values[:, geoms], values[:, [ground]]

    def prefer(geom_value: Any, ground_value: Any, mixed: Any) -> Any:
        """By the higher priority."""
        return np.where(above, geom_value, np.where(below, ground_value, mixed))

    priority = m.geom_priority.numpy()[:, None]
    above = priority[geoms] > priority[ground]
    below = priority[geoms] < priority[ground]
    condim = m.geom_condim.numpy()[:, None]
    solmix, solmix_0 = read_pair("solmix")
    friction, friction_0 = read_pair("friction")
    solref, solref_0 = read_pair("solref")
    solimp, solimp_0 = read_pair("solimp")
    total = solmix + solmix_0
    share = prefer(1.0, 0.0, np.where(total < types.MJ_MINVAL, 0.5, solmix / np.maximum(total, types.MJ_MINVAL)))
    condim = prefer(condim[geoms], condim[ground], np.maximum(condim[geoms], condim[ground]))
    friction = prefer(friction, friction_0, np.maximum(friction, friction_0))
    timed = (solref[..., :1] > 0.0) & (solref_0[..., :1] > 0.0)
    solref = np.where(timed, share * solref + (1.0 - share) * solref_0, np.minimum(solref, solref_0))
    with wp.ScopedDevice(m.geom_condim.device):
        return make_struct(
            Surfaces,
            geom=wp.array(geoms, dtype=int),
            body=wp.array(m.geom_bodyid.numpy()[geoms], dtype=int),
            condim=wp.array(condim[:, 0], dtype=int),
            friction=wp.array(np.maximum(friction[..., [0, 0, 1, 2, 2]], types.MJ_MINMU), dtype=types.vec5),
            solref=wp.array(solref, dtype=wp.vec2),
            solimp=wp.array(share * solimp + (1.0 - share) * solimp_0, dtype=types.vec5),
        )


def _share_row(array: Any) -> Any:
    """An array over worlds; its first row where all rows are equal, so that robots read the same memory."""
    if array.shape[0] == 1 or array.strides[0] == 0:
        return array[:1]
    values = array.numpy()
    return array[:1] if (values == values[:1]).all() else array


def _read_model(m: Any) -> SimpleNamespace:
    """Arrays of mujoco_warp's model as our kernels take them: one row where all worlds are equal, numbers alone."""
    arrays = {name: getattr(m, name) for name in (*Tree.vars, *Problem.vars) if hasattr(m, name)}
    for name, array in arrays.items():
        if array.ndim > 1 and name not in _NOT_SHARED:
            arrays[name] = array = _share_row(array)
        if name in ("actuator_gainprm", "actuator_biasprm"):  # the same memory, which the model keeps
            arrays[name] = wp.array(ptr=array.ptr, dtype=float, shape=(*array.shape, 10), device=array.device)
    return SimpleNamespace(**arrays)


def is_supported(m: Any) -> bool:
    """Whether :class:`Dynamics` supports this model: robots of joints and position actuators, and nothing else."""
    flags = types.DisableBit
    needed = flags.GRAVITY | flags.SPRING | flags.DAMPER | flags.ACTUATION | flags.CLAMPCTRL | flags.CONSTRAINT
    needed |= flags.FRICTIONLOSS | flags.LIMIT | flags.CONTACT | flags.WARMSTART | flags.REFSAFE
    joints = m.jnt_type.numpy()
    actuated = m.actuator_trnid.numpy()[:, 0]
    free = joints == types.JointType.FREE
    bodies = m.jnt_bodyid.numpy()
    unsupported = (
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
    return not any(unsupported)


def _levels(m: Any) -> tuple[np.ndarray, np.ndarray]:
    """Bodies but the world in order of depth, and their depths."""
    parent = m.body_parentid.numpy()
    depth = np.full(m.nbody, -1, np.int32)
    for body in range(1, m.nbody):
        depth[body] = depth[parent[body]] + 1
    order = np.argsort(depth, kind="stable")[1:].astype(np.int32)
    return order, depth[order]


class Dynamics:
    """The dynamics of a physics step in two kernels, one before and one after contacts are found.

    External forces (``qfrc_applied``, ``xfrc_applied``) are ignored; :meth:`view_forces` is where some can be added.
    Numbers of the model may change if they do so in all worlds equally, or differed between worlds at the start; its
    arrays may not be replaced.

    Attributes:
        surfaces: Contact parameters of a robot's shapes on the ground.
        tree: The model.
    """

    def __init__(
        self, m: Any, d: Any, contacts: Contacts, surfaces: Surfaces, parked: Any, tree_sizes: TreeSizes, sizes: Sizes
    ) -> None:
        """Use a model that :func:`is_supported`, and write the forces of ``contacts``.

        Worlds where the int ``parked`` (num_worlds,) is 2 are left out.
        """
        self.surfaces = surfaces
        self._tree_sizes = tree_sizes
        self._sizes = sizes
        self._num_worlds = d.nworld
        order, levels = _levels(m)
        actuator = np.full(m.nv, -1, np.int32)
        actuator[m.jnt_dofadr.numpy()[m.actuator_trnid.numpy()[:, 0]]] = np.arange(m.nactuator)
        model = _read_model(m)
        with wp.ScopedDevice(d.qpos.device):
            self.tree = make_struct(
                Tree,
                model,
                m.opt,
                body_order=wp.array(order, dtype=int),
                body_level=wp.array(levels, dtype=int),
                dof_actuator=wp.array(actuator, dtype=int),
                roots=wp.array(np.unique(m.body_rootid.numpy()[1:]).astype(np.int32), dtype=int),
            )
            spilled = wp.zeros((d.nworld, sizes.global_floats), dtype=float)
            slope = wp.zeros((d.nworld, m.nv), dtype=float)
        ours = {"contacts": contacts, "surfaces": surfaces, "spilled_contacts": spilled}
        self._problem = make_struct(Problem, model, m.opt, d, **ours)
        self._robots = make_struct(Robots, d, parked=parked, slope=slope)

    def vary_bases(self, **values: Any) -> VariedRobots:
        """Give each world its own base and motors; ``values`` are further ones of :class:`VariedRobots`."""
        with wp.ScopedDevice(self._robots.qpos.device):
            self._robots.strength = wp.ones(self._num_worlds, dtype=float)
            for name, base_name in _BASE_ARRAYS.items():
                array = getattr(self.tree, name)
                rows = np.broadcast_to(array.numpy(), (self._num_worlds, *array.numpy().shape[1:]))
                setattr(self.tree, name, wp.array(rows, dtype=array.dtype))
                values[base_name] = wp.array(rows[:, BASE], dtype=array.dtype)
        return make_struct(VariedRobots, self.tree, self._robots, **values)

    def view_forces(self, **values: Any) -> ForcedStep:
        """The forces that :meth:`find` found; ``values`` are further ones of :class:`ForcedStep`."""
        return make_struct(ForcedStep, self.tree, self._robots, self._problem, **values)

    def find(self) -> None:
        """Compute poses, inertias and all forces but those of constraints, from ``qpos``, ``qvel`` and ``ctrl``."""
        find_dynamics(self.tree, self._robots, self._tree_sizes, _JOINT_CODES)

    def step(self) -> None:
        """Solve the constraints, contacts among them, and move to the next state."""
        step_robots(self._robots, self._problem, self._sizes, _CODES)


_BASE_ARRAYS = {
    "body_mass": "base_mass",
    "body_subtreemass": "total_mass",
    "body_ipos": "base_centre",
    "body_iquat": "base_frame",
    "body_inertia": "base_inertia",
}
"""The base's numbers in :class:`VariedRobots`, by their arrays in :class:`Tree`."""


class StockDynamics:
    """The same by mujoco_warp's own step, for any model."""

    def __init__(self, m: Any, d: Any, contacts: Contacts, surfaces: Surfaces, ground: int) -> None:
        self.surfaces = surfaces
        self._model = m
        self._data = d
        self._contacts = contacts
        d.contact.type.fill_(int(types.ContactType.CONSTRAINT))
        self._solver_contacts = make_struct(
            SolverContacts,
            d.contact,
            count=d.nacon,
            efc_force=d.efc.force,
            overflow=d.overflow,
            too_many=types.OverflowType.NARROWPHASE.value,
            ground=ground,
            slot=wp.zeros(contacts.shape.shape, dtype=int, device=d.qpos.device),
        )

    def find(self) -> None:
        """Compute poses alone."""
        mujoco_warp.kinematics(self._model, self._data)

    def step(self) -> None:
        """Make the whole step; it computes poses once more."""
        self._data.nacon.zero_()
        contacts_to_solver(self._contacts, self.surfaces, self._solver_contacts)
        mujoco_warp.step(self._model, self._data)
        forces_from_solver(self._solver_contacts, self._contacts)


def make_dynamics(
    m: Any, d: Any, contacts: Contacts, parked: Any, geoms: NDArray[Any], ground: int
) -> Dynamics | StockDynamics:
    """:class:`Dynamics` where the model :func:`is_supported`, else :class:`StockDynamics`.

    Worlds where ``parked``, int (num_worlds,), is 2 may be left out. ``geoms`` are the solver's numbers of a robot's
    shapes, (num_shapes,), the same in all worlds, and ``ground`` is the ground's.
    """
    surfaces = mix_surfaces(m, geoms, ground)
    entries = m.M_colind.shape[0]
    tree = TreeSizes(
        bodies=m.nbody,
        coordinates=m.nq,
        dofs=m.nv,
        actuators=m.nu,
        levels=1 + int(_levels(m)[1].max()),
        inertia=entries,
    )
    sizes = Sizes(
        parents=tuple(m.dof_parentid.numpy().tolist()),
        dimensions=max(3, int(m.nmaxcondim)),
        inertia=entries,
        losses=bool((m.dof_frictionloss.numpy() > 0.0).any()),
        capacity=contacts.shape.shape[1],
    )
    fits = fits_block(tree.shared_floats, dynamics.LANES) and fits_block(sizes.shared_floats, solver.LANES)
    if fits and is_supported(m):
        return Dynamics(m, d, contacts, surfaces, parked, tree, sizes)
    return StockDynamics(m, d, contacts, surfaces, ground)
