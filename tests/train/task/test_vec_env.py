"""The contract of rsl_rl's environments."""

import torch

from train.task.vec_env import CommandVecEnv


def test_nothing_handed_out_changes_later(shared_task):
    env = CommandVecEnv(shared_task)
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (6, 12, 1000)
    handed = [env.get_observations()["policy"], env.episode_length_buf]
    actions = torch.zeros(6, 12, device=env.device)
    observations, rewards, dones, extras = env.step(actions)
    assert observations["policy"].shape == (6, 235) and rewards.shape == dones.shape == (6,)
    handed += [observations["policy"], rewards, dones, extras["time_outs"], actions]
    copies = [tensor.clone() for tensor in handed]
    for _ in range(3):
        env.step(torch.ones(6, 12, device=env.device))
    assert all(tensor.equal(copy) for tensor, copy in zip(handed, copies, strict=True))
    assert not env.get_observations()["policy"].equal(handed[0])


def test_time_outs_are_the_dones_of_the_clock(shared_task):
    env = CommandVecEnv(shared_task)
    shared_task.restart_all(torch.zeros(6, device=env.device))
    env.episode_length_buf = torch.tensor([0, 998, 999, 999, 5, 5], device=env.device)
    joint_q = torch.from_dlpack(shared_task.sim.joint_q)
    joint_q[3:5, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0], device=env.device)  # on their backs
    _, _, dones, extras = env.step(torch.zeros(6, 12, device=env.device))
    assert dones.tolist() == [False, False, True, True, True, False]
    assert extras["time_outs"].tolist() == [False, False, True, False, False, False]
    assert env.episode_length_buf.tolist() == [1, 999, 0, 0, 0, 6]
