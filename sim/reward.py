"""The reward of a crossing: that of the robot's training, summed over the whole time, whatever the crossing came to."""

from dataclasses import asdict
from typing import Any

import numpy as np
import warp as wp

from kernels.episode import EpisodeState, latch_outcomes
from kernels.goal import Task
from kernels.paid_steps import add_paid, make_paid_steps, mark_paid, start_paying
from kernels.rewards import REWARDS, RewardWeights, make_feet, reward_steps
from sim.crossing import make_episode_state
from sim.motion import make_motion
from sim.simulation import Simulation


class RewardSum:
    """Sums the training reward of every robot from its start to the end of its time.

    Beside the crossing it keeps a second set of episodes, the same but without a goal: base collision, leaving the
    world, an invalid state or the time end them. A base collision is a fall; tilt, which ends an episode of the
    training, ends none here.

    Attributes:
        episode: The episodes without a goal; while one runs, its robot must be stepped.
    """

    def __init__(self, sim: Simulation, task: Task, *, command: Any, action: Any) -> None:
        """Allocate on the current device.

        Args:
            sim: The robots.
            task: Limits of the crossing; its goal is taken out.
            command: Command the action answers, shape (num_envs, 3).
            action: Clipped action of the step, shape (num_envs, num_joints).

        Raises:
            ValueError: If the robot's training settings do not fit it.
        """
        robot, training = sim.robot, sim.robot.training
        self.episode: EpisodeState = make_episode_state(sim.num_envs)
        self._only_positive, self._sim, self._action = training.only_positive, sim, action
        self._task = task
        self._task.goal_radius = 0.0  # nobody is nearer than that
        self._weights = RewardWeights()
        for name, weight in asdict(training.rewards).items():
            setattr(self._weights, name, weight)
        geoms = len(robot.geom_names)
        self._feet = make_feet(sim.num_envs, geoms, sim.device, min_air_time_s=training.min_air_time_s)
        self._paid = make_paid_steps(sim.num_envs, robot.num_joints)
        self._terms = wp.zeros((sim.num_envs, len(REWARDS)), dtype=float)
        self._motion = make_motion(
            sim,
            training,
            command=command,
            action=action,
            previous_action=self._paid.previous_action,
            previous_joint_vel=self._paid.previous_joint_vel,
            fallen=self._paid.fallen,
        )

    def start(self) -> None:
        """Begin again, with robots that were just put down."""
        self.episode.outcome.zero_()
        self.episode.steps.zero_()
        self.episode.num_running.fill_(self._sim.num_envs)
        self._feet.air_time.zero_()
        self._feet.touched.zero_()
        start_paying(self._sim.joint_qd, self._paid)

    def latch(self) -> None:
        """Judge the episodes after a physics step."""
        sim = self._sim
        latch_outcomes(
            sim.joint_q, sim.joint_qd, sim.geom_force, sim.geom_role, sim.overflow, sim.contact_count,
            sim.contact_capacity, self._task, self.episode,
        )  # fmt: skip

    def add(self) -> None:
        """Reward the control step just made, before the next command is written."""
        mark_paid(self.episode.outcome, self._paid)
        reward_steps(
            self._motion,
            self._weights,
            only_positive=self._only_positive,
            valid=self._paid.valid,
            feet_out=self._feet,
            reward_out=self._paid.reward,
            terms_out=self._terms,
        )
        add_paid(self._action, self._sim.joint_qd, self._paid)

    def total(self) -> np.ndarray:
        """Reward of each episode so far, float64, shape (num_envs,)."""
        return self._paid.total.numpy().astype(np.float64)
