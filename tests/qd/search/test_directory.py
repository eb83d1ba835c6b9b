import dataclasses
import os
from pathlib import Path

import pytest

from qd.search.directory import (
    RunDirectory,
    claimed,
    find_run,
    output_folder,
    read_robot_archive,
    results_folder,
    search_seed,
)
from sim.robots.find import get_robot
from tests.builders import small_archive, write_run
from tests.qd.searches import CFG

ORIGIN = {"command": "faultline archive", "commit": "c", "device": "CPU", "seed": 3}


def test_a_claim_keeps_others_out_and_leaves_no_empty_directory(tmp_path):
    (tmp_path / "mine").mkdir()
    for path in (tmp_path / "a" / "b", tmp_path / "mine"):
        with claimed(path), pytest.raises(ValueError, match=path.name), claimed(path):
            pass
        with claimed(path):
            assert path.is_dir()
    assert not (tmp_path / "a" / "b").exists() and (tmp_path / "mine").exists()


@pytest.mark.parametrize("name", ["a\nb", os.fsdecode(b"\xff"), "\x1b[31m", "a" * 300])
def test_a_name_that_no_directory_or_command_can_have_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="run directory"), claimed(tmp_path / name):
        pass
    assert not any(tmp_path.iterdir())


def test_what_a_run_was_asked_to_do_comes_back_with_all_its_sessions(tmp_path):
    run = RunDirectory(tmp_path)
    run.begin_session(CFG, ORIGIN, 0)
    longer = dataclasses.replace(CFG, iterations=9)
    run.begin_session(longer, ORIGIN | {"command": "faultline archive --resume"}, 2)
    assert run.read_cfg() == longer and search_seed(tmp_path) == 3
    config = run.read_config()
    assert config["command"] == "faultline archive"  # that of the beginning
    assert [(session["command"], session["from_iteration"]) for session in config["sessions"]] == [
        ("faultline archive", 0), ("faultline archive --resume", 2),
    ]  # fmt: skip


@pytest.mark.parametrize("content", ["{", '{"seed": 1}', '{"settings": {}, "iterations": 1}'])
def test_a_damaged_config_is_refused(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=r"config\.json"):
        RunDirectory(tmp_path).read_cfg()


def test_what_is_no_run_or_has_not_begun_has_no_state(tmp_path):
    run = RunDirectory(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        run.read_config()
    assert run.load(CFG) is None and search_seed(tmp_path) is None
    (tmp_path / ".config.json.tmp").write_text("{")  # what a killed beginning leaves
    assert run.load(CFG) is None
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="--run-dir"):
        run.load(CFG)


@pytest.fixture
def results(tmp_path, monkeypatch):
    """An empty folder of published results, beside an empty one to work in."""
    monkeypatch.chdir(tmp_path)
    Path("results").mkdir()
    return Path("results")


def test_published_results_are_those_of_the_working_folder_else_of_the_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (results_folder() / "anymal" / "archive" / "archive.npz").exists()
    Path("results").mkdir()
    assert results_folder() == Path("results")


def make_run(path: Path, time: float = 0.0, **changes) -> Path:
    write_run(path, dataclasses.replace(small_archive(), **changes))
    os.utime(path / "archive.npz", (time, time))
    return path


def test_the_run_is_the_one_named_the_newest_of_the_robot_or_the_published_one(results):
    robot = get_robot("anymal")
    with pytest.raises(FileNotFoundError, match="anymal"):
        find_run(robot)
    published = make_run(results / "anymal" / "archive")
    assert find_run(robot) == published and output_folder(published, "anymal") == Path("runs/anymal-published")
    course = published.parent / "spaces" / "course" / "archive.npz"
    assert output_folder(course, "anymal") == Path("runs/anymal-published-course")
    with pytest.raises(FileNotFoundError):
        find_run(robot, published="never")
    with pytest.raises(ValueError, match=published.name):
        find_run(robot, published, published="never")
    assert find_run(robot, published) == published
    for number in (1, 3, 2):
        make_run(Path(f"runs/{number}"), number)
    make_run(Path("runs/cassie"), 9, robot="cassie")
    (make_run(Path("runs/damaged"), 10) / "archive.npz").write_bytes(b"no archive")
    assert find_run(robot) == find_run(robot, published="never") == Path("runs/3")
    assert output_folder(Path("runs/3/archive.npz"), "anymal") == Path("runs/3")
    assert find_run(robot, published="first") == published
    assert find_run(robot, Path("elsewhere")) == Path("elsewhere")


def test_an_archive_of_another_robot_or_of_the_robot_as_it_was_is_refused(results):
    robot = get_robot("anymal")
    assert len(read_robot_archive(robot, make_run(Path("now")))) == 3
    wrong = ({"robot_sha256": "0" * 64}, {"penalty_definition": "cubed"}, {"robot": "cassie"})
    for name, changes in zip("abc", wrong, strict=True):
        with pytest.raises(ValueError, match=r"anymal|cubed|cassie"):
            read_robot_archive(robot, make_run(Path(name), **changes))
