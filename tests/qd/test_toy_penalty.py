"""A toy penalty: robots are searched with it, and figures and replays have its label."""

from contextlib import contextmanager

import pytest

from faultline import main
from kernels.penalties import PENALTIES
from qd.search.archive import read_archive
from qd.show.figures import draw_archive
from qd.workers.pipeline import Pipeline, build_simulator
from sim.files.atomic import to_json
from sim.robots.find import get_robot
from sim.robots.robot import robot_identity
from tests.qd.searches import crossing_by
from tests.sim.dogs import write_dog

SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "2", "--replicas", "2", "--iterations", "1"]


@contextmanager
def open_here(cfg):
    """Crosses in this process, which knows the penalty."""
    yield Pipeline(cfg.num_terrains, build_simulator(cfg, cfg.num_terrains))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A search of the dog, whose settings name the penalty; its command line and its folder."""
    folder = tmp_path_factory.mktemp("toy")
    dog = write_dog(folder)
    dog.write_text(dog.read_text().replace('"vel_y", "collision"', '"vel_y", "roll_rate"'))
    robot = get_robot(str(dog))
    robot.scales_file.write_bytes(to_json({**robot_identity(robot), "scales": dict.fromkeys(robot.penalties, 1.0)}))
    flags = ["--robot", str(dog), "--policy", f"{folder}/dog_trot.py:Trot", "--device", "cpu"]
    with crossing_by(open_here):
        assert main(["archive", *flags, *SIZE, "--run-dir", str(folder / "run")]) == 0
    return flags, folder / "run"


def test_a_search_sums_it(run):
    archive = read_archive(run[1])
    assert (archive.penalty_mean[:, archive.penalties.index("roll_rate")] > 0.0).all()


def test_figures_show_its_label(run):
    figure = draw_archive(read_archive(run[1]))
    assert "roll rate of\nthe trunk" in [tick.get_text() for axes in figure.axes for tick in axes.get_xticklabels()]


def test_replay_prints_its_label_and_unit(run, capsys):
    flags, folder = run
    with crossing_by(open_here):
        main(["replay", *flags, "--run", str(folder), "--replicas", "1"])
    assert "roll rate of the trunk [(rad/s)^2 s]" in " ".join(capsys.readouterr().out.split())


def test_robots_that_do_not_name_it_do_without(robot):
    assert "roll_rate" in PENALTIES and "roll_rate" not in robot.penalties
