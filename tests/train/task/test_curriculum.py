"""Training tiles: grid order and shares."""

import numpy as np
import pytest

from sim.terrains.hand_crafted import NUM_COLS, NUM_LEVELS, NUM_ROWS, training_tiles
from train.task.curriculum import CurriculumCfg, make_tiles


@pytest.fixture(scope="module")
def tiles():
    return make_tiles(CurriculumCfg(num_columns=5, noise_columns=2), seed=3)


def test_grid_order(tiles):
    assert tiles.heights.shape == (NUM_LEVELS * 7, NUM_ROWS, NUM_COLS)
    assert (tiles.num_levels, tiles.num_columns) == (NUM_LEVELS, 7)
    assert tiles.type_of_column[-2:] == ("noise", "noise")
    without_noise = tiles.heights.reshape(NUM_LEVELS, 7, NUM_ROWS, NUM_COLS)[:, :5].reshape(-1, NUM_ROWS, NUM_COLS)
    rng = np.random.default_rng(3).spawn(2)[0]
    np.testing.assert_array_equal(without_noise, training_tiles(5, rng)[0])


def test_noise_grows_with_the_level(tiles):
    for level in range(NUM_LEVELS):
        tile = tiles.heights[level * 7 + 6]
        bound = 0.02 + 0.08 * level / 10
        assert 0.9 * bound < np.abs(tile).max() <= bound
    assert (tiles.heights[5] != tiles.heights[6]).any()


def test_every_column_gets_its_share(tiles):
    counts = np.bincount(tiles.assign_columns(700))
    assert counts.tolist() == [100] * 7
    assert set(np.bincount(tiles.assign_columns(703))) == {100, 101}
    assert tiles.assign_columns(3).max() < 7


def test_columns_of_noise_alone_and_none_at_all():
    assert make_tiles(CurriculumCfg(num_columns=0, noise_columns=1), seed=0).type_of_column == ("noise",)
    with pytest.raises(ValueError, match="num_columns"):
        make_tiles(CurriculumCfg(num_columns=0, noise_columns=0), seed=0)
