"""The search over the real simulation: small, but nothing in it is a stand-in."""

import dataclasses

import numpy as np
import pytest

from qd.search.fitness import FitnessCfg
from qd.search.presets import SchedulerCfg
from qd.workers.compute import Compute
from qd.workers.crosser import open_pipeline
from sim.crossing import CrossingCfg
from sim.robots.find import get_robot
from sim.rollout import Rollout
from tests.qd.searches import rows_of, run

ROBOT = get_robot("anymal")


def short_rollout(cfg, num_terrains):
    return Rollout(
        dataclasses.replace(ROBOT, max_duration_s=1.6),
        cfg.policy, num_terrains=num_terrains, replicas=cfg.replicas, num_envs=4, device=cfg.compute.device,
        cfg=CrossingCfg(start=(12.5, 4.0), poll_every_s=0.2),
    )  # fmt: skip


@pytest.mark.slow
def test_a_search_in_groups_that_is_extended_equals_the_one_in_one_go_by_any_number_of_processes(tmp_path, device):
    """Robots go on with the terrains of other groups; three emitters make groups of one and two."""
    settings = {
        "replicas": 3,
        "fitness": FitnessCfg(penalties=ROBOT.penalties, scales=(1.0, 2.0, 1.0, 300.0, 0.05, 0.3)),
        "scheduler": SchedulerCfg(method="cma_mae+map_elites", emitters=3, batch_size=2, sigma0=1.0, groups=2),
    }

    def searched(path, iterations, *, workers="1"):
        def opened(cfg):
            compute = Compute(device, workers=workers if device == "cpu" else None)
            return open_pipeline(dataclasses.replace(cfg, compute=compute), build=short_rollout)

        return run(path, iterations=iterations, **settings, opener=opened)

    whole = searched(tmp_path / "whole", 3)
    searched(tmp_path / "pieces", 1, workers="2")
    pieces = searched(tmp_path / "pieces", 3, workers="1")
    assert len(whole) > 1
    assert all(0.0 <= row["idle_share"] <= 1.0 for row in rows_of(tmp_path / "pieces"))
    if device == "cpu":  # a GPU adds in any order
        for name in ("genes", "cell", "fitness", "iteration", "ratios"):
            np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)
