import dataclasses

import numpy as np
import pytest

from qd.fitness import FitnessCfg
from qd.fresh import drawn_elites, numbers_of, reevaluate
from tests.builders import small_archive
from tests.qd.stand_in import make_result


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


def again_of(archive, evaluate, num_replicas=40):
    fitness = FitnessCfg(penalties=archive.penalties, scales=archive.scales)
    return reevaluate([archive], evaluate, fitness, num_replicas=num_replicas, seeds=[0])[0]


def reproduced(archive, evaluate):
    return again_of(archive, evaluate).reproduced.tolist()


def test_the_same_cell_and_its_neighbours_count():
    # cells of two ratios: [.3, .4) x [.6, .7) has index 3; .45 is one interval further, .55 two
    found = archive_of([0.35, 0.35, 0.35, 0.35])
    assert reproduced(found, evaluator([0.38, 0.45, 0.55, 0.25])) == [True, True, False, True]


def test_an_invalid_terrain_is_not_reproduced_and_counts_in_no_mean():
    invalid = np.zeros((2, 40), bool)
    invalid[1, :11] = True  # 11 of 40 is more than a quarter
    archive = archive_of([0.45, 0.45])
    again = again_of(archive, evaluator([0.45, 0.45], invalid=invalid))
    assert again.reproduced.tolist() == [True, False]
    assert again.corrected_elites().tolist() == [0]
    # mean 1 of the two penalties together, no deviation, no collision: fitness 1
    assert numbers_of(again, archive.cells) == {
        "reevaluated": 2, "reproduced": 1, "mean_std": 0.0, "mean_std_interval": None,
        "corrected_mean_fitness": 1.0, "failing": 0, "corrected_elites": 1,
        "corrected_coverage": 1 / archive.cells.num_cells, "corrected_qd_score": 21.0,
    }  # fmt: skip


def test_collision_intervals_by_hand():
    collides, invalid = np.zeros((4, 40), bool), np.zeros((4, 40), bool)
    collides[0, :10] = True
    collides[1] = invalid[1] = True
    collides[3, :5], invalid[3, 5:10] = True, True
    again = again_of(archive_of([0.45] * 4), evaluator([0.45] * 4, base_collision=collides, invalid=invalid))
    # Wilson with z = 1.96, z^2 = 3.842: of 10 of 40 the centre is (.25 + 3.842/80) / (1 + 3.842/40) = .2719, half the
    # width 1.96 sqrt(.25 .75 / 40 + 3.842 / 6400) / 1.0960 = .1300; nothing is known of the second; none of 40 give
    # 3.842 / (40 + 3.842) = .0876; of 5 of 35, (.1429 + .0549) / 1.1098 = .1782 and 1.96 sqrt(.004283) / 1.1098 = .1156
    assert again.collision_low == pytest.approx([0.1419, 0.0, 0.0, 0.0626], abs=1e-4)
    assert again.collision_high == pytest.approx([0.4019, 1.0, 0.0876, 0.2938], abs=1e-4)
    assert again.collision_rate.tolist() == [0.25, 0.0, 0.0, 5 / 35]


def test_the_collision_bit_is_taken_over_the_first_twenty():
    collides = np.zeros((3, 40), bool)
    collides[1, 19] = True
    collides[2, 20] = True
    again = evaluator([0.35] * 3, base_collision=collides)
    assert reproduced(archive_of([0.35] * 3, collided=[False] * 3), again) == [True, False, True]
    assert reproduced(archive_of([0.35] * 3, collided=[True] * 3), again) == [False, True, False]


def test_elites_that_land_in_one_cell_are_one_corrected_elite_the_fittest():
    columns = np.repeat(np.array([[1.0, 3.0], [2.0, 6.0], [3.0, 1.0]])[:, None], 40, axis=1)
    again = again_of(archive_of([0.25, 0.35, 0.75]), lambda *_: make_result(columns))
    assert again.corrected_elites().tolist() == [1, 2]
    assert numbers_of(again, small_archive(1).cells)["corrected_qd_score"] == (8 + 20) + (4 + 20)


def test_several_archives_at_once_by_few_replicas_make_forty_episodes_each():
    seen = []

    def evaluate(genes, seeds, progress=None):
        seen.append((genes, seeds))
        marks = np.arange(len(genes) * 12, dtype=float).reshape(len(genes), 12)
        return make_result(np.stack([marks, marks + 1.0], axis=2))

    one, two = archive_of([0.25, 0.35]), archive_of([0.45])
    fitness = FitnessCfg(penalties=one.penalties, scales=one.scales)
    first, second = reevaluate([one, two], evaluate, fitness, num_replicas=12, seeds=[0, 1])
    genes, seeds = seen[0]
    # 4 times 12 episodes, of which 40 count
    assert np.array_equal(genes, np.concatenate([one.genes, two.genes]).repeat(4, axis=0))
    assert len(set(seeds.tolist())) == 12
    assert first.episodes.tolist() == [40, 40]
    assert first.penalty_mean[:, 0].tolist() == [19.5, 48 + 19.5]
    assert second.penalty_mean[:, 0].tolist() == [96 + 19.5]
    alone = reevaluate([two], evaluate, fitness, num_replicas=12, seeds=[1])
    assert np.array_equal(seen[1][1], seeds[8:])
    assert len(alone) == 1


def test_an_empty_archive_has_none():
    again = again_of(small_archive(0), evaluator([0.5]))
    assert len(again.reproduced) == 0
    assert numbers_of(again, small_archive(0).cells)["mean_std"] is None


def test_episodes_of_another_number_than_said_are_refused():
    with pytest.raises(ValueError, match="evaluate must give 40 episodes, got 4"):
        again_of(archive_of([0.5]), lambda *_: make_result([[[1.0, 1.0]] * 4]))


def test_drawn_elites_are_some_of_them_each_once():
    archive = small_archive(3)
    assert drawn_elites(archive, 3, seed=0) is archive
    drawn = drawn_elites(archive, 2, seed=0)
    assert len(drawn) == 2
    assert set(drawn.cell.tolist()) < set(archive.cell.tolist())
