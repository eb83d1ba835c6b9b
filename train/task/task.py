"""The command-following task: a robot on rough terrain told a velocity and a heading, rewarded for keeping to them.

One control step is one captured graph: action, physics, end of episodes, rewards, curriculum, restart, commands,
pushes, observation. The host copies actions in and results out, and draws no random number.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from kernels.episode import Kind, Outcome, Task, latch_outcomes, make_episodes, note_base_forces
from kernels.launch import make_struct
from kernels.observation import apply_action
from kernels.queue import StartRanges
from kernels.rewards import REWARDS, remember_steps
from kernels.route import follow_routes
from kernels.training import (
    STATISTICS,
    Rules,
    command_episodes,
    make_training,
    promote_episodes,
    record_steps,
    seed_restarts,
)
from sim.controllers.loaders import prepare_torch
from sim.crossing import CAPACITY_OVERFLOWS, CrossingCfg, make_start_ranges, make_task, make_trail
from sim.robots.find import read_stray
from sim.robots.robot import RobotCfg
from sim.simulation import Reward, Simulation
from sim.terrains.bank import TerrainBank
from train.cfg import TaskCfg
from train.task.tiles import Tiles, make_tiles

_FALLS = (Outcome.BASE_COLLISION, Outcome.TILT, Outcome.INVALID)
"""An invalid state costs what a fall does: were it free, falling robots would learn to whip their legs too fast."""
_TILE_SIDE = 8.0
_TILE_CENTRE = (8.0, 4.0)


class CommandTask:
    """``num_envs`` robots following commands on the tiles of the curriculum.

    Attributes are views of the memory the graph works in, of a row an environment: the next step overwrites them.

    Attributes:
        end: How the episode ended with the step just made (:class:`kernels.episode.Outcome`), int32.
        episode_steps: Control steps of the episode so far, int32.
        counter: Control steps since the seed's first number: the state of all random numbers, int32, shape (1,).
    """

    def __init__(
        self, robot: RobotCfg, cfg: TaskCfg, *, num_envs: int, device: str, seed: int, tiles: Tiles | None = None
    ) -> None:
        """Build terrain, robots and graph; every episode begins. Without ``tiles``, those of the curriculum."""
        prepare_torch(device)
        self.robot, self.cfg, self.num_envs, self.device = robot, cfg, num_envs, device
        tile_seed, level_seed, model_seed, count_seed = np.random.SeedSequence(seed).generate_state(4)
        first_count = int(count_seed) % 2**30  # far from where a 32-bit counter wraps
        self.tiles = tiles or make_tiles(cfg.curriculum, int(tile_seed))
        columns = self.tiles.assign_columns(num_envs)
        max_level = cfg.curriculum.max_first_level
        levels = np.random.default_rng(level_seed).integers(max_level, size=num_envs, endpoint=True, dtype=np.int32)
        levels %= self.tiles.num_levels
        self.sim = self._build_simulation(levels * self.tiles.num_columns + columns, np.random.default_rng(model_seed))
        self._task = _make_task(cfg, robot, self.tiles)
        self.trail = None if self.sim.disturbed is None else make_trail(num_envs, robot, device)
        self._rules = _make_rules(cfg, robot, self.tiles)
        self._ranges = _make_start_ranges(cfg, robot)
        self._noise = self.sim.make_noise(cfg.noise)
        self.max_episode_steps: int = self._task.max_steps
        self._episodes = make_episodes(num_envs, device)
        sizes = {"num_joints": robot.num_joints, "observation_size": robot.observation_size}
        self._training = training = make_training(columns, levels, **sizes, first_count=first_count, device=device)
        self._robot_step = self.sim.make_step(training.command, training.last_action)
        self._reward = Reward(self.sim, cfg, self._robot_step, falls=_FALLS)
        rewards = self._reward.state
        self._action = torch.from_dlpack(training.action)
        self.observation = torch.from_dlpack(training.observation)
        self.reward = torch.from_dlpack(rewards.step)
        self.end = torch.from_dlpack(training.ended)
        self.episode_steps = torch.from_dlpack(self._episodes.steps)
        self.levels = torch.from_dlpack(training.level)
        self.counter = torch.from_dlpack(training.counter)
        self._column = torch.from_dlpack(training.column)
        self._terrain_of_env = torch.from_dlpack(self.sim.terrain_of_env)
        self._statistics = torch.from_dlpack(training.statistics)
        self._counted = torch.zeros_like(self._statistics)
        self._reward_terms = torch.from_dlpack(rewards.terms)
        # Capturing makes a step, which is undone after. At the pose of its file a robot may be deep in the ground, with
        # more contacts than fit: so it is put at a start before.
        self.restart_all(torch.from_numpy(levels))
        self._graph = self.sim.capture(self._control_step)
        self.counter.fill_(first_count)
        self.restart_all(torch.from_numpy(levels))

    def _build_simulation(self, terrain_of_env: np.ndarray, rng: np.random.Generator) -> Simulation:
        tiles = self.tiles
        ground = tiles.ground
        with_conditions = ground is not None and ground.conditions is not None
        maps = {"with_ground": ground is not None, "with_conditions": with_conditions}
        bank = TerrainBank(len(tiles.heights), device=self.device, **maps)
        bank.set_heights(tiles.heights, ground=ground)
        friction = rng.uniform(*self.cfg.friction, self.num_envs).astype(np.float32)
        mass = rng.uniform(*self.cfg.added_base_mass, self.num_envs).astype(np.float32)
        return Simulation(self.robot, bank, terrain_of_env, friction=friction, added_base_mass=mass)

    def step(self, action: torch.Tensor) -> None:
        """Make one control step with actions (num_envs, num_joints); an episode that ends restarts within it."""
        if action.shape != self._action.shape:
            raise ValueError(f"action must have shape {tuple(self._action.shape)}, got {tuple(action.shape)}")
        self._action.copy_(action)
        self.sim.launch(self._graph)

    def restart_all(self, levels: torch.Tensor) -> None:
        """Begin every episode anew on the given terrain levels, shape (num_envs,), with nothing counted yet."""
        self._restart_on(levels)
        self.read_statistics()
        self._counted.zero_()

    def exchange(self, tiles: Tiles) -> None:
        """Put as many other terrains in place of the present ones, and begin every episode anew on the first level."""
        self.sim.bank.set_heights(tiles.heights, ground=tiles.ground)
        self.tiles = tiles
        self._restart_on(torch.zeros_like(self.levels))
        torch.neg(self._statistics, out=self._counted)  # read_statistics adds steps on the terrains before

    def _restart_on(self, levels: torch.Tensor) -> None:
        self.levels.copy_(levels)
        self._terrain_of_env.copy_(self.levels * self.tiles.num_columns + self._column)
        self.end.fill_(int(Outcome.TIME_OUT))
        self._begin_episodes()

    def counts(self) -> dict[str, np.ndarray]:
        """:data:`STATISTICS` of each environment since the last exchange of terrains, shape (num_envs,) each."""
        return dict(zip(STATISTICS, (self._counted + self._statistics).T.cpu().numpy(), strict=True))

    def read_statistics(self) -> dict[str, float]:
        """Sums over all environments since the last call: :data:`STATISTICS`, then each weighted reward term."""
        sums = torch.cat((self._statistics.sum(0), self._reward_terms.sum(0))).tolist()
        self._counted += self._statistics
        self._statistics.zero_()
        self._reward_terms.zero_()
        return dict(zip((*STATISTICS, *REWARDS), sums, strict=True))

    def level_by_type(self) -> dict[str, float]:
        """Mean terrain level of the environments of each type."""
        levels = self.levels.cpu().numpy()
        types = np.array(self.tiles.type_of_column)[self._column.cpu().numpy()]
        return {str(name): float(levels[types == name].mean()) for name in dict.fromkeys(types)}

    def _control_step(self) -> None:
        sim, episodes, training = self.sim, self._episodes, self._training
        apply_action(training.action, sim.sensors, self.robot.action_scale, training.last_action, sim.targets)
        for step in range(1, self.robot.decimation + 1):
            sim.physics_step(follows=step > 1)
            # A crossing ends at the first touch of the base, however short; other outcomes are checked once a step.
            if self.cfg.crosses and step < self.robot.decimation:
                sim.read_geom_forces()
                note_base_forces(self._robot_step, episodes)
        sim.read_geom_forces()
        latch_outcomes(self._robot_step, self._task, episodes)
        self._reward.pay(episodes.outcome)
        record_steps(self._robot_step, self._rules, episodes, self._reward.state, training)
        promote_episodes(sim.joint_q, episodes, self._rules, sim.terrain_of_env, training)
        self._begin_episodes()

    def _begin_episodes(self) -> None:
        sim, episodes, training = self.sim, self._episodes, self._training
        seed_restarts(training, episodes)
        sim.restart(training.ended, self._robot_step, self._ranges, episodes, self._reward.state)
        command_episodes(sim.joint_q, episodes, self._rules, self._task, sim.joint_qd, training)
        dt = self.robot.control_dt
        if sim.disturbed is not None:
            follow_routes(sim.joint_q, sim.disturbed.row, self._task, dt, episodes, self.trail, training.command)
        sim.observe(self._robot_step, episodes, dt, self._noise, training.counter, training.observation)
        remember_steps(training.last_action, sim.joint_qd, self._reward.state, training.counter)


def _make_task(cfg: TaskCfg, robot: RobotCfg, tiles: Tiles) -> Any:
    """Goal, command and limits of an episode as a kernel argument; its steps are control steps."""
    has_routes = tiles.ground is not None and (tiles.ground.rows[:, -1] == Kind.ROUTE).any()
    goal = CrossingCfg(base_force=cfg.base_force, stray_m=read_stray(robot) if has_routes else None)
    if not cfg.crosses:
        endless: dict[str, Any] = {"lower": (-np.inf, -np.inf), "upper": (np.inf, np.inf)}
        goal = replace(goal, yaw_gain=cfg.yaw_gain, max_yaw_rate=cfg.max_yaw_rate, **endless)
    task = make_task(goal, robot, to_goal=cfg.crosses)
    max_steps = round(cfg.episode_s / robot.control_dt)
    # An overflow is counted, and no reason to end an episode.
    return make_struct(Task, task, max_steps=max_steps, max_gravity_z=cfg.max_gravity_z, overflow_mask=0)


def _make_rules(cfg: TaskCfg, robot: RobotCfg, tiles: Tiles) -> Any:
    """Commands, pushes and levels of the task as a kernel argument."""
    names = ("command", "push")
    steps = {f"{name}_steps": round(getattr(cfg, f"{name}_interval_s") / robot.control_dt) for name in names}
    limits = {"promotion_distance": 0.5 * _TILE_SIDE, "demotion_time_s": 0.5 * cfg.episode_s}
    limits["overflow_mask"] = CAPACITY_OVERFLOWS
    return make_struct(Rules, cfg, tiles, crosses=int(cfg.crosses), **limits, **steps)


def _make_start_ranges(cfg: TaskCfg, robot: RobotCfg) -> Any:
    if cfg.crosses:
        return make_struct(StartRanges, make_start_ranges(CrossingCfg(), robot), ahead=cfg.start_spread)
    names = ("start_position_range", "start_yaw_range", "start_joint_range", "start_velocity_range")
    start = CrossingCfg(start=_TILE_CENTRE, **{name: getattr(cfg, name) for name in names})
    half = max(robot.footprint)  # whatever the heading
    return make_struct(StartRanges, make_start_ranges(start, robot), footprint=(half, half))
