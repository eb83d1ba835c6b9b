"""The search for certified failures over the stand-in: who is asked what, what it leaves, and what a kill costs."""

import dataclasses
import json
from contextlib import contextmanager

import numpy as np
import pytest

from qd.archive import read_archive
from qd.gate import Gate, groups_behind, open_gate, rates_of
from qd.search import run_search
from qd.show import figures
from qd.workers.evaluator import EvaluatorError, Pipeline, open_evaluator
from tests.qd import crossers, stand_in
from tests.qd.searches import CFG, make_job, rows_of

CERTIFIERS = {"C-G": "certifier", "S": "weaker certifier"}
GATED = {"certified_by": ("C-G=certifier", "S=weaker certifier"), "certifier_sha256": ("a" * 64, "b" * 64)}
GATED |= {"certify_episodes": 5, "iterations": 4, "reevaluate_every": 3}
SCHEDULER = dataclasses.replace(CFG.scheduler, emitters=5, batch_size=6, method="cma_mae+map_elites")


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    monkeypatch.setattr(figures, "write_figures", lambda *_: [])


def cross(policy, genes, seeds, num_replicas):
    """The controller fails where genes 0 to 9 are high on average; a certifier fails some of these terrains too."""
    result = stand_in.evaluate(genes, seeds, num_replicas)
    limit = {"certifier": 0.3, "weaker certifier": 0.1}.get(policy, 0.0)
    fails = np.broadcast_to((genes[:, :10].mean(axis=1) > limit)[:, None], result.invalid.shape)
    return dataclasses.replace(result, base_collision=fails, reached_goal=~fails)


class Lots(Pipeline):
    """Crosses lot by lot; is lost when so many were taken."""

    def __init__(self, cfg, left=10_000):
        super().__init__(cfg.num_terrains)
        self.cfg, self.left, self.lots, self.most = cfg, left, [], 0

    def put(self, terrains, seeds):
        self.lots.append((terrains, seeds))
        self.most = max(self.most, len(self.lots))
        assert sum(len(genes) for genes, _ in self.lots) <= self.num_terrains

    def take(self, progress=None):
        self.left -= 1
        if self.left < 0:
            raise EvaluatorError("a worker process died")
        return cross(self.cfg.policy, *self.lots.pop(0), self.cfg.num_replicas)

    def clear(self):
        self.lots.clear()


def opening(opened=None, lost=None):
    """Opens pipelines; the one whose policy is named in ``lost`` is lost after so many lots."""

    @contextmanager
    def open_lots(cfg):
        pipeline = Lots(cfg, (lost or {}).get(cfg.policy, 10_000))
        (opened if opened is not None else []).append(pipeline)
        yield pipeline

    return open_lots


def search(path, *, groups=3, opened=None, lost=None, open_with=None, certifiers=CERTIFIERS, **changes):
    settings = {**GATED, "scheduler": dataclasses.replace(SCHEDULER, groups=groups), **changes}
    job = make_job(path, **{**settings, "resumes": (path / "config.json").exists()})
    job = dataclasses.replace(job, certifiers=certifiers)
    return run_search(job, open_evaluator=open_with or opening(opened, lost))


class Crosser(crossers.Crosser):
    def evaluate(self, terrains, seeds, *, progress=None):
        return cross(self.cfg.policy, terrains, seeds, self.cfg.num_replicas)


def by_processes(cfg):
    return open_evaluator(dataclasses.replace(cfg, workers="2"), build=Crosser)


def test_certifiers_cross_what_the_controller_does_not(tmp_path, capsys):
    archive = search(tmp_path / "run")
    own = archive.certificates
    assert own is not None and own.certifiers == ("C-G", "S") and own.certifier_sha256 == ("a" * 64, "b" * 64)
    high = archive.genes[:, :10].mean(axis=1)
    assert np.array_equal(np.isnan(own.goal_rate), np.stack([high <= 0.0] * 2, axis=1))
    assert np.array_equal(own.certified, (high > 0.0) & (high <= 0.3))
    assert own.certified.any() and (high > 0.3).any() and (high <= 0.0).any()
    numbers, rows = json.loads((tmp_path / "run/archive.json").read_text()), rows_of(tmp_path / "run")
    assert [row["episodes"] for row in rows] == [30 * 4] * 4  # 30 terrains, 4 episodes each
    by_certifiers = [row["certifier_episodes"] for row in rows]
    assert all(count > 0 and count % (2 * 5) == 0 for count in by_certifiers)  # two certifiers, 5 episodes each
    assert numbers["controller_episodes"] == 4 * 120 and numbers["certifier_episodes"] == sum(by_certifiers)
    assert numbers["episodes"] == 4 * 120 + sum(by_certifiers)
    assert rows[-1]["certified_elites"] == numbers["certified_in_search"]["elites"] == own.certified.sum()
    assert numbers["certified_in_search"]["certifiers"] == {"C-G": "a" * 64, "S": "b" * 64}
    # what elites are worth is told without the gate
    assert numbers["qd_score"] == pytest.approx((archive.fitness + 20.0).sum())
    assert np.allclose(archive.fitness, archive.penalty_mean.sum(1) - archive.penalty_std.sum(1)
                       - 2.0 * np.where(archive.collision_rate > 0, 1 - archive.collision_rate, 0.0))  # fmt: skip
    told = capsys.readouterr().out
    assert f"{own.certified.sum()} of {len(archive)} elites were certified in the search" in told
    assert "C-G, S cross it 5 times each" in told


def test_certificates_come_back_from_the_file_with_their_elites(tmp_path):
    archive = search(tmp_path / "run")
    back = read_archive(tmp_path / "run")
    assert np.array_equal(back.certificates.goal_rate, archive.certificates.goal_rate, equal_nan=True)
    assert back.certificates.certifiers == ("C-G", "S")
    turned = back.rows(np.array([2, 0]))
    assert np.array_equal(turned.certificates.goal_rate, back.certificates.goal_rate[[2, 0]], equal_nan=True)
    file = tmp_path / "run/archive.npz"
    with np.load(file) as arrays:
        content = dict(arrays)
    for changes in (
        {"search_certifier_goal_rate": np.full(back.certificates.goal_rate.shape, 2.0)},
        {"search_certifiers": np.array(["C-G"])},
        {"search_certifier_sha256": np.array(["a"])},
    ):
        np.savez(file, **{**content, **changes})
        with pytest.raises(ValueError, match="search_certifier_goal_rate must"):
            read_archive(file)
    del content["search_certifiers"]
    np.savez(file, **content)
    with pytest.raises(ValueError, match="search_certifiers"):
        read_archive(file)


@pytest.mark.slow
@pytest.mark.parametrize("groups", [1, 2, 4, 5])
def test_lost_at_any_lot_it_goes_on_as_if_it_had_not_been(tmp_path, groups):
    """Four groups and more leave one with the certifiers while the next is crossed."""
    whole = tmp_path / "whole"
    search(whole, groups=groups)
    expected = (whole / "archive.npz").read_bytes(), rows_of(whole)
    for policy, lots in (("p", groups + 1), ("certifier", groups + 1), ("weaker certifier", 2 * groups - 1)):
        path = tmp_path / f"{policy}-{lots}"
        with pytest.raises(EvaluatorError, match="a worker process died"):
            search(path, groups=groups, lost={policy: lots})
        search(path, groups=groups)
        assert ((path / "archive.npz").read_bytes(), rows_of(path)) == expected, (policy, lots)


@pytest.mark.slow
def test_who_crosses_changes_nothing(tmp_path):
    search(tmp_path / "whole", groups=4, iterations=2)
    search(tmp_path / "pieces", groups=4, iterations=1)
    search(tmp_path / "pieces", groups=4, iterations=2, open_with=by_processes)
    assert (tmp_path / "whole/archive.npz").read_bytes() == (tmp_path / "pieces/archive.npz").read_bytes()


def test_lots_of_certifiers_wait_behind_each_other_and_robots_follow_from_their_share(tmp_path):
    opened = []
    search(tmp_path / "run", groups=4, opened=opened)
    controller, certifier = opened[:2]
    assert groups_behind(4) == 1 and certifier.most == 2 and controller.most == 4
    # two lots of at most two of the five emitters x 6 terrains, of which half are reckoned to fail
    assert certifier.cfg.num_terrains == 24 and certifier.cfg.num_replicas == 5
    robots = controller.cfg.envs_of_worker * controller.cfg.num_workers
    assert certifier.cfg.num_envs == round(0.5 * 24 * 5 / (30 * 4) * robots)
    assert [groups_behind(count) for count in (1, 2, 3, 4, 8)] == [0, 0, 0, 1, 3]


def test_without_certifiers_there_is_no_gate(tmp_path):
    opened = []
    archive = search(tmp_path / "run", opened=opened, certifiers={}, certified_by=(), certifier_sha256=())
    assert len(opened) == 1 and archive.certificates is None
    assert "certifier_episodes" not in rows_of(tmp_path / "run")[0]
    with open_gate(CFG, {}, opened[0].cfg, opening()) as gate:
        assert gate is None


def test_rates_by_hand():
    asked = np.array([True, False, True])
    # goal, base collision, other, invalid: 3 of 4; all of the 3 valid; 1 of 5 and, too often invalid, none
    counts = np.array([[[3, 1, 0, 0], [3, 0, 0, 1]], [[1, 0, 4, 0], [1, 0, 0, 4]]])
    expected = [[0.75, 1.0], [np.nan, np.nan], [0.2, 0.0]]
    np.testing.assert_array_equal(rates_of(asked, counts), expected)


def test_a_lot_of_nothing_is_crossed_by_nobody():
    gate = Gate([Lots(make_job("x").evaluator), Lots(make_job("x").evaluator)])
    gate.put(np.zeros((0, 64), np.float32), np.zeros(0, np.uint32))
    gate.put(np.zeros((2, 64), np.float32), np.zeros(2, np.uint32))
    assert gate.take().shape == (0, 2, 4)
    assert gate.take().tolist() == [[[4, 0, 0, 0]] * 2] * 2
