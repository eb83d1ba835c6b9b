"""The toys of tests/toys, each one file: one robot is searched, dosed, shown and reported with all of them at once."""

import json
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
from sim.terrains.spaces.registry import get_space
from tests.qd.searches import crossing_by
from tests.sim.dogs import write_dog

pytestmark = pytest.mark.slow
SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "4", "--replicas", "2", "--iterations", "2"]


@contextmanager
def open_here(cfg):
    """Crosses in this process, which knows the toys."""
    yield Pipeline(cfg.num_terrains, build_simulator(cfg, cfg.num_terrains))


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A search of the dog, whose settings name the penalty; its robot's flags and its folder."""
    folder = tmp_path_factory.mktemp("toys")
    dog = write_dog(folder)
    dog.write_text(dog.read_text().replace('"vel_y", "collision"', '"vel_y", "roll_rate"'))
    robot = get_robot(str(dog))
    robot.scales_file.write_bytes(to_json({**robot_identity(robot), "scales": dict.fromkeys(robot.penalties, 1.0)}))
    flags = ["--robot", str(dog), "--device", "cpu", "--policy", f"{folder}/dog_trot.py:Trot"]
    with crossing_by(open_here):
        toys = ["--space", "humps+wind", "--method", "toy", "--scheduler.toy-step", "0.1"]
        assert main(["archive", "--skip-level-ground", *flags, *toys, *SIZE, "--run-dir", str(folder / "run")]) == 0
    return flags, folder / "run"


def test_they_are_searched(searched):
    archive = read_archive(searched[1])
    assert archive.space == "humps+wind" and archive.genes.shape[1] == get_space("humps+wind").num_genes
    assert (archive.penalty_mean[:, archive.penalties.index("roll_rate")] > 0.0).all()


def test_a_hump_and_wind_are_dosed(searched, tmp_path):
    flags, out = searched[0], tmp_path / "dose.json"
    values = ["hump=0.05,0.3", "wind=0,2"]
    controller = ["--policies", f"dog={flags[-1]}"]
    with crossing_by(open_here):
        size = ["--terrains", "1", "--episodes", "1", "--out", str(out)]
        assert main(["dose", *flags[:4], *controller, "--elements", *values, *size]) == 0
    rows = json.loads(out.read_text())["dose"]
    assert [(row["element"], row["value"]) for row in rows] == [("hump", 0.05), ("hump", 0.3), ("wind", 0), ("wind", 2)]


def test_figures_show_the_label_of_the_penalty(searched):
    figure = draw_archive(read_archive(searched[1]))
    assert "roll rate of\nthe trunk" in [tick.get_text() for axes in figure.axes for tick in axes.get_xticklabels()]


@pytest.mark.slow
def test_a_replay_and_a_report_name_them(searched, capsys):
    flags, run = searched
    with crossing_by(open_here):
        assert main(["replay", *flags, "--run", str(run), "--replicas", "1"]) == 0
        shown = " ".join(capsys.readouterr().out.split())
        assert main(["report", *flags, "--run", str(run), "--elites", "1"]) == 0
    page = (run / "report.html").read_text()
    assert all(text in shown for text in ("roll rate of the trunk [(rad/s)^2 s]", "hump of 0.", "wind of 2."))
    assert "wind of 2." in page and "2 iterations of toy" in page


def test_robots_that_do_not_name_the_penalty_do_without(robot):
    assert "roll_rate" in PENALTIES and "roll_rate" not in robot.penalties
