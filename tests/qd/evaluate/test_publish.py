"""The published numbers in the README."""

import json
from pathlib import Path

import pytest

from qd.evaluate.publish import BEGIN, END, PAGE, Tables, numbers_of

ROOT = Path(__file__).parents[3]

ARCHIVE = {
    "iterations": 1000, "episodes": 4_000_000, "elites": 1200, "elites_reproduced": 1100, "reachable_cells": 4795,
    "reachable_coverage": 0.25, "with_collision": 700, "without_collision": 500, "mean_fitness": 5.04,
    "qd_score": 30_000.4, "corrected_qd_score": None, "wall_s": 3000.0, "gpus": 4,
}  # fmt: skip
TABLES = {
    "success": {"generated": {"base": 0.7, "C-G": 0.9, "C-G@1": 0.8}},
    "goal": {"generated": {"base": None, "C-G": 0.8, "C-G@1": 0.8}},
    "reward": {"generated": {"base": 20.0, "C-G": 22.0, "C-G@1": 24.0}},
    "intervals": {
        "success": {"generated": {"base": [0.6, 0.8], "C-G": [0.8, 1.0], "C-G@1": [0.7, 0.9]}},
        "goal": {"generated": {"base": None, "C-G": [0.7, 0.9], "C-G@1": [0.7, 0.9]}},
        "reward": {"generated": {"base": [19.0, 21.0], "C-G": [21.0, 23.0], "C-G@1": [23.0, 25.0]}},
    },
    "over_seeds": {"success": {"generated": {"C-G": {"mean": 0.85, "interval": [0.2, 1.0], "values": [0.9, 0.8]}}}},
    "terrains": {"generated": 300}, "episodes": 20, "archive": {"iterations": 1000},
}  # fmt: skip
ABLATION = {
    "iterations": [50, 100],
    "mean_std": {"alpha_1": [2.0, 1.5], "alpha_0": [3.0, 3.25]},
    "intervals": {"alpha_1": [[1.9, 2.1], [1.4, 1.6]], "alpha_0": [[2.9, 3.1], [3.1, 3.4]]},
}


@pytest.fixture
def results(tmp_path):
    for robot in ("anymal", "cassie"):
        (tmp_path / robot / "archive").mkdir(parents=True)
        (tmp_path / robot / "archive" / "archive.json").write_text(json.dumps(ARCHIVE))
    (tmp_path / "anymal" / "tables.json").write_text(json.dumps(TABLES))
    distances = {"nearest_m": {"hard_random": {"median": 0.129}, "generated": {"median": 0.0266}}}
    (tmp_path / "anymal" / "distances.json").write_text(json.dumps(distances))
    (tmp_path / "cassie" / "ablation.json").write_text(json.dumps(ABLATION))
    (tmp_path / "bench").mkdir()
    return tmp_path


def test_what_the_results_say_stands_beside_the_papers(results):
    anymal, cassie = numbers_of(results).split("**Cassie**")
    assert anymal.startswith("**ANYmal C**")
    for line in (
        "| elites | 1,200 | 1,129 |",
        "| coverage of the reachable cells | 25.0% | 23.5% |",
        "| ... corrected by fresh episodes | - | - |",
        "| search time | 50 min on up to 4 GPUs | about 8 h on two RTX 3070 Ti |",
        "RMS distance of the terrains' heights to the nearest elite trained on, medians: hard-random 12.9 cm; "
        "generated 2.7 cm.",
        "In brackets the terrains of a set; 20 episodes each; elites of the archive after 1,000 iterations.",
        "| generated (300) | base | - | 0.700 (0.600 to 0.800) | 20.0 (19.0 to 21.0) | - |",
        # Over two seeds where that is known, else the first of them.
        "| generated (300) | C-G | 0.800 (0.700 to 0.900) | 0.850 (0.200 to 1.000), 2 seeds | 22.0 (21.0 to 23.0) |",
    ):
        assert line in anymal
    assert "@" not in anymal and "mean STD" not in anymal
    assert "| with / without a base collision | 700 / 500 | 598 / 332 |" in cassie
    assert "| 100 | 1.50 (1.40 to 1.60) | 3.25 (3.10 to 3.40) |" in cassie


def test_certified_terrains_and_contact_resolved_stand_there_where_they_are_known(results):
    base, tuned = {"base": 0.1, "C-G": 0.8, "C-G@1": 0.9}, {"base": [0.0, 0.2], "C-G": [0.7, 0.9], "C-G@1": [0.8, 1.0]}
    one = {
        "terrains": 300, "goal": 0.75, "success": 0.9, "intervals": {"goal": [0.7, 0.8], "success": [0.8, 1.0]},
        "goal_bias": 0.05, "goal_bias_interval": [0.01, 0.09], "success_bias": 0.0,
        "success_bias_interval": [-0.1, 0.1],
    }  # fmt: skip
    more = {
        **TABLES, "part": "test",
        "certified": {"generated": {"terrains": 40, "chosen_by": {"base": "searched", "C-G": "certifier"}}},
        "certified_goal": {"generated": base}, "certified_success": {"generated": base},
        "intervals": {
            **TABLES["intervals"], "certified_goal": {"generated": tuned}, "certified_success": {"generated": tuned},
        },
        "resolved": {"generated": {"C-G": one}}, "mujoco_c": {"generated": {"C-G": {**one, "terrains": 60}}},
    }  # fmt: skip
    (results / "anymal" / "tables.json").write_text(json.dumps(more))
    said = numbers_of(results)
    for line in (
        "| generated, certified (40) | base (searched) | 0.100 (0.000 to 0.200) | 0.100 (0.000 to 0.200) | - | - |",
        "| generated, certified (40) | C-G (certifier) | 0.800 (0.700 to 0.900) |",
        "a controller marked (searched) is too low there and that of a (certifier) too high",
        "| generated (300) | C-G | here | 0.750 (0.700 to 0.800) | +0.050 (+0.010 to +0.090) | 0.900 (0.8",
        "| generated (60) | C-G | MuJoCo C |",
    ):
        assert line in said


def test_numbers_that_settings_were_chosen_by_are_not_published(results):
    (results / "anymal" / "tables.json").write_text(json.dumps({**TABLES, "part": "validation"}))
    with pytest.raises(ValueError, match="validation terrains, by which settings are chosen"):
        numbers_of(results)


def test_a_kind_whose_controllers_all_have_a_seed_in_their_name_is_there(results):
    renamed = json.loads(json.dumps(TABLES).replace('"C-G": ', '"C-G@0": '))
    renamed["over_seeds"] = TABLES["over_seeds"]
    (results / "anymal" / "tables.json").write_text(json.dumps(renamed))
    row = "| generated (300) | C-G | 0.800 (0.700 to 0.900) | 0.850 (0.200 to 1.000), 2 seeds | 22.0 (21.0 to 23.0) |"
    assert row in numbers_of(results)


def test_it_is_written_between_the_marks_and_checked(results, capsys):
    page = results / "README.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    cfg = Tables(results=results, page=page)
    with pytest.raises(ValueError, match="says something else than"):
        Tables(results=results, page=page, check=True).execute()
    cfg.execute()
    text = page.read_text()
    assert (
        text.startswith(f"before\n{BEGIN}\n**ANYmal C**") and text.endswith(f"|\n{END}\nafter\n") and "old" not in text
    )
    Tables(results=results, page=page, check=True).execute()
    cfg.execute()
    assert page.read_text() == text


def test_what_is_not_there_is_named(results, tmp_path):
    page = results / "README.md"
    page.write_text("nothing\n")
    with pytest.raises(ValueError, match="must hold the lines"):
        Tables(results=results, page=page).execute()
    with pytest.raises(ValueError, match="no results of a robot under"):
        numbers_of(tmp_path / "nowhere")
    (results / "anymal" / "tables.json").write_text(json.dumps({**TABLES, "goal": {}}))
    with pytest.raises(ValueError, match=r"tables.json lacks a number \(KeyError: 'generated'\)"):
        numbers_of(results)


def test_the_published_page_says_what_the_results_say():
    Tables(results=ROOT / "results", page=ROOT / PAGE, check=True).execute()
