"""Shapes of parts of terrains as a robot meets them, from surfaces whose slopes are known."""

import numpy as np
import pytest

from qd.faults.causes import find_effects, largest_height, measure_shape
from sim.terrains.bank import heights_of
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

Y, X = np.meshgrid(SPACING * np.arange(NUM_ROWS), SPACING * np.arange(NUM_COLS), indexing="ij")
HALF_WIDTH = 0.4


def plateau(x_from, x_to, height, *, y_from=-1.0, y_to=9.0, run=0.5, turn=0.0):
    """A plateau with ramps of ``run`` metres at its ends along the way and a wall at its sides."""
    along = (X - 8) * np.cos(turn) + (Y - 4) * np.sin(turn) + 8
    ramps = np.clip(np.minimum(along - x_from, x_to - along) / run, 0.0, 1.0)
    return (height * ramps * ((y_from <= Y) & (y_to >= Y))).astype(np.float32)


def test_a_ramp_by_hand():
    shape = measure_shape(plateau(6.0, 12.0, 0.2), HALF_WIDTH)  # .2 m over .5 m: 21.8 degrees
    assert shape.kind == "rise"
    assert (shape.height_m, shape.across_deg) == (0.2, 0.0)
    assert shape.slope_deg == shape.along_deg == pytest.approx(np.rad2deg(np.arctan(0.4)), abs=1e-3)
    assert shape.length_m == pytest.approx(5.5, abs=0.06)  # from half way up to half way down
    assert (shape.left_m, shape.right_m) == pytest.approx((4.05, 4.05))  # to beyond the edge of the grid


@pytest.mark.parametrize(
    ("field", "kind"),
    [
        (plateau(6.0, 12.0, -0.2), "drop"),
        (np.where(X < 12, -0.2 * np.clip((X - 4) / 4, 0, 1), 0).astype(np.float32), "rise"),  # down gently, up a wall
        (plateau(7.0, 7.6, 0.2, run=0.2), "ridge"),
        (plateau(7.0, 7.6, -0.2, run=0.2), "ditch"),
        (plateau(7.0, 7.6, 0.2, run=0.05, y_from=3.8), "ridge end"),
        (plateau(7.0, 7.6, -0.2, run=0.05, y_to=4.1), "ditch end"),
        (plateau(7.0, 7.6, 0.2, run=0.05, y_from=3.7, y_to=4.3), "knob"),
        (plateau(7.0, 7.6, -0.2, run=0.05, y_from=3.7, y_to=4.3), "hole"),
        (plateau(6.0, 12.0, 0.2, turn=0.75), "oblique rise"),
        (plateau(6.0, 12.0, -0.2, turn=-0.75), "oblique drop"),
        (plateau(7.9, 12.0, 0.2, turn=1.4), "side slope"),
        (plateau(7.7, 8.0, 0.2, run=0.1, turn=0.7), "oblique ridge"),
        (plateau(6.0, 12.0, 0.2, y_from=6.0), "beside the way"),
        (plateau(6.0, 12.0, 0.02), "beside the way"),
        (plateau(5.0, 12.0, 0.2, run=3.0), "gentle hill"),
        (plateau(5.0, 12.0, -0.2, run=3.0), "gentle hollow"),
    ],
)
def test_kinds(field, kind):
    assert measure_shape(field, HALF_WIDTH).kind == kind


def test_the_angle_to_the_way_and_the_reach_to_either_side():
    shape = measure_shape(plateau(6.0, 12.0, 0.2, turn=np.deg2rad(40)), HALF_WIDTH)
    assert shape.oblique_deg == pytest.approx(40, abs=2)  # a little more at the foot of the ramp
    assert shape.slope_deg == pytest.approx(np.rad2deg(np.arctan(0.4)), abs=0.5)
    for sides, reach in (((3.8, 9.0), (4.05, 0.25)), ((-1.0, 4.12), (0.15, 4.05))):  # the way is at y = 4
        shape = measure_shape(plateau(7.0, 7.6, 0.2, run=0.05, y_from=sides[0], y_to=sides[1]), HALF_WIDTH)
        assert (shape.left_m, shape.right_m) == pytest.approx(reach)


def test_parts_are_told_from_the_rest():
    genes = SUPER_GAUSSIAN.hard_random(1, 5)
    fields = find_effects(genes[0], [0, 3, 7], SUPER_GAUSSIAN).heights
    others = heights_of(SUPER_GAUSSIAN.without(genes, [1, 2, 4, 5, 6]))[0]
    np.testing.assert_allclose(fields.sum(axis=0), others, atol=1e-6)
    assert largest_height(fields[0], HALF_WIDTH) == np.abs(fields[0, 72:89, 40:281]).max()
