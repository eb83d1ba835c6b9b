"""Families: terrains joined by kin, however far its ends are apart."""

import numpy as np

from qd.families import KIN_M, families_of, joined, rms_distances
from sim.bank import heights_of
from sim.space import SUPER_GAUSSIAN


def test_kin_of_kin_are_of_one_family_and_families_are_numbered_as_they_come():
    kin = np.eye(5, dtype=bool)
    for one, other in ((4, 1), (1, 3)):  # 4 and 3 are not kin themselves
        kin[one, other] = kin[other, one] = True
    assert joined(kin).tolist() == [0, 1, 2, 1, 1]


def test_a_distance_is_the_root_of_the_mean_square():
    assert rms_distances(np.array([[0.0, 0.0]]), np.array([[3.0, 4.0], [0.0, 0.0]])).tolist() == [[12.5**0.5, 0.0]]


def test_a_child_is_kin_and_strangers_are_not():
    strangers = SUPER_GAUSSIAN.hard_random(4, 0)
    child = strangers[2].copy()
    child[7] = 0.97 * child[7] - 0.01  # one bump's height
    genes = np.clip(np.concatenate([strangers, child[None]]), -1.0, 1.0).astype(np.float32)
    heights = heights_of(genes[[2, 4]])
    assert 0.0 < np.sqrt(((heights[0] - heights[1]) ** 2).mean()) < KIN_M
    assert families_of(genes, SUPER_GAUSSIAN).tolist() == [0, 1, 2, 3, 2]
    assert families_of(genes[:0], SUPER_GAUSSIAN).tolist() == []
