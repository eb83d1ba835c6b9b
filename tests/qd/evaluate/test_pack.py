"""Packs from end to end: made of a judged run, crossed by any controller, exported; what is refused."""

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.evaluate.evaluate import Evaluate
from qd.evaluate.pack import MakePack, evaluate_pack, make_pack
from qd.evaluate.pack_rates import grouped, over_all, rows_of
from qd.run.judge import Certify, Confirm, certify_run, confirm_run
from qd.run.minimise import Minimise, minimise_run
from qd.show import figures
from qd.show.export import Export, export
from sim.files.command import Interrupted
from tests.qd.evaluate.test_evaluate import Crossings
from tests.qd.searches import found_and_fresh
from tests.qd.stand_in import make_result
from tests.train.results import GOAL, HIT, LATE, result_of

RESULTS = Path(__file__).parents[3] / "results"
OTHER = f"C-G={RESULTS}/anymal/C-G.pt"
HERE = {"device": "cpu", "workers": "1"}


@contextmanager
def judges(cfg):
    """Only C-G crosses bump 4 where it is higher than .1 m."""

    def evaluate(genes, seeds, progress=None):
        fails = (np.abs(genes[:, 4 * 8 + 7]) > 0.4) & ("C-G" not in cfg.policy)
        fails = np.repeat(fails[:, None], cfg.num_replicas, axis=1)
        return make_result(np.ones((*fails.shape, 6)), base_collision=fails)

    yield evaluate


class Crosses:
    """C-G crosses everything, others nothing but terrains whose highest point is below .2 m; counts."""

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
            return result_of([[GOAL if passed else HIT] * cfg.num_replicas for passed in passes])

        yield evaluate


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with fresh episodes, once as it is and once confirmed, certified and with minimal terrains."""
    folder = found_and_fresh(tmp_path_factory.mktemp("made"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "write_figures", lambda folder, archive, metrics: [])
        path = folder / "fresh"
        archive = read_archive(path)
        first = np.flatnonzero(archive.failing)[:2]
        genes = archive.genes.copy()
        genes[first, 4 * 8 : 5 * 8] = (0.0, 0.0, -0.5, 1.0, 1.0, 1.0, 0.0, 0.96)
        write_archive(path / "archive.npz", replace(archive, genes=genes))
        shutil.copytree(path, folder / "judged")
        path = folder / "judged"
        confirm_run(Confirm(run=path, **HERE), open_evaluator=judges)
        certify_run(Certify(run=path, by=(OTHER,), **HERE), open_evaluator=judges)
        named = " ".join(map(str, first))
        minimise_run(Minimise(run=path, elite=named, confirm=True, by=(OTHER,), **HERE), open_evaluator=judges)
    return folder


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A folder to work in, with no results."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def packed(made, crosses=None, **changes):
    values = {"run": made / "judged", "controllers": ("base=shipped", OTHER), "out": Path("pack"), **HERE} | changes
    return make_pack(MakePack(**values), open_evaluator=(crosses or Crosses()).open)


def test_a_pack_from_end_to_end(made, home, capsys):
    crosses, archive = Crosses(), read_archive(made / "judged")
    content = packed(made, crosses)
    assert json.loads(Path("pack/pack.json").read_text()) == json.loads(json.dumps(content))
    assert Path("pack/pack.png").read_bytes().startswith(b"\x89PNG")
    verdicts = [about["verdict"] for about in content["terrains"]]
    minimal = [about for about in content["terrains"] if about["kind"] == "minimal"]
    assert (
        verdicts == sorted(verdicts)
        and verdicts.count("fault") == int((archive.confirmed & archive.certified).sum()) + 2
    )
    assert len(minimal) == 2 and all(about["parts"] == [4] and about["cause"] == "rise" for about in minimal)
    assert {about["cause"] for about in content["terrains"] if about["elite"] == minimal[0]["elite"]} == {"rise"}
    for about in content["terrains"]:
        assert about["searched"]["goal_rate"] < 0.75 and about["certificates"][0]["controller"] == "C-G"
        assert about["rates"]["C-G"]["goal_rate"] == 1.0 and about["rates"]["base"]["valid_episodes"] == 20
    assert content["searched"] == "base" and content["rates"]["C-G"]["goal_rate"] == 1.0
    assert content["rates"]["base"]["failing"] == sum(
        about["rates"]["base"]["goal_rate"] < 0.5 for about in content["terrains"]
    )
    assert {one.num_replicas for one in crosses.opened} == {20} and not any(one.resolved for one in crosses.opened)
    for key in ("command", "commit", "device", "versions", "seed", "date", "robot_sha256", "policy_sha256"):
        assert key in content, key
    count = len(verdicts)
    assert f"of which the pack has {count}, 100 were asked for." in capsys.readouterr().out
    few = packed(made, size=3, out=Path("few"))  # the first of the same
    assert [about["name"] for about in few["terrains"]] == [about["name"] for about in content["terrains"][:3]]


def test_a_stopped_pack_goes_on(made, home):
    with pytest.raises(Interrupted, match=r"what is crossed is kept\. The same command goes on"):
        packed(made, Crosses(stop_after=1))
    assert not Path("pack/pack.json").exists()
    crosses = Crosses()
    packed(made, crosses)
    assert ["C-G" in one.policy for one in crosses.opened] == [True]  # base was crossed before


def test_any_controller_is_tested_on_a_pack(made, home, capsys):
    content = packed(made)
    flags = Evaluate(pack="pack", policy="tests.sim.policies:stand", terrains=5, episodes=2, **HERE)
    report = evaluate_pack(flags, open_evaluator=Crosses().open)
    (file,) = Path("runs").glob("anymal-*-pack.json")
    assert json.loads(file.read_text()) == json.loads(json.dumps(report)) and file.with_suffix(".png").exists()
    rates = [about["rates"]["this"]["goal_rate"] for about in report["terrains"]]
    assert rates == [about["rates"]["base"]["goal_rate"] for about in content["terrains"][:5]]
    assert report["rates"]["failing"] == rates.count(0.0) > 0 and report["rates"]["terrains"] == 5
    assert report["beside"]["C-G"]["goal_rate"] == 1.0 and report["beside"]["base"]["failing"] == rates.count(0.0)
    rows = {one["cause"]: one["failing"] for one in report["by"]["cause"]}
    assert sum(row["this"] for row in rows.values()) == rates.count(0.0) and rows["rise"]["C-G"] == 0
    said = capsys.readouterr().out
    assert f"It fails {rates.count(0.0)} of 5 terrains" in said and "by failure mode" in said and "rise" in said
    assert "Episodes differ from those of the pack's controllers" in said


def test_a_pack_is_exported(made, home):
    content = packed(made, size=2)
    files = export(Export(pack="pack", elite="all", formats=("npz", "xml", "stl"), out=Path("files")))
    names = [about["name"] for about in content["terrains"]]
    assert {file.name for file in files} == {
        "index.json", *(f"{name}.{ending}" for name in names for ending in ("npz", "xml", "stl", "json")),
    }  # fmt: skip
    index = json.loads(Path("files/index.json").read_text())
    assert [one["verdict"] for one in index["elites"]] == ["fault", "fault"] and index["pack"] == "pack"
    with pytest.raises(ValueError, match="holds an export already"):
        export(Export(pack="pack", formats=("npz",), out=Path("files")))
    with pytest.raises(ValueError, match="got --run, --space or --minimal beside --pack"):
        export(Export(pack="pack", run=made / "judged"))


def test_what_is_no_pack_to_be_made_of_is_refused(made, home, tmp_path):
    with pytest.raises(ValueError, match=r"crossed by `faultline confirm`.*run `.*confirm --robot anymal --run"):
        packed(made, run=made / "fresh")
    half = Path(shutil.copytree(made / "fresh", tmp_path / "half"))
    confirm_run(Confirm(run=half, **HERE), open_evaluator=judges)
    with pytest.raises(ValueError, match=r"run `.*certify --robot anymal --run .*half` first"):
        packed(made, run=half)
    one = str(np.flatnonzero(read_archive(half).failing)[0])
    certify_run(Certify(run=half, by=(OTHER,), elite=one, **HERE), open_evaluator=judges)
    with pytest.raises(ValueError, match=r"which says what is a fault, got 1 of them: run `.*certify"):
        packed(made, run=half)
    with pytest.raises(ValueError, match="give that robot or another --run"):
        packed(made, robot="cassie")
    with pytest.raises(ValueError, match="controller C-G does not fit anymal"):
        packed(made, controllers=(f"C-G={RESULTS}/cassie/C-G.pt",))
    assert not Path("pack").exists() and not Path("runs").exists()


def test_what_does_not_go_with_a_pack_is_refused(made, home):
    packed(made, size=1)
    with pytest.raises(ValueError, match="is of anymal, got --robot cassie: give that robot or another --pack"):
        evaluate_pack(Evaluate(pack="pack", robot="cassie", **HERE))
    for flags in ({"policies": ("base=shipped",)}, {"run_dir": Path("x")}, {"split_seed": 1}, {"space": "course"}):
        with pytest.raises(ValueError, match="leave out --policies, --archive, --sets, --split-seed, --run-dir"):
            evaluate_pack(Evaluate(pack="pack", **flags, **HERE))
    with pytest.raises(FileNotFoundError, match="no pack at cassie"):
        evaluate_pack(Evaluate(pack="cassie", **HERE))
    content = json.loads(Path("pack/pack.json").read_text())
    Path("pack/pack.json").write_text(json.dumps(content | {"robot_sha256": "0" * 64}))
    with pytest.raises(ValueError, match="its settings, model or meshes have changed since"):
        evaluate_pack(Evaluate(pack="pack", **HERE))


def test_a_controller_really_crosses_a_pack(made, home):
    packed(made, size=1)
    crossings = Crossings()
    flags = Evaluate(pack="pack", policy="tests.sim.policies:stretch", episodes=2, **HERE)
    report = evaluate_pack(flags, open_evaluator=crossings.open)
    assert crossings.sets == [("tests.sim.policies:stretch", 1)] and not crossings.opened[0].reward
    assert report["rates"]["terrains"] == 1 and report["terrains"][0]["rates"]["this"]["valid_episodes"] == 2
    again = Crossings()
    assert evaluate_pack(flags, open_evaluator=again.open)["rates"] == report["rates"] and again.sets == []


def test_rates_over_a_pack_are_means_with_families_drawn_together():
    abouts = [{"family": family, "verdict": "fault", "mode": 1, "cause": None, "kind": "elite"} for family in (0, 0, 1)]
    rows = rows_of(result_of([[GOAL] * 4, [GOAL] * 4, [HIT, HIT, LATE, LATE]]))
    found = over_all(rows, abouts, 0)
    assert found["goal_rate"] == pytest.approx(2 / 3) and found["success_rate"] == pytest.approx((1 + 1 + 0.5) / 3)
    assert (found["failing"], found["terrains"], found["failing_families"], found["families"]) == (1, 3, 1, 2)
    assert found["goal_interval"] == [0.0, 1.0]  # two families: a quarter of the resamples each has one alone
    (row,) = grouped(abouts, {"this": rows})["mode"]
    assert (row["terrains"], row["failing"]) == (3, {"this": 1})
