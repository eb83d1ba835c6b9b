"""Fine-tuning of a described controller: it begins as it was, goes on, and can be loaded and crossed with."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from qd.faults.searches import controllers_in
from sim.controllers.described import read_controller
from sim.controllers.loaders import load_policy
from sim.mujoco_c.crossing import cross_in_mujoco_c, draw_starts
from sim.robots.find import get_robot
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from tests.sim.dogs import write_toml
from tests.train.conftest import PPO, begun
from train.cfg import FinetuneCfg, RunCfg
from train.finetune import finetune
from train.ppo.checkpoint import STD, read_checkpoint, read_start

TERMS = """observation = [
  {term = "ang_vel", scale = 0.25, clip = 4.0}, {term = "gravity"}, {term = "joint_pos", clip = [-1.0, 2.0]},
  {term = "last_action"}, {term = "clock", period_s = 0.5},
]
history = {length = 3, newest = "last", by = "term", fill = "first"}
action_scale = [0.2, 0.3, 0.2, 0.3]
action_clip = 2.0
action_delay_steps = 1
joints = ["HR_knee", "FL_hip", "FL_knee", "FR_hip"]
"""
COLUMNS = 3 * (3 + 3 + 4 + 4 + 2)


def layers(*sizes):
    """Layers with SiLU between them."""
    torch.manual_seed(0)
    parts = [part for k in range(len(sizes) - 1) for part in (torch.nn.Linear(sizes[k], sizes[k + 1]), torch.nn.SiLU())]
    return torch.nn.Sequential(*parts[:-1])


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The dog with a described controller beside it, whose network is TorchScript."""
    file = write_toml(tmp_path_factory.mktemp("described") / "dog")
    torch.jit.script(layers(COLUMNS, 16, 8, 4)).save(file.with_name("net.pt"))
    file.with_name("controller.toml").write_text(f'policy = "net.pt"\n{TERMS}')
    return get_robot(str(file))


def cfg_of(robot, **changes):
    values = {"mix": "hard-random", "num_envs": 6, "terrains": 4, "iterations": 1, "ppo": PPO}
    return replace(FinetuneCfg.of(robot), **values | changes)


def test_the_actor_begins_as_the_controller(robot, tmp_path):
    tuned = begun(robot, cfg_of(robot), tmp_path)
    policy, env, alg = load_policy(robot.policy_file, robot, "cpu"), tuned.learner.env, tuned.learner.alg
    assert alg.get_policy().state_dict()[STD].tolist() == pytest.approx([0.3] * 4)
    observations, ends, done = env.get_observations(), 0, []
    step = env.task.step
    env.task.step = lambda action: (done.append(action.clone()), step(action))
    with torch.inference_mode():
        for k in range(60):
            policy.reset(env.task.episode_steps == 0)
            expected = policy(env.task.observation.clone())
            if k == 30:
                env.task.episode_steps[:3] = env.task.max_episode_steps - 1  # these end; the others go on
            observations, _, dones, _ = env.step(alg.actor(observations))
            torch.testing.assert_close(done[-1], expected, rtol=1e-5, atol=1e-5)
            ends += int(dones.sum())
    assert ends >= 3 and np.unique(torch.stack(done).numpy()).size > 100


def test_it_learns_goes_on_and_crosses(robot, tmp_path, capsys):
    run, on_cpu = tmp_path / "run", RunCfg(device="cpu", export=tmp_path / "panel" / "mine.pt")
    for iterations in (2, 3):
        described = finetune(robot, cfg_of(robot, iterations=iterations), run, on_cpu)
    assert f"written to {described} and" in capsys.readouterr().out
    assert described == run / "controller.toml" and read_checkpoint(run / "checkpoint.pt")["iter"] == 3
    assert read_controller(described) == replace(
        read_controller(robot.policy_file), policy="policy.pt", activation="swish"
    )
    assert controllers_in(tmp_path / "panel") == {"mine": str(tmp_path / "panel" / "mine.toml")}
    start, after, copy = (load_policy(path, robot, "cpu") for path in
                          (robot.policy_file, described, tmp_path / "panel" / "mine.toml"))  # fmt: skip
    rows = torch.randn(5, COLUMNS)
    assert 1e-6 < (after.network(rows) - start.network(rows)).abs().max() < 0.1
    torch.testing.assert_close(copy.network(rows), after.network(rows))
    flat = np.zeros((NUM_ROWS, NUM_COLS), np.float32)
    brief = replace(robot, max_duration_s=0.2)
    assert not cross_in_mujoco_c(brief, after, flat, draw_starts(brief, flat, 2, 3, "cpu")).invalid.any()
    (tmp_path / "further").mkdir()
    # As a hardening does: with its critic.
    further = begun(robot, cfg_of(robot, policy=str(run / "checkpoint.pt")), tmp_path / "further")
    expected = read_checkpoint(run / "checkpoint.pt")["critic_state_dict"]
    assert all(value.equal(expected[key]) for key, value in further.learner.alg.critic.state_dict().items())
    assert further.learner.env.controller.activation == "swish"


def test_other_networks_are_refused(robot, tmp_path):
    class Limited(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = layers(COLUMNS, 16, 8, 4)

        def forward(self, rows):
            return self.layers(rows.clamp(-9.0, 9.0))

    torch.jit.script(Limited()).save(tmp_path / "limited.pt")
    (tmp_path / "controller.toml").write_text(f'policy = "limited.pt"\n{TERMS}')
    with pytest.raises(ValueError, match="finetune needs a network of plain layers"):
        read_start(tmp_path / "controller.toml", robot)
