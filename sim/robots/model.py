"""A robot as a Newton builder, of the model that MuJoCo compiles (:mod:`sim.robots.compiled`)."""

from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.robots.compiled import mj, read_mesh, robot_spec, rotation_matrix
from sim.robots.robot import RobotCfg

_SHAPES = ("SPHERE", "CAPSULE", "CYLINDER", "BOX", "ELLIPSOID", "MESH", "PLANE")
_TYPES = {getattr(mj.mjtGeom, f"mjGEOM_{name}"): getattr(newton.GeoType, name) for name in _SHAPES}
_PASSIVE = {"armature": "armature", "damping": "damping", "friction": "frictionloss"}  # Newton's names and MuJoCo's
_FREE_RANGE = 1e10  # limits of a joint that turns freely [rad]
_NO_EFFORT_LIMIT = 1e6  # [N m]
_RAW_SOLREF = 1  # Newton: MuJoCo's solref is taken as it stands
_vec2: Any = wp.vec2


def build_robot(robot: RobotCfg) -> newton.ModelBuilder:
    """One robot as a Newton builder without visual shapes, ready for a scene."""
    return make_builder(robot_spec(robot).compile())


def make_builder(model: Any) -> newton.ModelBuilder:
    """A compiled robot of :func:`sim.robots.compiled.robot_spec` as a Newton builder."""
    solver = newton.solvers.SolverMuJoCo
    builder = newton.ModelBuilder(gravity=wp.vec3(*map(float, model.opt.gravity)))
    solver.register_custom_attributes(builder)
    builder.rigid_gap = 0.0  # the default of 0.1 m triples the contacts
    joints = [_add_body(builder, model, body) for body in range(1, model.nbody)]
    builder.add_articulation(joints)
    for actuator in range(model.nu):
        dof = int(model.jnt_dofadr[model.actuator_trnid[actuator, 0]])
        row: dict[str, Any] = {"ctrl_source": solver.CtrlSource.CTRL_DIRECT, "ctrl_type": solver.CtrlType.GENERAL}
        if model.actuator_biastype[actuator]:  # else a motor, whose force is its control
            builder.joint_target_ke[dof] = float(model.actuator_gainprm[actuator, 0])
            builder.joint_target_kd[dof] = float(-model.actuator_biasprm[actuator, 2])
            builder.joint_target_mode[dof] = int(newton.JointTargetMode.POSITION)
            row = {"ctrl_source": solver.CtrlSource.JOINT_TARGET, "ctrl_type": solver.CtrlType.POSITION}
        for name in ("ctrl", "force"):
            limited = bool(getattr(model, f"actuator_{name}limited")[actuator])
            row[f"actuator_{name}limited"] = row[f"actuator_has_{name}range"] = int(limited)
            row[f"actuator_{name}range"] = _vec2(*getattr(model, f"actuator_{name}range")[actuator])
        row["actuator_trnid"] = wp.vec2i(dof, 0)
        builder.add_custom_values(**{f"mujoco:{name}": value for name, value in row.items()})
    for k in range(model.neq):
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        builder.set_joint_mimic(joints[follower], joints[leader], coeffs=_vec2(*model.eq_data[k, :2]))
    for geom in np.flatnonzero(model.geom_contype):
        _add_geom(builder, model, int(geom))
    return builder


def _transform(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Any:
    w, x, y, z = map(float, quaternion)
    return wp.transform(wp.vec3(*map(float, position)), wp.quat(x, y, z, w))


def _add_body(builder: newton.ModelBuilder, model: Any, body: int) -> int:
    """Adds a body with its joint, whose number it returns."""
    axes = rotation_matrix(model.body_iquat[body])
    inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
    pose = _transform(model.body_pos[body], model.body_quat[body])
    masses = {"mass": float(model.body_mass[body]), "inertia": wp.mat33(*map(float, inertia.ravel()))}
    centre = wp.vec3(*map(float, model.body_ipos[body]))
    link = builder.add_link(xform=pose, label=model.body(body).name, com=centre, lock_inertia=True, **masses)
    joint = int(model.body_jntadr[body])
    dof = int(model.jnt_dofadr[joint])
    if body == 1:
        base = builder.add_joint_free(child=link, label=model.joint(joint).name)
        for ours, theirs in _PASSIVE.items():
            getattr(builder, f"joint_{ours}")[:6] = getattr(model, f"dof_{theirs}")[:6].tolist()
        return base
    limits = model.jnt_range[joint] if model.jnt_limited[joint] else (-_FREE_RANGE, _FREE_RANGE)
    anchor = _transform(model.jnt_pos[joint], np.array([1.0, 0.0, 0.0, 0.0]))
    is_hinge = model.jnt_type[joint] == mj.mjtJoint.mjJNT_HINGE
    add_joint: Any = builder.add_joint_revolute if is_hinge else builder.add_joint_prismatic
    effort = float(model.jnt_actfrcrange[joint, 1]) if model.jnt_actfrclimited[joint] else _NO_EFFORT_LIMIT
    return add_joint(
        parent=int(model.body_parentid[body]) - 1,
        child=link,
        parent_xform=pose * anchor,
        child_xform=anchor,
        axis=wp.vec3(*map(float, model.jnt_axis[joint])),
        target_ke=0.0,
        target_kd=0.0,
        stiffness=float(model.jnt_stiffness[joint]),
        rest_q=float(model.qpos_spring[model.jnt_qposadr[joint]]),
        limit_lower=float(limits[0]),
        limit_upper=float(limits[1]),
        effort_limit=effort,
        **{ours: float(getattr(model, f"dof_{theirs}")[dof]) for ours, theirs in _PASSIVE.items()},
        label=model.joint(joint).name,
        custom_attributes={
            "mujoco:solreflimit": _vec2(*model.jnt_solref[joint]),
            "mujoco:solreflimit_mode": _RAW_SOLREF,
            "mujoco:solimplimit": _vector(model.jnt_solimp[joint]),
            "mujoco:limit_margin": float(model.jnt_margin[joint]),
            "mujoco:solreffriction": _vec2(*model.dof_solref[dof]),
            "mujoco:solimpfriction": _vector(model.dof_solimp[dof]),
        },
    )


def _vector(values: NDArray[np.float64]) -> Any:
    return wp.types.vector(length=len(values), dtype=wp.float32)(*map(float, values))


def _add_geom(builder: newton.ModelBuilder, model: Any, geom: int) -> None:
    kind = mj.mjtGeom(int(model.geom_type[geom]))
    source, scale = None, model.geom_size[geom]
    if kind == mj.mjtGeom.mjGEOM_MESH:
        vertices, faces = read_mesh(model, geom)
        source, scale = newton.Mesh(vertices, faces.ravel(), compute_inertia=False), (1.0, 1.0, 1.0)
    friction = dict(zip(("mu", "mu_torsional", "mu_rolling"), map(float, model.geom_friction[geom]), strict=True))
    builder.add_shape(
        body=int(model.geom_bodyid[geom]) - 1,
        type=_TYPES[kind],
        xform=_transform(model.geom_pos[geom], model.geom_quat[geom]),
        scale=wp.vec3(*map(float, scale)),
        src=source,
        label=model.geom(geom).name,
        # Of collision group 0: a robot does not touch itself.
        cfg=newton.ModelBuilder.ShapeConfig(density=0.0, gap=0.0, collision_group=0, **friction),
        custom_attributes={
            "mujoco:condim": int(model.geom_condim[geom]),
            "mujoco:geom_priority": int(model.geom_priority[geom]),
            "mujoco:geom_solimp": _vector(model.geom_solimp[geom]),
            "mujoco:geom_solmix": float(model.geom_solmix[geom]),
            "mujoco:solref": _vec2(*model.geom_solref[geom]),
            "mujoco:solref_mode": _RAW_SOLREF,
        },
    )
