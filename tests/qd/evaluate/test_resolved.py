"""Tables with contact resolved, here and in plain MuJoCo C: what is crossed again, what is kept, what is said of it."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.evaluate.evaluate import Evaluate, evaluate_tables
from qd.evaluate.resolved import PLAIN_EPISODES, check_resolved, compared, drawn_sets
from qd.evaluate.sets import make_sets, part_of
from qd.evaluate.show import draw_tables
from sim.files.command import Interrupted, run_command
from sim.robots.robot import get_robot
from tests.qd.evaluate.test_evaluate import PROTOTYPE, STANDER, Crossings, config
from tests.train.results import BAD, GOAL, HIT, LATE


def in_mujoco_c(asked, stop_after=99):
    """Stands for MuJoCo C: every second episode arrives. Notes what it was asked, and may be stopped."""

    def cross(robot, policy, heights, seeds, *, num_episodes, device, processes, time_constant_s, ground, crossed):
        asked.append((policy, robot.physics_dt, time_constant_s, heights.shape, seeds.tolist(), num_episodes))
        for terrain in range(len(heights)):
            if terrain == stop_after:
                raise KeyboardInterrupt
            outcome = np.array([Outcome.GOAL, Outcome.TIME_OUT] * (num_episodes // 2), np.uint8)
            crossed(terrain, SimpleNamespace(outcome=outcome))

    return cross


@pytest.fixture
def walker(tmp_path):
    """A controller whose code is a file."""
    file = tmp_path / "walker.py"
    file.write_text("from tests.sim.policies import stretch as walk\n")
    return f"{file}:walk"


def test_rates_with_contact_resolved_and_their_bias():
    sets = make_sets(["hard_random"], 4, 0)
    ours = np.array([[GOAL] * 4, [GOAL] * 4, [GOAL, GOAL, HIT, HIT], [GOAL] * 4])
    theirs = np.array([[GOAL] * 4, [GOAL, GOAL, GOAL, LATE], [HIT] * 4, [BAD] * 4])
    (found,) = compared({"hard_random": {"base": ours}}, {"hard_random": {"base": theirs}}, sets, sets, 0).values()
    one = found["base"]
    # Goal rates 1, .75, 0 and an invalid terrain, against 1, 1, .5.
    assert one["terrains"] == 3 and one["goal"] == pytest.approx(1.75 / 3)
    assert one["goal_bias"] == pytest.approx(0.75 / 3) and one["success_bias"] == pytest.approx(0.5 / 3)
    low, high = one["goal_bias_interval"]
    assert low <= one["goal_bias"] <= high and one["intervals"]["goal"] == [0.0, 1.0]
    # Of two terrains of a set alone, the third and the first, the same two of the tables are taken.
    part = {"hard_random": part_of(sets["hard_random"], np.array([2, 0]), "hard_random")}
    some = compared({"hard_random": {"base": ours}}, {"hard_random": {"base": theirs[[2, 0]]}}, sets, part, 0)
    assert some["hard_random"]["base"]["goal_bias"] == pytest.approx(0.25)


def test_the_bias_over_elites_is_over_their_families():
    alone = make_sets(["hard_random"], 8, 0)
    kin = {"hard_random": replace(alone["hard_random"], families=np.array([0] * 7 + [1]))}
    ours, theirs = np.full((8, 4), GOAL), np.array([[GOAL] * 4] * 7 + [[HIT] * 4])
    crossed = [{"hard_random": {"base": one}} for one in (ours, theirs)]
    of_terrains, of_kin = (compared(*crossed, sets, sets, 0)["hard_random"]["base"] for sets in (alone, kin))
    # Of two families a quarter of the resamples has nothing but the last one.
    assert of_kin["goal_bias_interval"][1] == 1.0 and of_kin["intervals"]["goal"][0] == 0.0
    assert of_terrains["goal_bias_interval"][1] < 0.6 and of_terrains["goal_bias"] == of_kin["goal_bias"] == 0.125


def test_terrains_for_mujoco_c_are_drawn_by_the_seed():
    sets = make_sets(["hand_crafted", "hard_random"], 20, 0)
    drawn = [drawn_sets(sets, 5, seed) for seed in (0, 0, 1)]
    numbers = [one["hard_random"].numbers.tolist() for one in drawn]
    assert numbers[0] == numbers[1] != numbers[2] and len(set(numbers[0])) == 5
    np.testing.assert_array_equal(drawn[0]["hard_random"].terrains, sets["hard_random"].terrains[numbers[0]])
    assert len(drawn_sets(sets, 99, 0)["hand_crafted"]) == 20


def test_the_tables_have_both_and_go_on_after_a_stop(tmp_path, walker, monkeypatch, capsys):
    asked = []
    own = {"policies": (f"base={STANDER}", f"C-G={walker}"), "sets": ("hand_crafted hard_random",), "terrains": 3}
    cfg = config(tmp_path, **own, resolved=("C-G",), mujoco_c=2)
    monkeypatch.setattr("sim.mujoco_c.crossing.cross_plain", in_mujoco_c(asked, stop_after=1))
    crossings = Crossings()
    with pytest.raises(KeyboardInterrupt):
        evaluate_tables(cfg, open_evaluator=crossings.open)
    assert [(one.resolved, one.reward) for one in crossings.opened] == [(False, True), (False, True), (True, False)]
    assert [who for who, _ in crossings.sets] == [STANDER] * 2 + [walker] * 4
    monkeypatch.setattr("sim.mujoco_c.crossing.cross_plain", in_mujoco_c(asked))
    again = Crossings()
    report = evaluate_tables(cfg, open_evaluator=again.open)
    assert again.sets == []  # nor is anything in MuJoCo C
    assert [shape[0] for _, _, _, shape, _, _ in asked] == [2, 1, 2]
    for policy, step, time_constant, shape, _, episodes in asked:
        assert (policy, step, time_constant, shape[1:], episodes) == (walker, 0.001, 0.003, (161, 321), PLAIN_EPISODES)
    assert list(report["resolved"]) == list(report["mujoco_c"]) == ["hand_crafted", "hard_random"]
    for name in report["resolved"]:
        assert list(report["resolved"][name]) == list(report["mujoco_c"][name]) == ["C-G"]
        one, plain = report["resolved"][name]["C-G"], report["mujoco_c"][name]["C-G"]
        assert one["terrains"] == 3 and one["goal_bias"] == pytest.approx(report["goal"][name]["C-G"] - one["goal"])
        assert plain["terrains"] == 2 and plain["goal"] == 0.5 and plain["success"] == 1.0
    assert json.loads((tmp_path / "tables" / "tables.json").read_text())["resolved"] == report["resolved"]
    shown = capsys.readouterr().out
    assert "contact resolved: rates, and how far those at the search's settings lie above them (bias)" in shown
    assert "MuJoCo C, contact resolved: rates" in shown and "C-G on hard_random with contact resolved: goal" in shown
    *_, bias = draw_tables(report).axes
    assert "above contact resolved" in bias.get_ylabel()
    told = [text.get_text() for text in bias.get_legend().get_texts()]
    assert told == ["C-G: contact resolved", "C-G: MuJoCo C, contact resolved"]


def test_ctrl_c_in_mujoco_c_says_how_to_go_on(tmp_path, walker, monkeypatch):
    monkeypatch.setattr("sim.mujoco_c.crossing.cross_plain", in_mujoco_c([], stop_after=0))
    crossings = Crossings()
    monkeypatch.setattr(
        "qd.evaluate.evaluate.evaluate_tables", lambda flags: evaluate_tables(flags, open_evaluator=crossings.open)
    )
    cfg = config(tmp_path, policies=(f"base={walker}",), sets=("hard_random",), resolved=("base",), mujoco_c=1)
    with pytest.raises(Interrupted, match=r"what is crossed is kept\. The same command goes on"):
        cfg.execute()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--resolved", "C-X"], "resolved must name controllers of the tables, each once, some of base, C-G; got C-X"),
        (["--resolved", "base base"], "each once"),
        (["--mujoco-c", "3"], "mujoco_c 3 is for the controllers of --resolved, got none: name them"),
        (["--mujoco-c", "-1"], "mujoco_c must be at least 0, got -1"),
        (
            ["--resolved", "base", "--mujoco-c", "2", "--ground", "softness"],
            "leave MuJoCo C out with --mujoco-c 0",
        ),
    ],
)
def test_what_cannot_be_crossed_so_is_refused(flags, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("qd.evaluate.evaluate.open_evaluator", None)
    named = ["--policies", f"base={STANDER}", f"C-G={PROTOTYPE}", "--sets", "hard_random", "--device", "cpu"]
    given = [*named, "--run-dir", str(tmp_path / "tables"), "--terrains", "2", *flags]
    assert run_command(Evaluate, given, name="evaluate") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "tables").exists()


def test_a_robot_that_mujoco_cannot_read_is_told_so(monkeypatch):
    def unreadable(robot, heights):
        raise ValueError("MuJoCo cannot read robot")

    monkeypatch.setattr("sim.mujoco_c.model.crossing_model", unreadable)
    with pytest.raises(ValueError, match="cannot read robot, or leave MuJoCo C out with --mujoco-c 0"):
        check_resolved(["a"], 1, {"a": STANDER}, get_robot("anymal"), {})
    check_resolved(["a"], 0, {"a": STANDER}, get_robot("anymal"), {})
