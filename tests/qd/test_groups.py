"""Elites in families and in orders: faults before costs, and no kind of failure twice among the first."""

import dataclasses

import numpy as np

from qd.groups import KIN_M, ORDERS, elites_of, families_of, rank, rms_distances
from sim.bank import heights_of
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import judged_archive, small_archive
from tests.qd.show.report.test_numbers import grouped_archive


def test_verdicts_come_before_rates_and_rates_before_fitness():
    elites = elites_of(judged_archive())
    assert elites.verdict.tolist() == [4, 2, 3, 1, 0]  # fault, confirmed, certified, failing, not failing
    assert elites.by_severity().tolist() == [0, 2, 1, 3, 4]
    archive = dataclasses.replace(
        small_archive(5),
        goal_rate=np.array([0.9, 0.1, 0.0, 0.0, 0.0]),
        collision_rate=np.array([0.0, 0.9, 0.2, 0.3, 0.3]),
        fallen_rate=np.array([0.0, 0.0, 0.5, 0.0, 0.1]),
        fitness=np.array([9.0, 5.0, 4.0, 3.0, 2.0]),
    )
    elites = elites_of(archive)
    assert elites.verdict.tolist() == [0, 1, 1, 1, 1]  # by the episodes that found them: nobody else looked
    assert elites.by_severity().tolist() == [4, 3, 2, 1, 0]


def test_the_first_are_one_of_each_way_of_failing_and_of_different_families():
    archive, kinds = grouped_archive()  # 6 stuck, 9 collided, 5 across
    genes = archive.genes.copy()
    genes[7] = genes[0] = genes[6]  # two collided and one stuck are the same terrain
    goal_rate = archive.goal_rate.copy()
    goal_rate[8:15], goal_rate[0:6] = 0.05, np.linspace(0.01, 0.06, 6)
    ranking = rank(dataclasses.replace(archive, genes=genes, goal_rate=goal_rate), SUPER_GAUSSIAN)
    order = ranking.order()
    assert sorted(order.tolist()) == list(range(20))
    assert ranking.leaders() == [6, 1] and ranking.worst(2) == [6, 1]  # 0 is worse than 1, and of the family of 6
    assert kinds[order[:2]].tolist() == [1, 0]
    assert ranking.families[[0, 6, 7]].tolist() == [1, 1, 1]
    by_worst = ranking.families[ranking.order("fault")].tolist()
    assert [*dict.fromkeys(by_worst)] == [*range(1, 1 + len(set(by_worst)))]
    count = len(set(ranking.families[:15]))
    assert len(set(ranking.families[order[:count]])) == count  # other families come first
    assert set(order[15:].tolist()) == set(range(15, 20))
    assert ranking.order("fault").tolist()[:2] == [6, 7]
    families = ranking.families[ranking.order("family")]
    assert families.tolist() == sorted(families) and families[0] == families[1] == 1
    for name in ("goal_rate", "collision_rate", "fallen_rate", "fitness"):
        values = getattr(ranking.elites, name)[ranking.order(name)]
        assert np.all(np.diff(values if name == "goal_rate" else -values) >= 0.0) and name in ORDERS


def test_without_failing_elites_nothing_leads():
    archive = dataclasses.replace(small_archive(4), goal_rate=np.ones(4))
    ranking = rank(archive, SUPER_GAUSSIAN)
    assert ranking.leaders() == [] and sorted(ranking.worst(4)) == [0, 1, 2, 3]


def test_a_distance_is_the_root_of_the_mean_square():
    assert rms_distances(np.array([[0.0, 0.0]]), np.array([[3.0, 4.0], [0.0, 0.0]])).tolist() == [[12.5**0.5, 0.0]]


def test_kin_of_kin_are_of_one_family_and_families_are_numbered_as_they_come():
    strangers = np.clip(SUPER_GAUSSIAN.hard_random(4, 0), -1.0, 1.0).astype(np.float32)
    child, grandchild = strangers[1].copy(), strangers[1].copy()
    child[31], grandchild[31] = strangers[1, 31] - 0.5, strangers[1, 31] - 1.0  # the height of a bump
    genes = np.stack([*strangers, child, grandchild])
    first, second, third = heights_of(genes[[1, 4, 5]])
    near = [float(np.sqrt(((one - other) ** 2).mean())) for one, other in ((first, second), (second, third))]
    assert max(near) < KIN_M < np.sqrt(((first - third) ** 2).mean())
    assert families_of(genes[[0, 5, 1, 2, 4, 3]], SUPER_GAUSSIAN).tolist() == [0, 1, 1, 2, 1, 3]
    assert families_of(genes[:0], SUPER_GAUSSIAN).tolist() == []
