"""Figures of a search, by hand."""

import dataclasses

import matplotlib.image
import numpy as np
import pytest

from qd.show.figures import draw_archive, draw_curves, relief, write_figures
from tests.builders import fresh_values, small_archive

ROW = {"terrains": 10, "episodes": 40, "invalid_episodes": 1, "wall_s": 2.5}


def rows(count: int) -> list[dict]:
    return [
        {"iteration": k, "qd_score": 20.0 * k, "elites": 5 * k, "mean_fitness": 1.0 + k, **ROW}
        for k in range(1, count + 1)
    ]


def test_curves_show_what_the_metrics_say():
    metrics = rows(4)
    figure = draw_curves(small_archive(), metrics)
    left, middle, right, *_ = figure.axes
    assert left.lines[0].get_xydata().tolist() == [[1, 20], [2, 40], [3, 60], [4, 80]]
    assert middle.lines[0].get_ydata().tolist() == [5, 10, 15, 20]
    assert right.lines[0].get_ydata().tolist() == [2, 3, 4, 5]
    # two ratios have 10 reachable cells, so the right-hand scale is ten times the left-hand one
    figure.draw_without_rendering()
    (coverage,) = middle.child_axes
    assert coverage.get_ylim()[1] == pytest.approx(10 * middle.get_ylim()[1])


def test_archive_figure_has_a_line_an_elite_and_the_worst_on_top():
    archive = small_archive(4)
    (lines,) = draw_archive(archive).axes[0].collections
    np.testing.assert_array_equal([line[:, 1] for line in lines.get_segments()], archive.ratios[::-1])
    assert lines.get_array().tolist() == archive.fitness[::-1].tolist()
    # with fresh values those that are valid, in their order
    ratios = np.array([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7], [0.4, 0.6]])
    fresh = dataclasses.replace(fresh_values(archive), ratios=ratios, invalid_episodes=np.array([0, 40, 0, 0]))
    (lines,) = draw_archive(dataclasses.replace(archive, fresh=fresh)).axes[0].collections
    assert np.allclose(lines.get_array(), archive.fitness[[3, 2, 0]] / 2)
    assert np.allclose([line[:, 1] for line in lines.get_segments()], ratios[[3, 2, 0]])


@pytest.mark.parametrize("num_elites", [0, 1])
def test_figures_are_files_for_archives_of_any_size(tmp_path, num_elites):
    files = write_figures(tmp_path, small_archive(num_elites), rows(1))
    assert [file.name for file in files] == ["curves.png", "archive.png"]
    assert all(matplotlib.image.imread(file).std() > 0.01 for file in files)  # something is drawn


@pytest.mark.parametrize("every", [1, 2])
def test_a_relief_is_blue_below_the_start_and_brown_above_with_start_and_goal(every):
    heights = np.zeros((161, 321), np.float32)
    heights[:, 100:160], heights[:, 160:220] = -0.4, 0.4
    pixels = relief(heights[::every, ::every])
    low, high = (pixels[40 // every, column // every].astype(int) for column in (130, 190))
    assert low[2] > low[0] and high[0] > high[2]
    # start at (2, 4) m and goal at (14, 4) m, nodes 0.05 m apart
    assert pixels[80 // every, 40 // every].tolist() == [240, 200, 60]
    assert pixels[80 // every, 280 // every].tolist() == [0, 158, 115]
