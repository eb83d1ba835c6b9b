"""Packs made of a judged run, from end to end over the stand-in."""

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.evaluate.make_pack import make_pack
from qd.evaluate.pack import read_pack
from qd.judge import judge
from qd.minimise import minimise
from qd.workers.evaluator import Compute
from sim.robots.find import get_robot
from tests.qd.evaluate.test_pack import Crosser
from tests.qd.searches import found_and_fresh, without_figures
from tests.qd.stand_in import Stub, make_result

RESULTS = Path(__file__).parents[3] / "results"
TUNED = {"C-G": f"{RESULTS}/anymal/C-G.pt"}
CPU = Compute(workers="1")
pytestmark = pytest.mark.slow


@contextmanager
def judges(cfg):
    """Only C-G crosses bump 4 if it is higher than .1 m."""

    def evaluate(genes, seeds, progress=None):
        fails = (np.abs(genes[:, 4 * 8 + 7]) > 0.4) & ("C-G" not in cfg.policy)
        fails = np.repeat(fails[:, None], cfg.num_replicas, axis=1)
        return make_result(np.ones((*fails.shape, 6)), base_collision=fails)

    yield Stub(evaluate)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with fresh episodes, once as it is and once judged and with two minimal terrains."""
    folder = found_and_fresh(tmp_path_factory.mktemp("made"))
    with pytest.MonkeyPatch.context() as patch:
        without_figures(patch)
        path = folder / "fresh"
        archive = read_archive(path)
        first = np.flatnonzero(archive.failing)[:2]
        genes = archive.genes.copy()
        genes[first, 4 * 8 : 5 * 8] = (0.0, 0.0, -0.5, 1.0, 1.0, 1.0, 0.0, 0.96)
        write_archive(path / "archive.npz", replace(archive, genes=genes))
        path = Path(shutil.copytree(path, folder / "judged"))
        given = {"compute": CPU, "certifiers": TUNED, "open_evaluator": judges}
        judge(path, stages=("resolved", "others"), **given)
        minimise(path, elite=" ".join(map(str, first)), judged=True, **given)
    return folder


@pytest.fixture
def pack(made, tmp_path, monkeypatch):
    """Makes packs in a folder to work in, without results."""
    monkeypatch.chdir(tmp_path)

    def make(crosser=None, run="judged", controllers=None, **changes):
        named = {"base": str(get_robot("anymal").policy_file), **TUNED} if controllers is None else controllers
        opened = (crosser or Crosser()).open
        return make_pack(made / run, named, compute=CPU, open_evaluator=opened, **{"out": Path("pack"), **changes})

    return make


def test_a_pack_from_end_to_end(made, pack):
    crosser, archive = Crosser(), read_archive(made / "judged")
    content = pack(crosser)
    assert json.loads(Path("pack/pack.json").read_text()) == json.loads(json.dumps(content))
    assert Path("pack/pack.png").read_bytes().startswith(b"\x89PNG")
    verdicts = [about["verdict"] for about in content["terrains"]]
    minimal = [about for about in content["terrains"] if about["kind"] == "minimal"]
    faults = int((archive.confirmed & archive.certified).sum())
    assert verdicts == sorted(verdicts) and verdicts.count("fault") == faults + 2
    assert len(minimal) == 2 and all(about["parts"] == [4] and about["cause"] == "rise" for about in minimal)
    assert {about["cause"] for about in content["terrains"] if about["elite"] == minimal[0]["elite"]} == {"rise"}
    for about in content["terrains"]:
        assert about["searched"]["goal_rate"] < 0.75 and about["certificates"][0]["controller"] == "C-G"
        assert about["rates"]["C-G"]["goal_rate"] == 1.0 and about["rates"]["base"]["valid_episodes"] == 20
    assert content["searched"] == "base" and content["rates"]["C-G"]["goal_rate"] == 1.0
    failing = sum(about["rates"]["base"]["goal_rate"] < 0.5 for about in content["terrains"])
    assert content["rates"]["base"]["failing"] == failing
    assert {cfg.num_replicas for cfg in crosser.opened} == {20} and not any(cfg.resolved for cfg in crosser.opened)
    for key in ("command", "commit", "sources_sha256", "device", "versions", "seed", "date", "robot_sha256"):
        assert key in content, key
    few = pack(size=3, out=Path("few"))  # the first of the same
    assert [about["name"] for about in few["terrains"]] == [about["name"] for about in content["terrains"][:3]]
    np.testing.assert_array_equal(read_pack(Path("few")).heights, read_pack(Path("pack")).heights[:3])


def test_a_stopped_pack_goes_on(pack):
    with pytest.raises(KeyboardInterrupt):
        pack(Crosser(stop_after=1), size=4)
    assert not Path("pack/pack.json").exists()
    crosser = Crosser()
    pack(crosser, size=4)
    assert ["C-G" in cfg.policy for cfg in crosser.opened] == [True]  # base was crossed before


def test_the_searched_controller_is_always_among_those_that_cross(pack):
    content = pack(size=2, controllers=TUNED)
    assert list(content["controllers"]) == ["searched", "C-G"] and content["searched"] == "searched"
    assert list(pack(size=2, controllers={}, out=Path("usual"))["controllers"]) == ["base"]  # no results here


def test_what_is_no_pack_to_be_made_of_is_refused(made, pack, tmp_path):
    with pytest.raises(ValueError, match="judge"):
        pack(run="fresh")
    half = Path(shutil.copytree(made / "fresh", tmp_path / "half"))
    judge(half, compute=CPU, stages=("resolved",), open_evaluator=judges)  # nobody else crossed them
    with pytest.raises(ValueError, match="judge"):
        pack(run=half)
    with pytest.raises(ValueError, match="cassie"):
        pack(robot="cassie")
    with pytest.raises(ValueError, match="anymal"):
        pack(controllers={"C-G": f"{RESULTS}/cassie/C-G.pt"})
    assert not Path("pack").exists() and not Path("runs").exists()
