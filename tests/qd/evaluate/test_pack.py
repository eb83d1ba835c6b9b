"""Packs: what one takes, in which order, its files, and any controller tested on it."""

import json
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from qd.commands import Evaluate
from qd.evaluate.make_pack import Candidate, choose, write_terrains
from qd.evaluate.pack import HEIGHT_UNIT_M, evaluate_pack, grouped, over_all, pack_folder, read_pack, rounded, rows_of
from qd.workers.evaluator import Compute
from sim.files.command import run_command
from sim.files.records import identity
from sim.terrain import NUM_COLS, NUM_ROWS
from tests.qd.stand_in import Stub
from tests.train.results import BAD, GOAL, HIT, LATE, result_of

CPU = Compute(workers="1")
NAMES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")


class Crosser:
    """C-G crosses everything, others nothing but terrains whose highest point is below .2 m; may be stopped."""

    def __init__(self, stop_after=1000):
        self.opened, self.stop_after = [], stop_after

    @contextmanager
    def open(self, cfg):
        if len(self.opened) == self.stop_after:
            raise KeyboardInterrupt
        self.opened.append(cfg)

        def evaluate(heights, seeds, progress=None):
            assert heights.shape[1:] == (161, 321) and len(seeds) == len(heights)
            passes = (np.abs(heights).max(axis=(1, 2)) < 0.2) | ("C-G" in cfg.policy)
            return result_of([[GOAL if passed else HIT] * cfg.num_replicas for passed in passes], names=NAMES)

        yield Stub(evaluate)


def candidate(elite, *, fault=True, family=0, mode=1, kind="elite", rate=0.0):
    about = {
        "name": f"elite-{elite}", "elite": elite, "kind": kind, "verdict": "fault" if fault else "near-fault",
        "family": family, "mode": mode, "cause": None, "searched": {"goal_rate": rate},
    }  # fmt: skip
    return Candidate(np.full(64, elite / 100, np.float32), about)


@pytest.mark.parametrize(
    ("candidates", "expected"),
    [
        ([candidate(0, fault=False, rate=0.0), candidate(1, rate=0.4)], [1, 0]),  # faults first
        ([candidate(0), candidate(1), candidate(2, family=1, rate=0.4)], [0, 2, 1]),  # one family before two
        ([candidate(0), candidate(1, family=1), candidate(2, family=2, mode=2, rate=0.4)], [0, 2, 1]),  # modes
        ([candidate(0), candidate(1, family=1), candidate(2, family=2, kind="minimal", rate=0.4)], [0, 2, 1]),  # kinds
        ([candidate(0, rate=0.4), candidate(1, family=1, rate=0.1)], [1, 0]),  # the lowest goal rate
    ],
)
def test_what_comes_next(candidates, expected):
    for size in (9, 1):  # each beginning of a pack is one
        assert [chosen.about["elite"] for chosen in choose(candidates, size)] == expected[:size]


@pytest.fixture
def pack(tmp_path, anymal, monkeypatch):
    """Three terrains: random heights of both signs, flat ground, and a step of 0.5 m."""
    monkeypatch.chdir(tmp_path)
    heights = np.zeros((3, NUM_ROWS, NUM_COLS))
    heights[0] = np.random.default_rng(0).uniform(-4.0, 4.0, heights[0].shape)
    heights[2, :, 150:] = 0.5
    Path("pack").mkdir()
    chosen = [candidate(3), candidate(7, fault=False), candidate(9, family=1, mode=2)]
    digest = write_terrains(Path("pack"), rounded(heights), chosen, {"more": np.arange(3)})
    rows = rows_of(result_of([[HIT] * 4, [GOAL] * 4, [GOAL, GOAL, GOAL, HIT]]))
    abouts = [terrain.about | {"rates": {"base": row}} for terrain, row in zip(chosen, rows, strict=True)]
    content = {
        **identity(anymal, anymal.policy_file), "seed": 0, "episodes": 4, "searched": "base", "terrains": abouts,
        "modes": [{"mode": mode, "ending": "base collision", "marked_by": "vel_x"} for mode in (1, 2)],
        "rates": {"base": over_all(rows, abouts, 0)}, "terrains_sha256": digest,
    }  # fmt: skip
    Path("pack/pack.json").write_text(json.dumps(content))
    return heights


def test_a_pack_is_read_as_it_was_written(pack):
    found = read_pack(pack_folder("pack"))
    assert len(found) == 3 and found.terrains[1]["verdict"] == "near-fault"
    np.testing.assert_array_equal(found.heights, rounded(pack))
    assert np.abs(found.heights - pack).max() <= HEIGHT_UNIT_M / 2 + 1e-6
    assert found.genes[:, 0].tolist() == pytest.approx([0.03, 0.07, 0.09])
    with np.load("pack/pack.npz") as content:  # any program may read it
        heights = np.cumsum(np.cumsum(content["twists"], axis=1), axis=2) * content["height_unit_m"]
        np.testing.assert_array_equal(heights.astype(np.float32), found.heights)
        assert content["name"].tolist() == ["elite-3", "elite-7", "elite-9"] and content["more"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("file", ["pack.json", "pack.npz"])
def test_a_damaged_pack_is_refused(pack, file):
    path = Path("pack") / file
    data = path.read_bytes()
    cut = data[:-9] if file == "pack.json" else data[: len(data) // 2] + b"?" + data[len(data) // 2 + 1 :]
    path.write_bytes(cut)
    with pytest.raises(ValueError, match="pack"):
        read_pack(Path("pack"))


def test_terrains_of_another_making_are_refused(pack):
    chosen = [candidate(elite) for elite in (3, 7, 9)]
    write_terrains(Path("pack"), rounded(pack[::-1]), chosen, {})
    with pytest.raises(ValueError, match=r"pack\.npz"):
        read_pack(Path("pack"))


@pytest.mark.parametrize("key", ["terrains", "rates", "terrains_sha256", "robot_sha256"])
def test_a_pack_without_something_is_refused(pack, key):
    content = json.loads(Path("pack/pack.json").read_text())
    del content[key]
    Path("pack/pack.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=key):
        read_pack(Path("pack"))


def test_a_published_pack_is_found_by_the_robots_name(pack, monkeypatch):
    Path("results/anymal").mkdir(parents=True)
    Path("pack").rename("results/anymal/pack")
    assert pack_folder("anymal") == Path("results/anymal/pack")
    with pytest.raises(FileNotFoundError, match="cassie"):
        pack_folder("cassie")


def test_rates_over_a_pack_are_means_with_families_drawn_together():
    abouts = [{"family": family, "verdict": "fault", "mode": 1, "cause": None, "kind": "elite"} for family in (0, 0, 1)]
    rows = rows_of(result_of([[GOAL] * 4, [GOAL] * 4, [HIT, HIT, LATE, LATE]]))
    rates = over_all(rows, abouts, 0)
    assert rates["goal_rate"] == pytest.approx(2 / 3) and rates["success_rate"] == pytest.approx((1 + 1 + 0.5) / 3)
    assert (rates["failing"], rates["terrains"], rates["failing_families"], rates["families"]) == (1, 3, 1, 2)
    assert rates["goal_interval"] == [0.0, 1.0]  # two families: a quarter of the resamples each has one alone
    (line,) = grouped(abouts, {"this": rows})["mode"]
    assert (line["terrains"], line["failing"]) == (3, {"this": 1})
    # Nine of one family that all arrive, and one that does not: resamples of terrains hardly ever have 3 of that.
    many = [{**abouts[0], "family": int(place == 9)} for place in range(10)]
    wide = over_all(rows_of(result_of([[GOAL] * 4] * 9 + [[HIT] * 4])), many, 0)
    assert wide["goal_rate"] == pytest.approx(0.9) and wide["goal_interval"] == [0.0, 1.0]
    # An invalid terrain is in no rate.
    rows = rows_of(result_of([[GOAL] * 4, [BAD] * 4, [HIT] * 4]))
    rates = over_all(rows, abouts, 0)
    assert (rows[1]["goal_rate"], rates["goal_rate"], rates["terrains"], rates["failing"]) == (None, 0.5, 2, 1)


def test_any_controller_is_tested_on_a_pack(pack, anymal, capsys):
    crosser = Crosser()
    given = {"compute": CPU, "terrains": 2, "episodes": 2, "open_evaluator": crosser.open}
    found = read_pack(Path("pack"))
    report = evaluate_pack(found, anymal, "tests.sim.policies:stand", **given)
    (file,) = Path("runs").glob("anymal-*-pack.json")
    assert json.loads(file.read_text()) == json.loads(json.dumps(report)) and file.with_suffix(".png").exists()
    # It fails the first terrain, which is 4 m high, and crosses the flat one.
    assert [about["rates"]["this"]["goal_rate"] for about in report["terrains"]] == [0.0, 1.0]
    assert (report["rates"]["failing"], report["rates"]["terrains"]) == (1, 2)
    assert report["beside"]["base"]["goal_rate"] == 0.5 and report["pack"]["terrains"] == 3
    assert {line["verdict"]: line["failing"]["this"] for line in report["by"]["verdict"]} == {
        "fault": 1,
        "near-fault": 0,
    }
    shown = capsys.readouterr().out
    assert "1 of 2" in shown and "1: base collision, vel_x" in shown
    assert "Episodes differ" in shown  # 2, where the pack's controllers had 4
    assert not crosser.opened[0].reward and not crosser.opened[0].resolved
    again = Crosser()
    evaluate_pack(found, anymal, "tests.sim.policies:stand", **{**given, "open_evaluator": again.open})
    assert not again.opened
    all_of_it = evaluate_pack(found, anymal, "tests.sim.policies:stand", **{**given, "terrains": 9})
    assert all_of_it["rates"]["terrains"] == 3


def test_a_pack_of_the_robot_before_it_changed_is_refused(pack, capsys):
    content = json.loads(Path("pack/pack.json").read_text())
    Path("pack/pack.json").write_text(json.dumps(content | {"robot_sha256": "0" * 64}))
    for flags in ([], ["--robot", "cassie"]):
        assert run_command(Evaluate, ["--pack", "pack", "--device", "cpu", *flags], name="evaluate") == 2
        assert "pack/pack.json is of" in capsys.readouterr().err
