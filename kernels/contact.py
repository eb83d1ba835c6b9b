"""Terrain contact: strips of sphere probes against height grids.

A strip is a row of equal spheres on one collision shape, straight but for meshes (:mod:`sim.robots.probes` makes them).
Some strips of a body that lie together are a bundle, in one ball: most are far from the ground.
Of the probes of a strip that touch, the first, the deepest and the last become contacts: a lying capsule rests on its
two ends and on the highest point between, and a robot on its back cannot flood the solver.
"""

import math
from typing import Any

import warp as wp

from kernels.ground import FIRM, Ground, patch_at
from kernels.heightfield import SurfacePoint, Terrain, ceiling_over, nearest_surface_point
from kernels.launch import kernel_over, launch_grid, least_float_of_lanes, least_of_lanes, make_zeros

_MAX_THREADS = 150_000  # that a GPU is given: where robots are few, several share the probes of a strip
_NONE = wp.constant(2**30)
vec5 = wp.types.vector(5, float)
"""MuJoCo's frictions of a contact, or an impedance."""


@wp.struct
class Probes:
    """Sphere probes of one robot in strips, and strips in bundles."""

    position: wp.array[wp.vec3]
    """Probe centres in the frame of their body [m], shape (num_probes,), strip after strip in order along the strip."""
    strip_start: wp.array[int]
    """First probe of each strip, shape (num_strips + 1,)."""
    strip_radius: wp.array[float]
    """Probe radius of each strip [m], shape (num_strips,)."""
    strip_spread: wp.array[float]
    """Largest distance of a strip's centres from the line between its ends [m], shape (num_strips,); 0 if straight."""
    strip_shape: wp.array[int]
    """Collision shape of each strip, counted within one robot, shape (num_strips,)."""
    bundle_start: wp.array[int]
    """First strip of each bundle, shape (num_bundles + 1,)."""
    bundle_body: wp.array[int]
    """Body of each bundle, counted within one robot, shape (num_bundles,)."""
    bundle_ball: wp.array[wp.vec4]
    """Ball round each bundle: its middle in the frame of the body, and its radius [m], shape (num_bundles,)."""


@wp.struct
class Poses:
    """Poses of bodies, world-local frame; arrays of mujoco_warp's data, shape (num_envs, num_solver_bodies)."""

    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    """wxyz."""
    column_of_body: wp.array[int]
    """Column of each body of a robot, shape (bodies_per_env,); the base comes first."""


@wp.struct
class Contacts:
    """Terrain contacts of every robot, shape (num_envs, capacity) each."""

    count: wp.array[int]
    """Number of contacts of each robot, shape (num_envs,); contacts beyond the capacity are counted, but not stored."""
    rank: wp.array2d[int]
    """Place among all contacts that the robot can have, by which they are worked on: threads find them in any order."""
    shape: wp.array2d[int]
    """Collision shape, counted within one robot."""
    point: wp.array2d[wp.vec3]
    """Middle between the surfaces that overlap, world-local [m]."""
    normal: wp.array2d[wp.vec3]
    """From the ground to the robot."""
    distance: wp.array2d[float]
    """Signed distance of the surfaces [m], negative."""
    friction: wp.array2d[float]
    """Factor of the friction, from the patch of ground."""
    time_constant: wp.array2d[float]
    """Contact time constant of soft ground [s], ``FIRM`` for the robot's own."""
    force: wp.array2d[wp.vec3]
    """On the robot, world frame [N]; from the solver."""


@wp.struct
class Surfaces:
    """Contact parameters of each collision shape with the ground, under MuJoCo's names; (num_shapes,) each.

    Arrays of two dimensions have a row for each robot, or one for all.
    """

    geom: wp.array[int]
    """The solver's geom."""
    body: wp.array[int]
    condim: wp.array[int]
    friction: wp.array2d[vec5]
    solref: wp.array2d[wp.vec2]
    solimp: wp.array2d[vec5]


@wp.func
def _write_contact(
    contacts: Contacts, rank: int, strip: int, probe: int, point: SurfacePoint, pose: wp.transform, ground: Ground,
    t: int, env: int, probes: Probes,
):  # fmt: skip
    slot = wp.atomic_add(contacts.count, env, 1)
    if slot < contacts.shape.shape[1]:
        radius = probes.strip_radius[strip]
        centre = wp.transform_point(pose, probes.position[probe])
        touched = centre - point.normal * point.distance
        contacts.rank[env, slot] = rank
        contacts.shape[env, slot] = probes.strip_shape[strip]
        contacts.point[env, slot] = 0.5 * (touched + centre - point.normal * radius)
        contacts.normal[env, slot] = point.normal
        contacts.distance[env, slot] = point.distance - radius
        factor = float(1.0)
        time_constant = FIRM
        if ground.friction.shape[0] > 0:
            patch = patch_at(touched[0], touched[1])
            factor = ground.factor[t] * ground.friction[t, patch[0], patch[1]]
            time_constant = ground.time_constant[t, patch[0], patch[1]]
        contacts.friction[env, slot] = factor
        contacts.time_constant[env, slot] = time_constant


@wp.func
def _collide_strip(
    pose: wp.transform, strip: int, lane: int, lanes: int, terrain: Terrain, ground: Ground, t: int, env: int,
    probes: Probes, contacts_out: Contacts,
):  # fmt: skip
    radius = probes.strip_radius[strip]
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
        return
    first = int(_NONE)
    last = int(-1)
    deepest = int(_NONE)
    least = float(radius)
    of_first = SurfacePoint()
    of_last = SurfacePoint()
    of_deepest = SurfacePoint()
    for k in range(begin + lane, end, lanes):
        centre = wp.transform_point(pose, probes.position[k])
        if centre[2] - radius < ceiling:
            point = nearest_surface_point(terrain, t, centre, radius)
            if point.distance < radius:
                if last < 0:
                    first = k
                    of_first = point
                last = k
                of_last = point
                if point.distance < least:
                    least = point.distance
                    deepest = k
                    of_deepest = point
    first_of_all = least_of_lanes(first, lanes)
    if first_of_all == _NONE:
        return
    last_of_all = -least_of_lanes(-last, lanes)
    if least_float_of_lanes(least, lanes) < least:
        deepest = _NONE
    deepest_of_all = least_of_lanes(deepest, lanes)
    rank = 3 * strip
    if deepest == deepest_of_all:
        _write_contact(contacts_out, rank, strip, deepest, of_deepest, pose, ground, t, env, probes)
    if first == first_of_all and first != deepest_of_all:
        _write_contact(contacts_out, rank + 1, strip, first, of_first, pose, ground, t, env, probes)
    if last == last_of_all and last != deepest_of_all:
        _write_contact(contacts_out, rank + 2, strip, last, of_last, pose, ground, t, env, probes)


@wp.kernel
def _collide_strips_kernel(
    poses: Poses,
    terrain_of_env: wp.array[int],
    terrain: Terrain,
    probes: Probes,
    ground: Ground,
    parked: wp.array[int],
    lanes: int,
    contacts_out: Contacts,
):
    """Grid (num_bundles, num_envs, lanes): the threads of a warp look at the same part of different robots."""
    bundle, env, lane = wp.tid()
    if parked[env] == 2:
        return
    t = terrain_of_env[env]
    column = poses.column_of_body[probes.bundle_body[bundle]]
    wxyz = poses.xquat[env, column]
    pose = wp.transform(poses.xpos[env, column], wp.quat(wxyz[1], wxyz[2], wxyz[3], wxyz[0]))
    ball = probes.bundle_ball[bundle]
    middle = wp.transform_point(pose, wp.vec3(ball[0], ball[1], ball[2]))
    lower = wp.vec2(middle[0] - ball[3], middle[1] - ball[3])
    upper = wp.vec2(middle[0] + ball[3], middle[1] + ball[3])
    if not (middle[2] - ball[3] < ceiling_over(terrain, t, lower, upper)):
        return  # also where the state is NaN
    for strip in range(probes.bundle_start[bundle], probes.bundle_start[bundle + 1]):
        _collide_strip(pose, strip, lane, lanes, terrain, ground, t, env, probes, contacts_out)


def collide_strips(
    poses: Poses, terrain_of_env: Any, terrain: Terrain, probes: Probes, ground: Ground, parked: Any, contacts: Contacts
) -> None:
    """Find every robot's terrain contacts, all of ``contacts`` but the forces.

    Without arrays the ground is the same everywhere. Where ``parked`` (num_envs,) is 2 a robot touches nothing.
    """
    contacts.count.zero_()
    device, lanes, size = terrain_of_env.device, 1, (len(probes.bundle_body), len(terrain_of_env))
    while not device.is_cpu and lanes < 16 and 2 * lanes * math.prod(size) <= _MAX_THREADS:
        lanes *= 2
    inputs = [poses, terrain_of_env, terrain, probes, ground, parked, lanes, contacts]
    launch_grid(_collide_strips_kernel, (*size, lanes), inputs, device)


def make_contacts(num_envs: int, capacity: int) -> Contacts:
    """Room for so many contacts of each robot, on the current device."""
    return make_zeros(Contacts, None, **dict.fromkeys(Contacts.vars, (num_envs, capacity)) | {"count": (num_envs,)})


@kernel_over("geom_force_out")
def sum_forces(contacts: Contacts, column_of_shape: wp.array[int], geom_force_out: wp.array2d[wp.vec3]):
    """Grid (num_envs, num_geoms): sum the contact forces on each geom, in the order of ranks.

    ``column_of_shape`` is the geom's column for each collision shape, -1 for none.
    """
    env, column = wp.tid()
    count = wp.min(contacts.count[env], contacts.shape.shape[1])
    force = wp.vec3(0.0)
    touching = int(0)
    for c in range(count):
        if column_of_shape[contacts.shape[env, c]] == column:
            force += contacts.force[env, c]
            touching += 1
    if touching > 2:  # the order of two changes nothing
        force = wp.vec3(0.0)
        added = int(-1)  # place of the last contact
        for _ in range(touching):
            following = int(-1)
            least = int(2147483647)
            for c in range(count):
                place = count * contacts.rank[env, c] + c  # no two are the same
                if place > added and place < least and column_of_shape[contacts.shape[env, c]] == column:
                    following = c
                    least = place
            force += contacts.force[env, following]
            added = least
    geom_force_out[env, column] = force
