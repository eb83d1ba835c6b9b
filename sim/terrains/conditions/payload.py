"""A payload on the base: a point mass, or less of the base itself."""

from typing import Any

import numpy as np
import warp as wp

from kernels.conditions import BASE, VariedRobots
from sim.terrains.conditions.base import Array, Condition, ConditionDose, Gene, direction_text


@wp.func
def _point_inertia(d: wp.vec3) -> wp.mat33:
    """Inertia of a unit mass at ``d`` [m]."""
    return wp.length_sq(d) * wp.identity(n=3, dtype=float) - wp.outer(d, d)


@wp.func
def _begin_payload(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    mass, rotation = robots.base_mass[env], robots.base_frame[env]
    added = wp.max(row[first] * robots.total_mass[env], -0.5 * mass)
    frame = wp.quat(rotation[0], rotation[1], rotation[2], rotation[3])
    moved, moments = wp.vec3(0.0), 1.0 * robots.base_inertia[env]
    if added < 0.0:
        moments *= (mass + added) / mass
    if added > 0.0:
        offset = wp.vec3(row[first + 1], row[first + 2], 0.0)
        moved = (added / (mass + added)) * offset
        to_base = wp.quat_to_matrix(wp.quat(rotation[1], rotation[2], rotation[3], rotation[0]))
        inertia = to_base * wp.diag(moments) * wp.transpose(to_base)
        inertia += mass * _point_inertia(moved) + added * _point_inertia(offset - moved)
        axes, principal = wp.eig3(inertia)
        turned = wp.quat_from_matrix(axes)
        frame = wp.quat(turned[3], turned[0], turned[1], turned[2])
        moments = principal
    robots.body_mass[env, BASE] = mass + added
    robots.body_subtreemass[env, BASE] = robots.total_mass[env] + added
    robots.body_ipos[env, BASE] = robots.base_centre[env] + moved
    robots.body_iquat[env, BASE] = frame
    robots.body_inertia[env, BASE] = moments


class Payload(Condition):
    """Mass over that of the robot, and where it is from the base's mass centre, ahead and to the left [m].

    A negative one leaves less of the base, half of it at least.
    """

    name, cause = "payload", "payload"
    genes = (
        Gene(name="payload", low=-0.05, middle=0.0, high=0.4, limits=(-0.1, 10.0)),
        Gene(name="payload_x", low=-0.2, middle=0.0, high=0.2, unit="m"),
        Gene(name="payload_y", low=-0.2, middle=0.0, high=0.2, unit="m", mirrored=True),
    )
    dose = ConditionDose(title="payload over the mass", values=(0.0, 0.1, 0.2, 0.3, 0.4))
    varied = (-0.01, 0.03)
    begin = _begin_payload

    def text(self, values: Array) -> str:
        """Its share of the robot's mass, and where it is."""
        share, where = values[0], values[1:]
        if abs(share) < 0.0005:
            return ""
        if share < 0:
            return f"base lighter by {-share:.1%} of the robot's mass"
        offset = direction_text(where, ".2f", 0.005, ("m ahead of", "m behind", "m left of", "m right of"))
        return f"payload of {share:.1%} of the robot's mass{offset and f', {offset} the centre of the base'}"

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Adds the mass to the base of the model."""
        from sim.robots.elements import mj, rotation_matrix

        model, base = episodes.model, 1
        added = max(values[0] * model.body_subtreemass[base], -0.5 * model.body_mass[base])
        if added:
            model.body_sameframe[base] = 0  # or MuJoCo takes the frame of the body for that of its inertia
            model.body_subtreemass[[0, base]] += added
        if added < 0.0:
            model.body_inertia[base] *= (model.body_mass[base] + added) / model.body_mass[base]
            model.body_mass[base] += added
        elif added > 0.0:
            mass, offset = model.body_mass[base], np.append(values[1:], 0.0)
            moved = added / (mass + added) * offset
            axes = rotation_matrix(model.body_iquat[base])
            inertia = axes @ np.diag(model.body_inertia[base]) @ axes.T
            for kilograms, d in ((mass, moved), (added, offset - moved)):
                inertia += kilograms * (d @ d * np.eye(3) - np.outer(d, d))
            moments, axes = np.linalg.eigh(inertia)
            axes[:, 2] *= np.linalg.det(axes)  # right-handed
            mj.mju_mat2Quat(model.body_iquat[base], axes.ravel())
            model.body_inertia[base], model.body_mass[base] = moments, mass + added
            model.body_ipos[base] += moved
