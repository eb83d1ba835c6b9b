"""Elements of a robot's file that simulations cannot represent: each function yields complaints."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sim.robots.elements import mj, touching_geoms

_LEAST_GYRATION = 1e-4  # radius of gyration below which a body is a point [m]
_CONSTRAINT_FLAGS = ("constraint", "equality", "frictionloss", "limit", "contact", "refsafe")
_FORCE_FLAGS = ("spring", "damper", "gravity", "clampctrl", "actuation")
_ZERO_OPTIONS = ("density", "viscosity", "wind", "disableactuator")
_ZERO_ATTRIBUTES = {
    "body": ("gravcomp", "mocap"),
    "joint": ("ref",),
    "geom": ("margin", "gap", "adhesion", "surfacevel"),
    "actuator": ("armature", "damping", "delay"),
}
"""Attributes of elements that must be 0."""


def refused_elements(spec: Any) -> Iterator[str]:
    """Elements and attributes of a specification, with their line in the file."""
    yield from _refused_options(spec.option)
    yield from _refused_equalities(spec)
    bodies, joints, geoms = spec.bodies, spec.joints, touching_geoms(*spec.bodies)
    elements = {"body": bodies, "joint": joints, "geom": geoms, "actuator": spec.actuators}
    for kind, names in _ZERO_ATTRIBUTES.items():
        for element in elements[kind]:
            for name in names:
                if np.any(getattr(element, name)):
                    yield f"<{kind} {name}> of {element.name} ({element.info})"
    for joint in joints:
        is_free = joint.type == mj.mjtJoint.mjJNT_FREE
        if joint.type == mj.mjtJoint.mjJNT_BALL:
            yield f"a ball joint ({joint.info})"
        if not (is_free or joint.name):
            yield f"a joint without a name ({joint.info})"
        if np.any(joint.damping[1:]):
            yield f"<joint damping> of {joint.name} ({joint.info})"
        if np.any(joint.stiffness[0 if is_free else 1 :]):
            yield f"<joint stiffness> of {joint.name} ({joint.info})"
    for geom in geoms:
        if geom.type in (mj.mjtGeom.mjGEOM_HFIELD, mj.mjtGeom.mjGEOM_SDF):
            yield f"a height field or distance field as geom {geom.name} ({geom.info})"
    if spec.compiler.inertiafromgeom == mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        for body in bodies:
            if body.explicitinertial and not (body.joints or body.geoms):
                yield f'<inertial> of {body.name} ({body.info}) beside inertiafromgeom="true"'
    yield from (f"a tendon ({tendon.info})" for tendon in spec.tendons)
    yield from (f"a flexible body ({flex.info})" for flex in spec.flexes)


def _refused_options(option: Any) -> Iterator[str]:
    for flag in (*_CONSTRAINT_FLAGS, *_FORCE_FLAGS):
        if option.disableflags & getattr(mj.mjtDisableBit, f"mjDSBL_{flag.upper()}"):
            yield f'<flag {flag}="disable"> in <option>'
    if option.enableflags & mj.mjtEnableBit.mjENBL_OVERRIDE:
        yield '<flag override="enable">'
    yield from (f"<option {name}>" for name in _ZERO_OPTIONS if np.any(getattr(option, name)))
    if option.gravity[0] or option.gravity[1] or not option.gravity[2] < 0.0:
        yield f"<option gravity> that does not point down, {option.gravity}"


def _refused_equalities(spec: Any) -> Iterator[str]:
    """Equalities but those by which a joint follows one leader linearly, with MuJoCo's usual stiffness."""
    followers = [equality.name1 for equality in spec.equalities]
    usual = mj.MjSpec().add_equality()
    for equality in spec.equalities:
        is_linear = equality.type == mj.mjtEq.mjEQ_JOINT and not np.any(equality.data[2:5])
        has_leader = equality.name2 and equality.name2 not in followers and followers.count(equality.name1) == 1
        is_usual = all(np.array_equal(getattr(equality, name), getattr(usual, name)) for name in ("solref", "solimp"))
        if not (is_linear and has_leader and is_usual and equality.active):
            kind = mj.mjtEq(equality.type).name.removeprefix("mjEQ_").lower()
            yield f"<equality> {kind} of {equality.name1} ({equality.info})"


def structure_problems(model: Any) -> Iterator[str]:
    """Complaints about a compiled model that is no robot of single joints on a free base."""
    if not model.njnt or model.jnt_type[0] != mj.mjtJoint.mjJNT_FREE or model.jnt_bodyid[0] != 1:
        yield "the first body must move freely: give it a <freejoint/>"
        return
    if not model.geom_contype[model.geom_bodyid > 0].any():
        yield "no geom touches anything: give some contype 1, in a URDF a <collision>"
    for k in range(1, model.njnt):
        if model.jnt_type[k] == mj.mjtJoint.mjJNT_FREE or model.body_jntnum[model.jnt_bodyid[k]] != 1:
            yield f"joint {model.joint(k).name} must be a hinge or slide, the only joint of its body"
    for k in np.flatnonzero((model.geom_bodyid == 0) & (model.geom_contype != 0)):
        yield f"geom {model.geom(k).name} belongs to the world, not to the robot: take it out"
    poses = np.hstack([model.body_pos, model.body_quat, model.body_ipos])
    for k in range(1, model.nbody):
        if not np.isfinite(poses[k]).all():
            yield f"position and rotation of body {model.body(k).name} must be numbers"
        if model.body_inertia[k].min() < _LEAST_GYRATION**2 * model.body_mass[k]:
            yield f"inertia of body {model.body(k).name} is that of a point: give it that of a body [kg m^2]"
