import dataclasses
import itertools

import matplotlib.image
import numpy as np
import pytest

from qd.show.figures import draw_archive, draw_curves, draw_spread, save_figure, spread, summary, write_figures
from tests.builders import fresh_values, small_archive

ROW = {"terrains": 10, "episodes": 40, "invalid_episodes": 1, "wall_s": 2.5}


def rows(count: int) -> list[dict]:
    return [
        {
            "iteration": k,
            "qd_score": 20.0 * k,
            "elites": 5 * k,
            "mean_fitness": 1.0 + k,
            "reachable_coverage": 0.1,
            **ROW,
        }
        for k in range(1, count + 1)
    ]


def test_curves_show_what_the_metrics_say():
    figure = draw_curves(small_archive(), rows(4))
    left, middle, right, *_ = figure.axes
    assert left.lines[0].get_xydata().tolist() == [[1, 20], [2, 40], [3, 60], [4, 80]]
    assert middle.lines[0].get_ydata().tolist() == [5, 10, 15, 20]
    assert right.lines[0].get_ydata().tolist() == [2, 3, 4, 5]
    # two ratios have 10 reachable cells, so the right-hand scale is ten times the left-hand one
    coverage = next(axes for axes in figure.axes if "coverage" in axes.get_ylabel())
    assert coverage.get_ylim()[1] == pytest.approx(10 * middle.get_ylim()[1])
    assert "anymal, 7 iterations" in figure.get_suptitle()


def test_mean_std_has_a_panel_where_elites_were_looked_at():
    metrics = rows(4)
    metrics[1] |= {"mean_std": 2.0, "mean_std_interval": [1.5, 3.0]}
    metrics[2] |= {"mean_std": None, "mean_std_interval": None}  # all elites invalid
    metrics[3] |= {"mean_std": 1.0, "mean_std_interval": [1.0, 1.0]}
    axes = draw_curves(small_archive(), metrics).axes[3]
    assert axes.get_ylabel() == "mean STD of elites\n(40 fresh episodes)"
    line, _, (bars,) = axes.containers[0]
    assert line.get_xydata().tolist() == [[2, 2], [4, 1]]
    assert [segment[:, 1].tolist() for segment in bars.get_segments()] == [[1.5, 3.0], [1.0, 1.0]]


def test_archive_figure_has_a_line_an_elite_and_the_worst_on_top():
    archive = small_archive(30)
    axes = draw_archive(archive).axes[0]
    (lines,) = axes.collections
    segments = lines.get_segments()
    assert len(segments) == 30
    assert np.allclose(segments[-1][:, 1], archive.ratios[0])
    assert (np.diff(lines.get_array()) >= 0).all()
    assert [label.get_text() for label in axes.get_xticklabels()] == ["yaw-rate error", "forward-\nvelocity error"]
    assert "anymal, 7 iterations: 30 elites" in axes.get_title()


@pytest.mark.parametrize("num_elites", [0, 1, 3])
def test_figures_are_files_for_archives_of_any_size(tmp_path, num_elites):
    files = write_figures(tmp_path, small_archive(num_elites), rows(1))
    assert [file.name for file in files] == ["curves.png", "archive.png", "spread.png"]
    for file in files:
        assert matplotlib.image.imread(file).std() > 0.01  # something is drawn


def test_labels_do_not_overlap(tmp_path):
    names = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")
    six = np.full((3, 6), 1 / 6)
    archive = dataclasses.replace(small_archive(), penalties=names, ratios=six)
    figure = draw_archive(archive)
    save_figure(tmp_path / "a.png", figure)  # lays it out
    boxes = [label.get_window_extent() for label in figure.axes[0].get_xticklabels()]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))


def test_summary_by_hand():
    archive = dataclasses.replace(small_archive(), fitness=np.array([5.0, 1.0, -3.0]))
    numbers = summary(archive, rows(4), gpus=1, origin={"seed": 9})
    assert numbers == {
        "seed": 9,
        "robot": "anymal",
        "robot_sha256": None,
        "policy_sha256": None,
        "penalty_definition": "squared",
        "space": "super_gaussian",
        "space_sha256": None,
        "iterations": 7,
        "terrains_evaluated": 40,
        "episodes": 160,
        "elites": 3,
        "elites_reproduced": None,
        "reachable_cells": 10,
        "reachable_coverage": 0.3,
        "qd_score": 63.0,
        "mean_fitness": 1.0,
        "reevaluated": None,
        "corrected_qd_score": None,
        "corrected_coverage": None,
        "corrected_elites": None,
        "corrected_mean_fitness": None,
        "mean_std": None,
        "mean_std_interval": None,
        "failing": None,
        "confirmed": None,
        "certified": None,
        "faults": None,
        "panel": [],
        "with_collision": 3,
        "without_collision": 0,
        # cells 0 to 2 of two ratios are [0, .1) x [.9, 1], [.1, .2) x [.8, .9) and [.2, .3) x [.7, .8)
        "spread": {"yaw_rate": [1, 1, 1, 0, 0, 0, 0, 0, 0, 0], "vel_x": [0, 0, 0, 0, 0, 0, 0, 1, 1, 1]},
        "wall_s": 10.0,
        "gpus": 1,
        "invalid_episodes": 4,
    }


def test_summary_with_fresh_values_by_hand():
    archive = dataclasses.replace(small_archive(), penalty_std=np.array([[1.0, 2.0], [0.5, 0.5], [3.0, 2.0]]))
    fresh = dataclasses.replace(
        fresh_values(archive),
        fitness=np.array([5.0, 1.0, -20.0]),
        cell=np.array([4, 4, 0]),
        collision_rate=np.array([0.0, 0.5, 0.0]),
        invalid_episodes=np.array([0, 0, 11]),
    )
    archive = dataclasses.replace(archive, fresh=fresh, collision_rate=np.array([0.5, 0.0, 0.1]))
    numbers = summary(archive, rows(4), gpus=1, origin={})
    assert (numbers["reevaluated"], numbers["elites_reproduced"]) == (3, 2)
    # the third is invalid; the first two share a cell, of which the fitter stays, 5 above -20 by 25
    assert (numbers["corrected_elites"], numbers["corrected_coverage"]) == (1, 1 / 10)
    assert (numbers["corrected_qd_score"], numbers["corrected_mean_fitness"]) == (25.0, 3.0)
    assert numbers["mean_std"] == 2.0  # of 1 + 2 and .5 + .5
    assert numbers["mean_std_interval"] == [1.0, 3.0]
    assert (numbers["with_collision"], numbers["without_collision"]) == (2, 1)  # as found


def test_archive_figure_shows_the_fresh_values_that_are_valid():
    archive = small_archive(4)
    ratios = np.array([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7], [0.4, 0.6]])
    fresh = dataclasses.replace(fresh_values(archive), ratios=ratios, invalid_episodes=np.array([0, 40, 0, 0]))
    axes = draw_archive(dataclasses.replace(archive, fresh=fresh)).axes[0]
    (lines,) = axes.collections
    assert np.allclose(lines.get_array(), archive.fitness[[3, 2, 0]] / 2)
    assert np.allclose([line[:, 1] for line in lines.get_segments()], ratios[[3, 2, 0]])
    assert axes.get_title().endswith("corrected by 40 fresh episodes each: 2 reproduced")


def test_spread_by_hand():
    # cells 0 to 2 of two ratios are [0, .1) x [.9, 1], [.1, .2) x [.8, .9) and [.2, .3) x [.7, .8)
    archive = dataclasses.replace(
        small_archive(4), cell=np.array([0, 0, 1, 2]), collision_rate=np.array([0.0, 0.1, 1.0, 0.0])
    )
    counts = spread(archive)
    assert counts.shape == (2, 10, 2)
    assert counts[0, :3].tolist() == [[1, 1], [0, 1], [1, 0]]
    assert counts[1, 7:].tolist() == [[1, 0], [0, 1], [1, 1]]
    assert counts.sum() == 8
    figure = draw_spread(archive)
    without, collides = figure.axes[0].containers
    assert [bar.get_height() for bar in without][:3] == [1, 0, 1]
    assert [(bar.get_y(), bar.get_height()) for bar in collides][:3] == [(1, 1), (0, 1), (1, 0)]
    assert [round(bar.get_x(), 6) for bar in collides][:3] == [0.0, 0.1, 0.2]
    assert figure.get_suptitle().endswith("2 of 4 elites had a base collision when they were found")
    # a collision bit puts a second copy of the 10 cells behind the first
    bit = dataclasses.replace(archive, collision_bit=True, cell=np.array([0, 10, 11, 2]))
    assert np.array_equal(spread(bit), counts)
