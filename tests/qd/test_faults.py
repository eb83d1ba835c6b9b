"""Faults in numbers and in words, and how elites are crossed for them."""

import dataclasses
from contextlib import contextmanager

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import FaultCounts
from qd.faults import (
    EPISODES,
    Work,
    certify,
    confirm,
    confirm_in_mujoco_c,
    elite_words,
    fault_numbers,
    fault_words,
    is_judged,
    outcome_counts,
    with_certifiers,
)
from qd.groups import verdict_of
from qd.workers.evaluator import EvaluatorCfg
from sim.mujoco_c import crossing
from tests.builders import fresh_values, judged_archive, small_archive
from tests.qd.stand_in import make_result

EVALUATOR = EvaluatorCfg(robot="anymal", policy="p", num_terrains=9, num_replicas=4, device="cpu", workers="2", lots=3)


@pytest.fixture
def failing():
    """Six elites that all fail."""
    archive = small_archive(6)
    return dataclasses.replace(archive, fresh=dataclasses.replace(fresh_values(archive), goal_rate=np.zeros(6)))


@pytest.fixture
def certifier(tmp_path):
    file = tmp_path / "other.pt"
    file.write_bytes(b"another controller")
    return str(file)


def work(crosses, saved=None, opened=None, seeds=None):
    """Robots of which as many arrive as ``crosses(cfg, genes)`` says of each terrain, out of 20."""

    @contextmanager
    def open_evaluator(cfg):
        (opened if opened is not None else []).append(cfg)

        def evaluate(genes, terrain_seeds, progress=None):
            (seeds if seeds is not None else []).append((cfg.policy, cfg.resolved, terrain_seeds.tolist()))
            arrived = np.arange(EPISODES) < np.array(crosses(cfg, genes))[:, None]
            return make_result(np.ones((len(genes), EPISODES, 6)), base_collision=~arrived)

        yield evaluate

    saves = saved if saved is not None else []
    return Work(evaluator=EVALUATOR, open_evaluator=open_evaluator, seed=3, save=saves.append)


def test_outcomes_are_counted_by_hand():
    collided = np.array([[True, False, False, False], [False] * 4])
    invalid = np.array([[False, True, False, False], [False] * 4])
    late = [[False] * 3 + [True], [False] * 4]
    result = make_result(np.ones((2, 4, 6)), base_collision=collided, invalid=invalid, late=late)
    # one arrives, one collides, one is out of time, one is invalid
    assert outcome_counts(result).tolist() == [[1, 1, 1, 1], [4, 0, 0, 0]]


def test_confirming_crosses_with_contact_resolved_what_was_not_crossed_before(failing):
    opened, saved = [], []
    archive = confirm(failing, [0, 2, 5], work(lambda cfg, genes: [9] * len(genes), saved, opened))
    assert [(cfg.resolved, cfg.num_replicas, cfg.policy) for cfg in opened] == [(True, 20, "p")]
    assert archive.confirmed.tolist() == [True, False, True, False, False, True]
    assert archive.faults.resolved_outcomes[2].tolist() == [9, 11, 0, 0]
    assert [int(one.faults.resolved_outcomes.any(axis=1).sum()) for one in saved] == [
        2,
        3,
    ]  # lots of a terrain a worker
    again = confirm(archive, range(6), work(lambda cfg, genes: [10] * len(genes), [], opened))
    assert again.confirmed.tolist() == archive.confirmed.tolist()
    assert again.faults.resolved_outcomes.sum(axis=1).tolist() == [20] * 6
    confirm(again, range(6), work(lambda cfg, genes: pytest.fail("all of them were crossed"), [], opened))


def test_an_elite_has_its_own_episodes_whatever_is_crossed_beside_it(failing):
    seeds = []
    confirm(failing, range(6), work(lambda cfg, genes: [0] * len(genes), seeds=seeds))
    every = [seed for _, _, some in seeds for seed in some]
    alone = []
    confirm(failing.rows(np.array([4, 1])), [1], work(lambda cfg, genes: [0] * len(genes), seeds=alone))
    assert alone[0][2] == [every[1]]
    assert len(set(every)) == 6


def test_certificates_add_up_and_are_asked_for_with_contact_resolved_only_where_there_can_be_one(
    failing, certifier, tmp_path
):
    seeds = []

    def crosses(cfg, genes):
        # at the search's settings the first gene decides, with contact resolved the second
        return np.where(genes[:, int(cfg.resolved)] > 0, 10, 9)

    archive = certify(failing, range(6), {"C-G": certifier}, work(crosses, seeds=seeds))
    first, second = failing.genes[:, 0] > 0, failing.genes[:, 1] > 0
    assert archive.certified.tolist() == (first & second).tolist()
    assert 0 < archive.certified.sum() < first.sum() < 6
    assert {policy for policy, _, _ in seeds} == {certifier}
    crossed = [sum(len(some) for _, resolved, some in seeds if resolved is kind) for kind in (False, True)]
    assert crossed == [6, first.sum()]
    drawn = [seed for _, _, some in seeds for seed in some]
    assert len(set(drawn)) == len(drawn)
    other = tmp_path / "S.pt"
    other.write_bytes(b"a third controller")
    more = certify(archive, range(6), {"C-G": certifier, "S": str(other)}, work(lambda cfg, genes: [20] * len(genes)))
    assert more.faults.certifiers == ("C-G", "S")
    assert np.array_equal(more.faults.certifier_outcomes[:, 0], archive.faults.certifier_outcomes[:, 0])
    assert more.certified.all()


def test_a_name_is_of_one_controller_and_a_controller_of_one_name(failing, certifier, tmp_path):
    faults = with_certifiers(FaultCounts.none_of(6), {"C-G": certifier})
    assert with_certifiers(faults, {"same": certifier}) is faults
    other = tmp_path / "S.pt"
    other.write_bytes(b"a third controller")
    with pytest.raises(ValueError, match=r"certifier C-G must be the controller whose certificates the archive has"):
        with_certifiers(faults, {"C-G": str(other)})
    with pytest.raises(ValueError, match="certifier S must have a file"):
        with_certifiers(faults, {"S": "sys:exit"})


def test_more_in_mujoco_c_are_the_same_and_others(failing, monkeypatch):
    asked = []

    def cross_terrains(robot, policy, terrains, seeds, *, num_episodes, resolved, **_):
        asked.append((resolved, len(terrains), num_episodes))
        outcome = np.array([Outcome.GOAL] * 3 + [Outcome.TIME_OUT] * 15 + [Outcome.INVALID] + [Outcome.BASE_COLLISION])
        nothing = np.zeros((EPISODES, 6))
        record = crossing.PlainCrossings(outcome=outcome.astype(np.uint8), penalties=nothing, duration_s=nothing[:, 0])
        yield from ((number, record) for number in range(len(terrains)))

    monkeypatch.setattr(crossing, "cross_terrains", cross_terrains)
    nobody = work(lambda cfg, genes: pytest.fail("only MuJoCo C crosses"))
    two = confirm_in_mujoco_c(failing, range(6), 2, nobody)
    three = confirm_in_mujoco_c(two, range(6), 3, nobody)
    assert asked == [(True, 2, 20), (True, 1, 20)]
    drawn = [set(np.flatnonzero(archive.faults.mujoco_c_outcomes.any(axis=1)).tolist()) for archive in (two, three)]
    assert drawn[0] < drawn[1] and [len(some) for some in drawn] == [2, 3]
    assert three.faults.mujoco_c_outcomes[min(drawn[1])].tolist() == [3, 1, 15, 1]


def test_numbers_by_hand():
    numbers = fault_numbers(judged_archive())
    counts = {name: numbers[name] for name in ("failing", "confirmed", "certified", "faults")}
    assert counts == {"failing": 4, "confirmed": 2, "certified": 2, "faults": 1}
    assert numbers["panel"] == ["C-G", "S"]
    assert numbers["mujoco_c"] == {"crossed": 2, "failing": 1}
    assert [one["certified"] for one in numbers["certificates"]] == [1, 1]
    assert [one["crossed"] for one in numbers["certificates"]] == [4, 3]
    fresh_alone = dataclasses.replace(judged_archive(), faults=None)
    assert fault_numbers(fresh_alone)["failing"] == 4 and fault_numbers(fresh_alone)["faults"] is None
    assert fault_numbers(small_archive())["failing"] is None


def test_words_by_hand():
    archive = judged_archive()
    confirmed, in_c, faults, rest = fault_words(archive)
    # Wilson of 2 of 4: 15 to 85 %
    assert "Of 4 failing elites 4 were crossed with contact resolved: 2 of 4 (50%, 15 to 85%) confirmed" in confirmed
    assert in_c.startswith("In plain MuJoCo C 1 of 2 (50%")
    assert faults == "1 fault: a terrain that C-G or S crosses and this controller does not."
    assert rest == "2 failing elites are not known to be passable."
    assert fault_words(dataclasses.replace(archive, faults=None)) == []
    waits = dataclasses.replace(archive.faults, resolved_outcomes=0 * archive.faults.resolved_outcomes)
    waits = dataclasses.replace(archive, faults=waits)
    assert fault_numbers(waits)["faults"] is None
    assert fault_words(waits)[1:] == ["2 that C-G or S crosses are still to be confirmed.", rest]
    assert [verdict_of(archive, number) for number in range(5)] == ["fault", "confirmed", "certified", "failing", ""]
    assert elite_words(archive, 0)[-1] == "It is a fault: a terrain that S crosses and this controller does not."
    assert elite_words(archive, 1)[-1] == "It is confirmed, and not known to be passable."
    assert "It is certified but not confirmed" in elite_words(archive, 2)[-1]
    assert elite_words(archive, 3)[-1] == "It is not confirmed, and not known to be passable."
    assert elite_words(archive, 4)[-1] == "It does not fail by its fresh episodes."
    assert "With contact resolved: 9 of 20 (45%, 26 to 66%) reach the goal." in elite_words(archive, 0)


def test_judged_is_an_archive_of_which_nothing_is_left_to_be_crossed(failing, certifier):
    panel, everyone = {"C": certifier}, list(range(6))
    half = work(lambda cfg, genes: [0 if cfg.policy == "p" else 10] * len(genes))
    assert not is_judged(failing, panel)
    confirmed = confirm(failing, everyone, half)
    assert not is_judged(confirmed, panel) and is_judged(confirmed, {})
    assert not is_judged(certify(confirmed, everyone[:5], panel, half), panel)
    judged = certify(confirmed, everyone, panel, half)
    assert is_judged(judged, panel)
    # A certifier that does not cross at the search's settings is not asked with contact resolved.
    assert is_judged(certify(confirmed, everyone, panel, work(lambda cfg, genes: [0] * len(genes))), panel)


def test_where_nothing_fails_nothing_is_crossed_and_the_panel_is_named(failing, certifier):
    fine = dataclasses.replace(failing, fresh=dataclasses.replace(failing.fresh, goal_rate=np.ones(6)))
    assert not is_judged(fine, {"C": certifier})
    opened = []
    judged = certify(fine, [], {"C": certifier}, work(lambda cfg, genes: [0] * len(genes), opened=opened))
    assert is_judged(judged, {"C": certifier}) and fault_numbers(judged)["panel"] == ["C"] and not opened
