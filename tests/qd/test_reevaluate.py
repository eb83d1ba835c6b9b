import dataclasses

import numpy as np
import pytest

from qd.reevaluate import reproduced
from tests.qd.stand_in import make_result
from tests.qd.test_archive import small_archive


def archive_of(ratios, *, collided=None):
    """An archive whose elites have given first ratios of two, found with or without a collision."""
    archive = small_archive(len(ratios))
    columns = np.stack([np.asarray(ratios), 1.0 - np.asarray(ratios)], axis=1)
    archive = dataclasses.replace(archive, ratios=columns, scales=(1.0, 1.0), collision_bit=collided is not None)
    return dataclasses.replace(archive, cell=archive.cells.cell_of(columns, collided))


def evaluator(ratios, **kwargs):
    columns = np.stack([np.asarray(ratios), 1.0 - np.asarray(ratios)], axis=1)
    penalties = np.repeat(columns[:, None], 40, axis=1)
    return lambda genes, seeds, progress=None: make_result(penalties, **kwargs)


def test_the_same_cell_and_its_neighbours_count():
    # cells of two ratios: [.3, .4) x [.6, .7) has index 3; .45 is one interval further, .55 two
    found = archive_of([0.35, 0.35, 0.35, 0.35])
    again = evaluator([0.38, 0.45, 0.55, 0.25])
    assert reproduced(found, again, seed=0).tolist() == [True, True, False, True]


def test_an_invalid_terrain_is_not_reproduced():
    invalid = np.zeros((2, 40), bool)
    invalid[1, :11] = True  # 11 of 40 is more than a quarter
    again = evaluator([0.45, 0.45], invalid=invalid)
    assert reproduced(archive_of([0.45, 0.45]), again, seed=0).tolist() == [True, False]


def test_the_collision_bit_is_taken_over_the_first_twenty():
    collides = np.zeros((3, 40), bool)
    collides[1, 19] = True
    collides[2, 20] = True
    again = evaluator([0.35] * 3, base_collision=collides)
    assert reproduced(archive_of([0.35] * 3, collided=[False] * 3), again, seed=0).tolist() == [True, False, True]
    assert reproduced(archive_of([0.35] * 3, collided=[True] * 3), again, seed=0).tolist() == [False, True, False]


def test_an_empty_archive_has_none():
    assert len(reproduced(small_archive(0), evaluator([0.5]), seed=0)) == 0


def test_forty_episodes_are_needed():
    with pytest.raises(ValueError, match="evaluate must give 40 episodes, got 4"):
        reproduced(archive_of([0.5]), lambda *_: make_result([[[1.0, 1.0]] * 4]), seed=0)
