import numpy as np
import pytest
import torch

from qd.run.presets import SchedulerCfg
from qd.variation import vary_elites
from sim.spaces.super_gaussian import SUPER_GAUSSIAN

PAIR = torch.from_numpy(0.5 * SUPER_GAUSSIAN.uniform_random(2, 0))
LINE = (PAIR[1] - PAIR[0]).numpy()


def children(pool: torch.Tensor, count: int = 400, genes_per_part: int | None = 8, **steps: float) -> np.ndarray:
    cfg = SchedulerCfg(**{"iso_sigma": 0.0, "line_sigma": 0.0, "crossover_share": 0.0, **steps})
    return vary_elites(pool, count, cfg, genes_per_part, torch.Generator().manual_seed(0)).numpy()


def test_of_a_share_of_the_children_half_of_the_bumps_are_another_elites():
    found = children(PAIR, crossover_share=0.4).reshape(-1, 8, 8)
    first, second = ((found == elite.reshape(8, 8).numpy()).all(axis=2) for elite in PAIR)
    assert (first ^ second).all()
    mixed = first.any(axis=1) & second.any(axis=1)
    # 0.4 are crossed, half of them with the other of the two, which takes 1 to 7 bumps in 254 of 256 cases.
    assert mixed.mean() == pytest.approx(0.4 * 0.5 * 254 / 256, abs=0.06)
    assert 0.4 < first[mixed].mean() < 0.6


def test_a_space_without_parts_has_no_crossover():
    found = children(PAIR, crossover_share=1.0, genes_per_part=None)
    assert all((row == PAIR.numpy()).all(axis=1).any() for row in found)


def test_steps_along_lines_stay_on_them():
    found = children(PAIR, line_sigma=0.1)
    steps = np.stack([found - elite.numpy() for elite in PAIR])
    nearest = np.abs(steps).sum(axis=2).argmin(axis=0)
    step = steps[nearest, np.arange(len(found))]
    share = (step @ LINE) / (LINE @ LINE)
    np.testing.assert_allclose(step, share[:, None] * LINE, atol=1e-6)
    moved = share[np.abs(share) > 1e-6]
    assert 0.4 < len(moved) / len(found) < 0.6  # half of them meet the other elite
    assert moved.std() == pytest.approx(0.1, rel=0.2)


def test_own_steps_are_of_every_gene_and_end_at_the_limits():
    found = children(PAIR[:1], iso_sigma=0.02)
    step = found - PAIR[0].numpy()
    assert step.std() == pytest.approx(0.02, rel=0.05) and abs(step.mean()) < 1e-3
    assert np.abs(children(PAIR, iso_sigma=5.0)).max() == 1.0
