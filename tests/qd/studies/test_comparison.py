"""The numbers of a comparison by hand, and what its figure shows of them."""

import math

import pytest

from qd.studies.compare_arguments import METHODS
from qd.studies.comparison import AGAIN, LABELS, draw_comparison, report_of


def row(qd_score: float, *, corrected: float | None = None, collision_rate: float = 0.0) -> dict:
    """Metrics of one iteration of 10 terrains x 4 episodes."""
    again = {} if corrected is None else {**dict.fromkeys(AGAIN, 1.0), "corrected_qd_score": corrected}
    return {
        "qd_score": qd_score, "reachable_coverage": 0.25, "elites": 5, "mean_fitness": -1.0, "batch_fitness": 2.0,
        "batch_collision_rate": collision_rate, "batch_goal_rate": 0.5, "terrains": 10, "episodes": 40,
        "invalid_episodes": 1, "wall_s": 1.5, **again,
    }  # fmt: skip


RUNS = {
    "cma_mae": [[row(score), row(10 * score, corrected=5 * score, collision_rate=0.5)] for score in (1.0, 2.0, 3.0)],
    "hard_random": [[row(4.0), row(8.0, corrected=6.0)] for _ in range(3)],
}
HALF = 4.303 / math.sqrt(3)  # of 1, 2, 3: standard deviation 1, Student's quantile of 2 degrees of freedom


def reported(runs: dict) -> dict:
    seeds = list(range(len(next(iter(runs.values())))))
    return {"robot": "anymal", "seeds": seeds, **report_of(runs, {name: {"method": name} for name in runs})}


def test_report_by_hand():
    report = reported(RUNS)
    assert (report["iterations"], report["terrains_evaluated"], report["corrected_at"]) == (2, [10, 20], [20])
    found = report["methods"]["cma_mae"]
    assert found["settings"] == {"method": "cma_mae"}
    assert [point["mean"] for point in found["qd_score"]] == [2.0, 20.0]
    assert found["qd_score"][0]["interval"] == pytest.approx([2.0 - HALF, 2.0 + HALF])
    assert found["qd_score"][1]["seeds"] == [10.0, 20.0, 30.0]
    assert [point["mean"] for point in found["corrected_qd_score"]] == [10.0]
    assert found["corrected_qd_score"][0]["interval"] == pytest.approx([10.0 - 5 * HALF, 10.0 + 5 * HALF])
    assert found["batch_collision_rate"]["mean"] == 0.25  # 0 in the first iteration, .5 in the second
    assert (found["episodes"], found["invalid_episodes"], found["wall_s"]) == (3 * 2 * 40, 3 * 2, 3 * 2 * 1.5)
    assert report["methods"]["hard_random"]["qd_score"][1] == {"mean": 8.0, "interval": [8.0, 8.0], "seeds": [8.0] * 3}


def test_a_seed_without_a_value_leaves_the_mean_out():
    runs = {"mixed": [[{**row(1.0, corrected=1.0), "mean_std": value}] for value in (0.5, None)]}
    point = reported(runs)["methods"]["mixed"]["mean_std"][0]
    assert point == {"mean": None, "interval": None, "seeds": [0.5, None]}


def test_corrected_rows_that_some_runs_lack_are_left_out():
    runs = {"mixed": [[row(1.0, corrected=1.0), row(2.0, corrected=2.0)], [row(1.0), row(2.0, corrected=2.0)]]}
    report = reported(runs)
    assert report["corrected_at"] == [20]
    assert [point["mean"] for point in report["methods"]["mixed"]["corrected_qd_score"]] == [2.0]


def test_figure_has_a_line_a_method_and_panel_with_bands():
    figure = draw_comparison(reported(RUNS))
    score, coverage, corrected = figure.axes
    assert [len(axes.lines) for axes in figure.axes] == [2, 2, 2]
    assert score.lines[0].get_xydata().tolist() == [[10, 2], [20, 20]]
    assert coverage.lines[0].get_ydata().tolist() == [25, 25]  # per cent
    assert corrected.lines[0].get_xydata().tolist() == [[20, 10]]
    band = score.collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(20 + 10 * HALF)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["CMA-MAE", "hard-random"]
    assert "3 seeds a method" in figure.get_suptitle()


def test_figure_of_one_seed_has_lines_without_bands(tmp_path):
    report = reported({name: seeds[:1] for name, seeds in RUNS.items()})
    assert report["methods"]["cma_mae"]["qd_score"][0] == {"mean": 1.0, "interval": None, "seeds": [1.0]}
    figure = draw_comparison(report)
    assert figure.axes[0].lines[0].get_xydata().tolist() == [[10, 1], [20, 10]]
    figure.savefig(tmp_path / "figure.png")


def test_every_method_has_a_look_of_its_own():
    assert LABELS.keys() == METHODS.keys()
    assert len({look[1:] for look in LABELS.values()}) == len(METHODS)
