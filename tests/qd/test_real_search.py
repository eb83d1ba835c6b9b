"""The search over the real simulation on the CPU: small, but nothing in it is a stand-in."""

import dataclasses
from contextlib import contextmanager

import numpy as np
import pytest

from qd.fitness import FitnessCfg
from qd.run.presets import SchedulerCfg
from qd.workers.evaluator import EvaluatorCfg, EvaluatorError, episode_seeds, open_evaluator
from sim.crossing import CrossingCfg
from sim.robots.find import get_robot
from sim.rollout import Rollout
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd.searches import rows_of, run, without_figures
from tests.qd.stand_in import Stub

ROBOT = get_robot("anymal")
CFG = EvaluatorCfg(
    robot="anymal", policy=str(ROBOT.policy_file), num_terrains=4, num_replicas=2, device="cpu", workers="2"
)
SETTINGS = {
    "replicas": 2,
    "fitness": FitnessCfg(penalties=ROBOT.penalties, scales=(1.0, 2.0, 1.0, 300.0, 0.05, 0.3)),
    "scheduler": SchedulerCfg(method="cma_mae", emitters=1, batch_size=4, sigma0=1.0),
}


@pytest.fixture(scope="module")
def evaluate(device):
    workers = CFG.workers if device == "cpu" else None
    with open_evaluator(dataclasses.replace(CFG, device=device, workers=workers)) as evaluate:
        yield evaluate


@pytest.mark.slow
def test_one_and_two_processes_give_the_same_bits(evaluate, device):
    if device != "cpu":
        pytest.skip("a GPU is one process")
    terrains, seeds = SUPER_GAUSSIAN.uniform_random(4, 0), episode_seeds(0, 1, 4)
    with open_evaluator(dataclasses.replace(CFG, workers="1")) as evaluate_alone:
        one = evaluate_alone(terrains, seeds)
    two = evaluate(terrains, seeds)
    assert np.array_equal(one.penalties, two.penalties)
    assert np.array_equal(one.outcome, two.outcome)
    assert one.penalties.shape == (4, 2, 6)
    assert (one.penalties[:, :, 1] > 0).all()


def test_a_resumed_search_equals_the_uninterrupted_one(tmp_path, evaluate, device):
    @contextmanager
    def opened(cfg):
        yield evaluate

    left = 2

    @contextmanager
    def lost_in_the_third(cfg):
        def evaluate_twice(genes, seeds, progress=None):
            nonlocal left
            left -= 1
            if left < 0:
                raise EvaluatorError("a worker process died")
            return evaluate(genes, seeds, progress)

        yield Stub(evaluate_twice)

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    archive = run(whole, iterations=3, **SETTINGS, open_evaluator=opened)
    with pytest.raises(EvaluatorError):
        run(killed, iterations=3, **SETTINGS, open_evaluator=lost_in_the_third)
    assert len(rows_of(killed)) == 2
    run(killed, iterations=3, **SETTINGS, open_evaluator=opened)
    assert [row["iteration"] for row in rows_of(killed)] == [1, 2, 3]
    if device == "cpu":  # a GPU's crossings are not repeated bit for bit
        assert (whole / "archive.npz").read_bytes() == (killed / "archive.npz").read_bytes()
    assert len(archive) >= 1


def short_rollout(cfg, num_terrains):
    return Rollout(
        ROBOT, cfg.policy, num_terrains=num_terrains, num_replicas=cfg.num_replicas, num_envs=4, device=cfg.device,
        cfg=CrossingCfg(start=(12.5, 4.0), max_duration_s=1.6, poll_every_s=0.2),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("groups", [2, 3])
def test_a_search_in_groups_that_is_extended_equals_the_one_in_one_go(tmp_path, groups, device, monkeypatch):
    """Robots go on with the terrains of other groups; three emitters make groups of one and two, or of one each."""
    if device != "cpu":
        pytest.skip("a GPU adds in any order")
    without_figures(monkeypatch)
    scheduler = SchedulerCfg(method="cma_mae+map_elites", emitters=3, batch_size=2, sigma0=1.0, groups=groups)
    settings = {**SETTINGS, "scheduler": scheduler, "replicas": 3, "reevaluate_every": 0}

    def searched(path, iterations, *, workers="1"):
        def opened(cfg):
            mine = dataclasses.replace(cfg, policy=CFG.policy, workers=workers)
            return open_evaluator(mine, build=short_rollout)

        return run(path, iterations=iterations, **settings, open_evaluator=opened)

    whole = searched(tmp_path / "whole", 3)
    searched(tmp_path / "pieces", 1, workers="2")
    pieces = searched(tmp_path / "pieces", 3, workers="1")
    assert len(whole) > 1
    for name in ("genes", "cell", "fitness", "iteration", "ratios"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)
    assert all(0.0 <= row["idle_share"] <= 1.0 for row in rows_of(tmp_path / "pieces"))
