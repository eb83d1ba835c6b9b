"""The crossing task: robots cross terrains toward a goal, and what it cost them comes back."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from kernels.episode import Outcome, begin_all, command_goal, end_all, latch_outcomes, make_episodes, park_ended
from kernels.observation import Noise, apply_action, write_observation
from kernels.penalties import PENALTIES, add_penalties
from kernels.restart import restart_episodes, seed_starts
from kernels.rewards import Rewards, remember_steps
from sim.bank import TerrainBank
from sim.crossing import CrossingCfg, make_start_ranges, make_task
from sim.policy.loaders import PolicySpec, load_policy, prepare_torch
from sim.policy.runner import PolicyRunner
from sim.reward import Reward
from sim.robots.robot import RobotCfg
from sim.simulation import Simulation, SolverCfg
from sim.space import SUPER_GAUSSIAN, TerrainSpace

_FALLEN_TILT_DEG = 60.0


@dataclass(frozen=True, kw_only=True)
class RolloutResult:
    """What came of every episode; arrays lead with (num_terrains, num_replicas)."""

    penalties: np.ndarray
    """Raw penalty sums times the physics step, unscaled; (T, R, P) float64, NaN where invalid."""
    penalty_names: tuple[str, ...]
    outcome: np.ndarray
    """:class:`kernels.episode.Outcome` of each episode, uint8."""
    invalidity: np.ndarray
    """:class:`kernels.episode.Invalidity` of each episode, uint8."""
    fallen: np.ndarray
    """Tilt above 60 degrees at the end, bool."""
    duration_s: np.ndarray
    """Simulated time up to the end [s], float32."""
    final_position: np.ndarray
    """Base position at the end, world-local [m], (T, R, 3) float32."""
    physics_steps: int
    """Physics steps run until the last episode ended."""
    wall_s: float
    reward: np.ndarray | None = None
    """Training reward summed to the end of the time, (T, R) float64, NaN where invalid; None unless asked for."""

    @property
    def base_collision(self) -> np.ndarray:
        """Ended by base collision, bool."""
        return self.outcome == Outcome.BASE_COLLISION

    @property
    def reached_goal(self) -> np.ndarray:
        """Ended at the goal, bool."""
        return self.outcome == Outcome.GOAL

    @property
    def invalid(self) -> np.ndarray:
        """Non-finite, too fast or overflowed, bool."""
        return self.outcome == Outcome.INVALID


@dataclass(frozen=True, kw_only=True)
class RolloutState:
    """Device arrays (Warp) of a rollout between two control steps, not copied; one row an environment."""

    joint_q: Any
    """Joint coordinates, shape (num_envs, 7 + num_joints)."""
    geom_force: Any
    """Contact force on each geom of ``robot.geom_names`` in the last physics step, world frame [N], vectors of shape
    (num_envs, num_geoms)."""
    penalty_sums: Any
    """Columns :data:`kernels.penalties.PENALTIES`, times the physics step, shape (num_envs, 6)."""
    command: Any
    """Command of the coming control step, zero once an episode has ended, shape (num_envs, 3)."""
    outcome: Any
    """:class:`kernels.episode.Outcome`, shape (num_envs,)."""
    steps: Any
    """Physics steps up to the end, shape (num_envs,)."""


class Rollout:
    """Crossings of ``num_terrains`` x ``num_replicas`` robots at once; built once, used again and again."""

    def __init__(
        self,
        robot: RobotCfg,
        policy: PolicySpec,
        *,
        num_terrains: int,
        num_replicas: int,
        device: str,
        cfg: CrossingCfg | None = None,
        solver: SolverCfg | None = None,
        space: TerrainSpace = SUPER_GAUSSIAN,
    ) -> None:
        """Load the policy, build the simulation and capture the control step.

        Args:
            robot: Robot settings.
            policy: The controller, by file, ``module:callable`` or as a callable on device tensors.
            num_terrains: Terrains of one evaluation.
            num_replicas: Episodes on each.
            device: Warp device name.
            cfg: The crossing.
            solver: Solver options.
            space: What the genes of terrains mean.

        Raises:
            ValueError: If the policy does not fit the robot, or a number is not positive.
        """
        if num_terrains < 1 or num_replicas < 1:
            raise ValueError(f"num_terrains and num_replicas must be positive, got {num_terrains} and {num_replicas}")
        self.robot = robot
        self.cfg = cfg or CrossingCfg()
        self.num_terrains = num_terrains
        self.num_replicas = num_replicas
        self.space = space
        prepare_torch(device)
        loaded = load_policy(policy, robot, device) if isinstance(policy, str | Path) else policy
        bank = TerrainBank(num_terrains, device=device)
        terrain_of_env = np.repeat(np.arange(num_terrains), num_replicas)
        self.sim = Simulation(robot, bank, terrain_of_env, cfg=solver)
        with wp.ScopedDevice(device):
            self._allocate()
            self._start(np.zeros(num_terrains, dtype=np.uint32))
            self._policy = PolicyRunner(loaded, self._observation, self._action)
            self._graph = self.sim.capture(self._launch_control_step)

    def _allocate(self) -> None:
        num_envs, robot = self.sim.num_envs, self.robot
        self._ranges = make_start_ranges(self.cfg, robot)
        self._command = wp.zeros((num_envs, 3), dtype=float)
        self._action = wp.zeros((num_envs, robot.num_joints), dtype=float)
        self._last_action = wp.zeros_like(self._action)
        self._observation = wp.zeros((num_envs, robot.observation_size), dtype=float)
        self._counter = wp.zeros(1, dtype=int)
        self._sums = wp.zeros((num_envs, len(PENALTIES)), dtype=float)
        self._everyone = wp.ones(num_envs, dtype=int)
        self._seeds = wp.zeros(self.num_terrains, dtype=wp.uint32)
        self._task = make_task(self.cfg, robot)
        self._episode = self._stepped = make_episodes(num_envs)
        self._latches = [(self._task, self._episode)]
        self._reward: Reward | None = None
        if self.cfg.reward:
            # A second set of episodes runs beside the crossing's, the same but without a goal. While one of them runs,
            # its robot is stepped and paid. A base collision is a fall; an invalid state costs nothing.
            io = {"command": self._command, "action": self._last_action}
            self._reward = Reward(self.sim, robot.training, falls=(Outcome.BASE_COLLISION,), **io)
            self._stepped = make_episodes(num_envs)
            self._latches.append((make_task(self.cfg, robot, to_goal=False), self._stepped))
        self._rewards = Rewards() if self._reward is None else self._reward.state

    def _start(self, seeds: np.ndarray) -> None:
        sim = self.sim
        self._seeds.assign(seeds)
        begin_all(self._stepped)
        end_all(self._episode)
        seed_starts(self._seeds, sim.terrain_of_env, self.num_replicas, self._episode)
        restart_episodes(
            sim.terrain_of_env, sim.bank.terrain, self._ranges, sim.sensors, sim.joint_q, sim.joint_qd,
            self._last_action, self._episode, self._rewards,
        )  # fmt: skip
        self._remember()
        sim.clear_solver(self._everyone)
        self._sums.zero_()
        sim.refresh()
        self._observe()

    def _observe(self) -> None:
        command_goal(self.sim.joint_q, self._episode.outcome, self._task, self._command)
        write_observation(
            self.sim.joint_q, self.sim.joint_qd, self._command, self._last_action, self.sim.terrain_of_env,
            self.sim.bank.terrain, self.sim.sensors, Noise(), self._counter, self._observation,
        )  # fmt: skip

    def _remember(self) -> None:
        if self._reward is not None:
            remember_steps(self._last_action, self.sim.joint_qd, self._rewards, self._counter)

    def _launch_control_step(self) -> None:
        sim, robot = self.sim, self.robot
        apply_action(self._action, sim.sensors, robot.action_scale, self._last_action, sim.targets)
        park_ended(
            self._stepped.outcome, sim.sensors.default_joint_pos, sim.joint_q, sim.joint_qd, sim.targets,
            sim.body_q.reshape((sim.num_envs, -1)),
        )  # fmt: skip
        for _ in range(robot.decimation):
            sim.physics_step()
            sim.read_geom_forces()
            for task, episode in self._latches:
                latch_outcomes(
                    sim.joint_q, sim.joint_qd, self._last_action, sim.geom_force, sim.geom_role, sim.overflow,
                    sim.contact_count, sim.contact_capacity, task, episode,
                )  # fmt: skip
            add_penalties(
                sim.joint_q, sim.joint_qd, sim.sensors.base_com, self._command, sim.geom_force, sim.geom_role,
                robot.contact_force_limit, robot.physics_dt, self._episode.counted, self._sums,
            )  # fmt: skip
        if self._reward is not None:
            self._reward.pay(self._stepped.outcome)
        self._remember()
        self._observe()

    def evaluate(
        self,
        terrains: np.ndarray,
        seeds: np.ndarray,
        *,
        before_step: Callable[[], None] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> RolloutResult:
        """Run one crossing of every replica on every terrain.

        An episode depends on its terrain, the terrain's seed and its replica alone.

        Args:
            terrains: Genes, shape (num_terrains, num_genes), or heights [m], shape (num_terrains, nrow, ncol).
            seeds: One seed a terrain, shape (num_terrains,), uint32.
            before_step: Called before every control step, to look at :attr:`state` (:mod:`sim.recording.recorder`).
            progress: Called at every poll with the share done of the most control steps.

        Raises:
            ValueError: If a shape does not fit or a value is not finite.
        """
        began = time.perf_counter()
        self.begin(terrains, seeds)
        control_steps = self._run(progress, before_step)
        return self._collect(control_steps, began)

    @property
    def state(self) -> RolloutState:
        """The rollout's present state, on the device."""
        sim, episode = self.sim, self._episode
        return RolloutState(
            joint_q=sim.joint_q, geom_force=sim.geom_force, penalty_sums=self._sums, command=self._command,
            outcome=episode.outcome, steps=episode.steps,
        )  # fmt: skip

    def begin(self, terrains: np.ndarray, seeds: np.ndarray) -> None:
        """Set the terrains and put every robot at its start; arguments and errors as of :meth:`evaluate`."""
        if seeds.shape != (self.num_terrains,):
            raise ValueError(f"seeds must have shape ({self.num_terrains},), one a terrain, got {seeds.shape}")
        with wp.ScopedDevice(self.sim.device):
            if terrains.ndim == 3:
                self.sim.bank.set_heights(terrains)
            else:
                self.sim.bank.set_genes(terrains, self.space)
            self._start(seeds.astype(np.uint32))
        self._policy.reset()

    def control_step(self) -> None:
        """Let the policy act, then run the captured control step, without waiting for either."""
        self._policy()
        self.sim.launch(self._graph)

    def _run(self, progress: Callable[[float], None] | None, before_step: Callable[[], None] | None) -> int:
        most = round(self.cfg.max_duration_s / self.robot.control_dt)
        poll = max(1, round(self.cfg.poll_every_s / self.robot.control_dt))
        for step in range(1, most + 1):
            if before_step is not None:
                before_step()
            self.control_step()
            if step % poll == 0 or step == most:
                running_count = int(self._stepped.num_running.numpy()[0])
                if progress is not None:
                    progress(step / most)
                if running_count == 0:
                    return step
        return most

    def _collect(self, control_steps: int, began: float) -> RolloutResult:
        shape = (self.num_terrains, self.num_replicas)
        outcome = self._episode.outcome.numpy().astype(np.uint8).reshape(shape)
        pose = self._episode.final_pose.numpy().reshape(*shape, 7).copy()  # on the CPU numpy() is a view
        columns = [PENALTIES.index(name) for name in self.robot.penalties]
        penalties = self._sums.numpy().astype(np.float64)[:, columns].reshape(*shape, len(columns))
        penalties[outcome == Outcome.INVALID] = np.nan
        reward = None
        if self._reward is not None:
            reward = self._rewards.total.numpy().astype(np.float64).reshape(shape)
            reward[outcome == Outcome.INVALID] = np.nan
        with np.errstate(invalid="ignore"):
            upright = 1.0 - 2.0 * (pose[..., 3] ** 2 + pose[..., 4] ** 2)
        return RolloutResult(
            penalties=penalties,
            penalty_names=self.robot.penalties,
            outcome=outcome,
            invalidity=self._episode.invalidity.numpy().astype(np.uint8).reshape(shape),
            fallen=upright < np.cos(np.deg2rad(_FALLEN_TILT_DEG)),
            duration_s=(self._episode.steps.numpy() * self.robot.physics_dt).astype(np.float32).reshape(shape),
            final_position=pose[..., :3],
            physics_steps=control_steps * self.robot.decimation,
            wall_s=time.perf_counter() - began,
            reward=reward,
        )


def evaluate(
    robot: RobotCfg, policy: PolicySpec, terrains: np.ndarray, replicas: int, *, seed: int = 0, device: str = "cpu"
) -> RolloutResult:
    """Cross each terrain ``replicas`` times with one controller (:class:`Rollout` for repeated use).

    Args:
        robot: Robot settings.
        policy: The controller.
        terrains: Genes (num_terrains, 64) or heights (num_terrains, nrow, ncol).
        replicas: Episodes a terrain.
        seed: Seeds the terrains' streams.
        device: Warp device name.
    """
    rollout = Rollout(robot, policy, num_terrains=len(terrains), num_replicas=replicas, device=device)
    return rollout.evaluate(terrains, np.random.SeedSequence(seed).generate_state(len(terrains), np.uint32))
