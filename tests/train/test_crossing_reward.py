"""The reward of a crossing is the training task's, on the same motion."""

import dataclasses

import numpy as np
import torch

from sim.crossing import CrossingCfg
from sim.policy.loaders import load_policy
from sim.rollout import Rollout
from tests.train.conftest import CURRICULUM
from train.task.cfg import TaskCfg
from train.task.task import CommandTask

FLAT = np.zeros((161, 321), np.float32)
NUM_ENVS = 4


def test_a_crossing_is_paid_as_training_pays_it(anymal):
    """Robots walk up to the goal and stand there; the training task repeats their actions under the same commands."""
    walker = load_policy(anymal.policy_file, anymal, "cpu")
    commands, actions = [], []

    def record(observation: torch.Tensor) -> torch.Tensor:
        commands.append(observation[:, 9:12] / torch.tensor([2.0, 2.0, 0.25]))
        actions.append(walker(observation).clone())
        return actions[-1]

    cfg = CrossingCfg(start=(13.0, 4.0), max_duration_s=2.0, reward=True)
    rollout = Rollout(anymal, record, num_terrains=1, num_replicas=NUM_ENVS, device="cpu", cfg=cfg)
    rollout.put(FLAT[None], np.array([3]))
    start = rollout.sim.joint_q.numpy().copy(), rollout.sim.joint_qd.numpy().copy()
    commands.clear(), actions.clear()
    result = rollout.evaluate(FLAT[None], np.array([3]))
    assert result.reached_goal.all() and len(actions) == 100
    assert (torch.stack(commands)[-20:] == 0.0).all()  # they were told to stand

    on_robot = rollout.sim.model.shape_body.numpy() >= 0
    friction = float(rollout.sim.model.shape_material_mu.numpy()[on_robot].max())
    still = {"added_base_mass": (0.0, 0.0), "friction": (friction, friction), "push_interval_s": 0.0}
    task_cfg = dataclasses.replace(TaskCfg.of(anymal), curriculum=CURRICULUM, **still)
    task = CommandTask(anymal, task_cfg, num_envs=NUM_ENVS, device="cpu", seed=0)
    task.sim.bank.set_heights(np.zeros(task.sim.bank.heights.shape, np.float32))
    task.restart_all(torch.zeros(NUM_ENVS))
    task.sim.joint_q.assign(start[0])
    task.sim.joint_qd.assign(start[1])
    task._reward.state.previous_joint_vel.assign(start[1][:, 6:])
    total = np.zeros(NUM_ENVS)
    for command, action in zip(commands, actions, strict=True):
        task._training.command.assign(command.numpy())
        task.step(action)
        total += task.reward.numpy()
    assert (task.episode_steps == 100).all()  # nobody fell
    np.testing.assert_allclose(task.sim.joint_q.numpy(), rollout.sim.joint_q.numpy(), atol=1e-5)  # the same motion
    np.testing.assert_allclose(result.reward[0], total, rtol=1e-5)
    assert len(np.unique(total)) == NUM_ENVS and (total > 1.0).all()
