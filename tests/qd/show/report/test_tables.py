"""The page's chapter about an evaluation: tables by kind of controller, and what became of terrains."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.evaluate.measures import measure
from qd.evaluate.sets import TerrainSet
from qd.evaluate.tables import make_tables
from qd.show.report.evaluation import by_kind
from sim.files.atomic import to_json
from sim.files.records import robot_identity
from tests.qd.show.report.pages import DOT, Page
from tests.train.results import GOAL, LATE, result_of


@pytest.fixture
def tables(run, anymal):
    """Tables of two controllers on four elites, of which the second mends one and breaks another."""
    outcomes = {"base": [GOAL, GOAL, LATE, LATE], "C-G": [GOAL, LATE, GOAL, LATE]}
    crossed, about = {}, {}
    for name, ends in outcomes.items():
        crossed[name] = measure(result_of([[end] * 4 for end in ends], reward=np.ones((4, 4))), (1.0, 1.0))
        policy = run.parent / f"{name}.pt"
        policy.write_text(name)
        about[name] = {"policy": str(policy), "sha256": hashlib.sha256(name.encode()).hexdigest()}
    chosen = TerrainSet(name="generated", terrains=np.zeros((4, 64), np.float32), seeds=np.zeros(4, np.uint32),
                        numbers=np.array([3, 5, 7, 9]))  # fmt: skip
    made = make_tables({"generated": crossed}, {"generated": chosen}, anymal, controllers=about, episodes=4, seed=0)
    file = run.parent / "results" / "anymal" / "tables.json"
    file.parent.mkdir(parents=True)
    file.with_suffix(".png").write_bytes(DOT)
    file.write_bytes(to_json({**robot_identity(anymal), **made}))
    return file


def changed(file, **changes):
    file.write_bytes(to_json({**json.loads(file.read_text()), **changes}))


def test_the_page_has_the_numbers_of_the_tables(reported, tables):
    out, _ = reported()
    text = Page(out.read_bytes()).text
    assert "generated, held out 50 % (0 % to 100 %) 50 % (0 % to 100 %)" in text
    assert "generated, held out: base -> C-G 1 1 1 1 4" in text  # mended, still failing, newly broken, fine, compared
    assert (out.parent / "report-figures" / "tables.png").read_bytes() == DOT
    made = json.loads(tables.read_text())
    limits = {"generated": {"base": [0.0, 0.2], "C-G": None}}
    values = {"generated": {"base": 0.1, "C-G": None}}
    changed(
        tables,
        certified={"generated": {"terrains": 2, "certifiers": {"C-G": 2}, "chosen_by": {"base": "searched"}}},
        certified_goal=values, certified_success=values,
        intervals={**made["intervals"], "certified_goal": limits, "certified_success": limits},
    )  # fmt: skip
    text = Page(reported()[0].read_bytes()).text
    assert "generated, held out (2 certified): goal reached 10 % (0 % to 20 %), searched -" in text


def test_tables_without_the_controller_of_the_search_say_so(reported, tables, run):
    write_archive(run / "archive.npz", dataclasses.replace(read_archive(run), policy_sha256="1" * 64))
    controllers, texts = json.loads(tables.read_text())["controllers"], []
    for digest in ("1" * 64, "0" * 64):
        changed(tables, controllers={name: {**about, "sha256": digest} for name, about in controllers.items()})
        texts.append(Page(reported()[0].read_bytes()).text)
    assert ["faultline evaluate" in text for text in texts] == [False, True]


def test_of_several_trainings_the_mean_over_their_seeds_is_shown():
    values, limits = {"base": 0.5, "C-G": 0.6, "C-G@1": 0.8, "C-R@1": None}, {"base": [0.4, 0.6], "C-G": [0.5, 0.7],
                      "C-G@1": [0.7, 0.9], "C-R@1": None}  # fmt: skip
    over = {"mean": 0.7, "interval": None, "values": [0.6, 0.8]}
    measures = ("success", "goal", "reward")
    tables = {
        "controllers": {name: {"policy": name, "sha256": "0"} for name in values}, "terrains": {"near": 4},
        **{measure: {"near": values} for measure in measures},
        "intervals": {measure: {"near": limits} for measure in measures},
        "over_seeds": {measure: {"near": {"C-G": over}} for measure in measures},
    }  # fmt: skip
    kinds = by_kind(tables)
    assert kinds["goal"]["near"] == {"base": 0.5, "C-G (2 seeds)": 0.7, "C-R@1": None}
    assert kinds["intervals"]["goal"]["near"] == {"base": [0.4, 0.6], "C-G (2 seeds)": None, "C-R@1": None}
    assert list(kinds["controllers"]) == ["base", "C-G (2 seeds)", "C-R@1"]
