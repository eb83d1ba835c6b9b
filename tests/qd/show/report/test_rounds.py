"""The page of a hardening: its numbers, its figures, errors."""

import pytest

from qd.show.report.report import write_report
from sim.files.atomic import to_json
from tests.qd.evaluate.made import make_report
from tests.qd.show.report.pages import text_of

SETS = ("hand_crafted", "search-0")


def row(controller, faults):
    counts = {"elites": 40, "failing": 20, "confirmed": 18, "certified": 15}
    counts |= {"episodes": 1000, "faults": faults}
    return {"controller": controller, "search": f"search-{controller}", "certifiers": ["C-G"], **counts}


def content():
    # Of 13 terrains base crosses 4 and round-1 10: 7 are mended, 2 still failing, 1 newly broken, 3 fine.
    goals = {"base": [0] * 9 + [4] * 4, "round-1": [4] * 7 + [0] * 3 + [4] * 3}
    tables = make_report(dict.fromkeys(SETS, goals))
    rounds = [row("base", 12), row("round-1", 3)]
    return {"command": "faultline harden <b>", "robot": "anymal", "rounds": rounds, "tables": tables}


def written(run, **changes):
    """The run with its file."""
    (run / "rounds.json").write_bytes(to_json(content() | changes))
    return run


def test_the_page_has_the_numbers_of_the_rounds(tmp_path):
    choices = {"tune-1": {"kept": True, "why": "better"}, "tune-2": {"kept": False, "why": "<i>worse"}}
    run = written(tmp_path, choices=choices)
    text = text_of(write_report(run).read_bytes())
    for part in (
        "1 round of search and training: searches find 12 faults of anymal's controller before and 3 after",
        "base 1,000 40 20 18 15 12 C-G round-1 1,000 40 20 18 15 3 C-G", "hand-crafted base 31 % round-1 77 %",
        "base 31 % (8 to 62)", "search-0: base -> round-1 7 2 1 3 13",
        "tune-1 kept better tune-2 not kept <i>worse", "faultline harden <b>",
    ):  # fmt: skip
        assert part in text
    assert f"faultline report --run {tmp_path}/search-base " in text  # a command that works, wherever the run lies
    assert f"Made from {tmp_path.name}:" in text
    assert "report --robot anymal --run" in text_of(write_report(run, robot="anymal").read_bytes())
    written(run, rounds=[row("base", None)], tables={**content()["tables"], "differences": {}})  # one search alone
    assert "search-0: base" not in text_of(write_report(run).read_bytes())


def test_what_is_no_hardening_is_refused(tmp_path):
    with pytest.raises(ValueError, match="cassie"):
        write_report(written(tmp_path), robot="cassie")
    for changes in ({"rounds": []}, {"rounds": [{"controller": 3}]}, {"tables": {"episodes": 20}}):
        with pytest.raises(ValueError, match="rounds"):
            write_report(written(tmp_path, **changes))
