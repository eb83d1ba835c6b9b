"""Collision shapes to strips of sphere probes, close enough that no terrain edge slips between two of them."""

from typing import Any

import newton
import numpy as np
import warp as wp

from kernels.contact import Probes
from sim.robots.hull import hull_probes
from sim.robots.strip import Strip

MAX_SAG = 0.005
"""Deepest that a sharp ridge may sink between two neighbouring probes [m]."""
MAX_EDGE_RADIUS = 0.02
"""Largest probe radius on boxes and cylinders, whose edges the probes round off [m]."""
MAX_SIDE = 10.0
"""Longest side of a shape [m]; a longer one is in other units."""
_MESHES = (newton.GeoType.MESH, newton.GeoType.CONVEX_MESH)
_NUM_SIZES = {newton.GeoType.SPHERE: 1, newton.GeoType.CAPSULE: 2, newton.GeoType.CYLINDER: 2, newton.GeoType.BOX: 3}


def max_spacing(radius: float, sag: float = MAX_SAG) -> float:
    """Largest distance of neighbouring probes between which a sharp ridge sinks at most ``sag`` [m].

    Two spheres of radius r at distance s leave a dent of depth ``r - sqrt(r^2 - s^2 / 4)`` between them.
    """
    sag = min(sag, radius)
    return 2.0 * float(np.sqrt(2.0 * radius * sag - sag * sag))


def _line(low: float, high: float, spacing: float) -> np.ndarray:
    length = high - low
    if length <= 1e-9:
        return np.array([0.5 * (low + high)])
    return np.linspace(low, high, int(np.ceil(length / spacing - 1e-9)) + 1)


def _along_z(x: float, y: float, z: np.ndarray) -> np.ndarray:
    return np.stack([np.full_like(z, x), np.full_like(z, y), z], axis=1)


def capsule_strips(radius: float, half_height: float) -> list[Strip]:
    """One strip along the axis (z); exact at the caps."""
    return [Strip(centres=_along_z(0.0, 0.0, _line(-half_height, half_height, max_spacing(radius))), radius=radius)]


def box_strips(half: tuple[float, float, float]) -> list[Strip]:
    """Parallel strips under the whole surface of a box, along its longest side (z of a cube).

    Edges and corners are rounded by at most :data:`MAX_EDGE_RADIUS`; faces are exact at every probe.
    """
    radius = min(MAX_EDGE_RADIUS, *half)
    spacing = max_spacing(radius)
    # Contacts are made of the ends of a strip, so the fewer strips, the fewer contacts of a box that lies.
    order = [*np.argsort(half, kind="stable")]
    across, beside, along = (_line(-half[k] + radius, half[k] - radius, spacing) for k in order)
    back = np.argsort(order)
    strips = []
    for i, px in enumerate(across):
        for j, py in enumerate(beside):
            rim = i in (0, len(across) - 1) or j in (0, len(beside) - 1)
            # Inside the cross-section only the two end faces have a surface.
            for part in [along] if rim else [along[:1], along[-1:]]:
                strips.append(Strip(centres=_along_z(float(px), float(py), part)[:, back], radius=radius))
    return strips


def cylinder_strips(radius: float, half_height: float) -> list[Strip]:
    """Strips along the axis (z) round the mantle, and rings of single probes on the two end faces."""
    probe = min(MAX_EDGE_RADIUS, radius, half_height)
    spacing = max_spacing(probe)
    z = _line(-half_height + probe, half_height - probe, spacing)
    strips = []
    for ring, ring_radius in enumerate(_line(0.0, radius - probe, spacing)[::-1]):
        count = max(1, int(np.ceil(2.0 * np.pi * ring_radius / spacing)))
        for angle in np.arange(count) * 2.0 * np.pi / count:
            x, y = ring_radius * np.cos(angle), ring_radius * np.sin(angle)
            for part in [z] if ring == 0 else [z[:1], z[-1:]]:
                strips.append(Strip(centres=_along_z(float(x), float(y), part), radius=probe))
    return strips


def shape_strips(shape_type: newton.GeoType, scale: np.ndarray, mesh: Any = None) -> list[Strip]:
    """Strips of one collision shape, in the shape's frame.

    Args:
        shape_type: Sphere, capsule, box, cylinder or mesh.
        scale: Newton's shape scale [m]: (radius,), (radius, half height) or (half x, half y, half z); of a mesh its
            factors along x, y and z.
        mesh: Newton's mesh, which collides as its convex hull.

    Raises:
        ValueError: For any other shape, one without size or longer than :data:`MAX_SIDE`, or a mesh without volume.
    """
    sizes = np.asarray(scale, dtype=np.float64)[: _NUM_SIZES.get(shape_type, 0)]
    vertices = np.asarray(mesh.vertices, dtype=np.float64) * scale if shape_type in _MESHES else np.zeros((1, 3))
    if not (np.isfinite(vertices).all() and (sizes > 0.0).all()):
        raise ValueError(f"its sizes must be positive numbers, got {', '.join(f'{size:g}' for size in sizes)} m")
    longest = max(2.0 * sizes.max(initial=0.0), float(np.ptp(vertices, axis=0).max()))
    if not longest <= MAX_SIDE:
        raise ValueError(
            f"it is {longest:g} m long, at most {MAX_SIDE:g} m are taken: a mesh in millimetres has a scale"
        )
    if shape_type == newton.GeoType.SPHERE:
        return [Strip(centres=np.zeros((1, 3)), radius=float(scale[0]))]
    if shape_type == newton.GeoType.CAPSULE:
        return capsule_strips(float(scale[0]), float(scale[1]))
    if shape_type == newton.GeoType.BOX:
        return box_strips((float(scale[0]), float(scale[1]), float(scale[2])))
    if shape_type == newton.GeoType.CYLINDER:
        return cylinder_strips(float(scale[0]), float(scale[1]))
    if shape_type in _MESHES:
        return list(hull_probes(vertices).strips)
    raise ValueError(
        f"no probes for a {newton.GeoType(shape_type).name} collision shape: "
        "expected SPHERE, CAPSULE, BOX, CYLINDER or MESH; replace it in the robot's file"
    )


def placed(pose: Any, point: np.ndarray) -> Any:
    """A point [m] of a frame that stands at ``pose``, as a vec3 in the frame that the pose is in."""
    local: Any = wp.vec3(*point)
    return wp.transform_point(pose, local)


def make_probes(builder: newton.ModelBuilder) -> Probes:
    """Sphere probes of all collision shapes of one robot, on the current device.

    Raises:
        ValueError: If a shape has no probes, by its name.
    """
    centres, radius, spread, body, shape = [], [], [], [], []
    for k in range(builder.shape_count):
        if not builder.shape_flags[k] & newton.ShapeFlags.COLLIDE_SHAPES:
            continue
        pose: Any = builder.shape_transform[k]
        try:
            strips = shape_strips(
                newton.GeoType(builder.shape_type[k]), np.asarray(builder.shape_scale[k]), builder.shape_source[k]
            )
        except ValueError as error:
            raise ValueError(f"geom {builder.shape_label[k]}: {error}") from error
        for strip in strips:
            centres.append([placed(pose, centre) for centre in strip.centres])
            radius.append(strip.radius)
            spread.append(strip.spread)
            body.append(builder.shape_body[k])
            shape.append(k)
    probes = Probes()
    probes.position = wp.array([centre for strip in centres for centre in strip], dtype=wp.vec3)
    probes.strip_start = wp.array(np.cumsum([0] + [len(strip) for strip in centres]), dtype=int)
    probes.strip_radius = wp.array(radius, dtype=float)
    probes.strip_spread = wp.array(spread, dtype=float)
    probes.strip_body = wp.array(body, dtype=int)
    probes.strip_shape = wp.array(shape, dtype=int)
    return probes
