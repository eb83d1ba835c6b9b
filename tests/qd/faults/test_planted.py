"""Planted terrains and scripted walkers in the real simulation: whether the search of ways finds the right word."""

from typing import Any

import numpy as np
import pytest
import torch

from qd.faults.steer import SteerCfg, seek_witnesses
from qd.search.archive import WITNESSES, Witnesses
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser
from sim.controllers.described import read_row
from sim.controllers.loaders import load_policy
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.terrains import Terrains

Y, X = SPACING * np.indices((NUM_ROWS, NUM_COLS))
HEIGHTS = {
    "wall": np.where((X > 5.0) & (X < 5.5), 1.0, 0.0),
    "ditch": np.where((X > 5.0) & (X < 6.2) & ~((Y > 5.0) & (Y < 7.6)), -1.0, 0.0),  # a bridge 2 m to the left
    "kerb": np.where(X > 5.5, 0.08, 0.0),  # in the middle of a segment
    "level": np.zeros_like(X),
}
"""Heights [m] by what is planted, over the full width."""


class Walker:
    """ANYmal's own controller, which folds its legs where the walker gives up."""

    faultline_factory = True

    def __init__(self, robot: Any, device: str) -> None:
        self.robot, self.walk = robot, load_policy(str(robot.policy_file), robot, device)

    def __call__(self, row: torch.Tensor) -> torch.Tensor:
        folded = torch.tensor([0.0, 3.0, -5.0] * 2 + [0.0, -3.0, 5.0] * 2)
        return torch.where(self.gives_up(row)[:, None], folded, self.walk(row))


class Hasty(Walker):
    """Falls where a kerb is under it while it is told to go at more than 0.5 m/s."""

    def gives_up(self, row: torch.Tensor) -> torch.Tensor:
        sensed = read_row(row, self.robot)
        under = sensed.scan[:, 6:11, 3:8].flatten(1)  # up to 0.2 m around the base
        step = under.amax(dim=1) - under.amin(dim=1)
        return (step > 0.04) & (step < 0.15) & (sensed.command[:, 0] > 0.5)


class Unlucky(Walker):
    """Falls after a second in six of ten episodes, whatever it is told; how its joints stand at first says in which."""

    falls = steps = torch.zeros(0)

    def reset(self, begins: torch.Tensor) -> None:
        self.steps = torch.where(begins, 0.0, self.steps if len(self.steps) == len(begins) else 0.0)

    def gives_up(self, row: torch.Tensor) -> torch.Tensor:
        luck = torch.frac(1000.0 * read_row(row, self.robot).joint_pos.sum(dim=1).abs())
        self.falls = torch.where(self.steps == 0.0, luck, self.falls if len(self.falls) == len(luck) else 0.0)
        self.steps = self.steps + 1.0
        return (self.falls < 0.6) & (self.steps > 50.0)


def seek(names: list[str], walker: type[Walker], **settings: Any) -> Witnesses:
    cfg = SteerCfg(**settings)
    heights = np.stack([HEIGHTS[name] for name in names]).astype(np.float32)
    terrains = Terrains(heights=heights, seeds=np.arange(len(names)))
    seeds = np.random.default_rng(0).integers(2**32, size=(len(names), cfg.seeds), dtype=np.uint32)
    with Crosser("anymal", Compute(device="cpu", workers="1")) as crosser:
        walkers = {"searched": f"{__file__}:{walker.__name__}"}
        return seek_witnesses(crosser, walkers, terrains, seeds, 0.5, rng=np.random.default_rng(0), cfg=cfg)


SPREAD = {"samples": 12, "speed_std": 0.3, "offset_std": 0.25, "heading_std": 0.3}


@pytest.mark.slow
def test_a_wall_has_no_way_and_a_bridge_leads_around():
    witnesses = seek(["wall", "ditch"], Hasty, generations=6, best=3, step=0.7, **SPREAD)
    assert [WITNESSES[kind] for kind in witnesses.kind] == ["", "around"]
    assert not witnesses.counts[0, ..., :3].any() and not witnesses.counts[:, :, 0, :3].any()  # nobody without a way
    assert 1.0 < witnesses.way[1, 2, 1] < 3.6  # the place of x = 4 to 5 m is 1 m ahead


@pytest.mark.slow
def test_a_kerb_is_crossed_slowly_on_the_line():
    witnesses = seek(["kerb"], Hasty, generations=6, best=2, step=1.0, **SPREAD)
    assert [WITNESSES[kind] for kind in witnesses.kind] == ["line"]
    assert not witnesses.counts[0, :, 0, :3].any() and witnesses.way[0, 3, 0] < 0.55  # at x = 5 to 6 m


@pytest.mark.slow
def test_luck_on_level_ground_is_no_way():
    near = dict.fromkeys(("speed_std", "offset_std", "heading_std"), 0.1)
    witnesses = seek(["level"], Unlucky, generations=1, **near)
    goals, valid = witnesses.counts[0, 0, :, [2, 3]]
    assert (valid == 20).all() and (goals > 0).all() and (goals < 14).all()  # 8 of 20 are to be expected
    assert not witnesses.kind.any()
