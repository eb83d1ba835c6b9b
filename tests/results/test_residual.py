"""Offsets of joint targets: what genes mean, and the search for them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from kernels.episode import Outcome
from qd.faults.steer import SteerCfg, cross_half
from results.make import residual
from results.make.residual import OffsetPolicy, find_offsets, seek_offsets
from sim.controllers.runner import Memory, find_memory
from sim.robots.find import get_robot
from tests.qd.stand_in import result_of

JOINTS = 2


def genes_of(splines, hertz):
    """One robot's genes by splines of shape (splines, KNOTS, JOINTS)."""
    return torch.tensor(np.append(np.ravel(splines), hertz)[None], dtype=torch.float32)


def offsets_at(genes, x, time_s=0.0):
    return find_offsets(genes, torch.tensor([x]), torch.tensor([time_s]), JOINTS)[0].tolist()


def test_a_spline_is_linear_between_knots_from_start_to_goal():
    knots = np.zeros((1, 6, JOINTS))
    knots[0, :, 0] = [0.1, 0.2, 0.0, 0.0, 0.0, -0.2]
    genes = genes_of(knots, 2.0)
    # Knots are 12 m / 5 = 2.4 m apart: at 2, 4.4, ... 14 m. Before the first and behind the last the spline goes on.
    places = {1.0: 0.1, 2.0: 0.1, 3.2: 0.15, 4.4: 0.2, 5.0: 0.15, 8.0: 0.0, 12.8: -0.1, 15.0: -0.2}
    for x, expected in places.items():
        assert offsets_at(genes, x) == pytest.approx([expected, 0.0], abs=1e-6)


def test_a_gait_adds_sine_and_cosine_of_its_phase_within_the_largest_offset():
    knots = np.zeros((3, 6, JOINTS))
    knots[:, :, 0] = [[0.01], [0.1], [0.05]]  # constant, sine, cosine
    knots[:, :, 1] = [[0.2], [0.2], [0.0]]
    genes = genes_of(knots, 2.0)
    assert offsets_at(genes, 5.0, 0.0) == pytest.approx([0.06, 0.2], abs=1e-6)
    assert offsets_at(genes, 5.0, 0.125) == pytest.approx([0.11, 0.3], abs=1e-6)  # a quarter of a period; .4 is clipped
    assert offsets_at(genes, 5.0, 0.25) == pytest.approx([-0.04, 0.2], abs=1e-6)


class World:
    """What the policy reads of a rollout: two robots at 2 m, which run the second and the first episode."""

    def __init__(self):
        self.episode, self.sim = torch.tensor([1, 0]), self
        self.joint_q = torch.tensor([2.0, 0.0, 2.0, 0.0])


def test_the_controllers_action_is_shifted_by_the_episodes_genes(monkeypatch):
    monkeypatch.setattr(residual.wp, "to_torch", lambda array: array)
    robot = get_robot("anymal")
    policy = OffsetPolicy(lambda rows: torch.ones(len(rows), 12), robot)
    genes = np.zeros((2, 3 * 6 * 12 + 1), np.float32)
    genes[:, -1] = 1.0
    genes[0, 72:144] = 0.1  # the sine of the first episode
    genes[1, :72] = 0.2
    policy.use(World(), genes)
    assert find_memory(policy) is Memory.PER_ROBOT
    policy.reset(torch.ones(2, dtype=torch.bool))
    first, second = policy(torch.zeros(2, 48)), policy(torch.zeros(2, 48))
    sine = 0.1 * np.sin(2.0 * np.pi * robot.control_dt)
    assert first[:, 5].tolist() == pytest.approx([1.0 + 0.2 / robot.action_scale, 1.0])
    assert second[:, 5].tolist() == pytest.approx([1.0 + 0.2 / robot.action_scale, 1.0 + sine / robot.action_scale])
    policy.reset(torch.tensor([False, True]))  # the second robot begins anew
    assert policy(torch.zeros(2, 48))[1, 5].item() == 1.0


def test_the_search_finds_offsets_that_are_planted():
    """One terrain is crossed where the second joint is bent by over .15 rad at the third knot; one never, one aside."""

    def cross(genes, seeds):
        bend = genes[..., :-1].reshape(3, -1, 6, JOINTS)[:, :, 2, 1]
        crosses = bend > np.array([[0.15], [np.inf], [-np.inf]])
        end = np.zeros((*bend.shape, 3))
        end[..., 0] = np.where(crosses, 13.6, 7.0 + np.minimum(bend, 0.15))
        result = result_of(np.where(crosses, Outcome.GOAL, Outcome.TIME_OUT), final_position=end)
        return replace(result, deviation=np.array([[0.4], [0.0], [0.6]]) + 0.0 * bend)

    cfg = SteerCfg(generations=8, samples=32, least_std=0.02)
    robot = replace(get_robot("anymal"), joint_names=("hip", "knee"))
    rng, seeds = np.random.default_rng(0), np.zeros((3, 8), np.uint32)
    genes, curve = seek_offsets(cross, seeds, 1, robot, 0.5, rng=rng, cfg=cfg)
    assert genes.shape == (3, 6 * JOINTS + 1) and genes[0, :-1].reshape(6, JOINTS)[2, 1] > 0.15
    assert np.abs(genes[:, :-1]).max() <= residual.LARGEST
    assert [row["samples"] for row in curve] == [32 * k for k in range(1, 9)]
    assert curve[-1]["crossed"] == curve[-1]["half"] == 1 / 3 and curve[-1]["goal"] > 1 / 6 > curve[0]["goal"]


def test_half_of_the_valid_episodes_must_cross():
    assert cross_half(np.array([[9, 10, 20, 20], [9, 9, 9, 18], [0, 0, 0, 0]])).tolist() == [
        [False, True, True], [True, True, True], [False, False, False],
    ]  # fmt: skip
