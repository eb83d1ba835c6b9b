"""The command-following task as an rsl_rl environment."""

from dataclasses import asdict
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from kernels.episode import Outcome
from sim.controllers.described import ControllerCfg, Described
from train.task.task import CommandTask


class CommandVecEnv(VecEnv):
    """rsl_rl's view of a :class:`CommandTask`: one observation group, ``policy``, for actor and critic.

    A described actor has another group, ``actor``, and acts through its description.

    Every returned tensor is a copy: rsl_rl keeps the observation it acted on, and the task overwrites its memory in the
    next step.
    """

    def __init__(self, task: CommandTask, controller: ControllerCfg | None = None) -> None:
        """Wrap a task; ``controller`` describes an actor with other observations and actions than the task's."""
        self.task = task
        self.controller = controller
        self._described = None if controller is None else Described(controller, task.robot, "the controller")
        self.num_envs = task.num_envs
        self.num_actions = task.robot.num_joints if self._described is None else self._described.num_actions
        if self._described is not None:
            self._described.use(None, task.observation.device)
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
        """The present observations, ``policy``: shape (num_envs, observation_size).

        Call it when all episodes begin; :meth:`step` returns those after each step.
        """
        groups = {"policy": self.task.observation.clone()}
        if self._described is not None:
            self._described.reset(self.task.episode_steps == 0)
            groups["actor"] = self._described.observe(groups["policy"])
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Make one control step with ``actions`` (num_envs, num_actions), without host synchronisation.

        Returns observations after it (of the new episode if one ended), rewards (num_envs,), dones (num_envs,) and
        ``{"time_outs": (num_envs,)}``, the dones that no failure caused.
        """
        self.task.step(actions if self._described is None else self._described.act(actions))
        end = self.task.end
        # A robot at its goal or out of the world did not fail, so its value goes on as after a time-out.
        cut = (end == int(Outcome.TIME_OUT)) | (end == int(Outcome.GOAL)) | (end == int(Outcome.OUT))
        return self.get_observations(), self.task.reward.clone(), end != 0, {"time_outs": cut}
