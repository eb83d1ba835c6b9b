"""Training another robot: its own settings, on the command line too, its rewards, and a training that goes on."""

from dataclasses import asdict

import numpy as np
import pytest
import torch
import tyro

from sim.robots.find import get_robot
from train.cfg import PpoCfg, TaskCfg
from train.commands import TrainCommand

CONTROL_DT = 0.02


def test_the_command_line_begins_with_the_robots_settings():
    flags = ["--task.rewards.no-fly", "0.5", "--robot=cassie", "--task.push-speed", "0.25", "--iterations", "7"]
    cfg = tyro.cli(TrainCommand, args=flags, default=TrainCommand.defaults(flags))
    expected = TaskCfg.of(get_robot("cassie"))
    assert (cfg.robot, cfg.iterations, cfg.task.push_speed) == ("cassie", 7, 0.25)
    assert asdict(cfg.task.rewards) == asdict(expected.rewards) | {"no_fly": 0.5}
    assert (cfg.task.only_positive, cfg.task.rewards.termination) == (False, -200.0)
    assert cfg.ppo == PpoCfg(init_noise_std=0.5, desired_kl=0.02, entropy=0.005)


def test_falls_are_paid_for_and_clipped_nowhere(make_task):
    # Nobody balances them: within two seconds all are down, each for -200 * .02 s = -4 in the step it ends with.
    task = make_task(robot="cassie", start_joint_range=0.1, start_velocity_range=0.1, push_interval_s=0.0)
    task.restart_all(torch.zeros(task.num_envs))
    assert task.observation.shape == (task.num_envs, 169)
    falls, total = 0, 0.0
    for _ in range(120):
        task.step(torch.zeros(task.num_envs, 12, device=task.device))
        fell, reward = (task.end != 0).cpu().numpy(), task.reward.cpu().numpy()
        assert (reward[fell] < -3.5).all() and np.isfinite(reward).all() and task.observation.isfinite().all()
        falls += int(fell.sum())
        total += float(reward.sum())
    sums = task.read_statistics()
    assert falls >= task.num_envs
    assert sums["base_collision"] + sums["tilt"] == falls
    assert sums["termination"] == pytest.approx(-200.0 * CONTROL_DT * falls)
    assert sums["collision"] == 0.0 > sums["joint_deviation"]  # no limbs
    assert sums["dof_pos_limits"] <= 0.0 < sums["no_fly"]
    assert total == pytest.approx(sum(sums[name] for name in asdict(task.cfg.rewards)), rel=1e-4)
    assert sums["overflow"] == sums["invalid"] == 0
