"""rsl_rl's PPO with its minibatch step captured as one CUDA graph."""

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import nn

from sim.controllers.described import ControllerCfg
from sim.device import recording
from train.cfg import PpoCfg

_FIRST_ACTOR_RATE = 1e-4  # learning rate of a trained actor's first steps; adapted from then on
_EAGER_STEPS = 3  # optimiser steps before the capture: they allocate its state and choose the matrix kernels


def runner_settings(cfg: PpoCfg, controller: ControllerCfg | None = None) -> dict[str, Any]:
    """Settings for rsl_rl, which writes into them: a new dict each call."""
    network = {"class_name": "MLPModel", "activation": "elu", "obs_normalization": False}
    actor = {**network, "activation": "elu" if controller is None else controller.activation}
    noise = {"class_name": "GaussianDistribution", "init_std": cfg.init_noise_std, "std_type": "scalar"}
    return {
        "num_steps_per_env": cfg.steps_per_env,
        "multi_gpu": None,
        "obs_groups": {"actor": ["policy" if controller is None else "actor"], "critic": ["policy"]},
        "algorithm": {
            "class_name": CapturedPPO,
            **{name: getattr(cfg, name) for name in ("learning_rate", "desired_kl", "gamma", "lam")},
            "num_learning_epochs": cfg.epochs,
            "num_mini_batches": cfg.mini_batches,
            "schedule": "adaptive",
            "clip_param": cfg.clip,
            "entropy_coef": cfg.entropy,
            "value_loss_coef": 1.0,
            "use_clipped_value_loss": True,
            "max_grad_norm": 1.0,
        },
        "actor": {**actor, "hidden_dims": list(cfg.hidden_dims), "distribution_cfg": noise},
        "critic": {**network, "hidden_dims": list(cfg.hidden_dims)},
    }


class CapturedPPO(PPO):
    """rsl_rl's PPO for feed-forward actors, without a host synchronisation inside an update.

    The arithmetic is rsl_rl's own. But learning rate and losses stay on the device, so that on CUDA one minibatch step
    is one graph launch instead of hundreds of launches and five synchronisations. On the CPU it runs eagerly.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        on_cuda = torch.device(self.device).type == "cuda"
        self._lr = torch.tensor(float(self.learning_rate), device=self.device)
        self._actor_learns = torch.ones((), device=self.device)
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=self._lr, fused=on_cuda or None, capturable=on_cuda)
        count = self.storage.num_envs * self.storage.num_transitions_per_env
        self._index = torch.zeros(count // self.num_mini_batches, dtype=torch.long, device=self.device)
        self._advantages = torch.zeros(count, 1, device=self.device)
        self._losses = torch.zeros(3, device=self.device)
        self._stream = torch.cuda.Stream(self.device) if on_cuda else None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._eager_steps = 0

    def let_actor_learn(self, learns: bool) -> None:
        """Lets updates change the actor, or, while an untrained critic would mislead it, the critic alone."""
        self._actor_learns.fill_(float(learns))

    def begin_actor(self) -> None:
        """Resets the optimiser's moments of the actor, and lets it learn in small steps at first.

        They have counted zero gradients while the critic learned alone: first steps would be three times too large.
        """
        for parameter in self.actor.parameters():
            for value in self.optimizer.state.get(parameter, {}).values():
                value.zero_()
        self._lr.clamp_(max=_FIRST_ACTOR_RATE)

    def update(self) -> dict[str, float]:
        """Run all epochs over the stored rollout; returns the mean value, surrogate and entropy losses."""
        self._advantages.copy_(self.storage.advantages.flatten(0, 1))
        self._losses.zero_()
        order = torch.randperm(self.num_mini_batches * self._index.shape[0], device=self.device)
        if self._stream is None:
            self._run_epochs(order)
        else:
            # One stream for every backward pass: autograd remembers the stream of a parameter's first use, and a
            # capture must not meet another one.
            self._stream.wait_stream(torch.cuda.current_stream(self.device))
            with torch.cuda.stream(self._stream):
                self._run_epochs(order)
            torch.cuda.current_stream(self.device).wait_stream(self._stream)
        self.storage.clear()
        value, surrogate, entropy = (self._losses / (self.num_learning_epochs * self.num_mini_batches)).tolist()
        self.learning_rate = self._lr.item()
        return {"value": value, "surrogate": surrogate, "entropy": entropy}

    def save(self) -> dict[str, Any]:
        """Rsl_rl's state dicts, with the learning rate as a plain number."""
        state = super().save()
        for group in state["optimizer_state_dict"]["param_groups"]:
            group["lr"] = float(group["lr"])
        return state

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load rsl_rl's state dicts; the captured graph is dropped because it holds the old optimiser's tensors."""
        has_iteration = super().load(loaded_dict, load_cfg, strict)
        self._lr.fill_(float(self.learning_rate))
        for group in self.optimizer.param_groups:
            group.update(lr=self._lr, capturable=self._stream is not None, fused=self._stream is not None or None)
        for state in self.optimizer.state.values():  # a checkpoint of the other kind of device keeps its step elsewhere
            state["step"] = state["step"].to(self._lr.device)
        self._graph = None
        self._eager_steps = 0
        return has_iteration

    def _run_epochs(self, order: torch.Tensor) -> None:
        for _ in range(self.num_learning_epochs):
            for index in order.view(self.num_mini_batches, -1):
                self._index.copy_(index)
                # All processes of a training have taken the same number of steps, so they capture and replay together.
                if self._stream is None or self._eager_steps < _EAGER_STEPS:
                    self._learn_minibatch()
                    self._eager_steps += 1
                    continue
                if self._graph is None:
                    self.optimizer.zero_grad(set_to_none=True)
                    self._graph = torch.cuda.CUDAGraph()
                    # NCCL's watchdog queries events from another thread, which a capture of all threads forbids.
                    capture = torch.cuda.graph(self._graph, stream=self._stream, capture_error_mode="thread_local")
                    with recording(), capture:
                        self._learn_minibatch()
                self._graph.replay()

    def _learn_minibatch(self) -> None:
        """One optimiser step on the transitions of ``_index``; reads and writes fixed memory only."""
        stored = self.storage
        index = self._index
        observations: Any = {key: value.flatten(0, 1)[index] for key, value in stored.observations.items()}
        old_mean_std = tuple(value.flatten(0, 1)[index] for value in stored.distribution_params or ())
        distribution: Any = self.actor.distribution
        distribution.update(self.actor.mlp(self.actor.get_latent(observations)))
        log_prob = self.actor.get_output_log_prob(stored.actions.flatten(0, 1)[index])
        entropy = self.actor.output_entropy.mean()
        self._adapt_learning_rate(old_mean_std)
        advantages = self._advantages[index].squeeze(1)
        ratio = torch.exp(log_prob - stored.actions_log_prob.flatten(0, 1)[index].squeeze(1))
        clipped_ratio = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate_loss = torch.max(-advantages * ratio, -advantages * clipped_ratio).mean()
        values = self.critic(observations)
        returns = stored.returns.flatten(0, 1)[index]
        old_values = stored.values.flatten(0, 1)[index]
        clipped = old_values + (values - old_values).clamp(-self.clip_param, self.clip_param)
        value_loss = torch.max((values - returns).pow(2), (clipped - returns).pow(2)).mean()
        actor_loss = surrogate_loss - self.entropy_coef * entropy
        loss = self._actor_learns * actor_loss + self.value_loss_coef * value_loss
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if self.is_multi_gpu:
            self.reduce_parameters()
        nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
        nn.utils.clip_grad_norm_(self.critic.parameters(), self.max_grad_norm)
        self.optimizer.step()
        self._losses.add_(torch.stack((value_loss, surrogate_loss, entropy)).detach())

    @torch.no_grad()
    def _adapt_learning_rate(self, old_mean_std: tuple[torch.Tensor, ...]) -> None:
        kl = self.actor.get_kl_divergence(old_mean_std, self.actor.output_distribution_params).mean()
        if self.is_multi_gpu:
            torch.distributed.all_reduce(kl)
            kl = kl / self.gpu_world_size
        lower = torch.where(kl > 2.0 * self.desired_kl, (self._lr / 1.5).clamp(min=1e-5), self._lr)
        higher = (self._lr * 1.5).clamp(max=1e-2)
        adapted = torch.where((kl < 0.5 * self.desired_kl) & (kl > 0.0), higher, lower)
        self._lr.copy_(torch.where(self._actor_learns > 0.0, adapted, self._lr))
