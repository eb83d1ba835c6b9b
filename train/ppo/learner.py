"""PPO on an environment, one iteration at a time: from a seed, from a trained controller, or from a checkpoint.

Several processes of one training, as torchrun starts them, take a GPU each: gradients are averaged, the first writes.
"""

import contextlib
import io
import math
import os
import time
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import distributed

from kernels.episode import Outcome
from sim.controllers.described import ControllerCfg, Described
from sim.controllers.spec import in_one_line
from train.cfg import PpoCfg
from train.ppo.checkpoint import STD, Start, State
from train.ppo.ppo import CapturedPPO, runner_settings
from train.task.task import CommandTask


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """Rank of this process among the processes of a training."""

    rank: int = 0
    local_rank: int = 0
    """Rank on this machine, the number of its GPU."""
    size: int = 1

    @classmethod
    def from_environment(cls) -> "Ranks":
        """Reads RANK, LOCAL_RANK and WORLD_SIZE, which torchrun sets; without them there is one process."""
        rank, local_rank, size = (int(os.environ.get(name, 0)) for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"))
        return cls(rank=rank, local_rank=local_rank, size=max(1, size))

    @property
    def is_first(self) -> bool:
        """Whether this process prints and writes."""
        return self.rank == 0

    def device(self, name: str) -> str:
        """The Warp device of this process; ``name`` is what the user asked for."""
        if self.size == 1 or not name.startswith("cuda"):
            return name
        if name not in ("cuda", "cuda:0"):
            raise ValueError(f"with torchrun each process takes its own GPU, got device {name}: give cuda, or leave it")
        return f"cuda:{self.local_rank}"

    def all_true(self, value: bool, device: torch.device | str) -> bool:
        """Whether ``value`` is true in every process; all get the same answer."""
        if self.size == 1:
            return value
        flag = torch.tensor(int(value), device=device)
        distributed.all_reduce(flag, op=distributed.ReduceOp.MIN)
        return bool(flag.item())

    def check_same(self, parameters: list[torch.Tensor]) -> None:
        """Raises a FloatingPointError if the parameters of the processes differ; averaged gradients keep them equal."""
        if self.size == 1:
            return
        numbers = torch.cat([parameter.detach().flatten() for parameter in parameters])
        first = numbers.clone()
        distributed.broadcast(first, src=0)
        if not self.all_true(bool(torch.equal(numbers, first)), numbers.device):
            raise FloatingPointError("the networks of the processes have drifted apart: this training is not one")


class CommandVecEnv(VecEnv):
    """rsl_rl's view of a :class:`CommandTask`: one observation group, ``policy``, for actor and critic.

    A described actor has another group, ``actor``, and acts through its description ``controller``. Every returned
    tensor is a copy, because the next step overwrites the task's memory.
    """

    def __init__(self, task: CommandTask, controller: ControllerCfg | None = None) -> None:
        self.task = task
        self.controller = controller
        self.num_envs, self.num_actions = task.num_envs, task.robot.num_joints
        self._described = None
        if controller is not None:
            self._described = Described(controller, task.robot, "the controller")
            self._described.use(None, task.observation.device)
            self.num_actions = self._described.num_actions
        self.max_episode_length = task.max_episode_steps
        self.device = str(task.observation.device)
        self.cfg = asdict(task.cfg)

    @property
    def episode_length_buf(self) -> torch.Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Control steps of each episode so far, shape (num_envs,); assigning writes into the task."""
        return self.task.episode_steps.clone()

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self.task.episode_steps.copy_(steps)

    def get_observations(self) -> TensorDict:
        """The present observations, ``policy`` of shape (num_envs, observation_size), when all episodes begin."""
        groups = {"policy": self.task.observation.clone()}
        if self._described is not None:
            self._described.reset(self.task.episode_steps == 0)
            groups["actor"] = self._described.observe(groups["policy"])
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Makes one control step with ``actions`` (num_envs, num_actions), without host synchronisation.

        Returns observations, rewards, dones, and ``{"time_outs": ...}``, those dones that no failure caused.
        """
        self.task.step(actions if self._described is None else self._described.act(actions))
        end = self.task.end
        # A robot at its goal or out of the world did not fail, so its value goes on as after a time-out.
        cut = (end == int(Outcome.TIME_OUT)) | (end == int(Outcome.GOAL)) | (end == int(Outcome.OUT))
        return self.get_observations(), self.task.reward.clone(), end != 0, {"time_outs": cut}


class Iteration(NamedTuple):
    """Durations of one iteration, and its mean value, surrogate and entropy losses."""

    collection_s: float
    learning_s: float
    losses: dict[str, float]


class Learner:
    """Actor, critic and optimiser on an environment.

    Attributes:
        iteration: Iterations done, including those before a resume.
        averaged: Number of iterations whose actors are in the mean; 0 if there is no mean.
        steps_per_iteration: Environment steps of an iteration, of all processes.
        ranks: Rank of this process.
    """

    def __init__(self, env: CommandVecEnv, cfg: PpoCfg, *, seed: int, random_ages: bool = True) -> None:
        """Draws networks and actions from ``seed``; ``random_ages`` keep the first episodes from ending together."""
        torch.manual_seed(seed)
        self.env, self.cfg, self._random_ages = env, cfg, random_ages
        self.iteration = self.averaged = 0
        self._mean: State = {}
        self.ranks = Ranks.from_environment()
        self.steps_per_iteration = env.num_envs * cfg.steps_per_env * self.ranks.size
        settings, device = runner_settings(cfg, env.controller), str(env.device)
        if self.ranks.size > 1:
            on_cuda = device.startswith("cuda")
            distributed.init_process_group("nccl" if on_cuda else "gloo")
            if on_cuda:
                torch.cuda.set_device(self.ranks.local_rank)
            settings["multi_gpu"] = {"global_rank": self.ranks.rank, "world_size": self.ranks.size}
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the networks
            alg: Any = CapturedPPO.construct_algorithm(env.get_observations(), env, settings, device)
        self.alg: CapturedPPO = alg
        if self.ranks.size > 1:
            self.alg.broadcast_parameters()
            self._draw_apart(seed)
        self.begin()

    def _draw_apart(self, seed: int) -> None:
        """Seeds this process's random numbers, different from those of the other processes."""
        torch.manual_seed((seed + 1) * 1_000_003 + self.iteration * 1009 + self.ranks.rank)

    def begin(self) -> None:
        """Starts from an environment whose episodes have all just begun."""
        if self._random_ages:
            ages = torch.randint(0, int(self.env.max_episode_length), (self.env.num_envs,), device=self.env.device)
            self.env.episode_length_buf = ages
        self._observations = self.env.get_observations()

    def iterate(self) -> Iteration:
        """Collects ``steps_per_env`` control steps of every environment, then updates the networks."""
        alg = self.alg
        began = time.perf_counter()
        alg.train_mode()
        with torch.inference_mode():
            for _ in range(self.cfg.steps_per_env):
                self._observations, rewards, dones, extras = self.env.step(alg.act(self._observations))
                alg.process_env_step(self._observations, rewards, dones, extras)
            alg.compute_returns(self._observations)
        if rewards.is_cuda:
            torch.cuda.synchronize()  # or the simulation's time would be counted as learning
        collected = time.perf_counter()
        losses = alg.update()
        # The last step may have made the networks non-finite after the losses were computed.
        parameters = [*alg.actor.parameters(), *alg.critic.parameters()]
        sums = torch.stack([parameter.detach().sum() for parameter in parameters]).tolist()
        if not all(map(math.isfinite, [*losses.values(), *sums])):
            got = f"losses {losses} or weights that are not: begin again with a lower --ppo.learning-rate"
            raise FloatingPointError(f"iteration {self.iteration}: losses and weights must be finite, got {got}")
        self.iteration += 1
        return Iteration(collected - began, time.perf_counter() - collected, losses)

    def actor_state(self) -> State:
        """The actor under rsl_rl's keys, on the CPU."""
        return {key: value.detach().cpu().clone() for key, value in self.alg.get_policy().state_dict().items()}

    def mean_actor_state(self) -> State:
        """The mean of the actors counted so far, under the same keys; the present actor if none is counted."""
        return {**self.actor_state(), **{key: value.cpu().clone() for key, value in self._mean.items()}}

    def count_into_mean(self, counts: bool) -> None:
        """Count the present actor into the mean, or clear the mean if the actor does not count."""
        self.averaged = self.averaged + 1 if counts else 0
        if self.averaged <= 1:
            self._mean = {}
        for key, value in self.alg.get_policy().state_dict().items() if counts else ():
            if value.is_floating_point():
                self._mean.setdefault(key, value.detach().clone()).lerp_(value.detach(), 1.0 / self.averaged)

    def state(self) -> dict[str, Any]:
        """Content of a checkpoint: networks, optimiser, terrain levels and random numbers, all on the CPU."""
        task = self.env.task
        return {
            **self.alg.save(),
            "robot": task.robot.name,
            "iter": self.iteration,
            "levels": task.levels.to(torch.uint8),
            "counter": int(task.counter.item()),
            "averaged": self.averaged,
            "mean_actor_state_dict": {key: value.cpu() for key, value in self._mean.items()},
            "rng_cpu": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state(task.observation.device) if task.observation.is_cuda else None,
        }

    def start_from(self, start: Start) -> None:
        """Begin with trained networks; without a standard deviation of the actions, the configured one stays."""
        policy = self.alg.get_policy()
        policy.load_state_dict({STD: policy.state_dict()[STD], **start.actor})
        if start.critic is not None:
            self.alg.critic.load_state_dict(start.critic)

    def resume(self, content: dict[str, Any]) -> None:
        """Go on from :meth:`state`; episodes begin anew."""
        task = self.env.task
        try:
            self.alg.load(content, None, True)
            self.iteration = content["iter"]
            self.averaged = content["averaged"]
            self._mean = {key: value.to(self.alg.device) for key, value in content["mean_actor_state_dict"].items()}
            task.counter.fill_(content["counter"])
            task.restart_all(content["levels"].to(task.levels.device, task.levels.dtype))
            torch.set_rng_state(content["rng_cpu"])
            if content["rng_cuda"] is not None and task.observation.is_cuda:
                torch.cuda.set_rng_state(content["rng_cuda"], task.observation.device)
        except Exception as error:  # torch raises many types for states that do not fit
            raise ValueError(f"the checkpoint is damaged: {in_one_line(error)}; put a copy of it back") from error
        if self.ranks.size > 1:  # the state is the first process's
            self._draw_apart(int(torch.initial_seed()) % 2**31)
        self.begin()
