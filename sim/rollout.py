"""The crossing task: robots cross terrains toward a goal, and what it cost them comes back."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

from kernels.episode import Outcome, command_goal, latch_outcomes, park_ended, start_episodes
from kernels.observation import Noise, apply_action, write_observation
from kernels.penalties import PENALTIES, add_penalties
from sim.bank import TerrainBank
from sim.crossing import CrossingCfg, make_episode_state, make_start_ranges, make_task
from sim.policy.loaders import PolicySpec, load_policy, prepare_torch
from sim.policy.runner import PolicyRunner
from sim.reward import RewardSum
from sim.robots.robot import RobotCfg
from sim.rollout_result import RolloutResult, RolloutState
from sim.simulation import Simulation, SolverCfg
from sim.space import SUPER_GAUSSIAN, TerrainSpace

__all__ = ["Rollout", "RolloutResult", "evaluate"]

_FALLEN_TILT_DEG = 60.0


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
        self._task = make_task(self.cfg, robot)
        self._ranges = make_start_ranges(self.cfg, robot)
        self._command = wp.zeros((num_envs, 3), dtype=float)
        self._action = wp.zeros((num_envs, robot.num_joints), dtype=float)
        self._last_action = wp.zeros_like(self._action)
        self._observation = wp.zeros((num_envs, robot.observation_size), dtype=float)
        self._noise_seed = wp.zeros(1, dtype=int)
        self._sums = wp.zeros((num_envs, len(PENALTIES)), dtype=float)
        self._everyone = wp.ones(num_envs, dtype=int)
        self._seeds = wp.zeros(self.num_terrains, dtype=wp.uint32)
        self._episode = self._stepped = make_episode_state(num_envs)
        self._reward: RewardSum | None = None
        if self.cfg.reward:
            task = make_task(self.cfg, robot)
            self._reward = RewardSum(self.sim, task, command=self._command, action=self._last_action)
            self._stepped = self._reward.episode  # goes on when a crossing has ended at the goal

    def _start(self, seeds: np.ndarray) -> None:
        self._seeds.assign(seeds)
        start_episodes(
            self._seeds, self.sim.terrain_of_env, self.num_replicas, self.sim.bank.terrain, self._ranges,
            self.sim.sensors.base_com, self.sim.sensors.default_joint_pos, self.sim.joint_q, self.sim.joint_qd,
            self._episode,
        )  # fmt: skip
        self.sim.clear_solver(self._everyone)
        self._sums.zero_()
        self._last_action.zero_()
        if self._reward is not None:
            self._reward.start()
        self.sim.refresh()
        self._observe()

    def _observe(self) -> None:
        command_goal(self.sim.joint_q, self._episode.outcome, self._task, self._command)
        write_observation(
            self.sim.joint_q, self.sim.joint_qd, self._command, self._last_action, self.sim.terrain_of_env,
            self.sim.bank.terrain, self.sim.sensors, Noise(), self._noise_seed, self._observation,
        )  # fmt: skip

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
            latch_outcomes(
                sim.joint_q, sim.joint_qd, sim.geom_force, sim.geom_role, sim.overflow, sim.contact_count,
                sim.contact_capacity, self._task, self._episode,
            )  # fmt: skip
            if self._reward is not None:
                self._reward.latch()
            add_penalties(
                sim.joint_q, sim.joint_qd, sim.sensors.base_com, self._command, sim.geom_force, sim.geom_role,
                robot.contact_force_limit, robot.physics_dt, self._episode.counted, self._sums,
            )  # fmt: skip
        if self._reward is not None:
            self._reward.add()
        self._observe()

    def evaluate(
        self,
        terrains: np.ndarray,
        seeds: np.ndarray,
        *,
        record_paths: bool = False,
        before_step: Callable[[], None] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> RolloutResult:
        """Run one crossing of every replica on every terrain.

        An episode depends on its terrain, the terrain's seed and its replica alone.

        Args:
            terrains: Genes, shape (num_terrains, num_genes), or heights [m], shape (num_terrains, nrow, ncol).
            seeds: One seed a terrain, shape (num_terrains,), uint32.
            record_paths: Keep the base's position at every control step.
            before_step: Called before every control step, to look at :attr:`state` (:mod:`sim.recording.recorder`).
            progress: Called at every poll with the share done of the most control steps.

        Raises:
            ValueError: If a shape does not fit or a value is not finite.
        """
        began = time.perf_counter()
        self.begin(terrains, seeds)
        paths: list[np.ndarray] | None = [] if record_paths else None

        def look() -> None:
            if paths is not None:
                running = self._episode.outcome.numpy() == Outcome.RUNNING
                paths.append(np.where(running[:, None], self.sim.joint_q.numpy()[:, :3], np.nan))
            if before_step is not None:
                before_step()

        control_steps = self._run(progress, look)
        return self._collect(control_steps, began, paths)

    @property
    def state(self) -> RolloutState:
        """What the rollout stands at, on the device."""
        return RolloutState(
            joint_q=self.sim.joint_q,
            geom_force=self.sim.geom_force,
            penalty_sums=self._sums,
            command=self._command,
            outcome=self._episode.outcome,
            steps=self._episode.steps,
        )

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

    def _run(self, progress: Callable[[float], None] | None, look: Callable[[], None]) -> int:
        most = round(self.cfg.max_duration_s / self.robot.control_dt)
        poll = max(1, round(self.cfg.poll_every_s / self.robot.control_dt))
        for step in range(1, most + 1):
            look()
            self.control_step()
            if step % poll == 0 or step == most:
                running_count = int(self._stepped.num_running.numpy()[0])
                if progress is not None:
                    progress(step / most)
                if running_count == 0:
                    return step
        return most

    def _collect(self, control_steps: int, began: float, paths: list[np.ndarray] | None) -> RolloutResult:
        shape = (self.num_terrains, self.num_replicas)
        outcome = self._episode.outcome.numpy().astype(np.uint8).reshape(shape)
        pose = self._episode.final_pose.numpy().reshape(*shape, 7).copy()  # on the CPU numpy() is a view
        columns = [PENALTIES.index(name) for name in self.robot.penalties]
        penalties = self._sums.numpy().astype(np.float64)[:, columns].reshape(*shape, len(columns))
        penalties[outcome == Outcome.INVALID] = np.nan
        reward = None if self._reward is None else self._reward.total().reshape(shape)
        if reward is not None:
            reward[outcome == Outcome.INVALID] = np.nan
        with np.errstate(invalid="ignore"):
            upright = 1.0 - 2.0 * (pose[..., 3] ** 2 + pose[..., 4] ** 2)
        return RolloutResult(
            penalties=penalties,
            penalty_names=self.robot.penalties,
            outcome=outcome,
            fallen=upright < np.cos(np.deg2rad(_FALLEN_TILT_DEG)),
            duration_s=(self._episode.steps.numpy() * self.robot.physics_dt).astype(np.float32).reshape(shape),
            final_position=pose[..., :3],
            physics_steps=control_steps * self.robot.decimation,
            wall_s=time.perf_counter() - began,
            paths=None if paths is None else np.stack(paths, axis=1).reshape(*shape, -1, 3).astype(np.float32),
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
