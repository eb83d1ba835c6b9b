"""The captured PPO against rsl_rl's own, and its settings."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from sim.robots.find import get_robot
from train.cfg import PpoCfg, TrainCfg
from train.ppo.ppo import CapturedPPO, runner_settings

NUM_ENVS, NUM_OBS, NUM_ACTIONS = 6, 5, 2


class DummyEnv(VecEnv):
    """Random observations; the reward is higher the nearer the first action is to the first observation."""

    def __init__(self, device: str) -> None:
        self.num_envs, self.num_actions, self.max_episode_length = NUM_ENVS, NUM_ACTIONS, 10
        self.episode_length_buf = torch.zeros(NUM_ENVS, dtype=torch.long, device=device)
        self.device = device
        self.cfg = {}
        self.generator = torch.Generator().manual_seed(0)
        self.obs = self._draw()

    def _draw(self) -> TensorDict:
        rows = torch.randn(NUM_ENVS, NUM_OBS, generator=self.generator)  # the same on every device
        return TensorDict({"policy": rows.to(self.device)}, [NUM_ENVS])

    def get_observations(self) -> TensorDict:
        return self.obs

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        reward = -(actions[:, 0] - self.obs["policy"][:, 0]).square()
        self.obs = self._draw()
        done = torch.rand(NUM_ENVS, generator=self.generator).to(self.device) < 0.1
        return self.obs, reward, done.long(), {"time_outs": done & (reward > -1.0)}


def make_runner(algorithm: type[PPO], cfg: PpoCfg, device: str) -> OnPolicyRunner:
    torch.manual_seed(3)
    settings = runner_settings(cfg)
    settings["algorithm"]["class_name"] = algorithm
    return OnPolicyRunner(DummyEnv(device), settings, log_dir=None, device=device)


def parameters(runner: OnPolicyRunner) -> list[torch.Tensor]:
    return [*runner.alg.actor.parameters(), *runner.alg.critic.parameters()]


CFG = PpoCfg(hidden_dims=(16, 8), steps_per_env=8, epochs=3, mini_batches=2)


def close(device: str) -> dict[str, float]:
    """Tolerances of weights after an update; on CUDA the fused Adam of a captured graph rounds otherwise."""
    return {"rtol": 1e-5, "atol": 1e-6} if device == "cpu" else {"rtol": 1e-3, "atol": 1e-4}


@pytest.mark.parametrize("desired_kl", [1e-5, 0.01, 10.0])  # the learning rate falls, moves both ways, rises
def test_update_equals_rsl_rl(desired_kl: float, monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    cfg = replace(CFG, desired_kl=desired_kl, clip=0.005)  # so little that values and ratios are clipped
    ours, theirs = make_runner(CapturedPPO, cfg, device), make_runner(PPO, cfg, device)
    losses = []
    for runner in (ours, theirs):
        monkeypatch.setattr(runner.logger, "log", lambda loss_dict, **_: losses.append(loss_dict))
        torch.manual_seed(5)
        runner.learn(1)
    assert losses[0] == pytest.approx(losses[1], rel=1e-4 if device == "cpu" else 1e-3)
    assert ours.alg.learning_rate == pytest.approx(theirs.alg.learning_rate, rel=1e-4)
    assert ours.alg.learning_rate != cfg.learning_rate
    for mine, other in zip(parameters(ours), parameters(theirs), strict=True):
        torch.testing.assert_close(mine, other, **close(device))


def test_settings_reach_rsl_rl(device: str) -> None:
    cfg = replace(CFG, learning_rate=0.002, gamma=0.5, lam=0.6, clip=0.3, desired_kl=0.7, entropy=0.8)
    alg = make_runner(CapturedPPO, cfg, device).alg
    assert (alg.learning_rate, alg.gamma, alg.lam, alg.clip_param) == (0.002, 0.5, 0.6, 0.3)
    assert (alg.desired_kl, alg.entropy_coef, alg.num_learning_epochs, alg.num_mini_batches) == (0.7, 0.8, 3, 2)


@pytest.mark.parametrize("changes", [{"gamma": 2.0}, {"mini_batches": 49}, {"hidden_dims": ()}])
def test_settings_that_nothing_is_learned_with_are_named(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"ppo.{next(iter(changes))}"):
        TrainCfg(num_envs=NUM_ENVS, ppo=PpoCfg(**changes)).check(get_robot("anymal"))
