"""Terrain generators: shapes, seeds, shares, and heights computed by hand from the difficulty formulas."""

import numpy as np
import pytest

from sim.terrains import hand_crafted as terrain
from sim.terrains.hand_crafted import CROSSING_TYPES, TILE_TYPES, crossing_terrain, training_tile

GRID = (161, 321)


def col(x):
    return round(x / 0.05)


@pytest.fixture(scope="module")
def crossings():
    return terrain.hand_crafted_crossings(300, 7)


def square(heights):
    """The 8 m x 8 m feature in the middle of a grid."""
    return heights[:, col(4) : col(12) + 1]


def test_crossing_types_have_equal_shares_and_levels_are_uniform(crossings):
    heights, types, levels = crossings
    assert heights.shape == (300, *GRID) and heights.dtype == np.float32 and np.isfinite(heights).all()
    assert np.bincount(types).tolist() == [50] * 6
    assert set(np.unique(levels)) == set(range(10))
    assert abs(levels.mean() - 4.5) < 0.5  # standard error of 300 uniform levels: 2.87 / sqrt(300) = 0.17
    assert np.bincount(terrain.hand_crafted_crossings(8, 0)[1]).tolist() == [2, 2, 1, 1, 1, 1]
    with pytest.raises(ValueError, match="count"):
        terrain.hand_crafted_crossings(0, 0)


@pytest.mark.parametrize("kind", CROSSING_TYPES)
@pytest.mark.parametrize("level", [0, 9])
def test_crossing_is_flat_before_and_after_its_feature(kind, level):
    heights = crossing_terrain(kind, level, 3)
    assert not heights[:, : col(4) + 1].any()
    assert not heights[:, col(12) :].any()
    assert heights.any() or (kind, level) == ("slope", 0)
    assert (heights == heights[0]).all() == (kind in ("slope", "stairs_up_down", "stairs_down_up"))


def test_slope_crossing_has_the_levels_gradient():
    profile = crossing_terrain("slope", 5, 0)[80]  # d = 0.5: gradient 0.2
    assert profile[col(5)] == pytest.approx(0.2)  # 1 m up the flank
    assert profile[col(11)] == pytest.approx(0.2)
    np.testing.assert_allclose(profile[col(6.5) : col(9.5) + 1], 0.5)  # 2.5 m of flank before 3 m of plateau
    np.testing.assert_allclose(np.diff(profile[col(4) : col(6.5) + 1]), 0.01, atol=1e-6)  # 0.2 * 0.05 m a cell
    np.testing.assert_allclose(np.diff(profile[col(9.5) : col(12) + 1]), -0.01, atol=1e-6)


@pytest.mark.parametrize(("kind", "sign"), [("stairs_up_down", 1.0), ("stairs_down_up", -1.0)])
def test_stairs_crossing_has_the_levels_steps_and_treads(kind, sign):
    profile = crossing_terrain(kind, 5, 0)[80]  # d = 0.5: step 0.05 + 0.18 * 0.5 = 0.14 m
    risers = np.flatnonzero(np.diff(profile))
    # Treads of 0.31 m end at 4.31, 4.62, 4.93, 5.24, 5.55, 5.86, 6.17, 6.48 m: each at the next node, and mirrored.
    tops = [4.35, 4.65, 4.95, 5.25, 5.55, 5.90, 6.20, 6.50]
    up = [col(x) - 1 for x in tops]
    down = [col(16 - x) for x in reversed(tops)]
    assert risers.tolist() == up + down
    np.testing.assert_allclose(np.diff(profile)[up], sign * 0.14, atol=1e-6)
    np.testing.assert_allclose(np.diff(profile)[down], -sign * 0.14, atol=1e-6)
    assert profile[col(8)] == pytest.approx(sign * 1.12)  # 8 steps


def test_rough_slope_is_the_slope_and_roughness_interpolated_between_nodes_20_cm_apart():
    rough = square(crossing_terrain("rough_slope", 9, 1)) - square(crossing_terrain("slope", 9, 1))
    assert np.abs(rough).max() <= 0.05 + 1e-6
    assert rough[::4, 4:-4:4].std() == pytest.approx(0.05 / np.sqrt(3), rel=0.1)  # uniform on +-0.05
    np.testing.assert_allclose(rough[::4, 2::4], (rough[::4, :-1:4] + rough[::4, 4::4]) / 2, atol=1e-6)
    np.testing.assert_allclose(rough[2::4, ::4], (rough[:-1:4, ::4] + rough[4::4, ::4]) / 2, atol=1e-6)


@pytest.mark.parametrize(("level", "height"), [(0, 0.05), (9, 0.23)])  # 0.05 + 0.2 d
def test_boxes_crossing_has_the_levels_heights(level, height):
    values = np.unique(square(crossing_terrain("boxes", level, 2)))
    np.testing.assert_allclose(values, [-height, -height / 2, 0.0, height / 2, height], atol=1e-6)


def test_boxes_are_1_to_2_m_wide():
    rng = np.random.default_rng(0)
    for _ in range(20):
        heights = crossing_terrain("boxes", 9, rng)
        row, column = np.argwhere(heights != 0)[0]  # the first row with a box holds the top edges of boxes only
        ends = np.flatnonzero(heights[row, column:] != heights[row, column])
        assert 20 <= ends[0] - 1 <= 40  # cells of 0.05 m


@pytest.mark.parametrize(("level", "amplitude"), [(0, 0.02), (9, 0.092)])  # 0.02 + 0.08 d
def test_noise_crossing_is_uniform_on_20_cm_patches(level, amplitude):
    heights = square(crossing_terrain("noise", level, 4))[:160, 4:160]  # whole patches away from the edges
    patches = heights.reshape(40, 4, 39, 4)
    assert (patches == patches[:, :1, :, :1]).all()
    drawn = patches[:, 0, :, 0]
    assert len(np.unique(drawn)) == drawn.size
    assert 0.95 * amplitude < np.abs(drawn).max() <= amplitude
    assert drawn.std() == pytest.approx(amplitude / np.sqrt(3), rel=0.1)


def test_a_terrain_depends_on_the_seed_and_its_place_alone(crossings):
    np.testing.assert_array_equal(terrain.hand_crafted_crossings(6, 7)[0], crossings[0][:6])
    rng = np.random.default_rng(5)
    first, second = (terrain.hand_crafted_crossings(12, rng)[0] for _ in range(2))
    assert not np.array_equal(first, second)


def test_tiles_are_laid_out_by_level_and_column():
    heights, types = terrain.training_tiles(20, 7)
    assert heights.shape == (200, *GRID) and heights.dtype == np.float32 and np.isfinite(heights).all()
    assert np.bincount(types).tolist() == [2, 2, 7, 5, 4]  # .1 .1 .35 .25 .2 of 20 columns
    for level, column, kind in [(0, 4, "stairs_up"), (9, 4, "stairs_up"), (5, 15, "stairs_down"), (3, 0, "slope")]:
        assert TILE_TYPES[types[column]] == kind
        np.testing.assert_array_equal(heights[level * 20 + column], training_tile(kind, level, 0))


@pytest.mark.parametrize("kind", TILE_TYPES)
@pytest.mark.parametrize("level", [0, 9])
def test_tile_is_flat_round_the_start_and_its_edges_continue(kind, level):
    heights = training_tile(kind, level, 3)
    platform = heights[col(2.5) : col(5.5) + 1, col(6.5) : col(9.5) + 1]  # 3 m x 3 m round (8, 4)
    assert np.ptp(platform) <= (0.1 + 1e-6 if kind == "rough_slope" else 0.0)  # +-0.05 m of roughness
    assert (heights[:, : col(4)] == heights[:, [col(4)]]).all()
    assert (heights[:, col(12) + 1 :] == heights[:, [col(12)]]).all()
    assert not heights[:, [col(4), col(12)]].any()


@pytest.mark.parametrize(("kind", "sign"), [("stairs_up", -1.0), ("stairs_down", 1.0)])
def test_stairs_tile_is_a_pyramid_of_the_levels_steps(kind, sign):
    heights = training_tile(kind, 9, 0)  # d = 0.9: step 0.05 + 0.18 * 0.9 = 0.212 m
    assert heights[80, col(8)] == pytest.approx(sign * 8 * 0.212)
    np.testing.assert_array_equal(square(heights), square(heights).T)
    np.testing.assert_allclose(np.unique(heights), np.sort(sign * 0.212 * np.arange(9)), atol=1e-6)
    assert heights[80, col(4.3)] == 0.0
    assert heights[80, col(4.35)] == pytest.approx(sign * 0.212)


def test_slope_tile_is_a_pyramid_of_the_levels_gradient():
    heights = training_tile("slope", 5, 0)  # d = 0.5: gradient 0.2
    assert heights[80, col(5)] == pytest.approx(0.2)
    assert heights[col(1), col(8)] == pytest.approx(0.2)
    assert heights[col(1), col(6)] == pytest.approx(0.2)  # the nearer edge counts
    np.testing.assert_allclose(training_tile("rough_slope", 5, 0), heights, atol=0.05 + 1e-6)


def test_obstacles_tile_has_the_levels_heights_and_keeps_off_the_edge():
    tiles = np.stack([square(training_tile("obstacles", 9, seed)) for seed in range(50)])
    np.testing.assert_allclose(np.unique(tiles), [-0.23, -0.115, 0.0, 0.115, 0.23], atol=1e-6)  # 0.05 + 0.2 * 0.9
    assert not tiles[:, [0, -1]].any() and not tiles[:, :, [0, -1]].any()
