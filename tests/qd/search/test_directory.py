import dataclasses
import hashlib
import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from qd.search import directory
from qd.search import settings as module
from qd.search.archive import CrossedAgain, goal_rates, read_archive, write_archive
from qd.search.checkpoint import load_checkpoint
from qd.search.directory import RunDirectory, claimed, find_run, output_folder, read_robot_archive, search_seed
from qd.search.fitness import ColumnTable, FitnessCfg
from qd.search.presets import SchedulerCfg
from qd.search.settings import as_settings, differences, is_searched, preset
from sim.controllers.spec import controller_hash
from sim.robots.find import get_robot
from sim.robots.robot import ROBOTS, RobotCfg, robot_digest
from tests.builders import fresh_values, judged_archive, small_archive, steered_archive, write_run
from tests.qd import stand_in
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
    sessions = [(session["command"], session["from_iteration"]) for session in config["sessions"]]
    assert sessions == [("faultline archive", 0), ("faultline archive --resume", 2)]


@pytest.mark.parametrize("content", ["{", '{"seed": 1}', '{"settings": {}, "iterations": 1}'])
def test_a_damaged_config_is_refused(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=r"config\.json"):
        RunDirectory(tmp_path).read_cfg()


def test_what_is_no_run_or_has_not_begun_has_no_state(tmp_path):
    run = RunDirectory(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        run.read_config()
    assert run.load(CFG) == (None, []) and search_seed(tmp_path) is None
    (tmp_path / ".config.json.tmp").write_text("{")  # what a killed beginning leaves
    assert run.load(CFG) == (None, [])


@pytest.fixture
def results(tmp_path, monkeypatch):
    """An empty folder of published results, beside an empty one to work in."""
    monkeypatch.chdir(tmp_path)
    Path("results").mkdir()
    return Path("results")


def test_published_results_are_those_of_the_working_folder_else_of_the_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (directory.results_folder() / "anymal" / "archive" / "archive.npz").exists()
    Path("results").mkdir()
    assert directory.results_folder() == Path("results")


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


KIND = b"faultline search checkpoint "


def wrap(payload: bytes) -> bytes:
    """A file with a right magic and hash around any payload, as an attacker would make it."""
    return KIND + b"9\n" + hashlib.sha256(payload).digest() + payload


@pytest.mark.parametrize(
    "name",
    # Names of protocol 4 may have dots: numpy.dtype is admitted, what hangs on it is not.
    ["posix system", "builtins eval", "pickle loads", "numpy.testing measure", "numpy dtype.mro", "numpy os"],
)
def test_what_is_no_part_of_a_search_is_never_looked_up(tmp_path, name):
    names = b"".join(b"\x8c" + bytes([len(part)]) + part.encode() for part in name.split())
    (tmp_path / "checkpoint.bin").write_bytes(wrap(b"\x80\x04" + names + b"\x93."))
    with pytest.raises(ValueError, match=name.replace(" ", ".")):
        load_checkpoint(tmp_path / "checkpoint.bin")


FOREIGN = dict.fromkeys((b"", wrap(b"junk"), wrap(pickle.dumps([1, 2]))), "put a copy|got list")
FOREIGN |= {KIND + version + bytes(40): "another version.*: start a new run$" for version in (b"5\n", b"55\n", b"")}


@pytest.mark.parametrize("content", FOREIGN)
def test_foreign_files_and_those_of_another_version_are_refused(tmp_path, content):
    (tmp_path / "checkpoint.bin").write_bytes(content)
    with pytest.raises(ValueError, match=rf"checkpoint\.bin.*({FOREIGN[content]})"):
        load_checkpoint(tmp_path / "checkpoint.bin")


def grouped_archive():
    """Judged elites with families and causes."""
    causes = np.array(["ridge", "", "oblique rise", "drop", ""])
    return dataclasses.replace(judged_archive(), family=np.array([0, 1, 0, 2, 3]), cause=causes)


AGAIN = CrossedAgain(searched=np.arange(20).reshape(5, 4), certifiers=np.arange(40).reshape(5, 2, 4))
IN_MUJOCO_C = dataclasses.replace(AGAIN, steered=AGAIN.searched)
CROSSED = dataclasses.replace(steered_archive(), varied=AGAIN, mujoco_c=IN_MUJOCO_C)
ARCHIVES = {"0": small_archive(0), "3": small_archive(3), "judged": grouped_archive(), "crossed": CROSSED}


def assert_same(stored, table):
    """Equal columns, and equal tables of further columns."""
    for name, value in vars(table).items():
        if isinstance(value, ColumnTable):
            assert_same(getattr(stored, name), value)
        else:
            assert np.array_equal(getattr(stored, name), value), name


@pytest.mark.parametrize("archive", ARCHIVES.values(), ids=ARCHIVES.keys())
def test_an_archive_comes_back_whole_and_equal_ones_have_equal_files(tmp_path, archive):
    for name in ("archive.npz", "again.npz"):
        write_archive(tmp_path / name, archive)
    assert (tmp_path / "archive.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    assert_same(read_archive(tmp_path), archive)
    with np.load(tmp_path / "archive.npz") as arrays:
        assert "confirmed" not in arrays or arrays["confirmed"].tolist() == archive.confirmed.tolist()


def test_corrected_elites_are_in_order_of_fresh_fitness_and_the_invalid_last():
    archive = small_archive(4)
    # 11 invalid of 40 are more than a quarter, and -20 is what an invalid terrain has; -30 is worse, but valid
    fitness, invalid = np.array([1.0, -20.0, 5.0, -30.0]), np.array([0, 11, 10, 0])
    fresh = dataclasses.replace(fresh_values(archive), fitness=fitness, invalid_episodes=invalid)
    corrected = archive.corrected_by(fresh)
    order = [2, 0, 3, 1]
    assert corrected.cell.tolist() == order
    assert np.array_equal(corrected.genes, archive.genes[order])
    assert corrected.fresh.fitness.tolist() == [5.0, 1.0, -30.0, -20.0]
    assert corrected.fresh.reproduced.tolist() == [True, True, False, False]
    assert corrected.rows(np.array([3, 0])).fresh.fitness.tolist() == [-20.0, 5.0]
    some = grouped_archive().rows(np.array([3, 0]))
    assert (some.family.tolist(), some.cause.tolist()) == ([2, 0], ["drop", "ridge"])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, None) for name in ("cell", "fresh_reproduced", "certifiers")),
        ("genes", np.zeros((4, 64), np.float32)),
        ("certifier_outcomes", np.zeros((5, 1, 4), int)),
        ("robot", np.array(["anymal"])),
        ("fitness", np.array(list("abcde"))),
        ("fitness", np.full(5, np.nan)),
        ("witness_counts", None),
        ("witness_kind", np.array([0, 3, 0, 4, 0])),
        ("witness_kind", np.array([0.0, 3.0, 0.0, 1.5, 0.0])),
        ("witness_way", np.zeros((5, 11, 3), np.float32)),
        ("witness_way", np.full((5, 12, 3), np.nan, np.float32)),
    ],
)
def test_arrays_that_lack_or_are_of_another_shape_or_kind_are_refused_by_name(tmp_path, name, value):
    with pytest.raises(FileNotFoundError, match=r"archive\.npz"):
        read_archive(tmp_path / "archive.npz")
    write_archive(tmp_path / "archive.npz", steered_archive())
    with np.load(tmp_path / "archive.npz") as stored:
        arrays = {**stored, name: value}
    np.savez(tmp_path / "archive.npz", **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=name):
        read_archive(tmp_path)


def test_confirmed_and_certified_by_hand():
    archive = judged_archive()
    assert archive.failing.tolist() == [True, True, True, True, False]
    # under half with contact resolved; the last does not fail, whatever it does there
    assert archive.confirmed.tolist() == [True, True, False, False, False]
    # one controller reaches the goal in half of both kinds, not one here and the other there
    assert archive.certified.tolist() == [True, False, True, False, False]
    assert archive.certificates[:3].tolist() == [[False, True], [False, False], [True, False]]
    # an invalid elite fails nothing
    fresh = dataclasses.replace(archive.fresh, invalid_episodes=np.array([11, 10, 0, 0, 0]))
    assert dataclasses.replace(archive, fresh=fresh).failing.tolist() == [False, True, True, True, False]


def test_goal_rates_by_hand():
    counts = np.array([[0, 0, 0, 0], [9, 6, 5, 0], [9, 6, 0, 5], [8, 6, 0, 6], [0, 0, 0, 20]])
    # not crossed; 9 of 20; 9 of the 15 valid; 6 of 20 are more than a quarter
    np.testing.assert_array_equal(goal_rates(counts), [np.nan, 0.45, 0.6, np.nan, np.nan])


@pytest.fixture(autouse=True)
def made_up_scales(monkeypatch):
    monkeypatch.setattr(module, "read_penalty_scales", lambda robot, policy=None: stand_in.SCALES)


def robot(policy_file: Path = ROBOTS["anymal"].policy_file):
    """ANYmal with another controller."""
    kind = type("Robot", (RobotCfg,), {"policy_file": policy_file})
    return kind(**{field.name: getattr(ROBOTS["anymal"], field.name) for field in dataclasses.fields(RobotCfg)})


def test_paper_has_the_papers_numbers():
    cfg, wide = preset("paper", robot()), preset("wide", robot())  # as many episodes
    assert cfg.episodes_per_iteration == 4000
    assert wide.episodes_per_iteration * wide.iterations == 4000 * 1000
    assert (cfg.fitness.alpha, cfg.fitness.lam, cfg.intervals) == (1.0, 2.0, 10)


@pytest.mark.parametrize("scheduler", [{"method": "cma_mae"}, {"method": "surrogate+cma_mae"}, {"again": 0}])
def test_only_a_surrogate_with_a_pool_learns_what_nobody_crosses(scheduler):
    cfg = preset("wide", robot())
    fitness = dataclasses.replace(cfg.fitness, crossed=0.5)
    dataclasses.replace(cfg, fitness=fitness)
    with pytest.raises(ValueError, match=r"fitness\.crossed"):
        dataclasses.replace(cfg, fitness=fitness, scheduler=dataclasses.replace(cfg.scheduler, **scheduler))


@pytest.mark.parametrize(
    ("name", "value"), [("method", "ppo"), ("method", "cma_me+cma_me"), ("disagree_share", 0.9), ("sigma0", 1e30)]
)
def test_values_of_the_scheduler_out_of_range_are_named(name, value):  # the square of 1e30 is no float32
    with pytest.raises(ValueError, match=name):
        SchedulerCfg(**{name: value})


def test_iterations_that_settle_need_terrains_to_cross_again_and_others_before_them():
    with pytest.raises(ValueError, match="again"):
        SchedulerCfg(settling=2)
    cfg = dataclasses.replace(preset("small", robot()), scheduler=SchedulerCfg(again=2, settling=2))
    for changes, name in (({"iterations": 2}, "settling"), ({"replicas": 10**9}, "replicas")):
        with pytest.raises(ValueError, match=name):
            dataclasses.replace(cfg, **changes)


def test_settings_survive_json_and_those_of_something_else_are_refused_by_name(tmp_path):
    cfg = preset("small", robot())
    cfg = dataclasses.replace(cfg, scheduler=dataclasses.replace(cfg.scheduler, learning_rate=0.01, sigma0=0.5))
    write_run(tmp_path / "run", small_archive(), as_settings(cfg))
    assert RunDirectory(tmp_path / "run").read_cfg() == dataclasses.replace(cfg, iterations=7)
    config = json.loads((tmp_path / "run/config.json").read_text())
    del config["settings"]["fitness"]["crossed"]  # as in published ones, which are of 0
    (tmp_path / "run/config.json").write_text(json.dumps(config))
    assert RunDirectory(tmp_path / "run").read_cfg().fitness.crossed == 0.0
    write_run(tmp_path / "other", small_archive(), as_settings(cfg) | {"certified_by": []})
    with pytest.raises(ValueError, match="certified_by"):
        RunDirectory(tmp_path / "other").read_cfg()


def test_differences_name_every_key():
    stored = {"seed": 0, "scheduler": {"sigma0": 0.5, "method": "cma_mae"}, "old": 1, "same": [1, 2]}
    settings = {"seed": 0, "scheduler": {"sigma0": 0.2, "method": "cma_mae"}, "new": "x", "same": [1, 2]}
    assert [line.split(" ")[0] for line in differences(stored, settings)] == ["new", "old", "scheduler.sigma0"]
    assert differences(stored, stored) == []


def test_robot_and_controller_are_part_of_the_settings(tmp_path):
    shipped, other = tmp_path / "anymal.pt", tmp_path / "other.pt"
    shipped.write_bytes(b"a")
    other.write_bytes(b"b")
    body = robot(shipped)
    cfg, same, changed, code = (preset("paper", body, p) for p in (None, "shipped", str(other), "module:callable"))
    assert cfg == same and cfg.policy_sha256 == controller_hash(shipped) and cfg.robot_sha256 == robot_digest(body)
    assert changed.policy_sha256 == controller_hash(other) and code.policy_sha256 is None
    assert is_searched(cfg, str(shipped), body) and not is_searched(cfg, str(other), body)
    assert is_searched(code, "module:callable", body) and not is_searched(code, "module:other", body)


@pytest.mark.parametrize("names", [("vel_x", "torque"), ("vel_x",)])  # unknown; a single ratio is always 1
def test_penalties_that_cannot_count_are_refused(names):
    with pytest.raises(ValueError, match="penalties"):
        FitnessCfg(penalties=stand_in.PENALTIES, scales=stand_in.SCALES).with_penalties(names)
