"""What crossings say of controllers on each terrain, the tables of it, and the sets of terrains that they are on."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from qd.evaluate.labels import FATES, SETS
from qd.evaluate.sets import (
    TRAINED_ON,
    generated_set,
    hash_elites,
    make_sets,
    nearest_distance,
    random_elites,
    read_independent,
    read_trained_on,
    set_rng,
    split_elites,
)
from qd.evaluate.tables import (
    as_tables,
    check_seeds,
    difference,
    kind_mean,
    make_tables,
    measure,
    over_seeds,
    read_tables,
    show_tables,
    summarise_crossings,
    valid_interval,
    valid_mean,
    velocity_error,
)
from qd.search.settings import as_settings
from results.make.common import t_interval
from sim.robots.robot import robot_identity
from sim.terrains.bank import make_heights
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import judged_archive, make_archive, make_measured, make_set, write_run
from tests.qd.searches import CFG
from tests.qd.stand_in import BAD, GOAL, HIT, LATE, OUT, result_of
from tests.train.conftest import write_actor, write_trained

HASHES = {"base": 64 * "f", "C-G": 64 * "a", "S": 64 * "b"}
ABOUT = {who: {"policy": f"{who}.pt", "sha256": digest} for who, digest in HASHES.items()}
SET = replace(make_set(5), numbers=np.array([10, 3, 7, 5, 8]))


@pytest.fixture(scope="module")
def report(anymal):
    """Two controllers on two sets of three terrains, four episodes each."""
    good = result_of([[GOAL] * 4, [GOAL] * 4, [GOAL, GOAL, HIT, HIT]], reward=[[20] * 4, [20] * 4, [20, 20, 2, 2]])
    poor = result_of([[GOAL] * 4, [GOAL, HIT, HIT, HIT], [LATE] * 4], reward=[[20] * 4, [20, 2, 2, 2], [8] * 4])
    none = result_of([[GOAL] * 4, [BAD] * 4, [LATE] * 4], reward=[[20] * 4, [0] * 4, [8] * 4])
    crossed = {"hand_crafted": {"base": good, "C-G": good}, "generated": {"base": poor, "C-G": none}}
    measured = {name: {who: measure(row[who], (1.0, 1.0)) for who in row} for name, row in crossed.items()}
    return tables_of(anymal, measured, {"generated": make_set(3, 100)})


@pytest.fixture(scope="module")
def certified(anymal):
    """Three controllers on four elites of a search against base, of which C-G certifies the first two."""
    archive = replace(judged_archive(), policy_sha256="f" * 64).rows(np.array([2, 2, 3, 3]))
    goals = {"base": [4, 1, 0, 0], "C-G": [4, 2, 0, 4], "S": [4, 4, 4, 4]}
    row = {who: make_measured(counts, of=4) for who, counts in goals.items()}
    elites = replace(make_set(4, 10), elites=replace(archive, family=np.arange(4)))
    return tables_of(anymal, {"generated": row, "hard_random": row}, {"generated": elites})


def tables_of(robot, measured, sets):
    """Tables of crossings on some sets; others are of hard-random terrains."""
    sets = {name: make_set(len(next(iter(row.values())).goals)) for name, row in measured.items()} | sets
    about = {who: ABOUT[who] for who in next(iter(measured.values()))}
    return make_tables(measured, sets, robot, controllers=about, episodes=4, seed=0)


def test_values_are_means_over_terrains(report):
    assert report["success"]["hand_crafted"] == {"base": pytest.approx(2.5 / 3), "C-G": pytest.approx(2.5 / 3)}
    assert report["success"]["generated"] == {"base": pytest.approx(2.25 / 3), "C-G": 1.0}  # two valid terrains
    assert report["goal"]["generated"] == {"base": pytest.approx(1.25 / 3), "C-G": 0.5}
    assert report["reward"]["generated"] == {"base": pytest.approx((20 + 6.5 + 8) / 3), "C-G": 14.0}
    assert report["penalties"]["generated"]["base"] == {"yaw_rate": 0.0, "vel_x": 0.0}
    assert report["terrains"] == {"hand_crafted": 3, "generated": 3}
    # Of goal rates 1, .25, 0 a resample of 3 is all 0 in 1 of 27 cases, and all 1 in another: more than 2.5 %.
    assert report["intervals"]["goal"]["generated"]["base"] == [0.0, 1.0]


def test_intervals_over_elites_are_over_families_of_kin(anymal):
    measured = {"generated": dict.fromkeys(("base", "C-G"), make_measured([4] * 32 + [0] * 8, of=4))}
    family = np.array([0] * 16 + [1] * 16 + [2] * 4 + [3] * 4)
    kin = replace(make_set(40), elites=replace(make_archive(40), family=family))
    by_terrains, by_families = (tables_of(anymal, measured, sets) for sets in ({}, {"generated": kin}))
    # Of four families 1 of 16 resamples has nothing but the two that fail; of 40 terrains hardly any has 20 that do.
    assert by_families["intervals"]["goal"]["generated"]["base"][0] == 0.0
    assert by_terrains["intervals"]["goal"]["generated"]["base"][0] >= 0.5


def test_certified_terrains_stand_apart_with_who_certifies_them(certified):
    assert certified["certified_goal"] == {"generated": {"base": 0.625, "C-G": 0.75, "S": 1.0}}
    assert certified["certified_success"]["generated"] == {"base": 0.625, "C-G": 1.0, "S": 1.0}
    assert certified["intervals"]["certified_goal"]["generated"]["C-G"] == [pytest.approx(0.198, abs=1e-3), 1.0]
    # S certifies none of these terrains: its rate is not biased by that.
    chosen_by = {"base": "searched", "C-G": "certifier"}
    about = {"terrains": 2, "certifiers": {"C-G": 2, "S": 0}, "chosen_by": chosen_by}
    assert certified["certified"] == {"generated": about}
    pairs = {pair: about["mended"]["terrains"] for pair, about in certified["differences"]["generated"].items()}
    assert pairs == {"base -> C-G": [11, 13], "base -> S": [11, 12, 13], "C-G -> S": [12]}


def test_a_terrain_is_failed_below_half():
    # Goal rates                before: 0    .45  .5   .95  1
    #                           after:  1    .5   .45  .95  .1
    before, after = make_measured([0, 9, 10, 19, 20]), make_measured([20, 10, 9, 19, 2])
    changes = difference(before, after, SET, 0)
    assert [changes[fate].get("terrains") for fate in FATES] == [[3, 10], [], [7, 8], None]
    assert [changes[fate]["count"] for fate in FATES] == [2, 0, 2, 1] and changes["compared"] == 5
    # .45 to .5 may be chance: the Wilson intervals are (.26, .66) and (.30, .70). 0 to 1 and 1 to .1 are not.
    assert (changes["mended"]["clear"], changes["newly_broken"]["clear"]) == (1, 1)
    both = difference(make_measured([0, 9]), make_measured([9, 0]), SET.rows(np.arange(2)), 0)
    assert both["still_failing"]["terrains"] == [3, 10]


def test_gains_are_means_of_differences_terrain_by_terrain():
    # Goal rates differ by +.5 on every terrain: no spread, however hard the terrains are.
    before, after = make_measured([0, 5, 10] * 4, reward=8.0), make_measured([10, 15, 20] * 4, reward=9.5)
    gain = difference(before, after, make_set(12), 0)["gain"]
    for name, value in (("goal", 0.5), ("reward", 1.5)):
        assert gain[name] == {"mean": pytest.approx(value), "interval": pytest.approx([value, value])}


def test_a_terrain_invalid_to_one_is_not_compared():
    before, after = make_measured([0, 20, 0], bad=[0]), make_measured([20, 20, 20], bad=[2])
    changes = difference(before, after, SET.rows(np.arange(3)), 0)
    assert changes["compared"] == 1 and [changes[fate]["count"] for fate in FATES] == [0, 0, 0, 1]
    nothing = difference(make_measured([0], bad=[0]), make_measured([20]), SET.rows(np.arange(1)), 0)
    assert nothing["compared"] == 0 and nothing["gain"]["goal"]["mean"] is None


def test_mean_and_interval_of_a_kind_with_several():
    goals = {"base": 10, "C-G": 16, "C-G@1": 18, "C-G@2": 20, "C-HC@7": 8}
    row = {who: make_measured([count] * 12, reward=count / 2) for who, count in goals.items()}
    bad = {**row, "C-G@1": make_measured([0] * 12, bad=range(12))}
    summaries = over_seeds({"near": row, "far": bad}, {"near": make_set(12), "far": make_set(12)}, 0)
    assert summaries["goal"]["near"].keys() == {"C-G"}
    kind = summaries["goal"]["near"]["C-G"]
    assert kind["mean"] == pytest.approx(0.9) and kind["values"] == pytest.approx([0.8, 0.9, 1.0])
    # Terrains do not differ. Standard deviation .1, so .1 / sqrt(3) * 4.303 either way; a rate is at most 1.
    assert kind["interval"] == pytest.approx([0.9 - 0.2484, 1.0], abs=1e-4)
    assert summaries["reward"]["near"]["C-G"]["interval"] == pytest.approx([9.0 - 2.484, 9.0 + 2.484], abs=1e-3)
    assert summaries["goal"]["far"]["C-G"] == {
        "mean": None, "interval": None, "values": [pytest.approx(0.8), None, 1.0],
    }  # fmt: skip


def test_certified_terrains_have_intervals_over_families_and_trainings(anymal):
    archive = replace(judged_archive(), policy_sha256="f" * 64).rows(np.array([2, 2, 3, 3] * 6))
    row = {who: make_measured(counts * 6, of=4) for who, counts in {"C-G": [4, 0, 0, 4], "C-G@1": [4, 1, 0, 4]}.items()}
    elites = replace(make_set(24, 10), elites=replace(archive, family=np.arange(24)))
    summaries = over_seeds({"generated": row}, {"generated": elites}, 0)
    low, high = summaries["certified_goal"]["generated"]["C-G"]["interval"]
    assert archive.certified.sum() == 12 and low < 0.35 and high > 0.78  # twelve terrains, half of them crossed
    assert np.ptp(summaries["certified_goal"]["generated"]["C-G"]["values"]) == pytest.approx(0.125)


def test_one_training_is_not_several(tmp_path):
    a, b, c = (str(tmp_path / name) for name in ("a.pt", "b.pt", "c.pt"))
    for path, content in ((a, "1"), (b, "1"), (c, "2")):
        (tmp_path / path).write_text(content)
    check_seeds({"base": a, "C-G": c, "C-G@1": b})  # of different kinds, the same may stand twice
    bad = ({"C-G": a, "C-G@1": c, "C-G@2": b}, {"C-G@1": "no.such:code", "C-G@2": "no.such:code"}, {"C-G@1@2": a})
    for controllers in bad:
        with pytest.raises(ValueError, match="@2"):
            check_seeds(controllers)


def test_tables_are_read_as_they_were_written(certified, report, anymal, tmp_path):
    assert as_tables(json.loads(json.dumps(certified))) == certified
    file = tmp_path / "tables.json"
    file.write_text(json.dumps({**report, **robot_identity(anymal)}))
    assert read_tables(file, anymal)["goal"] == report["goal"]
    file.write_text(json.dumps({**report, "robot": "cassie"}))
    for bad, error in ((file, ValueError), (tmp_path / "none.json", FileNotFoundError)):
        with pytest.raises(error, match=bad.name):
            read_tables(bad, anymal)
    wrong = report | {"certified_goal": {"generated": {"base": 1.0}}}
    lacking = {key: value for key, value in report.items() if key != "differences"}
    for tables, field in ((wrong, "certified_goal"), (lacking, "differences")):
        with pytest.raises(ValueError, match=field):
            as_tables(tables)


def test_the_terminal_shows_the_numbers(report, capsys):
    show_tables(report)
    lines = capsys.readouterr().out.splitlines()
    assert "0.833 (" in next(line for line in lines if line.startswith("C-G"))
    # C-G fails terrain 102, as base does; terrain 101 is not compared.
    (row,) = (line.split() for line in lines if line.startswith("generated, base -> C-G"))
    assert row[4:] == ["0", "(0)", "0", "(0)", "1", "2", "+0.000", "(-0.658", "to", "+0.658)"]


def test_everything_is_a_mean_over_valid_episodes():
    # One of four is invalid: the terrain counts without it. Two of four: it does not count.
    result = result_of(
        [[GOAL, OUT, HIT, BAD], [GOAL, GOAL, BAD, BAD]],
        fallen=[[0, 0, 1, 1], [0] * 4],
        reward=[[20.0, 22.0, 3.0, 99.0], [20.0] * 4],
        vel_x=[[1.0, 2.0, 6.0, 99.0], [1.0] * 4],
    )
    measured = measure(result, (1.0, 2.0))
    for name, expected in {"success": 2 / 3, "goal": 1 / 3, "fallen": 1 / 3, "reward": 15.0}.items():
        assert measured.values[name] == pytest.approx([expected, np.nan], nan_ok=True), name
    assert measured.penalties["vel_x"] == pytest.approx([1.5, np.nan], nan_ok=True)  # (1 + 2 + 6) / 3 by the scale of 2
    assert measured.episodes.tolist() == [3, 0] and measured.goals.tolist() == [1, 0]
    summary = summarise_crossings(result, 0)
    assert summary["success_rate"] == pytest.approx(2 / 3)
    assert (summary["terrains"], summary["invalid_terrains"], summary["outcomes"]["invalid"]) == (2, 1, 3)
    with pytest.raises(ValueError, match="reward"):
        measure(result_of([[GOAL]]), (1.0, 1.0))


def test_means_and_intervals_leave_invalid_terrains_out():
    values = np.array([1.0, 0.0, np.nan, 1.0, 1.0])
    assert valid_mean(values) == 0.75 and valid_mean(np.array([np.nan])) is None
    low, high = valid_interval(values, 0, None, None)
    assert 0.0 <= low < 0.75 < high == 1.0
    # Two families: all ones, and the single zero. A quarter of the resamples has the second alone.
    assert valid_interval(values, 0, np.array([0, 1, 2, 0, 0]), None) == [0.0, 1.0]
    assert valid_interval(values, 0, np.zeros(5, np.int64), None) is None  # one family says nothing of its spread


def test_means_of_kinds_hold_families_and_trainings():
    # Two families of two terrains: the first kind crosses all of one and half of the other, the second none.
    first, families = np.array([[1.0, 1.0, 0.5, 0.5]]), np.array([7, 7, 9, 9])
    row = kind_mean([first, np.zeros((2, 4))], families, 0)
    assert row["mean"] == pytest.approx(0.75) and row["seeds"] == [1, 2]
    # So few families could have been others: Wilson's interval of 1.5 of 2 is (.20, .97), of 0 of 2 (0, .66).
    assert row["interval"] == pytest.approx([0.75 - np.hypot(0.75 - 0.198, 0.658), 1.0], abs=2e-3)
    # A terrain that is invalid for one controller counts for none.
    first[0, 0] = np.nan
    assert kind_mean([first, np.zeros((2, 4))], families, 0)["mean"] == pytest.approx(2 / 3)
    assert kind_mean([np.full((1, 4), np.nan)], families, 0) is None
    # Families do not differ here: what is left is Student's interval over two trainings.
    alike = np.array([[0.52], [0.5]]).repeat(24, axis=1)
    assert kind_mean([alike], np.arange(24) // 2, 0)["interval"] == pytest.approx(t_interval(alike[:, 0]))


def test_intervals_of_kinds_cover_the_truth():
    """Of 19 in 20 repetitions, with trainings that differ as they do and families that differ more."""
    rng, families, covered = np.random.default_rng(0), np.arange(60) // 2, 0
    for _ in range(200):
        terrains = rng.normal(0.0, 0.2, 30)[families]
        kinds = [0.5 + terrains * weight + rng.normal(0.0, 0.03, (3, 1)) for weight in (1.0, 0.7)]
        low, high = kind_mean(kinds, families, 0)["interval"]
        covered += low <= 0.0 <= high
    assert 182 <= covered <= 199


def test_groups():
    result = result_of([[GOAL], [HIT], [GOAL], [LATE]])
    summary = summarise_crossings(result, 0, types=np.array([0, 0, 4, 4]), levels=np.array([1, 9, 9, 9]))
    assert summary["by_type"]["slope"] == {"terrains": 2, "success_rate": 0.5, "goal_rate": 0.5, "fallen_rate": 0.0}
    assert summary["by_type"]["boxes"]["success_rate"] == 1.0
    assert summary["by_level"]["9"]["goal_rate"] == pytest.approx(1 / 3)
    json.dumps(summary, allow_nan=False)


def test_velocity_error_is_a_mean_over_time():
    # .9 (m/s)^2 s over 10 s counted is (.3 m/s)^2; .24 over 6 s is .2^2; a fall before 2 s and an invalid one do not
    # count.
    outcomes, duration_s = [[GOAL, GOAL], [HIT, BAD]], [[12.0, 8.0], [1.5, 12.0]]
    error = velocity_error(result_of(outcomes, duration_s=duration_s, vel_x=[[0.9, 0.24], [0.0, 9.0]]), 0)
    assert error["vx_error_mean"] == pytest.approx((0.3 + 0.2) / 2) and error["episodes"] == 2
    assert error["goal_rate"] == pytest.approx(2 / 3)


GENES = make_archive(20).genes


@pytest.mark.parametrize(
    ("robot", "elites", "train", "validation", "test"),
    [
        ("anymal", 1129, 750, 75, 300),  # the paper's; 79 are left over, of which 75 are for validation
        ("cassie", 930, 675, 75, 180),  # none is left over: training has so many fewer
        ("anymal", 1049, 755, 84, 210),  # one too few: 80 % and 20 %
        ("anymal", 5, 3, 1, 1),
    ],
)
def test_sizes_of_the_parts(robot, elites, train, validation, test):
    split = split_elites(make_archive(elites, robot=robot))
    assert (len(split.train), len(split.validation), len(split.test)) == (train, validation, test)
    together = np.concatenate([split.train, split.validation, split.test])
    assert len(np.unique(together)) == len(together) and together.min() >= 0 and together.max() < elites


def test_a_split_follows_from_the_elites_alone():
    archive = make_archive(60)
    split = split_elites(archive)
    assert split.test.tolist() == [10, 38, 31, 54, 32, 52, 26, 40, 55, 6, 47, 45]  # whatever machine, today and later
    assert split.train[:5].tolist() == [59, 48, 1, 16, 50]
    # The same elites in another order, as after judging them again: the same ones are held out, in the same order.
    order = np.random.default_rng(0).permutation(60)
    shuffled = split_elites(archive.rows(order))
    for part in ("train", "validation", "test"):
        np.testing.assert_array_equal(order[getattr(shuffled, part)], getattr(split, part))
    with pytest.raises(ValueError, match="got 4"):
        split_elites(make_archive(4))


def test_sets_have_random_numbers_of_their_own():
    names = ("hand_crafted", "hard_random", "flat", "generated", "generated_independent", "pack", "dose")
    draws = [set_rng(*way).integers(2**63) for way in itertools.product(names, (0, 1), ("test", "validation"))]
    draws += [np.random.default_rng(seed).integers(2**63) for seed in range(3)]
    assert len(set(draws)) == 31


def test_sets_are_what_they_were():
    hand_crafted, hard_random = make_sets(["hand_crafted", "hard_random"], 3, 0).values()
    assert hand_crafted.terrains.seeds.tolist() == [1984838927, 1048230665, 2803271684]
    assert hard_random.terrains.seeds.tolist() == [2055184588, 2981959608, 3748095775]
    assert hard_random.terrains.values[0, :4].tolist() == pytest.approx([0.2931203, 0.7102386, 0.6253537, -0.7938088])
    archive = make_archive(60)
    generated = generated_set(archive, 2, 0)
    assert generated.numbers.tolist() == [10, 38] and generated.terrains.seeds.tolist() == [1519996775, 4170185451]
    independent = random_elites("generated_independent", archive, 2, 0)
    assert independent.numbers.tolist() == [48, 42] and independent.terrains.seeds.tolist() == [2023635066, 1145927465]


def test_a_set_is_the_same_whenever_it_is_made():
    given = {"archive": make_archive(20), "independent": make_archive(20, seed=1)}
    all_at_once, other = make_sets((), 4, 0, **given), make_sets((), 4, 1, **given)
    assert list(all_at_once) == list(SETS)
    for name in SETS:
        alone = make_sets([name], 4, 0, **given)[name]
        terrains, others = all_at_once[name].terrains, other[name].terrains
        assert alone.terrains.digests() == terrains.digests()
        np.testing.assert_array_equal(alone.numbers, all_at_once[name].numbers)
        assert (others.seeds != terrains.seeds).all()
        # Which elites are held out does not depend on the seed of the sets.
        held_out = name in ("generated", "generated_far")
        assert np.array_equal(others.values, terrains.values) == held_out
    for names, field in ((["easy"], "easy"), (["flat"], "flat"), (["generated"], "generated")):  # flat: of base.json
        with pytest.raises(ValueError, match=field):
            make_sets(names, 6, 0)


def test_generated_terrains_are_those_held_out_with_the_families_of_their_kin():
    archive = make_archive(10)
    many = generated_set(archive, 300, 0)
    assert many.numbers.tolist() == split_elites(archive).test.tolist() and many.families.tolist() == [0, 1]
    np.testing.assert_array_equal(many.terrains.genes, archive.genes[many.numbers])
    alike = replace(archive, genes=np.repeat(archive.genes[:2], 5, axis=0))
    assert np.unique(random_elites("elites", alike, 9, 0).families).tolist() == [0, 1]
    # Elites that somebody was trained on are left out.
    left = random_elites("elites", archive, 9, 0, {*hash_elites(archive.genes[:7])})
    assert sorted(left.numbers) == [7, 8, 9]


def test_elites_carry_the_certificates_of_their_rows():
    archive = judged_archive().rows(np.array([2, 2, 3, 3] * 6))
    generated = generated_set(archive, 300, 0)
    certified = archive.certified[generated.numbers]
    assert generated.certified.tolist() == certified.tolist() and len(set(certified)) == 2
    np.testing.assert_array_equal(generated.rows(np.array([1, 3])).certified, certified[[1, 3]])
    assert generated_set(make_archive(30), 300, 0).certified is None


@pytest.mark.slow
def test_the_far_third_is_the_farthest():
    training = SUPER_GAUSSIAN.hard_random(60, 0)  # more than are compared at once
    genes = SUPER_GAUSSIAN.hard_random(4, 1)
    genes[2] = training[58]  # trained on: distance 0
    distance = nearest_distance(genes, training)
    maps, others = (make_heights(some, SUPER_GAUSSIAN).astype(np.float64) for some in (genes, training))
    by_hand = [min(np.sqrt(((terrain - other) ** 2).mean()) for other in others) for terrain in maps]
    np.testing.assert_allclose(distance, by_hand, atol=1e-6)
    # Of seven that are held out, the farthest three, with the same episodes.
    archive = make_archive(35)
    whole, far = make_sets(("generated", "generated_far"), 300, 0, archive=archive).values()
    distance = nearest_distance(whole.terrains.genes, archive.genes[split_elites(archive).train])
    chosen = np.sort(np.argsort(distance)[-3:])
    assert far.numbers.tolist() == whole.numbers[chosen].tolist()
    assert far.terrains.digests() == whole.terrains[chosen].digests()


def test_an_independent_archive_is_of_another_search(tmp_path, anymal):
    archive, kin, first = make_archive(20), make_archive(20, seed=4), as_settings(replace(CFG, seed=0))
    kin.genes[3] = archive.genes[5]
    trained = write_run(tmp_path / "trained", archive, first)
    other = write_run(tmp_path / "other", make_archive(20, seed=1), as_settings(CFG))
    for path, archive_path in ((other, trained), (other / "archive.npz", trained), (trained, None)):
        assert len(read_independent(path, archive_path, anymal)) == 20
    course = replace(make_archive(9), space="course", genes=COURSE.hard_random(9, 0))
    for path, field in (
        (write_run(tmp_path / "kin", kin, as_settings(CFG)), "1 elites in both"),
        (write_run(tmp_path / "same-seed", make_archive(20, seed=2), first), "seed 0"),
        (write_run(tmp_path / "cassie", make_archive(9, robot="cassie")), "cassie"),
        (write_run(tmp_path / "empty", make_archive(0)), "empty"),
        (write_run(tmp_path / "course", course), "course"),
    ):
        with pytest.raises(ValueError, match=field):
            read_independent(path, trained, anymal)


def test_the_records_of_all_files_of_a_controller_are_read(tmp_path):
    path = write_trained(tmp_path, GENES[:3])
    marks = hash_elites(GENES[:3])
    assert len(set(marks)) == 3 and hash_elites(GENES[2::-1].astype(np.float64)) == marks[::-1]
    for policy in (str(path), str(tmp_path / "tuned.onnx"), f"some.module:adapter@{path}"):
        assert read_trained_on(policy) == set(marks)
    assert read_trained_on("some.module:walk") == set() == read_trained_on(str(tmp_path / "other.pt"))
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: 5}))
    with pytest.raises(ValueError, match=TRAINED_ON):
        read_trained_on(str(path))


def test_marks_in_the_file_itself_count_where_no_record_lies_beside_it(tmp_path):
    path = write_actor(tmp_path / "policy.pt")
    torch.save(torch.load(path, weights_only=True) | {TRAINED_ON: hash_elites(GENES)}, path)
    assert read_trained_on(str(path)) == read_trained_on(f"some.module:adapter@{path}") == set(hash_elites(GENES))
