"""The page's chapters about an evaluation: tables by kind of controller, and terrains before and after fine-tuning."""

import dataclasses
import hashlib
import json
import re

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.evaluate.measures import measure
from qd.evaluate.sets import TerrainSet
from qd.evaluate.tables import make_tables, read_tables
from qd.show.report.evaluation import fates, most_mended
from qd.show.report.tables import by_kind, changes_of
from sim.files.atomic import to_json
from sim.files.records import robot_identity
from sim.robots.find import get_robot
from tests.qd.show.report.test_report import DOT, Page, make_run, reporter
from tests.train.results import GOAL, LATE, result_of


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path)


@pytest.fixture
def reported(run, monkeypatch):
    """Makes reports whose figures are a dot, without rendered pictures."""
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    monkeypatch.setattr("sim.files.figures._png_of", lambda figure: DOT)
    return reporter(run, monkeypatch)


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
    file = run.parent / "tables.json"
    file.with_suffix(".png").write_bytes(DOT)
    file.write_bytes(to_json({**robot_identity(robot), "archive": archive, **made}))
    return file


def changed(file, **changes):
    file.write_bytes(to_json({**json.loads(file.read_text()), **changes}))


def test_tables_and_the_same_terrain_before_and_after(reported, tables):
    out, crossed = reported(tables=tables)
    text = Page(out.read_bytes()).text
    worst = "base fares worst on generated, held out: 50 % (0 % to 100 %) of its episodes reach the goal; C-G 50 %"
    assert worst in text and "base trained further: C-G on hand-crafted ones and elites." in text
    assert "generated, held out: base -> C-G 1 1 1 1 4" in text  # mended, still failing, newly broken, fine, compared
    first = text[: text.index("From iteration 1")]
    assert "elites held out of training that base fails and C-G mends 1 of 2" in first
    assert "Of 4 elites held out of training C-G mends 1 of 2 that base fails; newly broken are 1 by C-G." in text
    for number, kind in ((7, "mended by"), (5, "newly broken by"), (9, "still failing with")):
        assert f"Elite {number}: {kind} C-G" in text
    one = "1 of 4 (25%, 5 to 70%) reach the goal (base collision 1, out of time 1, left the terrain 1; the middle"
    assert f"Mended by the tables. Crossed again from the same starts: with base {one}" in text
    assert f"numbered as in {out.parent.name}: the worst of those mended" in text
    assert f"faultline view --robot anymal --run {out.parent.name} --elite 7 --policies base=base.pt C-G=" in text
    assert [label for label in crossed if "with" in label] == [  # of one controller after the other
        f"elite {number} with {who}" for who in ("base", "C-G") for number in (7, 5, 9)
    ]
    assert (out.parent / "report-figures" / "change-7.png").exists()
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
    text = Page(reported(tables=tables)[0].read_bytes()).text
    assert "generated, held out (2 certified): goal reached 10 % (0 % to 20 %), searched -" in text
    changed(tables, certified_goal={"generated": {"base": 0.1}})
    with pytest.raises(ValueError, match="certified_goal"):
        read_tables(tables, get_robot("anymal"))


def test_validation_tables_are_no_report(tables):
    changed(tables, part="validation")
    with pytest.raises(ValueError, match="validation"):
        read_tables(tables, get_robot("anymal"))


def test_published_tables_are_taken_by_themselves(reported, tables):
    there = tables.parent / "results" / "anymal"
    there.mkdir(parents=True)
    tables.rename(there / "tables.json")
    assert "2 controllers on 1 set of terrains (generated, held out: 4)" in Page(reported()[0].read_bytes()).text


def test_tables_of_another_archive_are_not_told_of_in_the_first_chapter(reported, tables):
    changed(tables, archive={"path": "gone", "elites": 21, "iterations": 4})
    text = Page(reported(tables=tables)[0].read_bytes()).text
    assert "held out of training" not in text[: text.index("From iteration 1")]
    assert "Of 4 elites held out of training C-G mends 1 of 2" in text


def test_tables_without_the_controller_of_the_search_say_so(reported, tables, run):
    words = "None of these controllers is the one whose archive this page is about."
    searched = "1" * 64
    write_archive(run / "archive.npz", dataclasses.replace(read_archive(run), policy_sha256=searched))
    controllers = json.loads(tables.read_text())["controllers"]
    changed(tables, controllers={who: {**about, "sha256": searched} for who, about in controllers.items()})
    assert words not in Page(reported(tables=tables)[0].read_bytes()).text
    changed(tables, controllers={who: {**about, "sha256": "0" * 64} for who, about in controllers.items()})
    assert words in Page(reported(tables=tables)[0].read_bytes()).text


def test_tables_of_the_robot_before_it_changed_are_refused(tables):
    changed(tables, robot_sha256="0" * 64)
    with pytest.raises(ValueError, match=r"robot 'anymal' as it was.*000000000000"):
        read_tables(tables, get_robot("anymal"))


def test_controllers_and_archive_are_found_beside_the_tables_by_what_they_are(tables, run):
    robot = get_robot("anymal")
    shipped = hashlib.sha256(robot.policy_file.read_bytes()).hexdigest()
    tuned = hashlib.sha256(b"C-G").hexdigest()
    far = "/another/machine/policy.pt"
    about = {"path": "/another/machine/archive", "elites": 20, "iterations": 4}
    controllers = {"base": {"policy": far, "sha256": shipped}, "C-G": {"policy": far, "sha256": tuned}}
    changed(tables, controllers=controllers, archive=about)
    with pytest.raises(ValueError, match="The archive of the tables cannot"):
        changes_of(read_tables(tables, robot), tables, robot)
    run.rename(tables.parent / "archive")
    found = changes_of(read_tables(tables, robot), tables, robot)
    assert found.policies == {"base": "shipped", "C-G": str(tables.parent / "C-G.pt")}
    assert found.run == tables.parent / "archive" and len(found.archive) == 20
    (tables.parent / "C-G.pt").write_text("another one")
    with pytest.raises(ValueError, match="Controller C-G of the tables is not at /another/machine/policy"):
        changes_of(read_tables(tables, robot), tables, robot)


def fate(**terrains):
    """What became of terrains by number."""
    kinds = {kind: terrains.get(kind, []) for kind in ("mended", "still_failing", "newly_broken", "fine")}
    compared = sum(map(len, kinds.values()))
    counted = {kind: {"count": len(of), "terrains": of, "share": 0.5, "interval": None} for kind, of in kinds.items()}
    return {"compared": compared, **counted, "gain": {}}


def test_the_controller_that_mends_most_among_those_that_are_there_is_shown(tables):
    about = json.loads(tables.read_text())["controllers"]
    controllers = {**about, "C-X": {"policy": "gone.pt", "sha256": "0"}}
    generated = {"base -> C-G": fate(mended=[3, 5, 7], still_failing=[9]), "base -> C-X": fate(mended=[3, 5, 7, 9]),
                 "C-G -> C-X": fate(mended=[9], newly_broken=[3])}  # fmt: skip
    far = {"base -> C-G": fate(mended=[7], still_failing=[9])}
    changed(tables, controllers=controllers, differences={"generated": generated, "generated_far": far})
    made = json.loads(tables.read_text())
    found = changes_of(made, tables, get_robot("anymal"))
    assert [(change.kind, change.number, change.far) for change in found.chosen] == [
        ("mended", 3, False), ("mended", 7, True), ("still failing", 9, True)
    ]  # fmt: skip
    assert {change.after for change in found.chosen} == {"C-G"}
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"controllers": {w: {"policy": "gone.pt", "sha256": "0"} for w in ("base", "C-G")}},
            "base of the tables is not",
        ),
        (
            {"controllers": {w: {"policy": "tests.sim.policies:stand", "sha256": None} for w in ("base", "C-G")}},
            "base of the tables is code, tests.sim.policies:stand, and is not run",
        ),
        ({"archive": {"path": "gone", "elites": 20, "iterations": 4}}, "The archive of the tables cannot be read"),
        ({"archive": None}, "The archive of the tables cannot be read"),
        ({"differences": {"generated": {}}}, "No generated terrain of the tables is mended"),
    ],
)
def test_without_what_they_need_terrains_before_and_after_are_left_out(reported, tables, changes, reason):
    changed(tables, **changes)
    out, crossed = reported(tables=tables)
    assert reason in Page(out.read_bytes()).text
    assert not any("with" in label for label in crossed)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "cassie"}, "cassie"),
        ({"controllers": {"base": "x.pt", "C-G": "y.pt"}}, "controllers"),
        ({"differences": {"generated": {"base -> C-G": {"compared": 4, "mended": {"count": 1}}}}}, "differences"),
        ({"goal": {}}, "goal"),
        ({"goal": {"generated": {"base": "x", "C-G": 1.0}}}, "goal"),
        ({"goal": {"generated": {"base": 1.0}}}, "goal"),
        ({"goal": {"<b>": {"base": 1.0, "C-G": 1.0}}}, "goal"),
        ({"intervals": {}}, "intervals"),
        ({"over_seeds": {"goal": {"generated": {"C-G": 1.0}}}}, "over_seeds"),
        ({"over_seeds": {"goal": {"generated": {"C-G": {"mean": "<b>", "interval": None}}}}}, "over_seeds"),
    ],
)
def test_tables_that_are_none_are_refused(reported, run, tables, changes, message):
    changed(tables, **changes)
    with pytest.raises(ValueError, match=re.escape(message)):
        reported(tables=tables)
    assert not (run / "report.html").exists()
