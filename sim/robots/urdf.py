"""A URDF as a specification of MuJoCo's, with a free base and the masses of all its links."""

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.robots.elements import mj, rotation_matrix, touching_geoms

_FRICTION = 1.0
_TIME_CONSTANT_S = 0.01
_SKEW = 0.01  # share by which a principal axis may miss a joint's
_FULL = [[0, 3, 4], [3, 1, 5], [4, 5, 2]]  # matrix of MuJoCo's xx, yy, zz, xy, xz, yz


def read_urdf(root: ET.Element) -> Any:
    """The ``MjSpec`` of a URDF: contact as in docs/robots.md, and what is fixed to a link adds its mass to it."""
    compiler = root
    for tag in ("mujoco", "compiler"):
        element = compiler.find(tag)
        compiler = ET.SubElement(compiler, tag) if element is None else element
    compiler.attrib.setdefault("inertiafromgeom", "false")
    compiler.attrib |= dict.fromkeys(("strippath", "fusestatic", "discardvisual"), "false")
    ET.indent(root)  # every element on a line of its own
    spec = mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    for body in spec.bodies:
        geoms = touching_geoms(body)
        for number, geom in enumerate(geoms):
            geom.name = body.name if len(geoms) == 1 else f"{body.name}_{number}"
            geom.friction[0] = _FRICTION
            geom.solref = _TIME_CONSTANT_S, 1.0
    for base in spec.worldbody.bodies:
        if not base.joints:  # the world's joint may be floating already
            base.add_freejoint()
        _merge_masses(base)  # MuJoCo refuses inertias of fixed links that no body could have
    return spec


def _merge_masses(body: Any) -> list[Any]:
    """Gives a body the masses that are fixed to it; returns them: mass [kg], centre [m], inertia [kg m^2]."""
    axes = rotation_matrix(body.iquat)
    inertia = np.diag(body.inertia) if np.isnan(body.fullinertia[0]) else body.fullinertia[_FULL]
    masses = [(float(body.mass), np.array(body.ipos), axes @ inertia @ axes.T)] if body.mass > 0.0 else []
    for child in body.bodies:
        child_masses = _merge_masses(child)
        if not child.joints:
            turn = rotation_matrix(child.quat)
            masses += [(m, child.pos + turn @ centre, turn @ inertia @ turn.T) for m, centre, inertia in child_masses]
            child.mass, child.inertia, child.fullinertia = 0.0, np.zeros(3), np.full(6, np.nan)
    if body.joints and masses:
        mass = sum(m for m, _, _ in masses)
        middle = sum(m * centre for m, centre, _ in masses) / mass
        shifts = [(m, centre - middle, inertia) for m, centre, inertia in masses]
        whole = np.sum([inertia + m * (d @ d * np.eye(3) - np.outer(d, d)) for m, d, inertia in shifts], axis=0)
        if body.joints[0].type == mj.mjtJoint.mjJNT_HINGE:
            whole = _move_rotor(whole, body.joints[0])
        body.explicitinertial, body.mass, body.ipos, body.iquat = True, mass, middle, (1.0, 0.0, 0.0, 0.0)
        body.fullinertia = whole[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return masses


def _move_rotor(inertia: NDArray[np.float64], joint: Any) -> NDArray[np.float64]:
    """Moves the inertia about the joint's axis that no body can have to the joint's armature; returns the rest."""
    # The largest principal inertia of a body is at most the sum of the others; some URDFs add that of the motor.
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    about_axis = float(axis @ inertia @ axis)
    excess = 2.0 * about_axis - float(np.trace(inertia))
    if excess <= 0.0 or np.linalg.norm(inertia @ axis - about_axis * axis) > _SKEW * about_axis:
        return inertia
    excess += _SKEW * (about_axis - excess)  # the axis is a principal one but for rounding
    joint.armature += excess
    return inertia - excess * np.outer(axis, axis)
