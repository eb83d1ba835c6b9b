"""The tables of an evaluation on the page of a search."""

from qd.show.report.evaluation import compare_controllers
from sim.files.atomic import to_json
from sim.robots.robot import robot_identity
from tests.qd.evaluate.made import make_report
from tests.qd.show.report.pages import text_of

MEASURES = ("success", "goal", "reward")


def tables():
    """Two controllers on four elites, of which the second mends one and breaks another."""
    made = make_report({"generated": {"base": [4, 4, 0, 0], "C-G": [4, 0, 4, 0]}})
    values, limits = {"base": 0.5, "C-G": None}, {"base": [0.1, 0.9], "C-G": None}
    made |= {measure: {"generated": values} for measure in (*MEASURES, "certified_goal")}
    made["intervals"] |= {measure: {"generated": limits} for measure in (*MEASURES, "certified_goal")}
    about = {"terrains": 2, "certifiers": {"C-G": 2}, "chosen_by": {"base": "searched"}}
    return made | {"certified": {"generated": about}}


def test_tables_are_shown_where_they_are_asked_for(reported, run, anymal):
    assert "Controllers compared" not in text_of(reported()[0].read_bytes())
    file = run.parent / "tables.json"
    file.write_bytes(to_json({**robot_identity(anymal), **tables()}))
    text = text_of(reported(tables=file)[0].read_bytes())
    assert "Controllers compared From tables.json." in text
    assert "generated, held out (4) base 50 % (10 to 90) C-G -" in text
    assert "generated, held out: base -> C-G 1 1 1 1 4" in text  # mended, still failing, newly broken, fine, compared
    assert "generated, held out (2) base 50 % (10 to 90), searched C-G -" in text


def test_of_several_trainings_each_is_shown_and_the_mean_over_their_seeds():
    values, limits = {"base": 0.5, "C-G": 0.6, "C-G@1": 0.8}, {"base": [0.4, 0.6], "C-G": [0.5, 0.7], "C-G@1": None}
    over = {"mean": 0.7, "interval": None, "values": [0.6, 0.8]}
    several = {
        "controllers": {name: {"policy": name, "sha256": "0"} for name in values}, "terrains": {"near": 4},
        **{measure: {"near": values} for measure in MEASURES}, "episodes": 20, "differences": {},
        "intervals": {measure: {"near": limits} for measure in MEASURES},
        "over_seeds": {measure: {"near": {"C-G": over}} for measure in MEASURES},
    }  # fmt: skip
    compared = compare_controllers(several, searched="1")
    words, goals = compared["measures"][0]
    assert not compared["of_searched"] and words == "goal reached" and goals.head == ["controller", "near (4)"]
    expected = [["base", "50 % (40 to 60)"], ["C-G", "60 % (50 to 70)"], ["C-G@1", "80 %"], ["C-G, mean of 2", "70 %"]]
    assert goals.rows == expected
