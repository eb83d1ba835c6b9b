import dataclasses
import itertools

import matplotlib.image
import numpy as np
import pytest

from qd.report import draw_archive, draw_curves, save_figure, summary, write_figures
from tests.qd.test_archive import small_archive

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
    assert [file.name for file in files] == ["curves.png", "archive.png"]
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
    numbers = summary(archive, rows(4), gpus=1, num_reproduced=2, origin={"seed": 9})
    assert numbers == {
        "seed": 9,
        "robot": "anymal",
        "iterations": 7,
        "terrains_evaluated": 40,
        "episodes": 160,
        "elites": 3,
        "elites_reproduced": 2,
        "reachable_cells": 10,
        "reachable_coverage": 0.3,
        "qd_score": 63.0,
        "mean_fitness": 1.0,
        "wall_s": 10.0,
        "gpus": 1,
        "invalid_episodes": 4,
    }
