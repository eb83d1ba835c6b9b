"""The page of a hardening: its numbers, its figures, errors."""

import pytest

from qd.show.report.report import write_report
from qd.show.report.rounds import draw_faults, draw_rates
from sim.files.atomic import read_json, to_json
from tests.qd.evaluate.made import make_report
from tests.qd.show.report.pages import Page

SETS = ("hand_crafted", "search-0")
GOAL = {"base": 0.25, "round-1": 0.75}
LIMITS = {"base": [0.1, 0.4], "round-1": [0.6, 0.9]}


def row(controller, faults):
    counts = {"elites": 40, "failing": 20, "confirmed": 18, "certified": 15}
    counts |= {"episodes": 1000, "faults": faults}
    return {"controller": controller, "search": f"search-{controller}", "certifiers": ["C-G"], **counts}


def content():
    # Of 13 terrains base crosses 4 and round-1 10: 7 are mended, 2 still failing, 1 newly broken, 3 fine.
    goals = {"base": [0] * 9 + [4] * 4, "round-1": [4] * 7 + [0] * 3 + [4] * 3}
    tables = make_report(dict.fromkeys(SETS, goals))
    tables |= {measure: dict.fromkeys(SETS, GOAL) for measure in ("success", "goal", "reward")}
    tables["intervals"] |= {measure: dict.fromkeys(SETS, LIMITS) for measure in ("success", "goal", "reward")}
    rounds = [row("base", 12), row("round-1", 3)]
    return {"command": "faultline harden <b>", "robot": "anymal", "rounds": rounds, "tables": tables}


@pytest.fixture
def run(tmp_path):
    (tmp_path / "rounds.json").write_bytes(to_json(content()))
    return tmp_path


def write(run, **changes):
    (run / "rounds.json").write_bytes(to_json(read_json(run / "rounds.json") | changes))


def test_the_page_has_the_numbers_of_the_rounds(run):
    write(run, choices={"tune-1": {"kept": True, "why": "better"}, "tune-2": {"kept": False, "why": "<i>worse"}})
    page = Page(write_report(run).read_bytes())
    assert page.open == [] and all(source.startswith("data:") for source in page.resources)
    for part in (
        "faults of base, in 1,000 episodes 12 faults of round-1, in 1,000 episodes 3",
        "search-0: base -> round-1 7 2 1 3 13", "hand-crafted 25 % (10 % to 40 %) 75 % (60 % to 90 %)",
        "tune-1 kept better tune-2 not kept <i>worse", "faultline harden <b>",
    ):  # fmt: skip
        assert part in page.text
    assert {path.name for path in (run / "report-figures").iterdir()} == {"faults.png", "rates.png"}
    write(run, rounds=[row("base", None)], tables={**content()["tables"], "differences": {}})  # one search alone
    assert "search-0: base" not in Page(write_report(run).read_bytes()).text


def test_the_figures_show_the_numbers():
    bars = {bars.get_label(): [bar.get_height() for bar in bars] for bars in draw_faults(content()).axes[0].containers}
    assert bars == {"failing": [20, 20], "confirmed": [18, 18], "faults": [12, 3]}
    line = draw_rates(content()).axes[0].containers[0].lines[0]
    assert line.get_ydata().tolist() == [25.0, 75.0]


@pytest.mark.parametrize(
    ("changes", "asked", "field"),
    [
        ({"rounds": []}, {}, "rounds.json"),
        ({"rounds": [{"controller": 3}]}, {}, "rounds.json"),
        ({"tables": {"episodes": 20}}, {}, "rounds.json"),
        ({}, {"robot": "cassie"}, "cassie"),
    ],
)
def test_what_is_no_hardening_is_refused(run, changes, asked, field):
    write(run, **changes)
    with pytest.raises(ValueError, match=field):
        write_report(run, **asked)
