"""The tables: their numbers, what nobody crosses, and how they are shown."""

import json
from dataclasses import replace

import numpy as np
import pytest

from qd.evaluate.measures import measure
from qd.evaluate.publish import published
from qd.evaluate.sets import Certificates, plain_set
from qd.evaluate.show import draw_tables, picture_of, print_tables
from qd.evaluate.tables import KINDS, check_seeds, difference, differences, make_tables, over_seeds, split_by_goal
from sim.policy.spec import firsts
from tests.train.results import BAD, GOAL, HIT, LATE, result_of

SEED = 0


def a_set(name, count, first=0):
    return replace(plain_set("hard_random", count, 0), name=name, numbers=np.arange(first, first + count))


@pytest.fixture(scope="module")
def report(anymal):
    """Two controllers on two sets of three terrains, four episodes each."""
    good = result_of([[GOAL] * 4, [GOAL] * 4, [GOAL, GOAL, HIT, HIT]], reward=[[20] * 4, [20] * 4, [20, 20, 2, 2]])
    poor = result_of([[GOAL] * 4, [GOAL, HIT, HIT, HIT], [LATE] * 4], reward=[[20] * 4, [20, 2, 2, 2], [8] * 4])
    none = result_of([[GOAL] * 4, [BAD] * 4, [LATE] * 4], reward=[[20] * 4, [0] * 4, [8] * 4])
    crossed = {
        "hand_crafted": {"base": good, "C-G": good},
        "generated": {"base": poor, "C-G": none},
    }
    measured = {name: {who: measure(one, (1.0, 1.0)) for who, one in row.items()} for name, row in crossed.items()}
    sets = {"hand_crafted": a_set("hand_crafted", 3), "generated": a_set("generated", 3, 100)}
    about = {"robot": "anymal", "episodes": 4, "controllers": {"base": {}, "C-G": {}}}
    return {**about, **make_tables(measured, sets, anymal, SEED)}


def test_values_are_means_over_terrains(report):
    assert report["success"]["hand_crafted"] == {"base": pytest.approx(2.5 / 3), "C-G": pytest.approx(2.5 / 3)}
    assert report["success"]["generated"] == {"base": pytest.approx(2.25 / 3), "C-G": 1.0}  # two valid terrains
    assert report["goal"]["generated"] == {"base": pytest.approx(1.25 / 3), "C-G": 0.5}
    assert report["reward"]["generated"] == {"base": pytest.approx((20 + 6.5 + 8) / 3), "C-G": 14.0}
    assert report["fallen"]["generated"]["base"] == 0.0
    assert report["penalties"]["generated"]["base"] == {"yaw_rate": 0.0, "vel_x": 0.0}
    assert report["invalid_terrains"]["generated"] == {"base": 0, "C-G": 1}
    assert report["outcomes"]["generated"]["C-G"]["invalid"] == 4
    assert report["terrains"] == {"hand_crafted": 3, "generated": 3}
    assert report["reward_weights"]["tracking_lin_vel"] == 1.0 and report["reward_weights"]["only_positive"] is True
    json.dumps(report, allow_nan=False)


def test_intervals_over_elites_are_over_families_of_kin(anymal):
    many = result_of([[GOAL] * 4] * 8 + [[LATE] * 4] * 2, reward=[[1.0] * 4] * 10)
    measured = {"generated": {"base": measure(many, (1.0, 1.0)), "C-G": measure(many, (1.0, 1.0))}}
    alone = a_set("generated", 10)
    kin = replace(alone, families=np.array([0] * 4 + [1] * 4 + [2, 3]))
    of_terrains, of_kin = (make_tables(measured, {"generated": chosen}, anymal, SEED) for chosen in (alone, kin))
    assert of_kin["goal"] == of_terrains["goal"] == {"generated": {"base": 0.8, "C-G": 0.8}}
    # Of four families 1 of 16 resamples has nothing but the two that fail; of ten terrains hardly any has 6 that do.
    assert of_kin["intervals"]["goal"]["generated"]["base"][0] == 0.0
    assert of_terrains["intervals"]["goal"]["generated"]["base"][0] >= 0.5
    fates = of_kin["differences"]["generated"]["base -> C-G"]
    assert fates["fine"]["interval"][0] == 0.0 and fates["gain"]["goal"]["interval"] == [0.0, 0.0]


@pytest.fixture
def certified(anymal):
    """Three controllers on four elites of a search against base, of which C-G certifies the first two."""
    given = Certificates(
        certifiers=("C-G", "S"), sha256=("a", "b"), given=np.array([[1, 0], [1, 0], [0, 0], [0, 0]], bool),
        searched_sha256="f",
    )  # fmt: skip
    rows = {"base": [4, 0, 0, 0], "C-G": [4, 2, 0, 4], "S": [4, 4, 4, 4]}
    row = {
        who: measure(result_of([[GOAL] * k + [HIT] * (4 - k) for k in goals], reward=np.ones((4, 4))), (1.0, 1.0))
        for who, goals in rows.items()
    }
    sets = {
        "generated": replace(a_set("generated", 4, 10), certificates=given, families=np.arange(4)),
        "hard_random": a_set("hard_random", 4),
    }
    hashes = {"base": "f", "C-G": "a", "S": "b"}
    about = {"robot": "anymal", "episodes": 4, "controllers": {who: {} for who in rows}}
    return {**about, **make_tables(dict.fromkeys(sets, row), sets, anymal, SEED, hashes=hashes)}


def test_certified_terrains_stand_apart_with_who_certifies_them(certified):
    assert certified["certified_goal"] == {"generated": {"base": 0.5, "C-G": 0.75, "S": 1.0}}
    assert certified["certified_success"]["generated"]["base"] == 0.5
    assert certified["intervals"]["certified_goal"]["generated"]["C-G"] == [0.5, 1.0]
    # S certifies none of these terrains: its rate is not biased by that.
    assert certified["certified"] == {
        "generated": {
            "terrains": 2, "certifiers": {"C-G": 2, "S": 0}, "chosen_by": {"base": "searched", "C-G": "certifier"},
        }
    }  # fmt: skip
    json.dumps(certified, allow_nan=False)


def test_certified_terrains_are_shown_with_whose_rates_are_biased(certified, capsys):
    print_tables(certified)
    said = capsys.readouterr().out
    assert "generated: certified 2 of 4 terrains, which the search's controller fails and another one cross" in said
    assert "crosses (C-G 2, S 0)" in said and "C-G (certifier)" in said and "base (searched)" in said
    assert "searched: downward, since it failed them all; certifier: upward, since it crossed some of them" in said
    *_, axes = draw_tables(certified).axes
    assert "certified terrains" in axes.get_ylabel()
    assert axes.get_xlabel().endswith("base (searched) is too low, C-G (certifier) is too high")
    assert [label.get_text() for label in axes.get_xticklabels()] == ["generated,\nheld out\n(2 certified)"]


def test_seeds_of_a_kind_have_a_mean_on_certified_terrains_too(certified):
    tables = {"certified_goal": {"generated": {"C-G@0": 0.9, "C-G@1": 1.0}}}
    kind = over_seeds(tables, tables)["certified_goal"]["generated"]["C-G"]
    assert kind["mean"] == pytest.approx(0.95) and kind["interval"][1] == 1.0  # a rate


def test_where_no_certifier_was_asked_nothing_is_certified(report, capsys):
    assert report["certified"] == report["certified_goal"] == {}
    print_tables(report)
    assert "certified" not in capsys.readouterr().out


def test_intervals_stand_where_values_do(report):
    for name in ("success", "goal", "fallen", "reward"):
        for chosen, row in report[name].items():
            for who, value in row.items():
                low, high = report["intervals"][name][chosen][who]
                assert low <= value <= high
    # Of goal rates 1, .25, 0 a resample of 3 is all 0 in 1 of 27 cases, and all 1 likewise: more than 2.5 %.
    assert report["intervals"]["goal"]["generated"]["base"] == [0.0, 1.0]
    assert report["intervals"]["penalties"]["generated"]["C-G"]["vel_x"] == [0.0, 0.0]


def test_generated_terrains_are_marked_by_whether_anybody_crossed_them(report):
    groups = report["traversable"]["generated"]
    assert "hand_crafted" not in report["traversable"]
    assert groups["crossed"]["terrains"] == [100, 101] and groups["never_crossed"]["terrains"] == [102]
    assert groups["crossed"]["share"] == pytest.approx(2 / 3)
    assert groups["crossed"]["goal"] == {"base": pytest.approx(1.25 / 2), "C-G": 1.0}
    assert groups["never_crossed"]["reward"] == {"base": 8.0, "C-G": 8.0}
    assert groups["never_crossed"]["intervals"]["success"]["base"] is None  # of one terrain


def test_a_terrain_invalid_to_all_is_in_neither_group():
    result = result_of([[BAD] * 4, [LATE, GOAL, LATE, LATE]], reward=[[1] * 4] * 2)
    groups = split_by_goal({"a": measure(result, (1.0, 1.0)), "b": measure(result, (1.0, 1.0))}, np.arange(2), 0)
    assert (groups["crossed"]["terrains"], groups["never_crossed"]["terrains"]) == ([1], [])
    assert groups["crossed"]["share"] == 1.0 and groups["never_crossed"]["goal"] == {"a": None, "b": None}


def test_the_papers_numbers():
    assert published("mine") is None
    anymal, cassie = published("anymal"), published("cassie")
    assert anymal["success"]["generated"] == {"C-HC": 0.598, "C-HR": 0.876, "C-G": 0.914}
    assert anymal["reward"]["hard_random"]["C-HR"] == 24.9
    assert cassie["success"]["hard_random"]["C-G"] == 0.99
    assert cassie["reward"]["hand_crafted"] == {"C-HC": 32.7, "C-HR": 29.7, "C-G": 32.9}


def test_the_terminal_shows_everything(report, capsys):
    print_tables(report)
    said = capsys.readouterr().out
    row = next(line for line in said.splitlines() if line.startswith("C-G"))
    assert "0.833 (" in row and row.endswith("0.980, 25.4")  # ours, and the paper's
    assert "generated: 2 terrains that some controller crossed" in said
    # C-G fails terrain 102, as base does; terrain 101 is not compared.
    assert "base -> C-G: 0 mended (0), 1 still failing, 0 newly broken (0) of 2; goal rate +0.000" in said
    assert "C-G on generated: 4 of 12 episodes are invalid (33.3%) and left out; counted as failures, goal" in said


def test_the_figure_shows_the_tables(report):
    figure = draw_tables(report)
    goal, success, reward, changes = figure.axes
    assert "%" in success.get_ylabel() and "%" in goal.get_ylabel() and "20 s" in reward.get_ylabel()
    assert "compared with base" in changes.get_xlabel()
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["base", "C-G", "of that name in the paper"]
    points = next(line for line in reward.lines if line.get_marker() == "s")
    np.testing.assert_allclose(points.get_ydata(), [report["reward"][name]["C-G"] for name in report["reward"]])
    diamonds = next(line for line in success.lines if line.get_marker() == "D")
    np.testing.assert_allclose(diamonds.get_ydata(), [98.0, 91.4])
    assert len({points.get_color() for points in reward.lines}) >= 2
    assert picture_of(report).startswith(b"\x89PNG")


def test_one_controller_alone_can_be_shown(report, anymal, capsys):
    good = {"base": measure(result_of([[GOAL] * 4], reward=[[20] * 4]), (1.0, 1.0))}
    alone = make_tables({"hard_random": good}, {"hard_random": a_set("hard_random", 1)}, anymal, SEED)
    alone = {"robot": "mine", "episodes": 4, "controllers": {"base": {}}, **alone, "paper": None}
    assert alone["differences"] == {"hard_random": {}} and alone["traversable"] == {}
    print_tables(alone)
    assert "mended" not in capsys.readouterr().out
    assert len(draw_tables(alone).axes) == 3


def test_a_set_of_which_nothing_is_valid_can_be_shown(anymal, capsys):
    bad = measure(result_of([[BAD] * 4, [BAD] * 4], reward=[[0] * 4] * 2), (1.0, 1.0))
    row = {"base": bad, "C-G": bad}
    report = make_tables({"generated": row}, {"generated": a_set("generated", 2)}, anymal, SEED)
    report = {"robot": "anymal", "episodes": 4, "controllers": row, **report}
    assert report["success"]["generated"]["base"] is None and report["intervals"]["reward"]["generated"]["base"] is None
    print_tables(report)
    assert "0 terrains that some controller crossed" in capsys.readouterr().out
    draw_tables(report).canvas.draw()


NUMBERS = np.array([10, 3, 7, 5, 8])


def measured(goals, *, of=20, reward=10.0, bad=()):
    """A controller that reached the goal in so many of ``of`` episodes of each terrain; ``bad`` ones are invalid."""
    rows = [[GOAL] * k + [HIT if k % 2 else LATE] * (of - k) for k in goals]
    for terrain in bad:
        rows[terrain] = [BAD] * of
    return measure(result_of(rows, reward=np.full((len(goals), of), reward)), (1.0, 1.0))


def test_a_terrain_is_failed_below_half():
    # Goal rates     before: 0    .45  .5   .95  1
    #                after:  1    .5   .45  .95  .1
    before, after = measured([0, 9, 10, 19, 20]), measured([20, 10, 9, 19, 2])
    found = difference(before, after, NUMBERS, 0)
    assert found["compared"] == 5
    assert {kind: found[kind].get("terrains") for kind in KINDS} == {
        "mended": [3, 10], "still_failing": [], "newly_broken": [7, 8], "fine": None,
    }  # fmt: skip
    assert [found[kind]["count"] for kind in KINDS] == [2, 0, 2, 1]
    assert [found[kind]["share"] for kind in KINDS] == [0.4, 0.0, 0.4, 0.2]
    # .45 to .5 may be chance: the Wilson intervals are (.26, .66) and (.30, .70). 0 to 1 and 1 to .1 are not.
    assert (found["mended"]["clear"], found["newly_broken"]["clear"]) == (1, 1)
    low, high = found["mended"]["interval"]
    assert 0.0 <= low < 0.4 < high <= 1.0
    assert found["still_failing"]["interval"] == [0.0, 0.0]


def test_both_failing_is_still_failing():
    found = difference(measured([0, 9]), measured([9, 0]), NUMBERS[:2], 0)
    assert found["still_failing"]["terrains"] == [3, 10] and found["still_failing"]["share"] == 1.0


def test_gains_are_means_of_differences_terrain_by_terrain():
    # Goal rates differ by +.5 on every terrain: no spread, however hard the terrains are.
    found = difference(measured([0, 5, 10], reward=8.0), measured([10, 15, 20], reward=9.5), NUMBERS[:3], 0)
    assert found["gain"]["goal"]["mean"] == pytest.approx(0.5)
    assert found["gain"]["goal"]["interval"] == pytest.approx([0.5, 0.5])
    assert found["gain"]["reward"] == {"mean": pytest.approx(1.5), "interval": pytest.approx([1.5, 1.5])}


def test_a_terrain_invalid_to_one_is_not_compared():
    found = difference(measured([0, 20, 0], bad=[0]), measured([20, 20, 20], bad=[2]), NUMBERS[:3], 0)
    assert found["compared"] == 1
    assert [found[kind]["count"] for kind in KINDS] == [0, 0, 0, 1]
    nothing = difference(measured([0], bad=[0]), measured([20]), NUMBERS[:1], 0)
    assert nothing["compared"] == 0 and nothing["mended"]["share"] is None and nothing["gain"]["goal"]["mean"] is None
    json.dumps([found, nothing], allow_nan=False)


def test_every_two_controllers_are_compared_once():
    crossed = {"base": measured([0, 0]), "C-HC": measured([20, 0]), "C-G": measured([20, 20])}
    found = differences(crossed, NUMBERS[:2], 0)
    assert list(found) == ["base -> C-HC", "base -> C-G", "C-HC -> C-G"]
    assert [row["mended"]["terrains"] for row in found.values()] == [[10], [3, 10], [3]]
    assert differences({"base": measured([0])}, NUMBERS[:1], 0) == {}


TABLES = {
    "success": {"near": {"base": 0.5, "C-G": 0.8, "C-G@1": 0.9, "C-G@2": 1.0, "C-HC@7": 0.4}},
    "goal": {"near": {"base": 0.5, "C-G": 0.7, "C-G@1": None, "C-G@2": 0.9, "C-HC@7": 0.4}},
}


def test_the_first_of_each_kind():
    assert firsts(TABLES["success"]["near"]) == ["base", "C-G", "C-HC@7"]


def test_mean_and_interval_of_a_kind_with_several():
    found = over_seeds(TABLES, ["success", "goal"])
    assert found["success"]["near"].keys() == {"C-G"}
    kind = found["success"]["near"]["C-G"]
    assert kind["mean"] == pytest.approx(0.9) and kind["values"] == [0.8, 0.9, 1.0]
    # Standard deviation .1, so .1 / sqrt(3) * 4.303 either way; a rate is at most 1.
    assert kind["interval"] == pytest.approx([0.9 - 0.2484, 1.0], abs=1e-4)
    rewards = over_seeds({"reward": {"near": {"C-G": 8.0, "C-G@1": 9.0, "C-G@2": 10.0}}}, ["reward"])
    assert rewards["reward"]["near"]["C-G"]["interval"] == pytest.approx([9.0 - 2.484, 9.0 + 2.484], abs=1e-3)
    assert found["goal"]["near"]["C-G"]["mean"] is None


def test_one_training_is_not_several(tmp_path):
    for name, content in (("a.pt", b"1"), ("b.pt", b"1"), ("c.pt", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, c = (str(tmp_path / name) for name in ("a.pt", "b.pt", "c.pt"))
    check_seeds({"base": a, "C-G": c, "C-G@1": b})  # of different kinds, the same may stand twice
    with pytest.raises(ValueError, match=r"C-G and C-G@2 must be of one kind from different seeds, got the same"):
        check_seeds({"C-G": a, "C-G@1": c, "C-G@2": b})
    with pytest.raises(ValueError, match=r"C-G@1 and C-G@2 must be"):
        check_seeds({"C-G@1": "no.such:code", "C-G@2": "no.such:code"})


@pytest.mark.parametrize("name", ["@1", "C-G@", "C-G@1@2", "@"])
def test_a_name_is_a_kind_and_at_most_one_seed(name):
    with pytest.raises(ValueError, match=f"a controller is named KIND or KIND@SEED, as C-G@1, got '{name}'"):
        check_seeds({"base": "no.such:code", name: "no.other:code"})


def test_more_than_an_interval_is_known_for():
    row = {f"C-G@{k}": 0.5 for k in range(11)}
    assert over_seeds({"goal": {"near": row}}, ["goal"])["goal"]["near"]["C-G"]["interval"] is None
