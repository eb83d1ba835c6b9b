import dataclasses
from pathlib import Path

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import write_archive
from qd.descriptors import Cells
from qd.fitness import FitnessCfg, evaluation_of
from qd.run.directory import RunDirectory
from qd.run.settings import suffix_of
from qd.show.elites import Found, find_archive
from qd.show.replay import Replay, ReplayElite, describe, draw, replay
from sim.files.command import run_command
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from tests.builders import fresh_values, small_archive
from tests.qd import stand_in
from tests.qd.recordings import FRAMES, recording_of
from tests.qd.searches import CFG, run


@pytest.fixture
def done(tmp_path):
    cells = Cells(2)
    ratios = np.array([[0.35, 0.65]])
    archive = dataclasses.replace(
        small_archive(1),
        ratios=ratios,
        cell=cells.cell_of(ratios),
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
    fitness = FitnessCfg(penalties=archive.penalties, scales=archive.scales)
    fresh = evaluation_of(recording.result(), cells, fitness)
    found = Found(run=tmp_path, archive=archive, robot=get_robot("anymal"))
    return Replay(found=found, out=tmp_path / "elite-0.png", elite=0, recording=recording, fresh=fresh)


def test_numbers_are_raw_with_units_beside_the_fresh_ones(done):
    text = describe(done)
    row = next(line for line in text.splitlines() if "yaw_rate [(rad/s)^2 s]" in line)
    assert " ".join(row.split()) == "yaw_rate [(rad/s)^2 s] 1.00 +- 0.50 (35% of all) 2.00 +- 0.00 (33% of all)"
    row = next(line for line in text.splitlines() if "vel_x [(m/s)^2 s]" in line)
    assert " ".join(row.split()) == "vel_x [(m/s)^2 s] 6.00 +- 1.00 (65% of all) 16.00 +- 0.00 (67% of all)"
    row = next(line for line in text.splitlines() if "base collision" in line)
    assert " ".join(row.split()) == "base collision 1 of 4 (25%, 5 to 70%) 1 of 4 (25%, 5 to 70%)"
    # Wilson, z^2 = 3.8415, of 1 of 4: (.25 + .4802 +- 1.96 sqrt(.0469 + .0600)) / 1.9604 = .3725 +- .3269
    row = next(line for line in text.splitlines() if "goal reached" in line)
    assert " ".join(row.split()) == "goal reached 3 of 4 (75%, 30 to 95%) 3 of 4 (75%, 30 to 95%)"
    # fresh: 4 + 8 - 0 - 2 * 3/4
    assert next(line for line in text.splitlines() if "fitness" in line).split() == ["fitness", "3.25", "10.50"]
    assert "lands in its cell or a neighbour of it again" in text


def test_corrected_values_stand_between_the_found_ones_and_those_of_now(done):
    fresh = dataclasses.replace(fresh_values(done.found.archive), invalid_episodes=np.array([8]))
    archive = dataclasses.replace(done.found.archive, fresh=fresh)
    corrected = dataclasses.replace(done, found=dataclasses.replace(done.found, archive=archive))
    lines = [" ".join(line.split()) for line in describe(corrected).splitlines()]
    assert lines[1:3] == ["found (4 episodes) corrected (40 episodes) now (4 episodes)", "fitness 3.25 1.62 10.50"]
    assert (
        "yaw_rate [(rad/s)^2 s] 1.00 +- 0.50 (35% of all) 1.00 +- 0.50 (35% of all) 2.00 +- 0.00 (33% of all)" in lines
    )
    # 8 of the 40 are invalid
    assert "base collision 1 of 4 (25%, 5 to 70%) 8 of 32 (25%, 13 to 42%) 1 of 4 (25%, 5 to 70%)" in lines
    title = draw(corrected).axes[0].get_title()
    assert title.endswith("fitness 3.25 as found, 1.62 corrected, 10.50 in 4 fresh episodes")


def test_another_controller_than_was_searched_is_named(done):
    other = dataclasses.replace(done, controller="runs/tuned/C-G.pt")
    text = describe(other)
    assert "Now it was crossed with runs/tuned/C-G.pt; all else is of the controller that was searched." in text
    assert "in its cell" not in text
    assert draw(other).axes[0].get_title().endswith("\nwith another controller than was searched: C-G.pt")


def test_what_one_controller_wrote_another_does_not_overwrite(tmp_path):
    for name, content in (("a.pt", b"1"), ("b.pt", b"1"), ("C-G.pt", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, tuned = (str(tmp_path / name) for name in ("a.pt", "b.pt", "C-G.pt"))
    robot, cfg = get_robot("anymal"), dataclasses.replace(CFG, policy=a, policy_sha256=controller_hash(a))
    assert suffix_of(cfg, a, robot) == suffix_of(cfg, b, robot) == ""
    assert suffix_of(cfg, tuned, robot) == "-C-G"
    assert suffix_of(cfg, "mine/row.py:adapt@my model.onnx", robot) == "-row.py-adapt-my-model"
    Path(a).write_bytes(b"3")
    assert suffix_of(cfg, a, robot) == "-a"  # another controller now, whatever its name
    code = dataclasses.replace(CFG, policy="no.such:code")
    assert suffix_of(code, "no.such:code", robot) == ""
    assert suffix_of(code, "no.other:code", robot) == "-no.other-code"


def test_of_an_invalid_terrain_no_rate_is_known(done):
    fresh = dataclasses.replace(done.fresh, invalid_episodes=np.array([3]), collision_rate=np.array([0.0]))
    lines = [" ".join(line.split()) for line in describe(dataclasses.replace(done, fresh=fresh)).splitlines()]
    assert "base collision 1 of 4 (25%, 5 to 70%) no valid episode" in lines


def test_the_drawing_has_all_paths_and_how_they_ended(done):
    outcomes = [Outcome.BASE_COLLISION, Outcome.GOAL, Outcome.GOAL, Outcome.TIME_OUT]
    figure = draw(dataclasses.replace(done, recording=recording_of(outcomes, [5.0, 14.0, 14.0, 9.0])))
    axes = figure.axes[0]
    paths = [line for line in axes.lines if len(np.asarray(line.get_xdata())) == FRAMES]
    assert len(paths) == 4
    image = axes.images[0]
    assert image.get_array().shape == (161, 321)
    assert tuple(image.get_extent()) == (0.0, 16.0, 0.0, 8.0)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["reached the goal (2)", "base collision (1)", "out of time (1)", "start", "goal"]


@pytest.mark.parametrize("change", [{"scales": (9.0,) * 6}, {"penalties": stand_in.PENALTIES[::-1]}])
def test_a_config_of_another_search_is_refused(tmp_path, change):
    fitness = dataclasses.replace(CFG.fitness, **change)
    run(tmp_path / "run")
    cfg = dataclasses.replace(CFG, fitness=fitness)
    RunDirectory(tmp_path / "run").begin_session(cfg, {"command": "", "commit": "", "device": "cpu"}, 0)
    with pytest.raises(ValueError, match=r"config\.json must have the penalties and scales of its archive, yaw_rate"):
        replay(ReplayElite(run=tmp_path / "run", device="cpu"))


@pytest.mark.parametrize("changes", [{"replicas": 0}, {"seed": -1}])
def test_numbers_of_no_episodes_are_refused(tmp_path, changes):
    write_archive(tmp_path / "archive.npz", small_archive())
    with pytest.raises(ValueError, match="episodes must be at least 1 and seed at least 0, got"):
        replay(ReplayElite(run=tmp_path, **changes))


def test_an_archive_of_penalties_that_the_robot_lacks_is_refused(tmp_path):
    write_archive(tmp_path / "archive.npz", dataclasses.replace(small_archive(), penalties=("yaw_rate", "<b>")))
    for refused in (lambda: replay(ReplayElite(run=tmp_path)), lambda: find_archive("anymal", tmp_path)):
        with pytest.raises(ValueError, match="penalties that robot anymal does not have: <b>; expected some of yaw_"):
            refused()


@pytest.mark.parametrize("out", ["a.jpg", "/proc/nowhere/a.png"])
def test_a_place_for_the_figure_is_looked_for_before_the_crossing(tmp_path, monkeypatch, out):
    run(tmp_path / "run")
    monkeypatch.setattr("sim.rollout.Rollout", None)  # crossing anything would fail with another error
    with pytest.raises(ValueError, match=r"out must be a file named \*\.png|cannot write to /proc/nowhere"):
        replay(ReplayElite(run=tmp_path / "run", device="cpu", out=Path(out)))


def test_an_elite_or_a_run_that_is_not_there_is_named(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_archive(tmp_path / "archive.npz", small_archive())

    def refused(*argv):
        assert run_command(ReplayElite, argv, name="replay") == 2
        return capsys.readouterr().err

    assert "archive.npz has no elite 3" in refused("--run", "archive.npz", "--elite", "3")
    assert "archive.npz has no elite -1" in refused("--run", "archive.npz", "--elite", "-1")
    assert "one elite here, got 'all'" in refused("--run", "archive.npz", "--elite", "all")
    assert "no archive of anymal under runs/" in refused()
    assert "no archive at elsewhere" in refused("--run", "elsewhere")
    assert "is of anymal, got --robot cassie" in refused("--run", "archive.npz", "--robot", "cassie")


def test_a_run_says_which_robot_it_is_of(tmp_path):
    penalties = ("yaw_rate", "vel_x")
    write_archive(tmp_path / "archive.npz", dataclasses.replace(small_archive(), robot="cassie", penalties=penalties))
    assert find_archive(None, tmp_path).robot.name == "cassie"
