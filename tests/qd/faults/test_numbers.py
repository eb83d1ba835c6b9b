"""Faults in numbers and in words."""

from dataclasses import replace

import numpy as np
import pytest

from qd.faults.numbers import (
    SPECIALIST,
    count_faults,
    describe_judgement,
    fault_numbers,
    fresh_counts,
    fresh_numbers,
    judgement,
    rate_numbers,
)
from tests.builders import fresh_values, judged_archive, small_archive


def pick_numbers(archive, *names, **known):
    numbers = fault_numbers(archive, **known)
    return tuple(numbers[name] for name in names)


def test_numbers_by_hand():
    archive = judged_archive()
    assert pick_numbers(archive, "failing", "confirmed", "certified", "faults_panel") == (4, 2, 2, 1)
    assert pick_numbers(archive, "certifiers", "crossed_resolved") == (["C-G", "S"], 4)
    (certificates,) = pick_numbers(archive, "certificates")
    assert [(entry["crossed"], entry["certified"]) for entry in certificates] == [(4, 1), (3, 1)]
    # Nobody trained a specialist, looked for families, or knows what the certifiers were trained on.
    names = ("faults", "faults_unseen", "families", "fault_families")
    assert pick_numbers(archive, *names) == (None,) * 4 and count_faults(archive) == 1


@pytest.mark.parametrize(("certifiers", "expected"), [(("C-G", SPECIALIST), (1, 0)), ((SPECIALIST, "S"), (1, 1))])
def test_the_specialists_faults_count_beside_those_of_the_panel(certifiers, expected):
    archive = replace(judged_archive(), certifiers=certifiers)
    assert pick_numbers(archive, "faults", "faults_panel") == expected and count_faults(archive) == 1


def test_faults_by_certifiers_that_trained_on_no_kin_and_families_of_faults():
    # The fault is elite 0, which S crosses; elite 2 is certified by C-G alone and not confirmed.
    archive, families, seen = judged_archive(), np.array([0, 1, 1, 2, 0]), np.zeros((5, 2), bool)
    names = ("faults_unseen", "families", "fault_families")
    assert pick_numbers(archive, *names, families=families, seen=seen) == (1, 3, 1)
    seen[0, 1] = True
    assert pick_numbers(archive, *names, families=families, seen=seen) == (0, 3, 1)


def test_numbers_of_what_nobody_looked_at_are_none():
    archive, names = judged_archive(), ("failing", "certified", "confirmed", "faults_panel")
    assert pick_numbers(small_archive(), *names) == (None,) * 4
    fresh_alone = replace(small_archive(5), fresh=archive.fresh)
    assert pick_numbers(fresh_alone, *names) == (4, None, None, None)
    fine = replace(fresh_alone, fresh=replace(archive.fresh, goal_rate=np.ones(5)))
    assert pick_numbers(fine, *names) == (0,) * 4
    unresolved = replace(archive, resolved_outcomes=0 * archive.resolved_outcomes)
    assert pick_numbers(unresolved, *names) == (4, 2, None, None)


def test_numbers_of_fresh_episodes_by_hand():
    archive = small_archive(3)
    fresh = replace(
        fresh_values(archive),
        cell=np.array([0, 0, 5]),  # found in 0, 1 and 2
        fitness=np.array([1.0, 2.0, 4.0]),
        penalty_std=np.array([[1.0, 1.0], [2.0, 2.0], [9.0, 9.0]]),
        invalid_episodes=np.array([0, 0, 11]),  # of 40: more than a quarter
        reproduced=np.array([True, True, False]),
    )
    numbers = fresh_numbers(archive, fresh)
    assert (numbers["reevaluated"], numbers["elites_reproduced"], numbers["elites_same_cell"]) == (3, 2, 1)
    assert (numbers["mean_std"], numbers["mean_fitness_corrected"]) == (3.0, 1.5)
    # Two land in cell 0, of which the fitter counts: 2 above the floor of -20.
    assert (numbers["corrected_elites"], numbers["corrected_qd_score"]) == (1, 22.0)
    assert numbers["corrected_coverage"] == 1 / archive.cells.num_cells


def test_sentences_say_counts_and_verdicts():
    archive = judged_archive()
    texts = [describe_judgement(archive, number) for number in range(5)]
    # a fault, confirmed alone, certified alone, failing alone, not failing
    assert ["a fault" in text[-1] for text in texts] == [True, False, False, False, False]
    assert ["not known" in text[-1] for text in texts] == [False, True, False, True, False]
    assert "9 of 20 (45%, 26 to 66%)" in texts[0][0]
    assert describe_judgement(small_archive(5), 0) == []


def test_rates_and_certificates_of_an_elite():
    archive = judged_archive()
    known = judgement(archive, 0)
    # 9 of 20: (.45 + 3.842 / 40) / (1 + 3.842 / 20) = .4581, 1.96 sqrt(.45 .55 / 20 + 3.842 / 1600) / 1.1921 = .1999
    assert known["resolved"] == {"goal_rate": 0.45, "goal_interval": [0.2582, 0.6579], "valid_episodes": 20}
    (certificate,) = known["certificates"]
    assert (certificate["controller"], certificate["searched"]["goal_rate"]) == ("S", 0.5)
    (certificate,) = judgement(archive, 2)["certificates"]
    assert (certificate["searched"]["goal_rate"], certificate["resolved"]["goal_rate"]) == (1.0, 0.5)
    assert judgement(small_archive(), 0) == {"resolved": None, "certificates": []}
    assert rate_numbers(np.array([14, 0, 0, 6]))["goal_rate"] is None  # 6 of 20 are invalid


def test_fresh_episodes_of_an_elite_are_counted():
    archive = small_archive(3)
    fresh = replace(fresh_values(archive), goal_rate=np.full(3, 0.1), collision_rate=np.full(3, 0.8))
    # Of 40 episodes 10 % arrive and 80 % collide.
    assert fresh_counts(replace(archive, fresh=fresh), 0).tolist() == [4, 32, 4, 0]
