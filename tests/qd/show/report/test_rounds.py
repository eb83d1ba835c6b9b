"""The page of a hardening, from a made-up rounds.json: what it says, its figures, errors."""

import pytest

from qd.show.report.command import Report, html_report
from qd.show.report.rounds import draw_faults, draw_rates
from sim.files.atomic import read_json, to_json
from tests.qd.evaluate.made import make_report
from tests.qd.show.report.test_report import Page

CONTROLLERS = ("base", "round-1")
SETS = ("hand_crafted", "search-0")
GOAL = {"base": 0.25, "round-1": 0.75}
LIMITS = {"base": [0.1, 0.4], "round-1": [0.6, 0.9]}


def row(controller, faults):
    counts = {"elites": 40, "failing": 20, "confirmed": 18, "certified": 15}
    return {"controller": controller, "search": f"search-{controller}", "episodes": 1000, "panel": ["C-G"], **counts,
            "faults": faults}  # fmt: skip


def content():
    # Of 13 terrains base crosses 4 and round-1 10: 7 are mended, 2 still failing, 1 newly broken, 3 fine.
    goals = {"base": [0] * 9 + [4] * 4, "round-1": [4] * 7 + [0] * 3 + [4] * 3}
    tables = make_report(dict.fromkeys(SETS, goals))
    tables |= {measure: dict.fromkeys(SETS, GOAL) for measure in ("success", "goal", "reward")}
    tables["intervals"] |= {measure: dict.fromkeys(SETS, LIMITS) for measure in ("success", "goal", "reward")}
    session = {"command": "faultline harden <b>", "commit": "abc", "device": "CPU", "date": "today"}
    return {
        **session, "robot": "anymal", "rounds": [row("base", 12), row("round-1", 3)], "comparisons": {},
        "tables": tables, "sessions": [session, session],
    }  # fmt: skip


@pytest.fixture
def run(tmp_path):
    (tmp_path / "rounds.json").write_bytes(to_json(content()))
    return tmp_path


def write(run, **changes):
    (run / "rounds.json").write_bytes(to_json(read_json(run / "rounds.json") | changes))


def test_the_page_says_what_the_rounds_brought(run):
    page = Page(html_report(Report(run=run)).read_bytes())
    assert page.open == [] and all(source.startswith("data:") for source in page.resources)
    assert "anymal hardened: 1 round of search and training" in page.text
    assert "against base found 12 faults, that against round-1 3 faults, 0.25 times as many." in page.text
    assert "Two searches of one controller may find numbers of faults that differ several times over" in page.text
    assert "search-0: base -> round-1 7 2 1 3 13" in page.text
    assert "hand-crafted 25 % (10 % to 40 %) 75 % (60 % to 90 %)" in page.text
    assert "worked on in 2 sessions" in page.text and "faultline harden <b>" in page.text
    assert {path.name for path in (run / "report-figures").iterdir()} == {"faults.png", "rates.png"}


def test_comparisons_stand_beside_the_rounds(run):
    write(run, comparisons={"hard_random": {**row("hard_random", 9), "rounds": 1}})
    page = Page(html_report(Report(run=run, out=run / "own.html")).read_bytes())
    assert "hard_random had as many trainings of the same length as 1 round on hard-random terrains" in page.text
    figure = draw_faults(read_json(run / "rounds.json"))
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["base", "round-1", "hard_random"]


def test_it_says_which_trainings_were_kept(run):
    assert "Which trainings were kept" not in Page(html_report(Report(run=run)).read_bytes()).text
    kept = {"tune-1": {"kept": True, "why": "better"}, "tune-2": {"kept": False, "why": "<i>worse"}}
    write(run, choices=kept)
    page = Page(html_report(Report(run=run)).read_bytes())
    assert "Which trainings were kept" in page.text
    assert "tune-1 kept better tune-2 not kept <i>worse" in page.text


def test_the_figures_show_the_numbers():
    bars = {bars.get_label(): [bar.get_height() for bar in bars] for bars in draw_faults(content()).axes[0].containers}
    assert bars == {"failing": [20, 20], "confirmed": [18, 18], "faults": [12, 3]}
    line = draw_rates(content()).axes[0].containers[0].lines[0]
    assert line.get_ydata().tolist() == [25.0, 75.0]


def test_one_search_alone_makes_a_page(run):
    tables = {**content()["tables"], "differences": {}}
    write(run, rounds=[row("base", None)], tables=tables)
    page = Page(html_report(Report(run=run)).read_bytes())
    assert "Nothing is trained yet" in page.text and "0 rounds" in page.text


@pytest.mark.parametrize(
    ("changes", "flags", "message"),
    [
        ({"rounds": []}, {}, "must have a search that is over, got none"),
        ({"rounds": [{"controller": 3}]}, {}, "its rounds cannot be read"),
        ({"choices": {"tune-1": {"kept": 1}}}, {}, "its choices cannot be read"),
        ({"tables": {"episodes": 20}}, {}, "must be of `faultline harden`"),
        ({}, {"robot": "cassie"}, "is of robot anymal, got --robot cassie"),
        ({}, {"out": "page.txt"}, "out must be a file named"),
    ],
)
def test_errors(run, changes, flags, message):
    write(run, **changes)
    flags = {name: run / value if name == "out" else value for name, value in flags.items()}
    with pytest.raises(ValueError, match=message):
        html_report(Report(run=run, **flags))
