"""Searches in several spaces side by side, and doses beside them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.run.directory import RunDirectory
from qd.studies.beside import Beside
from qd.studies.spaces import draw_spaces, searches_of
from sim.space import get_space
from tests.builders import fresh_values
from tests.qd.searches import CFG, make_job, run


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A search of 2 iterations, and one in the space of courses, half of whose elites fail in fresh episodes."""
    folder = tmp_path_factory.mktemp("spaces")
    run(folder / "bumps")
    shutil.copytree(folder / "bumps", folder / "course")
    archive = read_archive(folder / "bumps")
    count = len(archive)
    genes = get_space("course").hard_random(count, 0)
    course = replace(archive, space="course", genes=genes)
    fresh = replace(fresh_values(course), goal_rate=np.where(np.arange(count) < count // 2, 0.1, 0.9))
    write_archive(folder / "course" / "archive.npz", replace(course, fresh=fresh))
    (folder / "course" / "minimal.json").write_text('{"causes": {"step": 3, "ditch": 1}}')
    return folder


def dose_file(path, runs, **changes):
    archive = read_archive(runs / "bumps")
    row = {"element": "ditch", "parameter": "width", "value": 0.4, "controller": "base", "at": {}, "resolved": False,
           "goal_rate": 0.5, "interval": [0.3, 0.7]}  # fmt: skip
    half = [{"element": "ditch", "controller": "base", "words": "half of the robots reach the goal at 0.40 m"}]
    named = {"robot": "anymal", "robot_sha256": archive.robot_sha256, "resolved": False}
    path.write_text(json.dumps({**named, "dose": [{**row, **changes.pop("row", {})}], "half": half, **changes}))
    return path


def beside(runs, tmp_path, /, **changes):
    named = (f"super_gaussian={runs / 'bumps'}", f"course={runs / 'course'}")
    return Beside(**{"spaces": named, "out": tmp_path / "spaces.json"} | changes).execute()


def test_spaces_in_numbers_and_words(runs, tmp_path, capsys):
    dose = dose_file(tmp_path / "dose.json", runs)
    report = beside(runs, tmp_path, dose=(dose,))
    assert json.loads((tmp_path / "spaces.json").read_text()) == json.loads(json.dumps(report))
    assert (tmp_path / "spaces.png").stat().st_size > 10_000
    bumps, course = report["spaces"]["super_gaussian"], report["spaces"]["course"]
    archive = read_archive(runs / "course")
    assert course["space"] == "course" and course["elites"] == len(archive)
    assert course["failing"] == len(archive) // 2 and bumps["failing"] is None and bumps["faults"] is None
    assert course["episodes"] == bumps["episodes"] == 2 * 12 * 4  # iterations, terrains, replicas
    assert sum(mode["elites"] for mode in course["modes"]) == len(archive) // 2
    typical = course["modes"][0]["typical"]
    assert course["modes"][0]["terrain"] == get_space("course").describe(archive.genes[typical])
    assert course["causes"] == {"step": 3, "ditch": 1} and bumps["causes"] is None
    assert report["dose"][0]["goal_rate"] == 0.5 and report["half"][0]["resolved"] is False
    said = capsys.readouterr().out
    assert f"course (course): 96 episodes, {len(archive)} elites, {len(archive) // 2} failing" in said
    assert "causes: step 3, ditch 1" in said and "ditch, base: half of the robots reach the goal at 0.40 m" in said


def test_figure_has_an_archive_a_panel(runs):
    figure = draw_spaces(searches_of({"a": str(runs / "bumps"), "b": str(runs / "course")}, None))
    count = len(read_archive(runs / "course"))
    panels = figure.axes[:2]
    assert [len(axes.collections[0].get_segments()) for axes in panels] == [count, count]  # pyright: ignore
    assert panels[1].get_title() == f"b: {count} elites, {count // 2} failing"


def test_without_a_dose_there_is_none(runs, tmp_path):
    report = beside(runs, tmp_path)
    assert report["dose"] is None and report["half"] is None


def test_doses_of_several_files_are_joined(runs, tmp_path):
    one = dose_file(tmp_path / "one.json", runs)
    other = dose_file(tmp_path / "other.json", runs, row={"resolved": True}, resolved=True)
    report = beside(runs, tmp_path, dose=(one, other))
    assert [row["resolved"] for row in report["dose"]] == [False, True]
    assert [row["resolved"] for row in report["half"]] == [False, True]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spaces": ()}, "name either --runs, or --spaces"),
        ({"runs": ("a=x", "b=y")}, "name either --runs, or --spaces"),
        ({"spaces": ("{runs}/bumps",)}, "spaces must be NAME=DIR each"),
        ({"spaces": ("a={runs}/nowhere",)}, "no archive at"),
        ({"spaces": ("a={runs}/bumps", "b={tmp}/other")}, "but b has another policy_sha256 than a"),
        ({"dose": ("{tmp}/nothing.json",)}, "nothing.json"),
        ({"dose": ("{tmp}/text.json",)}, "must be numbers that `faultline dose` wrote"),
        ({"dose": ("{tmp}/cassie.json",)}, "must be of robot anymal as it was searched, got cassie"),
        ({"dose": ("{tmp}/one.json", "{tmp}/one.json")}, "has ditch of width 0.4 for base, which another file has too"),
    ],
)
def test_what_cannot_be_laid_side_by_side_is_refused(runs, tmp_path, changes, message):
    shutil.copytree(runs / "bumps", tmp_path / "other")
    cfg = replace(CFG, policy="tuned.pt", policy_sha256="b" * 64)
    RunDirectory(tmp_path / "other").write_config(cfg, make_job(tmp_path).origin)
    (tmp_path / "text.json").write_text("{}")
    dose_file(tmp_path / "one.json", runs)
    dose_file(tmp_path / "cassie.json", runs, robot="cassie")
    named = {key: tuple(text.format(runs=runs, tmp=tmp_path) for text in texts) for key, texts in changes.items()}
    named |= {"dose": tuple(map(Path, named.get("dose", ())))}
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        beside(runs, tmp_path, **named)
    assert not (tmp_path / "spaces.json").exists()
