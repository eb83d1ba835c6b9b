"""Shapes of parts of terrains as a robot meets them, from surfaces whose slopes are known."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from qd.faults import causes
from qd.faults.judge import with_families
from qd.faults.searches import Search
from sim.robots.robot import ROBOTS
from sim.terrains.bank import make_heights
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import bump, fresh_values, small_archive
from tests.qd.searches import CFG

Y, X = np.meshgrid(SPACING * np.arange(NUM_ROWS), SPACING * np.arange(NUM_COLS), indexing="ij")
HALF_WIDTH = 0.4


def plateau(x_from, x_to, height, *, y_from=-1.0, y_to=9.0, run=0.5, turn=0.0):
    """A plateau with ramps of ``run`` metres at its ends along the way and a wall at its sides."""
    along = (X - 8) * np.cos(turn) + (Y - 4) * np.sin(turn) + 8
    ramps = np.clip(np.minimum(along - x_from, x_to - along) / run, 0.0, 1.0)
    return (height * ramps * ((y_from <= Y) & (y_to >= Y))).astype(np.float32)


def test_a_ramp_by_hand():
    shape = causes.measure_shape(plateau(6.0, 12.0, 0.2), HALF_WIDTH)  # .2 m over .5 m: 21.8 degrees
    assert shape.kind == "rise"
    assert (shape.height_m, shape.across_deg) == (0.2, 0.0)
    assert shape.slope_deg == shape.along_deg == pytest.approx(np.rad2deg(np.arctan(0.4)), abs=1e-3)
    assert shape.length_m == pytest.approx(5.5, abs=0.06)  # from half way up to half way down
    assert (shape.left_m, shape.right_m) == pytest.approx((4.05, 4.05))  # to beyond the edge of the grid
    assert causes.describe_cause(asdict(shape)) == "rise, 0.20 m high, 22 degrees steep"


DIP_BEFORE_A_WALL = np.where(X < 12, -0.2 * np.clip((X - 4) / 4, 0, 1), 0).astype(np.float32)
CASES = [
    (plateau(6.0, 12.0, 0.2), "rise", "high"),
    (plateau(6.0, 12.0, -0.2), "drop", "deep"),
    (DIP_BEFORE_A_WALL, "rise", "high"),
    (plateau(7.0, 7.6, 0.2, run=0.2), "ridge", "high"),
    (plateau(7.0, 7.6, -0.2, run=0.2), "ditch", "deep"),
    (plateau(7.0, 7.6, 0.2, run=0.05, y_from=3.8), "ridge end", "high"),
    (plateau(7.0, 7.6, -0.2, run=0.05, y_to=4.1), "ditch end", "deep"),
    (plateau(7.0, 7.6, 0.2, run=0.05, y_from=3.7, y_to=4.3), "knob", "high"),
    (plateau(7.0, 7.6, -0.2, run=0.05, y_from=3.7, y_to=4.3), "hole", "deep"),
    (plateau(6.0, 12.0, 0.2, turn=0.75), "oblique rise", "high"),
    (plateau(6.0, 12.0, -0.2, turn=-0.75), "oblique drop", "deep"),
    (plateau(7.9, 12.0, 0.2, turn=1.4), "side slope", "high"),
    (plateau(7.9, 12.0, -0.2, turn=1.4), "side slope", "deep"),
    (plateau(7.7, 8.0, 0.2, run=0.1, turn=0.7), "oblique ridge", "high"),
    (plateau(7.7, 8.0, -0.2, run=0.1, turn=0.7), "oblique ditch", "deep"),
    (plateau(6.0, 12.0, 0.2, y_from=6.0), causes.OFF_THE_WAY, None),
    (plateau(6.0, 12.0, 0.02), causes.OFF_THE_WAY, "high"),
    (plateau(5.0, 12.0, 0.2, run=3.0), "gentle hill", "high"),
    (plateau(5.0, 12.0, -0.2, run=3.0), "gentle hollow", "deep"),
]


@pytest.mark.parametrize(("field", "kind", "size"), CASES)
def test_kinds_and_whether_they_are_high_or_deep(field, kind, size):
    shape = causes.measure_shape(field, HALF_WIDTH)
    assert shape.kind == kind
    size = f", {abs(shape.height_m):.2f} m {size}, {shape.slope_deg:.0f} degrees steep" if size else ""
    assert causes.describe_cause(asdict(shape)) == kind + size


def test_every_kind_is_measured_described_and_documented():
    assert {kind for _, kind, _ in CASES} == {*causes.SHAPES}
    page = (Path(__file__).parents[3] / "docs" / "faults.md").read_text()
    for kind in (*causes.SHAPES, causes.SLIPPERY, causes.SOFT, *(condition.cause for condition in CONDITIONS.values())):
        assert kind.removeprefix("oblique ") in page or kind == CONDITIONS["wind"].cause  # of the tests alone
        commonest = causes.describe_commonest(kind)
        is_shape = kind in causes.SHAPES and kind != causes.OFF_THE_WAY
        assert commonest.startswith(kind) and commonest.endswith(f"{'are' if is_shape else 'is'} the commonest cause")
        if kind not in causes.SHAPES:
            assert causes.describe_cause({"kind": kind, "height_m": 0.0, "slope_deg": 0.0}) == kind
    assert causes.describe_cause(None) == "unclear"
    assert causes.describe_commonest("ditch") == "ditches are the commonest cause"


def test_the_angle_to_the_way_and_the_reach_to_either_side():
    shape = causes.measure_shape(plateau(6.0, 12.0, 0.2, turn=np.deg2rad(40)), HALF_WIDTH)
    assert shape.oblique_deg == pytest.approx(40, abs=2)  # a little more at the foot of the ramp
    assert shape.slope_deg == pytest.approx(np.rad2deg(np.arctan(0.4)), abs=0.5)
    for sides, reach in (((3.8, 9.0), (4.05, 0.25)), ((-1.0, 4.12), (0.15, 4.05))):  # the way is at y = 4
        shape = causes.measure_shape(plateau(7.0, 7.6, 0.2, run=0.05, y_from=sides[0], y_to=sides[1]), HALF_WIDTH)
        assert (shape.left_m, shape.right_m) == pytest.approx(reach)


def test_effects_of_parts_add_up():
    genes = SUPER_GAUSSIAN.hard_random(1, 5)
    effects = causes.find_effects(genes[0], [0, 3, 7], SUPER_GAUSSIAN)
    fields = effects.heights
    rest = make_heights(SUPER_GAUSSIAN.without(genes, [1, 2, 4, 5, 6]))[0]
    np.testing.assert_allclose(fields.sum(axis=0), rest, atol=1e-6)
    assert effects.way(0, HALF_WIDTH) == (np.abs(fields[0, 72:89, 40:281]).max(), False)


@pytest.mark.parametrize(("half_width", "cause"), [(0.1, "unclear"), (0.6, "ridge end")])
def test_causes_depend_on_the_width_of_the_robot_that_was_searched(half_width, cause):
    # It begins half a metre left of the way, where a narrow robot does not step.
    beside = bump(x=8.0, y=4.9, sigma_x=0.5, sigma_y=0.5, height=0.25)
    genes = np.concatenate([beside, *[bump(x=8.0, sigma_x=0.5, height=0.0)] * 7])[None]
    ends = np.array([[8.0, 4.0]])
    assert causes.find_causes(genes, ends, SUPER_GAUSSIAN, half_width) == [cause]
    archive = replace(small_archive(1), genes=genes, end_position=ends, goal_rate=np.zeros(1))
    archive = replace(archive, fresh=fresh_values(archive))
    robot = replace(ROBOTS["anymal"], name="mine", footprint=(0.5, half_width))
    search = Search(run=Path("run"), cfg=CFG, robot=robot, policy="", space=SUPER_GAUSSIAN)
    assert with_families(archive, search).cause.tolist() == [cause]
