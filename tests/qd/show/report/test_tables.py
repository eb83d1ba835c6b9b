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
from qd.show.report.evaluation import fates, most_mended
from qd.show.report.tables import by_kind
from sim.files.atomic import to_json
from sim.files.records import robot_identity
from sim.robots.find import get_robot
from tests.qd.show.report.pages import DOT, Page
from tests.train.results import GOAL, LATE, result_of


@pytest.fixture
def tables(run):
    """Tables of two controllers on four elites, of which the second mends one and breaks another."""
    first, second = ([[GOAL] * 4] * 2 + [[LATE] * 4] * 2), ([[GOAL] * 4, [LATE] * 4, [GOAL] * 4, [LATE] * 4])
    crossed = {
        "generated": {
            who: measure(result_of(outcomes, reward=np.ones((4, 4))), (1.0, 1.0))
            for who, outcomes in (("base", first), ("C-G", second))
        }
    }
    numbers = np.array([3, 5, 7, 9])
    chosen = TerrainSet(name="generated", terrains=np.zeros((4, 64), np.float32), seeds=np.zeros(4, np.uint32),
                        numbers=numbers)  # fmt: skip
    about = {}
    for who in ("base", "C-G"):
        policy = run.parent / f"{who}.pt"
        policy.write_text(who)
        about[who] = {"policy": str(policy), "sha256": hashlib.sha256(who.encode()).hexdigest()}
    robot = get_robot("anymal")
    made = make_tables(crossed, {"generated": chosen}, robot, controllers=about, episodes=4, seed=0)
    archive = {"path": str(run), "elites": 20, "iterations": 4}
    file = run.parent / "results" / "anymal" / "tables.json"
    file.parent.mkdir(parents=True)
    file.with_suffix(".png").write_bytes(DOT)
    file.write_bytes(to_json({**robot_identity(robot), "archive": archive, **made}))
    return file


def changed(file, **changes):
    file.write_bytes(to_json({**json.loads(file.read_text()), **changes}))


def test_tables_say_who_crosses_what(reported, tables):
    out, _ = reported()
    text = Page(out.read_bytes()).text
    assert "base fares worst on generated, held out: 50 % (0 % to 100 %) of its episodes" in text
    assert "generated, held out: base -> C-G 1 1 1 1 4" in text  # mended, still failing, newly broken, fine, compared
    first = text[: text.index("From iteration 1")]
    assert "elites held out of training that base fails and C-G mends 1 of 2" in first
    assert "Of 4 elites held out of training C-G mends 1 of 2 that base fails; newly broken are 1 by C-G." in text
    assert (out.parent / "report-figures" / "tables.png").read_bytes() == DOT


def test_certified_terrains_stand_apart(reported, tables):
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


def test_tables_of_another_archive_are_not_told_of_in_the_first_chapter(reported, tables):
    changed(tables, archive={"path": "gone", "elites": 21, "iterations": 4})
    text = Page(reported()[0].read_bytes()).text
    assert "held out of training" not in text[: text.index("From iteration 1")]
    assert "Of 4 elites held out of training C-G mends 1 of 2" in text


def test_tables_without_the_controller_of_the_search_say_so(reported, tables, run):
    words = "None of these controllers is the one"
    write_archive(run / "archive.npz", dataclasses.replace(read_archive(run), policy_sha256="1" * 64))
    controllers = json.loads(tables.read_text())["controllers"]
    for digest, told in (("1" * 64, False), ("0" * 64, True)):
        changed(tables, controllers={who: {**about, "sha256": digest} for who, about in controllers.items()})
        assert (words in Page(reported()[0].read_bytes()).text) == told


def test_damaged_tables_are_refused(reported, run, tables):
    changed(tables, goal=3)
    with pytest.raises(ValueError, match="goal"):
        reported()
    assert not (run / "report.html").exists()


def fate(**terrains):
    """What became of terrains by number."""
    kinds = {kind: terrains.get(kind, []) for kind in ("mended", "still_failing", "newly_broken", "fine")}
    compared = sum(map(len, kinds.values()))
    counted = {kind: {"count": len(of), "terrains": of, "share": 0.5, "interval": None} for kind, of in kinds.items()}
    return {"compared": compared, **counted, "gain": {}}


def test_what_became_of_terrains_by_hand():
    generated = {"base -> C-G": fate(mended=[3, 5, 7], still_failing=[9]), "base -> C-X": fate(mended=[3, 5, 7, 9]),
                 "C-G -> C-X": fate(mended=[9], newly_broken=[3])}  # fmt: skip
    made = {"controllers": {who: {} for who in ("base", "C-G", "C-X")}, "differences": {"generated": generated}}
    assert fates(made) == (
        "Of 4 elites held out of training C-G mends 3 of 4 that base fails, C-X mends 4 of 4; newly broken are none."
    )
    assert most_mended(made) == ("elites held out of training that base fails and C-X mends", "4 of 4")


def test_of_several_trainings_the_mean_over_their_seeds_is_shown():
    values, limits = {"base": 0.5, "C-G": 0.6, "C-G@1": 0.8, "C-R@1": None}, {"base": [0.4, 0.6], "C-G": [0.5, 0.7],
                      "C-G@1": [0.7, 0.9], "C-R@1": None}  # fmt: skip
    over = {"mean": 0.7, "interval": None, "values": [0.6, 0.8]}
    measures = ("success", "goal", "reward")
    tables = {
        "controllers": {who: {"policy": who, "sha256": "0"} for who in values}, "terrains": {"near": 4},
        **{measure: {"near": values} for measure in measures},
        "intervals": {measure: {"near": limits} for measure in measures},
        "over_seeds": {measure: {"near": {"C-G": over}} for measure in measures},
    }  # fmt: skip
    kinds = by_kind(tables)
    assert kinds["goal"]["near"] == {"base": 0.5, "C-G (2 seeds)": 0.7, "C-R@1": None}
    assert kinds["intervals"]["goal"]["near"] == {"base": [0.4, 0.6], "C-G (2 seeds)": None, "C-R@1": None}
    assert list(kinds["controllers"]) == ["base", "C-G (2 seeds)", "C-R@1"]
