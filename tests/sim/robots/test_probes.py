"""Sphere probes: inside their shape, everywhere under its surface, and close enough for a sharp ridge."""

import newton
import numpy as np
import pytest

from sim.robots.model import build_robot
from sim.robots.probes import (
    MAX_EDGE_RADIUS,
    MAX_SAG,
    box_strips,
    capsule_strips,
    cylinder_strips,
    make_probes,
    max_spacing,
    shape_strips,
)

CAPSULES = [(0.0175, 0.1), (0.06, 0.04), (0.1, 0.375), (0.003, 0.2), (0.05, 0.0)]
BOXES = [(0.1, 0.1, 0.05), (0.3, 0.02, 0.15), (0.01, 0.01, 0.01)]
CYLINDERS = [(0.02, 0.0625), (0.1, 0.05), (0.25, 0.01)]


def spheres(strips):
    """Centres (n, 3) and radii (n,)."""
    radii = np.concatenate([np.full(len(strip.centres), strip.radius) for strip in strips])
    return np.concatenate([strip.centres for strip in strips]), radii


def uncovered(points, strips):
    """How far the points, on the shape's surface, lie outside of the nearest probe."""
    centres, radii = spheres(strips)
    return (np.linalg.norm(points[:, None] - centres, axis=2) - radii).min(axis=1)


def on_capsule(radius, half, rng, count=3000):
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = radius * direction
    points[:, 2] += half * np.sign(direction[:, 2])
    mantle = rng.random(count) < 0.5
    points[mantle, :2] *= radius / np.linalg.norm(points[mantle, :2], axis=1, keepdims=True)
    points[mantle, 2] = rng.uniform(-half, half, mantle.sum())
    return points


def on_box(half, rng, count=4000):
    points = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 3, count)
    points[np.arange(count), face] = np.sign(points[np.arange(count), face])
    return points * half


def on_cylinder(radius, half, rng, count=4000):
    angle, share = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.random(count))
    mantle = rng.random(count) < 0.5
    r = np.where(mantle, radius, radius * share)
    z = np.where(mantle, rng.uniform(-half, half, count), half * rng.choice([-1, 1], count))
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


@pytest.mark.parametrize("radius", [0.001, 0.005, 0.01, 0.0175, 0.03, 0.1, 0.3])
def test_spacing_lets_a_ridge_sink_by_the_bound(radius):
    # Two spheres of radius r, s apart, dent the line between them by r - sqrt(r^2 - s^2 / 4).
    s = max_spacing(radius)
    assert radius - np.sqrt(radius**2 - s**2 / 4) == pytest.approx(min(MAX_SAG, radius), abs=1e-9)


def test_spacing_by_hand():
    # Shank: r = 17.5 mm, sag 5 mm: s = 2 sqrt(2 * 17.5 * 5 - 25) = 2 sqrt(150) = 24.4949 mm.
    assert max_spacing(0.0175) == pytest.approx(0.0244949, abs=1e-7)


@pytest.mark.parametrize(("radius", "half"), CAPSULES)
def test_capsule(radius, half):
    strips = capsule_strips(radius, half)
    gaps = uncovered(on_capsule(radius, half, np.random.default_rng(0)), strips)
    assert gaps.max() <= min(MAX_SAG, radius) + 1e-9
    centres, radii = spheres(strips)
    assert (radii == radius).all()
    assert not centres[:, :2].any()
    assert (centres[0, 2], centres[-1, 2]) == (-half, half)  # exact at the caps
    assert (np.diff(centres[:, 2]) <= max_spacing(radius) + 1e-12).all()


@pytest.mark.parametrize("half", BOXES)
def test_box(half):
    half = np.array(half)
    strips = box_strips(tuple(half))
    centres, radii = spheres(strips)
    assert (np.abs(centres) + radii[:, None] <= half + 1e-9).all()  # nothing sticks out
    # A needle between four probes, or a corner (rounded by (sqrt 3 - 1) r = 14.6 mm), is the worst case.
    assert uncovered(on_box(half, np.random.default_rng(0)), strips).max() < 0.0147
    for axis in range(3):
        assert (centres + radii[:, None])[:, axis].max() == pytest.approx(half[axis])
    # Halfway along a straight line over a face, from probe to probe, a ridge sinks by the bound at most.
    s = np.diff(np.unique(centres[:, 0]))
    assert s.max(initial=0) <= max_spacing(radii[0]) + 1e-12


@pytest.mark.parametrize("longest", [0, 1, 2])
def test_strips_of_a_box_run_along_its_longest_side(longest):
    # 0.5 x 0.16 x 0.1 m, probes of 2 cm at most 26.5 mm apart: 19 along, 6 and 4 across. Of those 24 rows 16 are at the
    # rim; each of the 8 within has a probe on both end faces.
    half = np.roll([0.25, 0.08, 0.05], longest)
    strips = box_strips(tuple(half))
    lengths = [len(strip.centres) for strip in strips]
    assert sorted(lengths) == [1] * 16 + [19] * 16
    for strip in strips:
        assert np.ptp(strip.centres, axis=0)[np.arange(3) != longest].max() < 1e-12


@pytest.mark.parametrize(("radius", "half"), CYLINDERS)
def test_cylinder(radius, half):
    strips = cylinder_strips(radius, half)
    centres, radii = spheres(strips)
    assert (np.linalg.norm(centres[:, :2], axis=1) + radii <= radius + 1e-9).all()
    assert (np.abs(centres[:, 2]) + radii <= half + 1e-9).all()
    assert uncovered(on_cylinder(radius, half, np.random.default_rng(0)), strips).max() < 0.0147


@pytest.mark.parametrize("strips", [capsule_strips(0.02, 0.3), box_strips((0.2, 0.1, 0.3)), cylinder_strips(0.1, 0.2)])
def test_probes_of_a_strip_lie_in_a_row(strips):
    # kernels.contact bounds a strip by its ends and takes first and last as its outermost.
    for strip in strips:
        along = np.diff(strip.centres @ [0, 0, 1])
        assert (along > 0).all()
        np.testing.assert_allclose(strip.centres[:, :2], np.broadcast_to(strip.centres[0, :2], (len(strip.centres), 2)))


def test_shapes_by_their_newton_scale():
    assert len(shape_strips(newton.GeoType.SPHERE, np.array([0.03, 0, 0]))[0].centres) == 1
    for kind, scale, strips in (
        (newton.GeoType.CAPSULE, (0.06, 0.04, 0), capsule_strips(0.06, 0.04)),
        (newton.GeoType.BOX, (0.1, 0.2, 0.05), box_strips((0.1, 0.2, 0.05))),
        (newton.GeoType.CYLINDER, (0.1, 0.05, 0), cylinder_strips(0.1, 0.05)),
    ):
        np.testing.assert_allclose(spheres(shape_strips(kind, np.array(scale)))[0], spheres(strips)[0])


def test_a_shape_without_probes_is_named():
    with pytest.raises(ValueError, match=r"ELLIPSOID.*SPHERE, CAPSULE, BOX, CYLINDER or MESH"):
        shape_strips(newton.GeoType.ELLIPSOID, np.ones(3))


def test_probes_of_the_robot_stand_where_its_geoms_are(anymal):
    builder = build_robot(anymal)
    probes = make_probes(builder)
    starts, shapes = probes.strip_start.numpy(), probes.strip_shape.numpy()
    assert sorted(shapes) == list(range(13))  # every collision shape, once: no cylinders, no boxes
    labels = [label.rsplit("/", 1)[-1] for label in builder.shape_label]
    strip = list(shapes).index(labels.index("LF_FOOT"))
    # The file puts the foot at (0.08795, 0.01305, -0.31547) in the shank's frame, r = 0.03.
    np.testing.assert_allclose(probes.position.numpy()[starts[strip]], [0.08795, 0.01305, -0.31547], atol=1e-6)
    assert probes.strip_radius.numpy()[strip] == pytest.approx(0.03)
    assert builder.body_label[probes.strip_body.numpy()[strip]].endswith("LF_SHANK")
    # The base's capsule runs along x from -0.375 to 0.375.
    strip = list(shapes).index(labels.index("base"))
    ends = probes.position.numpy()[[starts[strip], starts[strip + 1] - 1]]
    np.testing.assert_allclose(np.sort(ends[:, 0]), [-0.375, 0.375], atol=1e-6)
    assert MAX_EDGE_RADIUS < 0.03


def test_probes_of_a_biped_are_a_sphere_and_two_strips(cassie):
    builder = build_robot(cassie)
    probes = make_probes(builder)
    starts, shapes = probes.strip_start.numpy(), probes.strip_shape.numpy()
    labels = [label.rsplit("/", 1)[-1] for label in builder.shape_label]
    assert [labels[shape] for shape in shapes] == ["pelvis", "left_toe", "right_toe"]
    np.testing.assert_allclose(probes.strip_radius.numpy(), [0.25, 0.02, 0.02], atol=1e-6)
    # At r = .02 neighbours may be 2 sqrt(2 * .02 * .005 - .005^2) = .0265 m apart: six on a toe of .125 m.
    assert np.diff(starts).tolist() == [1, 6, 6]
    position = probes.position.numpy()
    np.testing.assert_allclose(position[starts[0]], 0.0, atol=1e-6)
    for strip in (1, 2):
        toe = position[starts[strip] : starts[strip + 1]]
        # From the heel to the tip, in the plane that the toe turns in: (.03, .03) -+ .0625 (sin .85, -cos .85).
        np.testing.assert_allclose(np.sort(toe[[0, -1], 0]), [-0.01695, 0.07695], atol=1e-5)
        np.testing.assert_allclose(np.sort(toe[[0, -1], 1]), [-0.01125, 0.07125], atol=1e-5)
        np.testing.assert_allclose(toe[:, 2], 0.0, atol=1e-6)
        assert builder.body_label[probes.strip_body.numpy()[strip]].endswith(labels[shapes[strip]])
