"""One terrain again: its numbers by hand, its drawing, and which terrains a command line names."""

import dataclasses

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import write_archive
from qd.descriptors import Cells
from qd.fitness import FitnessCfg, evaluation_of
from qd.run.directory import RunDirectory
from qd.run.settings import suffix_of
from qd.show.elites import OpenedRun, open_run
from qd.show.recordings import Recordings
from qd.show.replay import Replay, describe, draw, replay
from sim.files.records import robot_identity
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from tests.builders import fresh_values, small_archive
from tests.qd.recordings import FRAMES, recording_of
from tests.qd.searches import CFG


@pytest.fixture
def done(tmp_path, anymal):
    ratios = np.array([[0.35, 0.65]])
    archive = dataclasses.replace(
        small_archive(1),
        ratios=ratios,
        cell=Cells(2).cell_of(ratios),
        penalty_mean=np.array([[2.0, 3.0]]),
        penalty_std=np.array([[1.0, 0.5]]),
        fitness=np.array([3.25]),
        collision_rate=np.array([0.25]),
        goal_rate=np.array([0.75]),
        fallen_rate=np.array([0.0]),
    )
    # raw sums of four episodes; scales .5 and 2 make them (4, 8), a ratio of 1/3
    sums = np.tile([2.0, 16.0, 0.0, 0.0, 0.0, 0.0], (4, 1))
    outcomes = [Outcome.BASE_COLLISION, Outcome.GOAL, Outcome.GOAL, Outcome.GOAL]
    recording = recording_of(outcomes, [5.0, 14.0, 14.0, 14.0], penalties=sums)
    opened_run = OpenedRun(path=tmp_path, archive=archive, robot=anymal)
    fitness = FitnessCfg(penalties=archive.penalties, scales=archive.scales)
    fresh = evaluation_of(recording.result(), Cells(2), fitness)
    return Replay(opened_run=opened_run, terrain=opened_run.terrain(), recording=recording, fresh=fresh)


def lines_of(replayed):
    return [" ".join(line.split()) for line in describe(replayed).splitlines()]


def test_numbers_are_raw_with_units_beside_the_fresh_ones(done):
    lines = lines_of(done)
    assert "yaw_rate [(rad/s)^2 s] 1.00 +- 0.50 (35% of all) 2.00 +- 0.00 (33% of all)" in lines
    assert "vel_x [(m/s)^2 s] 6.00 +- 1.00 (65% of all) 16.00 +- 0.00 (67% of all)" in lines
    # Wilson, z^2 = 3.8415, of 1 of 4: (.25 + .4802 +- 1.96 sqrt(.0469 + .0600)) / 1.9604 = .3725 +- .3269
    assert "base collision 1 of 4 (25%, 5 to 70%) 1 of 4 (25%, 5 to 70%)" in lines
    assert "goal reached 3 of 4 (75%, 30 to 95%) 3 of 4 (75%, 30 to 95%)" in lines
    assert "fitness 3.25 10.50" in lines  # fresh: 4 + 8 - 0 - 2 * 3/4
    far = dataclasses.replace(done, fresh=dataclasses.replace(done.fresh, cell=np.array([9])))
    other = dataclasses.replace(done, controller="runs/tuned/C-G.pt")
    cases = (lines, lines_of(far), lines_of(other))
    assert [any("does not land" in line for line in case) for case in cases] == [False, True, False]
    assert any("runs/tuned/C-G.pt" in line for line in lines_of(other))


def test_corrected_values_stand_between_the_found_ones_and_those_of_now(done):
    fresh = dataclasses.replace(fresh_values(done.opened_run.archive), invalid_episodes=np.array([8]))
    archive = dataclasses.replace(done.opened_run.archive, fresh=fresh)
    invalid = dataclasses.replace(done.fresh, invalid_episodes=np.array([3]), collision_rate=np.array([0.0]))
    case = dataclasses.replace(done, opened_run=dataclasses.replace(done.opened_run, archive=archive), fresh=invalid)
    lines = lines_of(case)
    assert lines[2].split() == ["fitness", "3.25", "1.62", "10.50"]
    # 8 of the 40 are invalid, and now the terrain as a whole
    assert "base collision 1 of 4 (25%, 5 to 70%) 8 of 32 (25%, 13 to 42%) no valid episode" in lines
    title = draw(case).axes[0].get_title()
    assert all(number in title for number in ("3.25", "1.62", "10.50"))


def test_the_drawing_has_all_paths_and_how_they_ended(done):
    outcomes = [Outcome.BASE_COLLISION, Outcome.GOAL, Outcome.GOAL, Outcome.TIME_OUT]
    figure = draw(dataclasses.replace(done, recording=recording_of(outcomes, [5.0, 14.0, 14.0, 9.0])))
    axes = figure.axes[0]
    assert sum(len(np.asarray(line.get_xdata())) == FRAMES for line in axes.lines) == 4
    assert axes.images[0].get_array().shape == (161, 321)
    assert tuple(axes.images[0].get_extent()) == (0.0, 16.0, 0.0, 8.0)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["reached the goal (2)", "base collision (1)", "out of time (1)", "start", "goal"]


def test_a_terrain_is_crossed_by_the_controller_that_is_named_and_drawn_in_the_run(done, monkeypatch):
    asked, opened_run = [], done.opened_run

    def all_of(recordings, wanted):
        asked.extend(wanted)
        return [done.recording]

    monkeypatch.setattr(Recordings, "all_of", all_of)
    assert replay(opened_run, opened_run.terrain("0"), replicas=4, seed=2).controller == ""
    assert (opened_run.folder / "elite-0.png").is_file()
    assert (asked[0].policy, asked[0].replicas, asked[0].seed) == (str(opened_run.robot.policy_file), 4, 2)
    assert replay(opened_run, opened_run.terrain("0"), policy="os.path:join").controller == "os.path:join"
    assert (opened_run.folder / "elite-0-os.path-join.png").is_file()
    np.testing.assert_array_equal(asked[1].terrain, opened_run.archive.genes[0])
    with pytest.raises(ValueError, match="out"):
        replay(opened_run, opened_run.terrain("0"), out=opened_run.folder / "a.jpg")


def test_what_one_controller_wrote_another_does_not_overwrite(tmp_path):
    for name, content in (("a.pt", b"1"), ("b.pt", b"1"), ("C-G.pt", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, tuned = (str(tmp_path / name) for name in ("a.pt", "b.pt", "C-G.pt"))
    robot, cfg = get_robot("anymal"), dataclasses.replace(CFG, policy=a, policy_sha256=controller_hash(a))
    assert suffix_of(cfg, a, robot) == suffix_of(cfg, b, robot) == ""
    assert suffix_of(cfg, tuned, robot) == "-C-G"
    assert suffix_of(cfg, "mine/row.py:adapt@my model.onnx", robot) == "-row.py-adapt-my-model"


def test_terrains_and_archives_that_are_not_there_are_refused(tmp_path, cassie):
    archive = tmp_path / "archive.npz"
    write_archive(archive, small_archive())
    opened_run = open_run(None, archive)
    assert [terrain.number for terrain in opened_run.terrains("2 0")] == [2, 0]
    assert [terrain.stem for terrain in opened_run.terrains("all")] == ["elite-0", "elite-1", "elite-2"]
    for elite in ("3", "-1", "x"):
        with pytest.raises(ValueError, match="elite"):
            opened_run.terrains(elite)
    with pytest.raises(ValueError, match="elite"):
        opened_run.terrain("all")
    with pytest.raises(FileNotFoundError, match="minimal"):
        opened_run.terrains("0", "all")
    with pytest.raises(ValueError, match="cassie"):
        open_run("cassie", archive)
    with pytest.raises(FileNotFoundError):
        open_run(None, tmp_path / "elsewhere")
    RunDirectory(tmp_path).begin_session(CFG, {"command": "", "commit": "", "device": "cpu"}, 0)
    with pytest.raises(ValueError, match=r"config\.json"):  # which has six penalties
        open_run(None, tmp_path).as_searched()
    write_archive(archive, dataclasses.replace(small_archive(), penalties=("yaw_rate", "<b>")))
    with pytest.raises(ValueError, match="penalties"):
        open_run("anymal", archive)
    robot = {"robot": "cassie", **robot_identity(cassie)}
    write_archive(archive, dataclasses.replace(small_archive(), **robot))
    assert open_run(None, archive).robot.name == "cassie"
