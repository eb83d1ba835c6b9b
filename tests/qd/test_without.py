"""Searches that leave penalties out: cells, files and figures are of the others alone."""

import json
from pathlib import Path

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import read_archive
from qd.fitness import FitnessCfg, evaluation_of
from qd.show.elites import Found
from qd.show.figures import draw_archive, look_of
from qd.show.replay import Replay, describe
from sim.robots.find import get_robot
from tests.qd import stand_in
from tests.qd.recordings import recording_of
from tests.qd.run.test_arguments import TINY, fails, in_a_folder_of_its_own, run_main  # noqa: F401 - a fixture for all of these
from tests.qd.searches import run

KEPT = [0, 1, 3, 5]  # without vel_y and stumble
FITNESS = FitnessCfg(
    penalties=("yaw_rate", "vel_x", "contact_force", "collision"), scales=tuple(stand_in.SCALES[k] for k in KEPT)
)


def test_a_search_of_four_penalties_and_five_intervals_runs_saves_and_resumes():
    pieces, whole = Path("pieces"), Path("whole")
    run(pieces, iterations=2, fitness=FITNESS, intervals=5)
    run(pieces, iterations=4, fitness=FITNESS, intervals=5, resumes=True)
    found = run(whole, iterations=4, fitness=FITNESS, intervals=5)
    assert (whole / "archive.npz").read_bytes() == (pieces / "archive.npz").read_bytes()
    # Of 4 indices of 0 to 4, those that sum to 2, 3 and 4: C(5, 3) + C(6, 3) + C(7, 3) = 10 + 20 + 35.
    assert json.loads((pieces / "archive.json").read_text())["reachable_cells"] == 65
    assert found.ratios.shape == found.penalty_mean.shape == (len(found), 4)
    assert found.ratios.sum(axis=1) == pytest.approx(np.ones(len(found)))
    assert np.array_equal(found.cells.cell_of(found.ratios), found.cell)
    # The stand-in's penalties are scale * 4 * hardness^3 of genes k, k + 6, ..., but for noise of 10 %.
    hardness = np.stack([np.abs(found.genes[:, k::6]).mean(axis=1) for k in KEPT], axis=1)
    assert found.penalty_mean == pytest.approx(4.0 * hardness**3, rel=0.1)


def test_figure_and_replay_show_the_penalties_that_are_kept():
    found = run(Path("a"), fitness=FITNESS, intervals=5)
    axes = draw_archive(found).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == [look_of(k).label for k in FITNESS.penalties]
    result = stand_in.evaluate(found.genes[:1], np.zeros(1, np.uint32))
    fresh = evaluation_of(result, found.cells, FITNESS)
    recording = recording_of([Outcome.GOAL], [14.0])
    where = Found(run=Path("a"), archive=found, robot=get_robot("anymal"))
    text = describe(Replay(found=where, out=Path("a.png"), elite=0, recording=recording, fresh=fresh))
    assert all(f"  {name} [" in text for name in FITNESS.penalties)
    assert "stumble" not in text and "vel_y" not in text


def test_penalties_left_out_are_remembered(capsys):
    listed = "anymal has yaw_rate, vel_x, vel_y, contact_force, stumble, collision"
    assert fails(capsys, *TINY, "--without", "torque", "slip") == f"no penalty named torque, slip: {listed}"
    assert "without must leave at least 2 of yaw_rate, vel_x" in fails(
        capsys, *TINY, "--without", "yaw_rate,vel_x,vel_y", "contact_force stumble"
    )
    assert not Path("runs").exists()
    assert run_main(*TINY, "--without", "stumble collision", "--intervals", "5", "--run-dir", "a") == 0
    assert "fitness.penalties (" in fails(capsys, "--resume", "a", "--without", "stumble")
    assert run_main("--resume", "a", "--iterations", "2") == 0
    assert run_main("--resume", "a", "--iterations", "3", "--without", "collision", "stumble") == 0
    fitness = json.loads(Path("a/config.json").read_text())["settings"]["fitness"]
    assert fitness["penalties"] == ["yaw_rate", "vel_x", "vel_y", "contact_force"]
    assert fitness["scales"] == [1.0, 2.0, 1.0, 4.0]
    archive = read_archive(Path("a"))
    assert (archive.iterations, archive.ratios.shape[1]) == (3, 4)
