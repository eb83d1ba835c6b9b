"""The crossing task: robots cross terrains toward a goal, and what it cost them comes back."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from kernels.episode import (
    FALLEN_GRAVITY_Z,
    Kind,
    Outcome,
    begin_episodes,
    command_goal,
    command_steered,
    latch_outcomes,
    make_episodes,
    park_ended,
)
from kernels.observation import apply_action
from kernels.penalties import PENALTIES, add_penalties, penalty_columns
from kernels.queue import make_queue, make_ready, ring_slices, turn_over
from kernels.rewards import Rewards, remember_steps
from kernels.route import follow_routes
from sim.controllers.loaders import Policy, PolicySpec, load_policy, prepare_torch
from sim.controllers.runner import Memory, PolicyRunner
from sim.crossing import CrossingCfg, SolverCfg, make_start_ranges, make_task, make_trail
from sim.recording.frames import Frames
from sim.robots.find import read_stray
from sim.robots.robot import RobotCfg
from sim.terrains.bank import TerrainBank
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.registry import check_conditions, space_key
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains

_LOOKS_AHEAD = 2  # at what has ended: what a GPU has to do while its host asks for terrains, 0.3 s of 22,400 robots


@dataclass(frozen=True, kw_only=True)
class RolloutResult:
    """What came of every episode; arrays lead with (num_terrains, replicas)."""

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
    deviation: np.ndarray
    """Largest distance of the base from the straight line between start and goal [m], float32."""
    physics_steps: int = 0
    """Physics steps run for it: since the result before, or since it was put in if nothing else was."""
    robot_steps: int = 0
    """Physics steps of all robots in that time, those that waited included."""
    busy_steps: int = 0
    """Those of them in which a robot had an episode, each to the end of its control step."""
    wall_s: float = 0.0
    """Time that took [s]."""
    reward: np.ndarray | None = None
    """Training reward summed to the end of the time, (T, R) float64, NaN where invalid; None unless asked for."""
    frames: Frames | None = None
    """What the robots did at every control step; None unless asked for."""

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

    @property
    def idle_share(self) -> float:
        """Share of the robots' steps in which they waited."""
        return 1.0 - self.busy_steps / self.robot_steps if self.robot_steps else 0.0

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Its arrays by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}

    def __getitem__(self, rows: np.ndarray) -> "RolloutResult":
        frames = None if self.frames is None else self.frames[rows]
        return replace(self, **{name: values[rows] for name, values in self.arrays.items()}, frames=frames)

    @staticmethod
    def join(results: Sequence["RolloutResult"], *, at_once: bool = False, axis: int = 0) -> "RolloutResult":
        """Results that ran one after the other, or at the same time if ``at_once``; terrains, or replicas on axis 1."""
        if len(results) == 1:
            return results[0]
        tables = [result.arrays for result in results]
        changes: dict[str, Any] = {name: np.concatenate([t[name] for t in tables], axis=axis) for name in tables[0]}
        if results[0].frames is not None:
            changes["frames"] = Frames.join([result.frames for result in results if result.frames is not None])
        for name in ("physics_steps", "robot_steps", "busy_steps", "wall_s"):
            combine = max if at_once and name in ("physics_steps", "wall_s") else sum
            changes[name] = combine(getattr(result, name) for result in results)
        return replace(results[0], **changes)


@dataclass(frozen=True, kw_only=True)
class _Lot:
    """Terrains that were put in together."""

    slots: tuple[slice, ...]
    """Where they lie in the ring, in order."""
    num_episodes: int
    max_steps: int
    """Control steps by which they have ended if nothing else is under way."""
    start_step: int
    """Control steps made before."""


class Rollout:
    """Crossings: ``num_envs`` robots run any number of episodes, and each takes the next when its own has ended.

    Built once, used again and again. Terrains are put in and their results taken out in the same order; several lots
    may be under way, so that robots have work while the last episodes of one lot still run. :meth:`evaluate` does both
    for a single lot.

    An episode depends on its terrain, the terrain's seed and its replica alone, whichever robot runs it beside whatever
    others; bit for bit, if its controller gives a row the same action in any batch.

    Attributes:
        sim: The robots' simulation.
        penalty_sums: Columns :data:`kernels.penalties.PENALTIES`, times the physics step, (num_envs, num_penalties).
        command: Command of the coming control step, zero once an episode has ended, shape (num_envs, 3).
        episode: The episode that a robot runs: replica ``episode % replicas`` of terrain slot
            ``episode // replicas``, -1 for none; shape (num_envs,).
        outcome: :class:`kernels.episode.Outcome` of it, shape (num_envs,).
        trail: How routes were commanded and walked (:mod:`kernels.route`); None where all episodes are crossings.
        watch: Looks at these arrays before every control step (it is called with False), where a robot that has just
            taken an episode stands at its start, and after it (True), before robots take the next.
    """

    def __init__(
        self,
        robot: RobotCfg,
        policy: PolicySpec,
        *,
        num_terrains: int,
        replicas: int,
        device: str,
        num_envs: int | None = None,
        cfg: CrossingCfg | None = None,
        solver: SolverCfg | None = None,
        space: TerrainSpace = SUPER_GAUSSIAN,
        with_ground: bool = False,
        with_conditions: bool = False,
        with_steering: bool = False,
    ) -> None:
        """Load the policy, build the simulation and capture the control step.

        The policy is a file, ``module:callable`` or a callable on device tensors. ``num_terrains`` may be under way at
        once, with ``replicas`` episodes on each, run by ``num_envs`` robots: one an episode if None, and never
        more. Heights may come with maps of the ground if ``with_ground``, and with conditions if ``with_conditions``;
        with genes the space decides. ``with_steering`` they may have ways of their episodes.
        """
        if num_terrains < 1 or replicas < 1 or (num_envs is not None and num_envs < 1):
            got = f"{num_terrains}, {replicas} and {num_envs}"
            raise ValueError(f"num_terrains, replicas and num_envs must be positive, got {got}")
        check_conditions(space.conditions, robot)
        self.robot = robot
        self.cfg = cfg or CrossingCfg()
        self.num_terrains = num_terrains
        self.replicas = replicas
        self.num_envs = min(num_envs or num_terrains * replicas, num_terrains * replicas)
        self.space = space
        self.watch: Callable[[bool], None] | None = None
        asked = with_conditions or space.asks != Kind.CROSS  # whether episodes may be no crossings
        with_ground |= bool(space.ground)
        with_conditions |= space.has_conditions
        prepare_torch(device)
        loaded = load_policy(policy, robot, device) if isinstance(policy, str | Path) else policy
        try:
            bank = TerrainBank(num_terrains, device=device, with_ground=with_ground, with_conditions=with_conditions)
            self._build(bank, loaded, solver, asked=asked, steered=with_steering)
        except (MemoryError, RuntimeError) as error:  # those of Warp have no type of their own
            failed = isinstance(error, MemoryError | torch.OutOfMemoryError)
            if not failed and not str(error).startswith("Failed to allocate"):
                raise
            rule = f"num_envs and num_terrains must fit the memory that {device} has free"
            got = f"{self.num_envs:,} robots and {num_terrains:,} terrains at once"
            raise ValueError(f"{rule}, got {got}: give fewer") from error

    def _build(
        self, bank: TerrainBank, policy: Policy, solver: SolverCfg | None, *, asked: bool, steered: bool
    ) -> None:
        from sim.simulation import Reward, Simulation  # Newton takes seconds to load: only what simulates loads it

        robot = self.robot
        num_envs = self.num_envs
        self.sim = sim = Simulation(robot, bank, np.zeros(num_envs, dtype=int), cfg=solver)
        self._lots: deque[_Lot] = deque()  # under way, the oldest first
        self._next_slot = 0  # of the ring, where the next terrain goes
        self._num_unreleased = 0  # episodes that were put in and no robot may take yet
        self._max_episode_steps = round(robot.max_duration_s / robot.control_dt)
        self._step = 0  # control steps made so far
        self._began_at = 0  # the step at which all robots last began together
        self._taken_at = 0  # step and time of the last result
        self._taken_s = time.perf_counter()
        with wp.ScopedDevice(bank.device):
            self.command = wp.zeros((num_envs, 3), dtype=float)
            self._action = wp.zeros((num_envs, robot.num_joints), dtype=float)
            self._last_action = wp.zeros_like(self._action)
            self._observation = wp.zeros((num_envs, robot.observation_size), dtype=float)
            self._counter = wp.zeros(1, dtype=int)
            self.penalty_sums = wp.zeros((num_envs, len(PENALTIES)), dtype=float)
            self._queue = make_queue(
                num_envs, self.num_terrains, self.replicas, len(PENALTIES),
                rewarded=self.cfg.reward, steered=steered, device=bank.device,
            )  # fmt: skip
            self.episode = self._queue.episode_of_env
            self._ranges = make_start_ranges(self.cfg, robot)
            self._robot_step = sim.make_step(self.command, self._last_action)
            routes = self.cfg.stray_m is None and self.space.asks == Kind.ROUTE
            is_resolved = solver is not None and solver.time_constant_s is not None
            stray = {"stray_m": read_stray(robot, resolved=is_resolved)} if routes else {}
            task_cfg = replace(self.cfg, **stray)
            self._task = make_task(task_cfg, robot)
            self._episode = self._stepped = make_episodes(num_envs)
            self.outcome = self._episode.outcome
            self._latches = [(self._task, self._episode)]
            self._reward = None
            if self.cfg.reward:
                # A second set of episodes runs beside the crossing's, the same but without a goal. While one of them
                # runs, its robot is stepped and paid. A base collision is a fall; an invalid state costs nothing.
                self._reward = Reward(sim, robot.training, self._robot_step, falls=(Outcome.BASE_COLLISION,))
                self._stepped = make_episodes(num_envs)
                self._latches.append((make_task(self.cfg, robot, to_goal=False), self._stepped))
            self.trail = make_trail(num_envs, robot, bank.device) if asked else None
            self._rewards = Rewards() if self._reward is None else self._reward.state
            self._policy = PolicyRunner(policy, self._observation, self._action, self._queue.begins)
            self._step_graph = sim.capture(self._launch_control_step)
            self._turn_graph = sim.capture(self._launch_turn_over)

    def _launch_control_step(self) -> None:
        sim = self.sim
        sensors = sim.sensors
        stepped = self._stepped.outcome
        apply_action(self._action, sensors, self.robot.action_scale, self._last_action, sim.targets)
        park_ended(stepped, sensors.default_joint_pos, sim.joint_q, sim.joint_qd, sim.targets, sim.parked)
        for k in range(self.robot.decimation):
            sim.physics_step(follows=k > 0)
            sim.read_geom_forces()
            for task, episode in self._latches:
                latch_outcomes(self._robot_step, task, episode)
            add_penalties(self._robot_step, self.robot.physics_dt, self._episode.counted, self.penalty_sums)
        if self._reward is not None:
            self._reward.pay(stepped)

    def _launch_turn_over(self) -> None:
        sim = self.sim
        queue = self._queue
        episode = self._episode
        turn_over(self._stepped.outcome, self._rewards, episode, self.penalty_sums, sim.terrain_of_env, queue)
        sim.restart(queue.begins, self._robot_step, self._ranges, episode, self._rewards)
        if self._reward is not None:
            begin_episodes(queue.begins, self._stepped)
            remember_steps(self._last_action, sim.joint_qd, self._rewards, self._counter)
        command_goal(sim.joint_q, episode.outcome, self._task, self.command)
        if self.trail is not None:
            row = sim.disturbed.row
            follow_routes(sim.joint_q, row, self._task, self.robot.control_dt, episode, self.trail, self.command)
        if queue.steering.shape[0]:
            steered = (queue.steering, queue.episode_of_env)
            command_steered(sim.joint_q, episode.outcome, *steered, self._task, self.command)
        sim.observe(self._robot_step, episode, self.robot.physics_dt, None, self._counter, self._observation)

    @property
    def num_free(self) -> int:
        """Terrains that may be put in now."""
        return self.num_terrains - sum(lot.num_episodes for lot in self._lots) // self.replicas

    def evaluate(self, terrains: Terrains, progress: Callable[[float], None] | None = None) -> RolloutResult:
        """Run one crossing of every replica on every terrain, of at most ``num_terrains``; drops all pending lots.

        ``progress`` is called now and then with the share that is done.
        """
        self.clear()
        try:
            self.put(terrains)
            return self.take(progress)
        finally:
            self.clear()

    def clear(self) -> None:
        """Drop all pending lots."""
        if not self._lots:
            return
        self._lots.clear()
        self._num_unreleased = 0
        for _, episode in self._latches:
            episode.outcome.fill_(int(Outcome.TIME_OUT))
        self._queue.episode_of_env.fill_(-1)

    def put(self, terrains: Terrains) -> None:
        """Queue crossings of at most :attr:`num_free` terrains; waits for nothing."""
        count = len(terrains)
        idle = not self._lots
        if not 1 <= count <= self.num_free:
            raise ValueError(f"terrains must be 1 to {self.num_free} at once here, got {count}")
        spaces = [space_key(space.name, space.sha256) for space in (terrains.space, self.space)]
        if terrains.genes is not None and spaces[0] != spaces[1]:
            raise ValueError(f"genes must be of the space {self.space.name} here, got {terrains.space.name}")
        asks = terrains.ground is not None and (terrains.ground.rows[:, -1] == Kind.ROUTE).any()
        if asks and (self.cfg.stray_m is None or self.trail is None):
            raise ValueError(
                "heights with routes need with_conditions and CrossingCfg.stray_m: give both, or genes of a space"
            )
        num_ways = 0 if terrains.steering is None else terrains.steering.shape[1]
        if num_ways != (self.replicas if self._queue.steering.shape[0] else 0):
            raise ValueError(f"terrains must have {self.replicas} ways each if with_steering, else 0, got {num_ways}")
        slots = ring_slices(0 if idle else self._next_slot, count, self.num_terrains)
        written = 0
        with wp.ScopedDevice(self.sim.device):
            for run in slots:
                lot = terrains[written : written + run.stop - run.start]
                self.sim.bank.set(lot, run)
                self._queue.seed[run].assign(lot.seeds.astype(np.uint32))
                self._queue.num_ended[run].zero_()
                if lot.steering is not None:
                    rows = slice(run.start * self.replicas, run.stop * self.replicas)
                    self._queue.steering[rows].assign(lot.steering.reshape(-1, *lot.steering.shape[2:]))
                written += len(lot)
        num_episodes = count * self.replicas
        max_steps = self._max_episode_steps * -(-num_episodes // self.num_envs)
        self._lots.append(_Lot(slots=slots, num_episodes=num_episodes, max_steps=max_steps, start_step=self._step))
        self._next_slot = slots[-1].stop % self.num_terrains
        self._num_unreleased += num_episodes
        if idle:
            for counts in (self._queue.taken, self._queue.ready, self._queue.busy):
                counts.zero_()
            self._began_at = self._taken_at = self._step
            self._taken_s = time.perf_counter()
        if idle or self._policy.memory is not Memory.SHARED:
            self._release(begin=idle)

    def _release(self, *, begin: bool) -> None:
        """Let robots take what was put in, now (``begin``, where all wait) or when their episodes have ended."""
        count = self._num_unreleased
        if self._policy.memory is Memory.SHARED:
            count = min(count, self.num_envs)
            self._policy.reset()
        self._num_unreleased -= count
        with wp.ScopedDevice(self.sim.device):
            make_ready(count, self._queue)
        if begin:
            self.sim.launch(self._turn_graph)

    def control_step(self) -> None:
        """Let the policy act, make the step, and let robots take the next episodes; waits for none of it."""
        if self.watch is not None:
            self.watch(False)
        self._policy()
        self.sim.launch(self._step_graph)
        if self.watch is not None:
            self.watch(True)
        self.sim.launch(self._turn_graph)
        self._step += 1

    def _advance(self) -> None:
        """Make the control steps up to the next look at what has ended."""
        poll = max(1, round(self.cfg.poll_every_s / self.robot.control_dt))
        since = self._step - self._began_at
        stop = min((since // every + 1) * every for every in (poll, self._max_episode_steps))
        for _ in range(stop - since):
            self.control_step()

    def take(self, progress: Callable[[float], None] | None = None) -> RolloutResult:
        """Wait for the terrains that were put in first, and return what came of their episodes.

        On a GPU what else is under way goes on without waiting. ``progress`` is called at every look with the share of
        them that is done, and may put in more.
        """
        if not self._lots:
            raise RuntimeError("take() must follow put(), got nothing under way")
        lot = self._lots[0]
        share = 0.0
        while True:
            ended = self._num_ended(lot)
            share = max(share, ended / lot.num_episodes, (self._step - lot.start_step) / lot.max_steps)
            if progress is not None and self._step > lot.start_step:
                progress(min(1.0, share))
            if ended == lot.num_episodes:
                break
            under_way = sum(other.num_episodes for other in self._lots) - self._num_unreleased
            if self._num_unreleased and sum(map(self._num_ended, self._lots)) == under_way:
                self._release(begin=True)
            self._advance()
        result = self._collect(lot)
        self._lots.popleft()
        if any(self._num_ended(other) < other.num_episodes for other in self._lots) and not self._num_unreleased:
            for _ in range(_LOOKS_AHEAD if self.sim.device.startswith("cuda") else 1):
                self._advance()
        return result

    def _num_ended(self, lot: _Lot) -> int:
        return sum(int(self._queue.num_ended[slots].numpy().sum()) for slots in lot.slots)

    def _collect(self, lot: _Lot) -> RolloutResult:
        queue = self._queue
        robot = self.robot
        rows = [slice(slots.start * self.replicas, slots.stop * self.replicas) for slots in lot.slots]

        def read(array: Any) -> np.ndarray:
            values = np.concatenate([array[run].numpy() for run in rows])  # a copy: on the CPU numpy() is a view
            return values.reshape(-1, self.replicas, *values.shape[1:])

        outcome = read(queue.outcome).astype(np.uint8)
        pose = read(queue.final_pose)
        penalties = read(queue.penalty_sums).astype(np.float64)[..., penalty_columns(robot.penalties)]
        reward = None if self._reward is None else read(queue.reward).astype(np.float64)
        for values in (penalties, reward):
            if values is not None:
                values[outcome == Outcome.INVALID] = np.nan
        with np.errstate(invalid="ignore"):
            upright = 1.0 - 2.0 * (pose[..., 3] ** 2 + pose[..., 4] ** 2)
        physics_steps = (self._step - self._taken_at) * robot.decimation
        busy_steps = int(queue.busy.numpy().sum(dtype=np.int64)) * robot.decimation
        queue.busy.zero_()
        wall_s = time.perf_counter() - self._taken_s
        self._taken_at = self._step
        self._taken_s += wall_s
        return RolloutResult(
            penalties=penalties,
            penalty_names=robot.penalties,
            outcome=outcome,
            invalidity=read(queue.invalidity).astype(np.uint8),
            fallen=upright < -float(FALLEN_GRAVITY_Z),
            duration_s=(read(queue.steps) * robot.physics_dt).astype(np.float32),
            final_position=pose[..., :3],
            deviation=read(queue.deviation),
            physics_steps=physics_steps,
            robot_steps=physics_steps * self.num_envs,
            busy_steps=busy_steps,
            wall_s=wall_s,
            reward=reward,
        )
