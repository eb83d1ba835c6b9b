"""The tables: their numbers, what nobody crosses, and how they are shown."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.train.results import BAD, GOAL, HIT, LATE, result_of
from train.evaluate.measures import measure
from train.evaluate.publish import published
from train.evaluate.sets import plain_set
from train.evaluate.show import draw_tables, print_tables, write_figure
from train.evaluate.tables import make_tables, split_by_goal

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
    assert groups["never_crossed"]["intervals"]["success"]["base"] == [1.0, 1.0]


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
    assert "C-G on generated: 4 of 12 episodes are invalid (33.3%) and left out; counted as failures, success" in said


def test_the_figure_shows_the_tables(report, tmp_path):
    figure = draw_tables(report)
    success, goal, reward, changes = figure.axes
    assert "%" in success.get_ylabel() and "%" in goal.get_ylabel() and "20 s" in reward.get_ylabel()
    assert "held against base" in changes.get_xlabel()
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["base", "C-G", "of that name in the paper"]
    points = next(line for line in reward.lines if line.get_marker() == "s")
    np.testing.assert_allclose(points.get_ydata(), [report["reward"][name]["C-G"] for name in report["reward"]])
    diamonds = next(line for line in success.lines if line.get_marker() == "D")
    np.testing.assert_allclose(diamonds.get_ydata(), [98.0, 91.4])
    assert len({points.get_color() for points in reward.lines}) >= 2
    write_figure(tmp_path / "tables.png", report)
    assert (tmp_path / "tables.png").read_bytes().startswith(b"\x89PNG")


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
