"""PPO on an environment: one iteration at a time, and checkpoints from which training goes on where it stopped."""

import contextlib
import io
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from sim.files.atomic import write_atomically
from sim.policy.loaders import read_weights, reason_of
from train.ppo.ppo import CapturedPPO, PpoCfg, runner_settings
from train.ppo.ranks import Ranks, Runner
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
        self.ranks = Ranks.of_environment()
        self.steps_per_iteration = env.num_envs * cfg.steps_per_env * self.ranks.size
        with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the networks
            self.runner = Runner(env, runner_settings(cfg), log_dir=None, device=str(env.device))
        self.alg = self.runner.alg
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

    def set_pace(self, iterations: int) -> None:
        """Take the final settings once their share of all ``iterations`` begins; to be called before each."""
        cfg = self.cfg
        if cfg.final_share == 0.0:
            return
        final = self.iteration >= (1.0 - cfg.final_share) * iterations
        desired_kl, entropy = (cfg.final_kl, cfg.final_entropy) if final else (cfg.desired_kl, cfg.entropy)
        if isinstance(self.alg, CapturedPPO):
            self.alg.set_pace(desired_kl, entropy)
        else:
            self.alg.desired_kl, self.alg.entropy_coef = desired_kl, entropy

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
        return float(self.actor_state()["distribution.std_param"].mean())

    def actor_state(self) -> dict[str, torch.Tensor]:
        """The actor under rsl_rl's keys, on the CPU."""
        return {key: value.detach().cpu().clone() for key, value in self.alg.get_policy().state_dict().items()}

    def save(self, path: Path, extra: dict[str, Any]) -> None:
        """Write a checkpoint, whole or not at all.

        Args:
            path: File to write.
            extra: Plain numbers, strings, lists and dicts to come back from :func:`read_checkpoint`.
        """
        task = self.env.task
        content = {
            **self.alg.save(),
            "format": CHECKPOINT_FORMAT,
            "robot": task.robot.name,
            "iter": self.iteration,
            "infos": None,
            "levels": task.levels.to(torch.uint8),
            "counter": int(task.counter.item()),
            "rng_cpu": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state(task.observation.device) if task.observation.is_cuda else None,
            "extra": extra,
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_atomically(path, buffer.getvalue())

    def start_from(self, actor: dict[str, torch.Tensor], critic: dict[str, torch.Tensor] | None) -> None:
        """Begin with a trained actor, and its critic where it is known.

        Args:
            actor: State under rsl_rl's keys; without a standard deviation of the actions, the configured one is kept.
            critic: Likewise.

        Raises:
            ValueError: If one has other shapes than the networks.
        """
        own = self.alg.get_policy().state_dict()
        known = {"distribution.std_param": own["distribution.std_param"], **actor}
        for name, network, state in (("actor", self.alg.get_policy(), known), ("critic", self.alg.critic, critic)):
            try:
                if state is not None:
                    network.load_state_dict(state)
            except Exception as error:  # torch answers states that do not fit with many types
                reason = " ".join(str(error).split())
                raise ValueError(f"the controller's {name} does not fit the training's networks: {reason}") from error

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


def read_checkpoint(path: Path, robot: str) -> dict[str, Any]:
    """Read a checkpoint as data only (no code in it is run).

    Args:
        path: File written by :meth:`Learner.save`.
        robot: Name of the robot it must be of.

    Returns:
        Its content, tensors on the CPU.

    Raises:
        ValueError: If the file is absent, truncated, foreign or of another robot.
    """
    remedy = "give the run directory of a training run to --resume"
    if not os.path.isfile(path):
        raise ValueError(f"no checkpoint at {path}: {remedy}")
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
    wrong = {
        name: type(content.get(name)).__name__
        for name, kinds in expected.items()
        if type(content.get(name)) not in kinds
    }
    if wrong:
        found = ", ".join(f"{name} must be {expected[name][0].__name__}, got {got}" for name, got in wrong.items())
        raise ValueError(f"{path} is a damaged checkpoint: {found}; put a copy of it back")
