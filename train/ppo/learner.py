"""PPO on an environment, one iteration at a time: from a seed, from a trained controller, or from a checkpoint.

Several processes of one training, as torchrun starts them, take a GPU each: gradients are averaged, the first writes.
"""

import contextlib
import io
import os
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from torch import distributed

from sim.files.atomic import write_atomically
from sim.policy.loaders import MlpPolicy, load_policy, read_weights, reason_of
from sim.robots.robot import RobotCfg
from train.ppo.cfg import PpoCfg
from train.ppo.ppo import CapturedPPO, runner_settings
from train.task.vec_env import CommandVecEnv

CHECKPOINT_FORMAT = "faultline training checkpoint 1"
_ENTRIES = {
    "robot": (str,),
    "iter": (int,),
    "levels": (torch.Tensor,),
    "counter": (int,),
    "rng_cpu": (torch.Tensor,),
    "rng_cuda": (torch.Tensor, type(None)),
    "extra": (dict,),
}
_STD = "distribution.std_param"
State = dict[str, torch.Tensor]
"""Weights under rsl_rl's keys."""


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """Which of how many processes this one is."""

    rank: int = 0
    local_rank: int = 0
    """Its number on this machine, which is its GPU's."""
    size: int = 1

    @classmethod
    def of_environment(cls) -> "Ranks":
        """What torchrun put into RANK, LOCAL_RANK and WORLD_SIZE; one process without it."""
        rank, local_rank, size = (int(os.environ.get(name, 0)) for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"))
        return cls(rank=rank, local_rank=local_rank, size=max(1, size))

    @property
    def is_first(self) -> bool:
        """Whether this process prints and writes."""
        return self.rank == 0

    def device(self, name: str) -> str:
        """The Warp device of this process, where ``name`` was asked for.

        Raises:
            ValueError: If one GPU was named for several processes.
        """
        if self.size == 1 or not name.startswith("cuda"):
            return name
        if name not in ("cuda", "cuda:0"):
            raise ValueError(f"with torchrun each process takes its own GPU, got device {name}: give cuda, or leave it")
        return f"cuda:{self.local_rank}"

    def all_want(self, wish: bool, device: torch.device | str) -> bool:
        """Whether every process wishes so; all get the same answer."""
        if self.size == 1:
            return wish
        flag = torch.tensor(int(wish), device=device)
        distributed.all_reduce(flag, op=distributed.ReduceOp.MIN)
        return bool(flag.item())

    def check_same(self, parameters: list[torch.Tensor]) -> None:
        """That the processes hold the same numbers, as averaged gradients must leave them.

        Raises:
            FloatingPointError: If they do not.
        """
        if self.size == 1:
            return
        own = torch.cat([parameter.detach().flatten() for parameter in parameters])
        first = own.clone()
        distributed.broadcast(first, src=0)
        if not self.all_want(bool(torch.equal(own, first)), own.device):
            raise FloatingPointError("the networks of the processes have drifted apart: this training is not one")


class Runner(OnPolicyRunner):
    """rsl_rl's runner, which several processes may share on CPUs too."""

    def _configure_multi_gpu(self) -> None:
        if Ranks.of_environment().size == 1 or self.device.startswith("cuda"):
            super()._configure_multi_gpu()
            return
        ranks = Ranks.of_environment()
        self.is_distributed, self.gpu_world_size = True, ranks.size
        self.gpu_local_rank, self.gpu_global_rank = ranks.local_rank, ranks.rank
        self.cfg["multi_gpu"] = {"global_rank": ranks.rank, "local_rank": ranks.local_rank, "world_size": ranks.size}
        distributed.init_process_group("gloo")  # rsl_rl's own choice is NCCL, which CPUs do not have


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """What one iteration took and what the update said."""

    collection_s: float
    learning_s: float
    losses: dict[str, float]
    """Mean value, surrogate and entropy losses."""


class Learner:
    """Actor, critic and optimiser at work on an environment.

    Attributes:
        iteration: Iterations done, those before a resume included.
        averaged: Iterations whose actors are in the mean; 0: there is none.
        steps_per_iteration: Environment steps of an iteration, of all processes.
        ranks: Which process of a training this is.
    """

    def __init__(self, env: CommandVecEnv, cfg: PpoCfg, *, seed: int, random_ages: bool = True) -> None:
        """Draw the networks from ``seed``.

        Args:
            env: What is learned.
            cfg: Settings.
            seed: Of networks and actions.
            random_ages: Begin episodes with clocks set forward, so that they do not end together; such an episode is
                shorter than its length says, and ends by the clock without having had its time.
        """
        torch.manual_seed(seed)
        torch.set_float32_matmul_precision("high")  # TF32 on CUDA: half the learning time, no measurable loss
        self.env = env
        self.cfg = cfg
        self._random_ages = random_ages
        self.iteration = 0
        self.averaged = 0
        self._mean: State = {}
        self.ranks = Ranks.of_environment()
        self.steps_per_iteration = env.num_envs * cfg.steps_per_env * self.ranks.size
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the networks
            self.runner = Runner(env, runner_settings(cfg), log_dir=None, device=str(env.device))
        self.alg: CapturedPPO = self.runner.alg  # pyright: ignore[reportAttributeAccessIssue] - as its settings say
        if self.ranks.size > 1:
            self.alg.broadcast_parameters()
            self._draw_apart(seed)
        self._begin()

    def _draw_apart(self, seed: int) -> None:
        """Other random numbers from here on than the other processes draw."""
        torch.manual_seed((seed + 1) * 1_000_003 + self.iteration * 1009 + self.ranks.rank)

    def _begin(self) -> None:
        if self._random_ages:
            ages = torch.randint(0, int(self.env.max_episode_length), (self.env.num_envs,), device=self.env.device)
            self.env.episode_length_buf = ages
        self._observations = self.env.get_observations()

    def iterate(self) -> Iteration:
        """Collect ``steps_per_env`` control steps of every environment, then update the networks.

        Raises:
            FloatingPointError: If losses or networks are not finite: they are beyond use, the last checkpoint is not.
        """
        alg = self.alg
        began = time.perf_counter()
        alg.train_mode()
        with torch.inference_mode():
            for _ in range(self.cfg.steps_per_env):
                actions = alg.act(self._observations)
                self._observations, rewards, dones, extras = self.env.step(actions)
                alg.process_env_step(self._observations, rewards, dones, extras)
            alg.compute_returns(self._observations)
        if rewards.is_cuda:
            torch.cuda.synchronize()  # or the simulation's time would be counted as learning
        collected = time.perf_counter()
        losses = alg.update()
        if not all(map(torch.isfinite, torch.tensor(list(losses.values())))):
            raise FloatingPointError(f"iteration {self.iteration}: losses are not finite, got {losses}")
        # The last step may have spoiled the networks after their losses were computed.
        parameters = [*alg.actor.parameters(), *alg.critic.parameters()]
        if not torch.isfinite(torch.stack([parameter.detach().sum() for parameter in parameters])).all():
            raise FloatingPointError(f"iteration {self.iteration}: the networks' weights are not finite")
        self.iteration += 1
        return Iteration(collection_s=collected - began, learning_s=time.perf_counter() - collected, losses=losses)

    @property
    def noise_std(self) -> float:
        """Mean standard deviation of the actions."""
        return float(self.actor_state()[_STD].mean())

    def actor_state(self) -> State:
        """The actor under rsl_rl's keys, on the CPU."""
        return {key: value.detach().cpu().clone() for key, value in self.alg.get_policy().state_dict().items()}

    def mean_actor_state(self) -> State:
        """The mean of the actors counted so far, likewise; the present one where there are none."""
        return {**self.actor_state(), **{key: value.cpu().clone() for key, value in self._mean.items()}}

    def count_into_mean(self, counts: bool) -> None:
        """Count the present actor into the mean, or forget the mean where it does not count."""
        self.averaged = self.averaged + 1 if counts else 0
        if self.averaged <= 1:
            self._mean = {}
        for key, value in self.alg.get_policy().state_dict().items() if counts else ():
            if value.is_floating_point():
                self._mean.setdefault(key, value.detach().clone()).lerp_(value.detach(), 1.0 / self.averaged)

    def save(self, path: Path, extra: dict[str, Any]) -> None:
        """Write a checkpoint, whole or not at all; ``extra`` is plain data that comes back from a read."""
        task = self.env.task
        content = {
            **self.alg.save(),
            "format": CHECKPOINT_FORMAT,
            "robot": task.robot.name,
            "iter": self.iteration,
            "levels": task.levels.to(torch.uint8),
            "counter": int(task.counter.item()),
            "averaged": self.averaged,
            "mean_actor_state_dict": {key: value.cpu() for key, value in self._mean.items()},
            "rng_cpu": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state(task.observation.device) if task.observation.is_cuda else None,
            "extra": extra,
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_atomically(path, buffer.getvalue())

    def start_from(self, actor: State, critic: State | None) -> None:
        """Begin with a trained actor, and its critic where it is known, as :func:`read_start` gives them.

        Args:
            actor: State under rsl_rl's keys; without a standard deviation of the actions, the configured one is kept.
            critic: Likewise.
        """
        policy = self.alg.get_policy()
        policy.load_state_dict({_STD: policy.state_dict()[_STD], **actor})
        if critic is not None:
            self.alg.critic.load_state_dict(critic)

    def begin_again(self) -> None:
        """Go on from the environment as it is now: to be called between iterations when its episodes began anew."""
        self._observations = self.env.get_observations()

    def resume(self, content: dict[str, Any]) -> None:
        """Go on from a checkpoint: networks, optimiser, learning rate, terrain levels, random numbers.

        Episodes begin anew. With another number of environments the levels are dealt out in turn.

        Raises:
            ValueError: If the networks have other shapes, or something in it is damaged.
        """
        try:
            self.alg.load(content, None, True)
        except Exception as error:  # torch answers states that do not fit with many types
            raise ValueError(
                f"the checkpoint's networks do not fit: {' '.join(str(error).splitlines()[-1:]).strip()}; "
                "give the --ppo.hidden-dims it was trained with"
            ) from error
        try:
            self._restore(content)
        except Exception as error:
            raise ValueError(f"the checkpoint is damaged: {reason_of(error)}; give a copy of it to --resume") from error
        self._begin()

    def _restore(self, content: dict[str, Any]) -> None:
        """Iteration, terrain levels and random numbers of a checkpoint."""
        task = self.env.task
        self.iteration = content["iter"]
        self.averaged, self._mean = self._read_mean(content)
        most = task.tiles.num_levels - 1
        if len(content["levels"]) == 0 or int(content["levels"].max()) > most:
            raise ValueError(f"levels must be at least one, and at most {most} each")
        levels = content["levels"].to(task.levels.device, task.levels.dtype)
        task.counter.fill_(content["counter"])
        task.restart_all(levels[torch.arange(task.num_envs, device=levels.device) % len(levels)])
        torch.set_rng_state(content["rng_cpu"])
        if content["rng_cuda"] is not None and task.observation.is_cuda:
            torch.cuda.set_rng_state(content["rng_cuda"], task.observation.device)
        if self.ranks.size > 1:  # the state is the first process's
            self._draw_apart(int(torch.initial_seed()) % 2**31)

    def _read_mean(self, content: dict[str, Any]) -> tuple[int, State]:
        """How many actors the mean of a checkpoint is of, and the mean; an older checkpoint has none."""
        count, mean = content.get("averaged", 0), content.get("mean_actor_state_dict", {})
        if type(count) is not int or not 0 <= count <= content["iter"]:
            raise ValueError(f"averaged must be a number of iterations, at most {content['iter']}, got {count}")
        floats = {key: value for key, value in self.actor_state().items() if value.is_floating_point()}
        expected = {key: (value.shape, value.dtype) for key, value in floats.items() if count}
        if {key: (value.shape, value.dtype) for key, value in mean.items()} != expected:
            raise ValueError("mean_actor_state_dict must be none if averaged is 0, and else have the actor's weights")
        if not all(bool(value.isfinite().all()) for value in mean.values()):
            raise ValueError("mean_actor_state_dict has weights that are not finite")
        return count, {key: value.to(self.alg.device) for key, value in mean.items()}


def read_checkpoint(path: Path, robot: str) -> dict[str, Any]:
    """Content of a checkpoint that :meth:`Learner.save` wrote, tensors on the CPU; no code in it is run.

    Raises:
        ValueError: If the file is absent, truncated, foreign or of another robot.
    """
    remedy = "give the run directory of a training run to --resume"
    if not os.path.isfile(path):
        raise ValueError(f"no checkpoint at {path}: {remedy}, or leave --resume out to begin one")
    try:
        content = read_weights(path)
    except Exception as error:  # a stream of pickle opcodes can fail with anything
        raise ValueError(
            f"{path} is no checkpoint (truncated, foreign, or holding code): {reason_of(error)}; {remedy}"
        ) from error
    if not isinstance(content, dict) or content.get("format") != CHECKPOINT_FORMAT:
        raise ValueError(f"{path} must be a '{CHECKPOINT_FORMAT}', got another kind of file: {remedy}")
    if content.get("robot") != robot:
        raise ValueError(
            f"{path} is of robot '{content.get('robot')}', expected '{robot}': name its robot, or {remedy} of '{robot}'"
        )
    check_entries(content, _ENTRIES, path)
    return content


def check_entries(content: dict[str, Any], expected: dict[str, tuple[type, ...]], path: Path) -> None:
    """That a part of a checkpoint has its entries, each of one of its types.

    Raises:
        ValueError: If one is absent or of another type.
    """
    found = [(name, kinds[0].__name__, type(content.get(name))) for name, kinds in expected.items()]
    wrong = [f"{name} must be {kind}, got {got.__name__}" for name, kind, got in found if got not in expected[name]]
    if wrong:
        raise ValueError(f"{path} is a damaged checkpoint: {', '.join(wrong)}; put a copy of it back")


@dataclass(frozen=True, kw_only=True)
class Start:
    """A trained actor, and its critic where it is known."""

    actor: State
    critic: State | None
    hidden_dims: tuple[int, ...]
    """Hidden layers of both."""

    def with_noise_of(self, other: "Start") -> "Start":
        """The same with another's standard deviation of the actions, where that is known."""
        noise = {_STD: other.actor[_STD]} if _STD in other.actor else {}
        return replace(self, actor={**self.actor, **noise})


def read_start(path: Path, robot: RobotCfg) -> Start:
    """Networks of an rsl_rl checkpoint, fit to be trained on.

    A normaliser of the observations becomes part of the first layer: (x - mean) / (std + .01) is linear. The critic of
    such a file is left: its own normaliser is another.

    Raises:
        ValueError: If it is no such file, of another robot, or its standard deviation or critic cannot be trained on.
    """
    policy = load_policy(path, robot, "cpu")
    if not isinstance(policy, MlpPolicy):
        raise ValueError(
            f"a fine-tuning starts from an rsl_rl checkpoint (actor_state_dict), got another kind of controller: "
            f"{path}; train one with `{robot.train_command}`, and leave --policy out"
        )
    content = read_weights(path)
    actor = {key: value for key, value in content["actor_state_dict"].items() if not key.startswith("obs_normalizer.")}
    if policy.normalised:
        weight = actor["mlp.0.weight"] / (policy.std.flatten() + 1e-2)
        actor |= {"mlp.0.weight": weight, "mlp.0.bias": actor["mlp.0.bias"] - weight @ policy.mean.flatten()}
    hidden = tuple(layer.out_features for layer in policy.layers if isinstance(layer, torch.nn.Linear))[:-1]
    critic = None if policy.normalised else content.get("critic_state_dict")
    _check_std(actor, robot, path)
    if critic is not None:
        _check_critic(critic, (policy.sizes[0], *hidden, 1), path)
    return Start(actor=actor, critic=critic, hidden_dims=hidden)


def _check_std(actor: State, robot: RobotCfg, path: Path) -> None:
    std = actor.get(_STD)
    fits = std is None or (std.shape == (robot.num_joints,) and bool((std > 0.0).all()) and bool(std.isfinite().all()))
    if not fits:
        raise ValueError(
            f"{path}: {_STD}, the standard deviation of the actions, must be {robot.num_joints} numbers above 0, got "
            f"{' '.join(str(std).split())}: leave it out, or give another controller"
        )


def _check_critic(critic: Any, sizes: tuple[int, ...], path: Path) -> None:
    expected = {}
    for k, (width, out) in enumerate(pairwise(sizes)):
        expected |= {f"mlp.{2 * k}.weight": (out, width), f"mlp.{2 * k}.bias": (out,)}
    tensors = isinstance(critic, dict) and all(isinstance(value, torch.Tensor) for value in critic.values())
    if not tensors or {key: tuple(value.shape) for key, value in critic.items()} != expected:
        raise ValueError(
            f"{path}: its critic (critic_state_dict) must have the actor's hidden layers {list(sizes[1:-1])}, "
            f"{sizes[0]} inputs and one output, got another: leave it out of the file, and one is trained"
        )
    if not all(bool(value.isfinite().all()) for value in critic.values()):
        raise ValueError(f"{path}: its critic (critic_state_dict) has weights that are not finite: leave it out")
