"""Elites in numbers and words, by cause, in families and in orders: faults first, no kind of failure twice at first."""

from dataclasses import replace

import numpy as np
import pytest

from qd.faults.families import (
    KIN_M,
    ORDERS,
    find_families,
    judged_numbers,
    kin_distances,
    pick_distinct,
    rank,
    summarise_search,
)
from qd.faults.numbers import (
    SPECIALIST,
    MinimalTerrains,
    count_faults,
    describe_judgement,
    fault_numbers,
    find_significant,
    fisher_p,
    fresh_counts,
    fresh_numbers,
    judgement,
    rate_numbers,
)
from qd.search.archive import CrossedAgain, no_outcomes, no_witnesses
from sim.terrains.bank import make_heights
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.conditions.likely import choose_likely
from sim.terrains.spaces.base import ShippedSpace, TerrainSpace
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import bump, fresh_values, judged_archive, small_archive, steered_archive


def pick_numbers(archive, *names):
    numbers = fault_numbers(archive)
    return tuple(numbers[name] for name in names)


def test_numbers_by_hand():
    archive = judged_archive()
    assert pick_numbers(archive, "failing", "confirmed", "certified", "faults_panel") == (4, 2, 2, 1)
    assert pick_numbers(archive, "certifiers", "crossed_resolved") == (["C-G", "S"], 4)
    (certificates,) = pick_numbers(archive, "certificates")
    assert [(entry["crossed"], entry["certified"]) for entry in certificates] == [(4, 1), (3, 1)]
    # Nobody trained a specialist or looked for families.
    names = ("faults", "families", "failing_families", "fault_families")
    assert pick_numbers(archive, *names) == (None,) * 4 and count_faults(archive) == 1


@pytest.mark.parametrize(
    ("certifiers", "expected"),
    [(("C-G", SPECIALIST), (1, 0)), (("C-G", f"{SPECIALIST} of another"), (1, 0)), ((SPECIALIST, "S"), (1, 1))],
)
def test_the_specialists_faults_count_beside_those_of_the_panel(certifiers, expected):
    archive = replace(judged_archive(), certifiers=certifiers)
    assert pick_numbers(archive, "faults", "faults_panel") == expected and count_faults(archive) == 1


def test_families_of_elites_of_failing_ones_and_of_faults():
    archive = replace(judged_archive(), family=np.array([0, 1, 1, 2, 3]))  # the first four fail, the first is a fault
    assert pick_numbers(archive, "families", "failing_families", "fault_families") == (4, 3, 1)


def all_faults(fresh_rates, resolved, coarse, fine):
    """Faults that one certifier crosses: episodes of 20 that reach the goal."""
    archive = small_archive(len(fresh_rates))
    goals = np.array([resolved, coarse, fine])
    counts = np.stack([goals, 20 - goals, 0 * goals, 0 * goals], axis=2)
    return replace(
        archive, fresh=replace(fresh_values(archive), goal_rate=np.array(fresh_rates)), resolved_outcomes=counts[0],
        certifiers=("C-G",), certifier_sha256=("a" * 64,), certifier_outcomes=counts[1][:, None],
        certifier_resolved_outcomes=counts[2][:, None]
    )  # fmt: skip


def test_a_strong_fault_is_under_a_fifth_and_over_four_fifths_with_both_kinds_of_physics():
    archive = all_faults([0.175, 0.2, 0.175, 0.175, 0.175], [3, 3, 4, 3, 3], [17, 17, 17, 16, 17], [17, 17, 17, 17, 16])
    assert archive.strong.tolist() == [True, False, False, False, False]
    assert pick_numbers(archive, "faults_panel", "strong") == (5, 1)
    assert not small_archive(2).strong.any()


def test_p_of_more_goals_by_hand():
    def p(*counts):
        return float(fisher_p(*map(np.array, counts)))

    assert p(3, 3, 0, 3) == pytest.approx(1 / 20)  # 6 over 3
    assert p(3, 4, 1, 4) == pytest.approx((4 * 4 + 1) / 70)  # 3 of 4 and 1 of 4, or 4 and none, of 8 over 4
    assert p(0, 3, 3, 3) == 1.0


def test_significant_are_those_of_the_worse_physics_whose_share_of_luck_is_held():
    archive = judged_archive()  # the first four fail; two certifiers double each p
    never, always = ([[0, count, 0, 0] for count in (6, 5, 4, 3, 6)], [[count, 0, 0, 0] for count in (6, 5, 4, 3, 6)])
    coarse, fine = np.zeros((2, 5, 2, 4), np.int64)
    coarse[:, 0] = fine[:, 0] = always
    coarse[3, 1], fine[3, 1] = (6, 0, 0, 0), (0, 6, 0, 0)  # p of 1 / 84 at the search's settings alone
    outcomes = {"certifier_outcomes": coarse, "certifier_resolved_outcomes": fine}
    archive = replace(archive, resolved_outcomes=np.array(never), **outcomes)
    # 2 / 924, 2 / 252 and 2 / 70 = .029 are under .05 times 1, 2 and 3 of 4; 2 / 20 is over .05.
    assert find_significant(archive).tolist() == [True, True, True, False, False]
    assert pick_numbers(archive, "faults_panel", "faults_fdr") == (4, 3)


def test_faults_that_hold_in_mujoco_c_are_a_share_of_those_tried():
    archive = judged_archive().rows(np.zeros(5, np.int64))  # the fault, five times; the last is not tried
    fails, crosses, never = [0, 6, 0, 0], [5, 0, 0, 0], [0, 0, 0, 0]
    others = np.zeros((5, 2, 4), np.int64)
    others[[0, 1, 2], 1], others[3, 0] = [crosses, crosses, [5, 1, 2, 0]], crosses  # C-G has no certificate
    outcomes = np.array([fails, fails, [2, 5, 1, 0], [0, 6, 0, 0], never])
    archive = replace(archive, mujoco_c=CrossedAgain(searched=outcomes, certifiers=others))
    (numbers,) = pick_numbers(replace(archive, family=np.array([4, 2, 3, 0, 1])), "faults_mujoco_c")
    # Wilson, 3 of 4: (.75 + 3.842 / 8) / (1 + 3.842 / 4) = .6275, 1.96 sqrt(.75 .25 / 4 + 3.842 / 64) / 1.9604 = .3269
    assert (numbers["tried"], numbers["hold"]) == (4, 3)
    assert numbers["interval"] == pytest.approx([0.3006, 0.9544], abs=1e-4)
    # Of three families, resamples draw the one that does not hold alone, or never, once in 27.
    (kin,) = pick_numbers(replace(archive, family=np.array([4, 4, 3, 0, 1])), "faults_mujoco_c")
    assert kin["interval"] == [0.0, 1.0]
    for family in (np.zeros(5, np.int64), None):
        assert pick_numbers(replace(archive, family=family), "faults_mujoco_c")[0]["interval"] is None
    # Elites 0, 3 and 4 are strong faults: 1 of 20 by the controller and 19 of 20 by S. The first of them holds.
    resolved, crossed = archive.resolved_outcomes.copy(), archive.certifier_outcomes.copy()
    resolved[[0, 3, 4]], crossed[[0, 3, 4], 1] = [1, 19, 0, 0], [19, 1, 0, 0]
    outcomes = {"resolved_outcomes": resolved, "certifier_outcomes": crossed, "certifier_resolved_outcomes": crossed}
    (strong,) = pick_numbers(replace(archive, **outcomes), "faults_mujoco_c")
    assert (strong["strong"]["tried"], strong["strong"]["hold"]) == (2, 1) and numbers["strong"]["tried"] == 0
    sentences = [describe_judgement(archive, number)[-1] for number in range(5)]
    assert [text.endswith("one, too.") for text in sentences] == [True, True, True, False, False]
    assert [text.endswith("is none.") for text in sentences] == [False, False, False, True, False]


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
    texts = [describe_judgement(judged_archive(), number) for number in range(5)]
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


def ranked(archive, minima=None, **chosen):
    return rank(archive, SUPER_GAUSSIAN, minima, half_width=0.4, **chosen)


def test_elites_are_as_found_without_fresh_values_and_else_those_that_are_valid():
    archive = small_archive(4)
    elites = ranked(archive)
    assert not elites.is_fresh.any() and elites.numbers.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(elites.goal_rate, archive.goal_rate)
    fresh = replace(fresh_values(archive), invalid_episodes=np.array([0, 40, 8, 0]))
    corrected = ranked(replace(archive, fresh=fresh), judged=True)
    assert corrected.is_fresh.all() and corrected.numbers.tolist() == [0, 2, 3]
    assert corrected.counted.tolist() == [40, 32, 40]
    np.testing.assert_array_equal(corrected.fitness, archive.fitness[[0, 2, 3]] / 2)
    assert [corrected.find_row(number) for number in (0, 2, 3)] == [0, 1, 2]


def test_verdicts_come_before_rates_and_rates_before_fitness():
    elites = ranked(judged_archive())
    assert elites.verdict.tolist() == [4, 3, 2, 1, 0]  # fault, confirmed, certified, failing, not failing
    assert elites.by_severity().tolist() == [0, 1, 2, 3, 4]
    archive = replace(
        small_archive(5),
        goal_rate=np.array([0.9, 0.1, 0.0, 0.0, 0.0]),
        collision_rate=np.array([0.0, 0.9, 0.2, 0.3, 0.3]),
        fallen_rate=np.array([0.0, 0.0, 0.5, 0.0, 0.1]),
        fitness=np.array([9.0, 5.0, 4.0, 3.0, 2.0]),
    )
    elites = ranked(archive)
    assert elites.verdict.tolist() == [0, 1, 1, 1, 1]  # by the episodes that found them: nobody else looked
    assert elites.by_severity().tolist() == [4, 3, 2, 1, 0]


def minima_with(causes):
    """Minimal terrains with causes of some kinds, by number of the elite."""
    entries = [{"elite": number, "cause": cause and {"kind": cause}} for number, cause in enumerate(causes)]
    return MinimalTerrains(numbers={"elites": entries}, genes={})


def six_elites(ends=(np.nan, np.nan)):
    """Six elites, worse from the first to the fifth, of which the third is a fault; the last is crossed."""
    archive = replace(
        small_archive(6),
        goal_rate=np.array([0.25, 0.0, 0.0, 0.0, 0.0, 0.75]),
        collision_rate=np.array([0.0, 0.5, 0.75, 0.75, 1.0, 0.25]),
        fallen_rate=np.array([0.0, 0.0, 0.25, 0.75, 1.0, 0.0]),
        end_position=np.full((6, 2), ends, np.float32),
    )
    crossed = np.array([[0, 20, 0, 0], [20, 0, 0, 0]])[[0, 0, 1, 0, 0, 0]][:, None]
    archive = replace(
        archive, fresh=fresh_values(archive), resolved_outcomes=np.tile([0, 20, 0, 0], (6, 1)), certifiers=("C-G",),
        certifier_sha256=("a" * 64,), certifier_outcomes=crossed, certifier_resolved_outcomes=crossed
    )  # fmt: skip
    return ranked(archive, minima_with(["ridge", "drop", "ridge", "ridge", None, "ridge"])), archive


def test_an_elite_is_named_by_its_cause_and_ending():
    ranking, _ = six_elites()
    assert ranking.causes == ("ridge", "drop", "ridge", "ridge", "unclear", "")
    assert [ranking.name(row) for row in range(6)] == [
        "ridge: gets stuck, 30 of 40",
        "drop: hits the ground, 20 of 40",  # of two endings as common the collision
        "ridge: hits the ground, 30 of 40",  # a third of those that collide have fallen
        "ridge: topples, 30 of 40",
        "unclear: topples, 40 of 40",
        "reaches the goal, 30 of 40",
    ]
    lying = replace(ranking, fallen_rate=np.array([0.75] + 5 * [0.0]))  # standing until the time is over
    assert lying.name(0) == "ridge: topples, 30 of 40"
    outside, _ = six_elites((9.0, 10.01))
    assert outside.name(0) == "ridge: leaves the terrain, 30 of 40"


def test_causes_are_by_number_and_the_unclear_last():
    ranking, archive = six_elites()
    by_cause = {cause: rows.tolist() for cause, rows in ranking.by_cause().items()}
    assert by_cause == {"ridge": [2, 3, 0], "drop": [1], "unclear": [4]} and [*by_cause] == ["ridge", "drop", "unclear"]
    summary = "The robot fails 5 of 6 terrains; ridges are the commonest cause"
    other = "another controller of this robot"
    assert summarise_search(ranking, archive) == f"{summary}; 1 is a fault: {other} passes it"
    judged = replace(archive, resolved_outcomes=np.zeros((6, 4), np.int64))
    assert summarise_search(ranking, judged) == f"{summary}; {other} passes 1 of them"
    alone = replace(archive, fresh=None, **no_outcomes(6), certifiers=(), certifier_sha256=())
    assert summarise_search(ranked(alone), alone) == "The robot fails 5 of 6 terrains"  # nobody knows why
    one = alone.rows(np.array([0]))
    assert summarise_search(ranked(one), one) == "The robot fails 1 of 1 terrain"
    crossed = replace(alone, goal_rate=np.ones(6))
    assert summarise_search(ranked(crossed), crossed) == "The robot fails none of 6 terrains"


def test_faults_by_ways_stand_beside_those_by_controllers():
    archive = steered_archive()
    names = ("certified", "faults", "faults_panel", "faults_controllers", "faults_witness", "strong")
    assert pick_numbers(archive, *names) == (3, 2, 1, 1, 1, 0)
    (witnesses,) = pick_numbers(archive, "witnesses")
    assert witnesses == {"tried": 2, "around": 1, "beside": 0, "line": 1, "own_line": 1, "limit_m": 0.5}
    sentences = [describe_judgement(archive, number)[-2:] for number in (1, 3)]
    assert sentences[0][0] == "It is a fault: it can be crossed on the line."
    assert sentences[0][1] == "Steered, at 0.5 m/s, this controller crosses it on the line, 17 of 20."
    assert sentences[1][0] == "It is not confirmed, and not known to be passable on the line."
    assert sentences[1][1] == "Steered, at 0.5 m/s, C-G crosses it by going round, 14 of 20."
    fails, arrives = np.array([[[0, 6, 0, 0]], [[6, 0, 0, 0]]]).repeat(5, axis=1)
    again = CrossedAgain(searched=fails, steered=arrives, certifiers=0 * archive.certifier_outcomes)
    held = replace(archive, mujoco_c=again)
    assert describe_judgement(held, 1)[-2] == "In MuJoCo C it is one, too."
    archive = replace(archive, cause=np.array([""] * 5), family=np.arange(5))
    passes = "2 are faults: another controller of this robot, or one that is steered, passes them"
    assert summarise_search(ranked(archive), archive).endswith(passes)
    nobody = {"certifiers": (), "certifier_sha256": ()}
    alone = replace(archive, **no_outcomes(5) | nobody | {"resolved_outcomes": archive.resolved_outcomes})
    assert pick_numbers(alone, "faults", "faults_controllers", "faults_witness") == (1, 0, 1)
    assert summarise_search(ranked(alone), alone).endswith("1 is a fault: a robot that is steered passes it")
    unconfirmed = replace(archive, **no_outcomes(5) | nobody)
    assert summarise_search(ranked(unconfirmed), unconfirmed).endswith("a robot that is steered passes 1 of them")
    assert pick_numbers(unconfirmed, "certified", "confirmed", "faults") == (1, None, None)
    assert "on the line, 17 of 20" in describe_judgement(unconfirmed, 1)[-1]
    nowhere = replace(unconfirmed, witnesses=no_witnesses(5, 0.5))
    assert summarise_search(ranked(nowhere), nowhere).endswith("a robot that is steered passes none of them")


def test_without_a_minimal_terrain_the_part_where_the_typical_episode_ends_is_the_cause():
    shapes = [(6.0, 0.5, 0.25), (8.0, 0.5, -0.2), (10.0, 1.5, -0.25), *[(8.0, 0.5, 0.0)] * 5]
    genes = np.concatenate([bump(x=x, sigma_x=sigma, height=height) for x, sigma, height in shapes])[None].repeat(4, 0)
    ends = np.array([[5.6, 4.0], [7.8, 4.0], [9.2, 4.0], [2.0, 4.0]], np.float32)
    archive = replace(small_archive(4), genes=genes, goal_rate=np.zeros(4), end_position=ends)
    assert ranked(archive).causes == ("ridge", "ditch", "drop", "unclear")


def test_the_first_are_one_of_each_cause_faults_first_and_of_different_families():
    archive = small_archive(20)  # 6 stuck, 9 collided, 5 across
    genes = archive.genes.copy()
    genes[7] = genes[0] = genes[6]  # two collided and one stuck are the same terrain
    archive = replace(
        archive, genes=genes, goal_rate=np.array([*np.linspace(0.01, 0.06, 6), 0.0, 0.0, *[0.05] * 7, *[1.0] * 5]),
        collision_rate=np.repeat([0.0, 1.0, 0.0], (6, 9, 5)), fallen_rate=np.zeros(20)
    )  # fmt: skip
    ranking = ranked(archive, minima_with(["drop"] * 6 + ["ridge"] * 9))
    order = ranking.order()
    assert sorted(order.tolist()) == list(range(20))
    assert ranking.worst(2) == [6, 1]  # 0 is worse than 1, and of the family of 6
    assert ranking.families[[0, 6, 7]].tolist() == [1, 1, 1]
    by_worst = ranking.families[ranking.order("fault")].tolist()
    assert [*dict.fromkeys(by_worst)] == [*range(1, 1 + len(set(by_worst)))]
    count = len(set(ranking.families[:15]))
    assert len(set(ranking.families[order[:count]])) == count  # other families come first
    assert set(order[15:].tolist()) == set(range(15, 20))
    assert ranking.order("fault").tolist()[:2] == [6, 7]
    assert six_elites()[0].order().tolist()[:3] == [2, 1, 4]  # the fault comes before other causes
    families = ranking.families[ranking.order("family")]
    assert families.tolist() == sorted(families) and families[0] == families[1] == 1
    for name in ("goal_rate", "collision_rate", "fallen_rate", "fitness"):
        values = getattr(ranking, name)[ranking.order(name)]
        assert np.all(np.diff(values if name == "goal_rate" else -values) >= 0.0) and name in ORDERS


def test_likely_faults_come_first_and_the_likeliest_is_named():
    space, known = get_space("super_gaussian+push"), judged_archive()
    pushes = CONDITIONS["push"].to_genes({"push_x": np.array([0.0, 2.0, 1.0, 0.5, 1.5])})
    genes = np.concatenate([known.genes[:, :64], pushes], axis=1).astype(np.float32)
    archive = replace(known, genes=genes, space=space.name)
    ranking = rank(archive, space, half_width=0.4, likely=choose_likely(space))
    assert replace(ranking, verdict=np.array([1, 1, 4, 4, 0])).order("likely").tolist() == [3, 2, 0, 1, 4]
    assert "likely" in ranking.orders and "likely" not in ranked(known).orders
    likeliest = judged_numbers(archive, space, choose_likely(space))["likeliest"]
    failing = np.flatnonzero(archive.failing)
    assert likeliest["failing"]["elite"] == failing[ranking.log_likelihood[failing].argmax()]
    assert likeliest["faults"]["log_likelihood"] == ranking.log_likelihood[archive.is_fault].max()
    assert "likeliest" not in judged_numbers(archive, space)


class Stripes(TerrainSpace):
    """Stripes across the way, by turns so high and so deep: the only gene times ``height`` [m]."""

    num_genes = 1

    def __init__(self, height=1.0):
        self.name, self.height = "stripes", height

    def rasterise(self, genes, spacing, heights_out):
        heights = np.full(heights_out.shape, self.height, np.float32) * genes.numpy()[:, :, None]
        heights[:, :, 1::2] *= -1.0
        heights_out.assign(heights)

    def hard_random(self, count, seed):
        return np.sign(self.uniform_random(count, seed))


class Plates(ShippedSpace):
    """Level ground as high as the only gene times the height of the space."""

    base_name, num_genes = "plates", 1

    def rasterise(self, genes, spacing, heights_out):
        heights_out.assign(np.ones(heights_out.shape, np.float32) * self.height * genes.numpy()[:, :, None])


@pytest.mark.parametrize("height", [0.25, 0.05])
def test_distinct_terrains_are_those_that_are_no_kin_of_a_distinct_one_before(height):
    space, genes = Plates(height=height), np.array([[0.0], [0.2], [0.4], [0.6]], np.float32)
    # Neighbours are 5 of 6 cm apart, others 10 and more; in a lower space both are a fifth.
    assert kin_distances(genes, space)[0] == pytest.approx([0.0, 5 / 6, 10 / 6, 15 / 6], rel=1e-5)
    assert find_families(genes, space).tolist() == [0, 0, 0, 0]
    assert pick_distinct(kin_distances(genes, space)).tolist() == [True, False, True, False]
    assert pick_distinct(kin_distances(genes[[1, 0, 2, 3]], space)).tolist() == [True, False, False, True]
    assert pick_distinct(kin_distances(genes[:0], space)).tolist() == []


def test_a_quarter_of_a_conditions_range_is_as_far_as_kin():
    space = get_space("super_gaussian+payload+motors")
    genes = np.zeros((4, space.num_genes), np.float32)
    genes[1:3, 64] = 0.25, 0.3  # payloads of .1 and .12, of a range from -.05 to .4
    genes[3, 67] = -0.5  # motors at .7, of a range from .4 to 1.2
    expected = [0.0, 0.1 / 0.1125, 0.12 / 0.1125, 0.3 / 0.2]
    assert kin_distances(genes, space)[0] == pytest.approx(expected, rel=1e-5)
    assert find_families(genes, space).tolist() == [0, 0, 0, 1]
    assert pick_distinct(kin_distances(genes, space)).sum() == 3
    genes[1] = np.append(SUPER_GAUSSIAN.hard_random(1, 0)[0], genes[1, 64:])
    heights = make_heights(genes[1:2, :64], every=2)
    assert kin_distances(genes, space)[0, 1] == pytest.approx(np.sqrt((heights**2).mean()) / KIN_M, rel=1e-5)


@pytest.mark.parametrize("height", [1.0, 0.01])
def test_a_space_without_a_height_is_scaled_by_its_random_terrains(height):
    # Stripes of a gene of 1 have the root mean square height of the space's random terrains; the paper's is .15 m.
    distances = kin_distances(np.array([[0.0], [1.0]], np.float32), Stripes(height))
    assert distances[0, 1] == pytest.approx(0.15 / 0.06, rel=0.05)
    assert kin_distances(np.ones((2, 1), np.float32), Stripes(0.0)).tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_distinct_elites_are_counted_where_somebody_knows():
    archive = replace(judged_archive(), genes=np.array([[0.0], [0.2], [0.4], [0.9], [-0.9]], np.float32))
    numbers = judged_numbers(archive, Plates())  # four fail, one is a fault
    assert (numbers["failing_distinct"], numbers["faults_distinct"], numbers["faults_panel"]) == (3, 1, 1)
    alone = replace(archive, **no_outcomes(5), certifiers=(), certifier_sha256=())
    numbers = judged_numbers(alone, Plates())
    assert (numbers["failing_distinct"], numbers["faults_distinct"]) == (3, None)
    assert judged_numbers(replace(alone, fresh=None), Plates())["failing_distinct"] is None


def test_kin_of_kin_are_of_one_family_and_families_are_numbered_as_they_come():
    strangers = np.clip(SUPER_GAUSSIAN.hard_random(4, 0), -1.0, 1.0).astype(np.float32)
    child, grandchild = strangers[1].copy(), strangers[1].copy()
    child[31], grandchild[31] = strangers[1, 31] - 0.5, strangers[1, 31] - 1.0  # the height of a bump
    genes = np.stack([*strangers, child, grandchild])
    first, second, third = make_heights(genes[[1, 4, 5]])
    near = [float(np.sqrt(((heights - others) ** 2).mean())) for heights, others in ((first, second), (second, third))]
    assert max(near) < KIN_M < np.sqrt(((first - third) ** 2).mean())
    assert find_families(genes[[0, 5, 1, 2, 4, 3]], SUPER_GAUSSIAN).tolist() == [0, 1, 1, 2, 1, 3]
    assert find_families(genes[:0], SUPER_GAUSSIAN).tolist() == []
