"""Terrain contact: strips of sphere probes against height grids, written as contact records for the physics solver.

A strip is a row of equal spheres on one collision shape, straight but for meshes (:mod:`sim.robots.probes` makes them).
Of the probes of a strip that touch, the first, the deepest and the last become contacts: a lying capsule rests on its
two ends and on the highest point between, and a robot on its back cannot flood the solver.
"""

from typing import Any

import warp as wp

from kernels.heightfield import SurfacePoint, Terrain, ceiling_over, nearest_surface_point


@wp.struct
class Probes:
    """Sphere probes of one robot, grouped in strips."""

    position: wp.array[wp.vec3]
    """Probe centres in the frame of their body [m], shape (num_probes,), strip after strip in order along the strip."""
    strip_start: wp.array[int]
    """First probe of each strip, shape (num_strips + 1,)."""
    strip_radius: wp.array[float]
    """Probe radius of each strip [m], shape (num_strips,)."""
    strip_spread: wp.array[float]
    """Farthest that a strip's centres lie from the line between its ends [m], shape (num_strips,); 0 if straight."""
    strip_body: wp.array[int]
    """Body of each strip, counted within one robot, shape (num_strips,)."""
    strip_shape: wp.array[int]
    """Collision shape of each strip, counted within one robot, shape (num_strips,)."""


@wp.struct
class Layout:
    """Where the robots of the environments stand in the flat model arrays."""

    bodies_per_env: int
    shapes_per_env: int
    first_shape: int
    """Index of environment 0's first collision shape."""
    ground_shape: int
    """The static shape that carries the ground's material."""


@wp.struct
class ContactBuffer:
    """Contact records as Newton's solver reads them (``newton.Contacts``), shape (capacity,) each."""

    count: wp.array[int]
    shape0: wp.array[int]
    shape1: wp.array[int]
    point0: wp.array[wp.vec3]
    point1: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    offset0: wp.array[wp.vec3]
    offset1: wp.array[wp.vec3]
    margin0: wp.array[float]
    margin1: wp.array[float]


@wp.func
def _emit_contact(
    contacts: ContactBuffer, slot: int, ground_shape: int, shape: int, terrain: Terrain, t: int, pose: wp.transform,
    centre: wp.vec3, radius: float,
):  # fmt: skip
    # The capacity is checked by whoever reads the count: it runs on past it, the records do not.
    if slot < contacts.shape0.shape[0]:
        centre_w = wp.transform_point(pose, centre)
        point = nearest_surface_point(terrain, t, centre_w, radius)
        contacts.shape0[slot] = ground_shape
        contacts.shape1[slot] = shape
        contacts.point0[slot] = centre_w - point.normal * point.distance
        contacts.point1[slot] = centre
        contacts.normal[slot] = point.normal
        contacts.offset0[slot] = wp.vec3(0.0)
        contacts.offset1[slot] = wp.transform_vector(wp.transform_inverse(pose), -point.normal * radius)
        contacts.margin0[slot] = 0.0
        contacts.margin1[slot] = radius


@wp.kernel
def _collide_strips_kernel(
    body_q: wp.array[wp.transform],
    terrain_of_env: wp.array[int],
    terrain: Terrain,
    probes: Probes,
    layout: Layout,
    contacts_out: ContactBuffer,
):
    """Grid (num_strips, num_envs): the threads of a warp look at the same part of different robots."""
    strip, env = wp.tid()
    t = terrain_of_env[env]
    radius = probes.strip_radius[strip]
    pose = body_q[env * layout.bodies_per_env + probes.strip_body[strip]]
    begin = probes.strip_start[strip]
    end = probes.strip_start[strip + 1]
    a = wp.transform_point(pose, probes.position[begin])
    b = wp.transform_point(pose, probes.position[end - 1])
    reach = radius + probes.strip_spread[strip]
    lowest = wp.min(a[2], b[2]) - reach
    lower = wp.vec2(wp.min(a[0], b[0]) - reach, wp.min(a[1], b[1]) - reach)
    upper = wp.vec2(wp.max(a[0], b[0]) + reach, wp.max(a[1], b[1]) + reach)
    ceiling = ceiling_over(terrain, t, lower, upper)
    if not (lowest < ceiling):
        return  # also where the state is NaN
    first = int(-1)
    last = int(-1)
    deepest = int(-1)
    depth = float(0.0)
    point = SurfacePoint()
    for k in range(begin, end):
        centre = wp.transform_point(pose, probes.position[k])
        if centre[2] - radius < ceiling:
            point = nearest_surface_point(terrain, t, centre, radius)
        else:
            point.distance = radius
        if point.distance < radius:
            if first < 0:
                first = k
            last = k
            if radius - point.distance > depth:
                depth = radius - point.distance
                deepest = k
    if first < 0:
        return
    shape = layout.first_shape + env * layout.shapes_per_env + probes.strip_shape[strip]
    slot = wp.atomic_add(contacts_out.count, 0, 1 + int(first != deepest) + int(last != deepest))
    ground = layout.ground_shape
    _emit_contact(contacts_out, slot, ground, shape, terrain, t, pose, probes.position[deepest], radius)
    if first != deepest:
        slot += 1
        _emit_contact(contacts_out, slot, ground, shape, terrain, t, pose, probes.position[first], radius)
    if last != deepest:
        slot += 1
        _emit_contact(contacts_out, slot, ground, shape, terrain, t, pose, probes.position[last], radius)


def collide_strips(
    body_q: Any, terrain_of_env: Any, terrain: Terrain, probes: Probes, layout: Layout, contacts_out: ContactBuffer
) -> None:
    """Append every environment's terrain contacts to ``contacts_out`` (whose count the caller has cleared).

    ``body_q`` are the poses in the world-local frame, shape (num_envs * bodies_per_env,). Contacts past the capacity
    are counted but not written.
    """
    num_envs = terrain_of_env.shape[0]
    if body_q.shape[0] != num_envs * layout.bodies_per_env:
        raise ValueError(
            f"body_q must hold {num_envs} x {layout.bodies_per_env} poses, got {body_q.shape[0]}: "
            "one robot per entry of terrain_of_env"
        )
    inputs, size = [body_q, terrain_of_env, terrain, probes, layout], (probes.strip_radius.shape[0], num_envs)
    wp.launch(_collide_strips_kernel, size, inputs, outputs=[contacts_out], device=body_q.device)
