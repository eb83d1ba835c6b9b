"""Training another robot: its own settings, on the command line too, its rewards, and a run from start to resume."""

import json
from dataclasses import asdict

import numpy as np
import pytest
import torch
import tyro

from sim.policy.loaders import load_policy
from sim.robots.find import get_robot
from tests.train.conftest import CURRICULUM
from train.base import train
from train.cfg import RunCfg, TrainCfg
from train.commands import Train
from train.ppo.cfg import PpoCfg
from train.task.cfg import TaskCfg

CONTROL_DT = 0.02
PPO = PpoCfg(hidden_dims=(16, 8), steps_per_env=4, epochs=1, mini_batches=2)


def parsed(flags):
    return tyro.cli(Train, args=flags, default=Train.defaults(flags))


def test_the_defaults_are_anymals_but_for_its_load():
    assert TaskCfg.of(get_robot("anymal")) == TaskCfg(added_base_mass=(-5.0, 5.0))


def test_cassies_settings():
    cfg = TaskCfg.of(get_robot("cassie"), push_speed=0.5)
    assert asdict(cfg.rewards) == {
        "tracking_lin_vel": 2.0, "tracking_ang_vel": 2.0, "lin_vel_z": -0.5, "ang_vel_xy": 0.0, "torques": -5e-6,
        "dof_acc": -1e-7, "feet_air_time": 2.5, "collision": -1.0, "action_rate": -0.01, "stumble": -0.1,
        "feet_contact_forces": -2e-4, "dof_pos_limits": -1.0, "no_fly": 0.25, "orientation": -1.0,
        "joint_deviation": -0.2, "termination": -200.0,
    }  # fmt: skip
    assert not cfg.only_positive
    assert (cfg.soft_joint_limit, cfg.min_air_time_s, cfg.added_base_mass) == (0.95, 0.5, (0.0, 0.0))
    assert cfg.push_speed == 0.5
    ppo = PpoCfg.of(get_robot("cassie"))
    assert (ppo.init_noise_std, ppo.desired_kl, ppo.entropy) == (0.5, 0.02, 0.005)
    assert PpoCfg.of(get_robot("anymal")) == PpoCfg()


@pytest.mark.parametrize("named", [["--robot", "cassie"], ["--robot=cassie"]])
def test_the_command_line_begins_with_the_robots_settings(named):
    cfg = parsed(["--task.rewards.no-fly", "0.5", *named, "--task.push-speed", "0.25", "--iterations", "7"])
    own = TaskCfg.of(get_robot("cassie"))
    assert (cfg.robot, cfg.iterations, cfg.task.push_speed) == ("cassie", 7, 0.25)
    assert asdict(cfg.task.rewards) == asdict(own.rewards) | {"no_fly": 0.5}
    assert not cfg.task.only_positive
    assert cfg.ppo == PpoCfg.of(get_robot("cassie"))
    assert parsed([]).task == TaskCfg.of(get_robot("anymal"))


def test_falls_are_paid_for_and_clipped_nowhere(make_task):
    # Nobody balances them: within two seconds all are down, each for -200 * .02 s = -4 in the step it ends with.
    task = make_task(robot="cassie", start_joint_range=0.1, start_velocity_range=0.1, push_interval_s=0.0)
    task.restart_all(torch.zeros(task.num_envs))
    assert task.observation.shape == (task.num_envs, 169)
    falls, rewards = 0, []
    for _ in range(120):
        task.step(torch.zeros(task.num_envs, 12, device=task.device))
        fell = (task.end != 0).cpu().numpy()
        assert (task.reward.cpu().numpy()[fell] < -3.5).all()
        falls += int(fell.sum())
        rewards.append(task.reward.cpu().numpy().copy())
        assert task.observation.isfinite().all() and task.reward.isfinite().all()
    sums = task.read_statistics()
    assert falls >= task.num_envs
    assert sums["base_collision"] + sums["tilt"] == falls
    assert sums["termination"] == pytest.approx(-200.0 * CONTROL_DT * falls)
    assert sums["collision"] == 0.0 > sums["joint_deviation"]  # no limbs
    assert sums["dof_pos_limits"] <= 0.0 < sums["no_fly"]
    assert np.sum(rewards) == pytest.approx(sum(sums[name] for name in asdict(task.cfg.rewards)), rel=1e-4)
    assert sums["overflow"] == sums["invalid"] == 0


def test_a_run_of_another_robot_is_saved_and_goes_on(tmp_path):
    robot, run = get_robot("cassie"), tmp_path / "run"
    task = TaskCfg.of(robot, curriculum=CURRICULUM)
    for iterations in (1, 2):
        train(robot, TrainCfg(num_envs=6, iterations=iterations, task=task, ppo=PPO), run, RunCfg(device="cpu"))
    record = json.loads((run / "policy.train.json").read_text())
    assert (record["robot"], record["iterations"]) == ("cassie", 2)
    assert record["settings"]["task"]["rewards"]["termination"] == -200.0
    assert all(np.isfinite(list(row["terms"].values())).all() for row in record["curve"])
    policy = load_policy(run / "policy.pt", robot, "cpu")
    assert policy(torch.randn(3, 169)).shape == (3, 12)
