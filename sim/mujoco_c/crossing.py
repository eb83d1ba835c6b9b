"""Crossings in plain MuJoCo C, one after another."""

import math
from collections import deque
from collections.abc import Callable
from copy import copy
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from kernels.episode import FALLEN_GRAVITY_Z, STAND_RADIUS, Invalidity, Kind, Outcome, make_episodes
from kernels.launch import make_struct, make_zeros
from kernels.observation import ACTION_LIMIT, Sensors
from kernels.penalties import PENALTIES, penalty_columns
from kernels.queue import restart_episodes
from kernels.rewards import Rewards
from kernels.state import RobotStep
from sim.controllers.loaders import Policy, load_policy, prepare_torch
from sim.controllers.runner import reset_all
from sim.crossing import CrossingCfg, SolverCfg, find_highest_command, make_start_ranges
from sim.mujoco_c.model import (
    NO_SOFTNESS,
    Routes,
    Starts,
    crossing_model,
    distances_from_line,
    goal_commands,
    observations,
    steered_commands,
    step_penalties,
    surface_heights,
)
from sim.robots.actuator_net import ActuatorNet, Array
from sim.robots.compiled import mj, robot_spec
from sim.robots.find import read_stray
from sim.robots.robot import RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.bank import TerrainBank, make_terrains
from sim.terrains.conditions.kinds import nominal_row, split_row
from sim.terrains.terrains import GroundMaps, Terrains

_WARNING_NAMES = ("CONTACTFULL", "CNSTRFULL", "BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
_WARNINGS = np.array([getattr(mj.mjtWarning, f"mjWARN_{name}").value for name in _WARNING_NAMES])


@lru_cache(maxsize=8)
def _base_com(robot: RobotCfg) -> Array:
    """Mass centre of the base in its frame [m]."""
    return robot_spec(robot).compile().body_ipos[1].copy()


def draw_starts(robot: RobotCfg, heights: NDArray[np.float32], seed: int, count: int) -> Starts:
    """The starts that :class:`sim.rollout.Rollout` gives to replicas 0 to ``count - 1`` of a terrain with this seed.

    ``heights`` [m] have the shape (nrow, ncol). The CPU draws them: each of many processes would hold memory of a GPU.
    """
    bank = TerrainBank(1, device="cpu")
    bank.set_heights(heights[None])
    base_com = _base_com(robot)
    with wp.ScopedDevice("cpu"):
        sensors = make_struct(Sensors, default_joint_pos=wp.array(robot.default_joint_pos, dtype=float))
        widths = {"joint_q": 7, "joint_qd": 6, "action": 0}
        shapes = {name: (count, width + robot.num_joints) for name, width in widths.items()}
        step = make_zeros(RobotStep, "cpu", **shapes)
        step.base_com = base_com
        episodes = make_episodes(count)
        signed = int(np.uint32(seed).astype(np.int32))  # as a kernel takes it
        streams = np.array([int(wp.rand_init(signed, k)) for k in range(count)], dtype=np.uint32)
        episodes.rng.assign(streams)
        where = (wp.ones(count, dtype=int), wp.zeros(count, dtype=int), bank.terrain)  # all robots, on the one terrain
        restart_episodes(*where, make_start_ranges(CrossingCfg(), robot), sensors, step, episodes, Rewards())
    return Starts.of_newton(step.joint_q.numpy(), step.joint_qd.numpy(), base_com.astype(np.float32), streams)


class EpisodeStates:
    """States of the episodes of one terrain, stepped one by one."""

    def __init__(
        self,
        robot: RobotCfg,
        model: Any,
        starts: Starts,
        conditions: Array | None = None,
        heights: NDArray[np.floating] | None = None,
    ) -> None:
        """From ``starts`` on, under a row of ``conditions`` by which the model is changed; nominal ones if None.

        ``heights`` are those of the terrain [m], shape (nrow, ncol); 0 if None.
        """
        self.robot = robot
        self.model = model
        self.strength = 1.0
        self.delay_steps = robot.drive_delay_steps
        self.former_rows = deque[Array]()
        self._steps = 0
        self.rng = np.random.default_rng(np.frombuffer(starts.qpos.tobytes(), np.uint32))
        self.streams = np.zeros(len(starts.qpos), np.uint32) if starts.streams is None else starts.streams
        self.row = nominal_row() if conditions is None else conditions
        self.qpos = starts.qpos.copy()
        self._heights = np.zeros((2, 2)) if heights is None else heights
        acting = (pair for pair in split_row(self.row) if pair[0].acts(self.row))
        self._conditions = sorted(acting, key=lambda pair: pair[0].disturbs_last)
        for condition, values in self._conditions:
            condition.begin_plain(self, values)
        self._model = model if robot.saturation_effort is None else copy(model)  # limits change with the speed
        self.data = [mj.MjData(model) for _ in starts.qpos]
        for data, qpos, qvel in zip(self.data, starts.qpos, starts.qvel, strict=True):
            data.qpos[:] = qpos
            data.qvel[:] = qvel
        self.qvel = starts.qvel.copy()
        self._sensed = np.zeros((len(self.data), model.nsensordata))
        self.forces = self._sensed.reshape(len(self.data), len(robot.geom_names), 3)
        self._warnings = np.zeros((len(self.data), mj.mjtWarning.mjNWARNING.value), int)
        self.warned = np.zeros(len(self.data), bool)
        # To ask MuJoCo for an array takes longer than to copy it.
        self._views = [(d, d.ctrl, d.qpos, d.qvel, d.sensordata, d.warning.number) for d in self.data]
        self._joints = model.actuator_trnid[:, 0] - 1
        self._effort = model.actuator_forcerange[:, 1] / self.strength
        motors = np.array([robot.saturation_effort, robot.velocity_limit])
        self._motors = None if robot.saturation_effort is None else motors[:, self._joints]
        self._net = robot.actuator_net and ActuatorNet(robot.actuator_net, len(self.data) * model.nu)
        self.targets = np.tile(robot.default_joint_pos, (len(self.data), 1))  # [rad], which count after their delay
        self._delayed = deque([self.targets.copy()] * self.delay_steps)

    def step(self, running: NDArray[np.intp]) -> None:
        """One physics step of the numbered episodes."""
        self._delayed.append(self.targets.copy())
        controls = self._delayed.popleft()[:, self._joints]
        for condition, values in self._conditions:
            controls = condition.drive_plain(self, values, controls, self._steps)
        if self._net is not None:
            controls = self._net.step(controls - self.qpos[:, 7 + self._joints], self.qvel[:, 6 + self._joints])
        for k in running if self._conditions else ():
            self.data[k].xfrc_applied[:] = 0.0
        for condition, values in self._conditions:
            condition.force_plain(self, values, running, self._steps)
        self._steps += 1
        for k in running.tolist():
            data, ctrl, qpos, qvel, sensed, warnings = self._views[k]
            ctrl[:] = controls[k]
            if self._motors is not None:
                stall, limit = self._motors
                lost = stall * qvel[6 + self._joints] / limit
                limits = np.clip([-stall - lost, stall - lost], -self._effort, self._effort).T
                self._model.actuator_forcerange[:] = self.strength * limits
            mj.mj_step(self._model, data)
            self.qpos[k], self.qvel[k], self._sensed[k], self._warnings[k] = qpos, qvel, sensed, warnings
        if self._warnings.any():
            self.warned[:] = self._warnings[:, _WARNINGS].any(axis=1)

    def find_ground(self, x: Array, y: Array) -> Array:
        """Heights [m] of the terrain at world-local points [m] of any one shape."""
        return surface_heights(self._heights, x, y)

    def disturb(self, rows: Array, running: NDArray[np.intp], step: int) -> Array:
        """Observations (num_episodes, observation_size) as the conditions show them; pushes the running episodes."""
        for condition, values in self._conditions:
            rows = condition.disturb_plain(self, values, rows, running, step)
        return rows


_SENSES: dict[str, Callable[[EpisodeStates, NDArray[np.bool_]], Array]] = {
    "pose": lambda episodes, feet: episodes.qpos[:, :7],
    "contacts": lambda episodes, feet: 0.01 * np.linalg.norm(episodes.forces[:, feet], axis=2),
    "torques": lambda episodes, feet: 0.01 * np.array([data.qfrc_actuator[6:] for data in episodes.data]),
}


def _judge(
    robot: RobotCfg,
    episode: NDArray[np.intp],
    state: list[NDArray[Any]],
    base: NDArray[np.bool_],
    routes: Routes,
    starts: Starts,
    *,
    ends: NDArray[np.bool_],
) -> NDArray[Any]:
    """Outcome of an ``episode`` after a physics step, row by row, the gravest of several; its time ``ends``, or not."""
    qpos, qvel, forces, warned = state
    cfg = CrossingCfg
    position = qpos[:, :2]
    outcome = np.where(ends, Outcome.TIME_OUT, Outcome.RUNNING)
    out = ((position < cfg.lower) | (position > cfg.upper)).any(axis=1)
    if routes.kind == Kind.CROSS:
        outcome[out] = Outcome.OUT
        outcome[np.hypot(*(cfg.goal - position).T) < cfg.goal_radius] = Outcome.GOAL
    else:
        if routes.kind == Kind.ROUTE:
            outcome[out | ends] = Outcome.GOAL
            outcome[routes.strayed[episode] >= round(cfg.stray_s / robot.control_dt)] = Outcome.STRAYED
        else:
            near = np.hypot(*(starts.qpos[episode, :2] - position).T) <= float(STAND_RADIUS)
            outcome[ends] = np.where(near, Outcome.GOAL, Outcome.STRAYED)[ends]
        outcome[2.0 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2) - 1.0 > float(FALLEN_GRAVITY_Z)] = Outcome.TILT
    force = np.linalg.norm(forces[:, base], axis=2).max(axis=1)
    outcome[force > cfg.base_force] = Outcome.BASE_COLLISION
    finite = np.isfinite(qpos).all(axis=1) & (np.abs(qvel) <= robot.max_speed).all(axis=1)
    outcome[~finite | warned] = Outcome.INVALID
    return outcome


_SUMMED = 25  # control steps at a time: NumPy takes as long for few rows as for many


def _add_up(
    robot: RobotCfg, counted: list[list[NDArray[Any]]], feet: NDArray[np.bool_], sums: Array, deviation: Array
) -> None:
    """Adds penalties of the counted states to the sums, raises the deviation to theirs, and drops them."""
    episode, *states = (np.concatenate(parts) for parts in zip(*counted, strict=True))
    raw = step_penalties(*states, feet=feet, force_limit=robot.contact_force_limit)
    np.add.at(sums, episode, robot.physics_dt * raw)
    np.maximum.at(deviation, episode, distances_from_line(states[0]))
    counted.clear()


@torch.inference_mode()
def cross_in_mujoco_c(
    robot: RobotCfg,
    policy: Policy,
    heights: NDArray[np.float32],
    starts: Starts,
    *,
    time_constant_s: float | None = None,
    ground: GroundMaps | None = None,
    steering: NDArray[np.float32] | None = None,
) -> RolloutResult:
    """Run one crossing from each start in plain MuJoCo C, with a controller on the CPU.

    It does not tell why an episode is invalid. Heights are those of one terrain [m], shape (nrow, ncol), and so is its
    ground with its conditions; the contact time constant is that of the robot's file if None. ``steering`` has a way an
    episode, as :class:`sim.terrains.terrains.Terrains` has. Noise is drawn otherwise than in the parallel simulation.
    """
    model = crossing_model(robot, heights, time_constant_s=time_constant_s, ground=ground)
    row = None if ground is None else ground.rows[0].astype(np.float64)
    episodes = EpisodeStates(robot, model, starts, row, heights)
    count = len(starts.qpos)
    base, feet = (np.isin(robot.geom_names, names) for names in (robot.base_geoms, robot.foot_geoms))
    default = np.array(robot.default_joint_pos)
    scan = np.stack(robot.scan_points(), axis=1)
    outcome = np.full(count, Outcome.RUNNING)
    steps = np.zeros(count, int)
    sums = np.zeros((count, len(PENALTIES)))
    deviation = np.zeros(count)
    counted: list[list[NDArray[Any]]] = []
    last_action = np.zeros((count, robot.num_joints))
    rows = np.zeros((count, robot.observation_size))
    remembers = reset_all(policy, count)  # it must be asked for the same robots every time
    max_steps = round(robot.max_duration_s / robot.physics_dt)
    highest = find_highest_command(CrossingCfg(), robot)
    row = nominal_row() if ground is None else ground.rows[0]
    is_resolved = time_constant_s is not None
    stray_m = read_stray(robot, resolved=is_resolved) if row[-1] == Kind.ROUTE else math.inf
    routes = Routes(robot, row.astype(np.float64), count, stray_m)
    for step in range(0, max_steps, robot.decimation):
        if len(running := np.flatnonzero(outcome == Outcome.RUNNING)) == 0:
            break
        qpos = episodes.qpos[running]
        command = np.zeros((count, 3))
        command[running] = goal_commands(qpos, robot.speed)
        if routes.kind != Kind.CROSS:
            command[running] = routes.command(episodes.qpos, step * robot.physics_dt)[running]
        if steering is not None:
            steered = running[~np.isnan(steering[running, 0, 0])]
            command[steered] = steered_commands(episodes.qpos[steered], steering[steered], highest)
        seen = (heights, qpos, episodes.qvel[running], command[running], last_action[running])
        row = observations(*seen, default_joint_pos=default, scan=scan)
        felt = [sense(episodes, feet)[running] for name, sense in _SENSES.items() if name in robot.senses]
        rows[running] = np.hstack([row, *felt])
        rows = episodes.disturb(rows, running, step)
        observed = rows if remembers else rows[running]
        action = policy(torch.from_numpy(observed.astype(np.float32))).numpy().astype(np.float64)
        action = action[running] if remembers else action
        limited = np.clip(action, -float(ACTION_LIMIT), float(ACTION_LIMIT))
        action = np.where(np.isfinite(action), limited, np.nan)  # of which MuJoCo warns: the episode is invalid
        last_action[running] = action
        episodes.targets[running] = default + robot.action_scale * action
        states: list[list[NDArray[Any]]] = []
        for _ in range(min(robot.decimation, max_steps - step)):
            episodes.step(running[~episodes.warned[running]])  # a state that has blown up stays as it is
            after = (episodes.qpos, episodes.qvel, episodes.forces, episodes.warned)
            states.append([running, *(values[running] for values in after)])
        # Rows by physics step, then episode.
        episode, *state = (np.concatenate(parts) for parts in zip(*states, strict=True))
        ends = np.arange(len(episode)) >= (max_steps - 1 - step) * len(running)
        judged = _judge(robot, episode, state, base, routes, starts, ends=ends)
        ended = (judged != Outcome.RUNNING).reshape(len(states), -1)
        counts = (np.cumsum(ended, axis=0) <= ended).ravel()  # up to the end of each episode
        episode, judged, qpos, qvel, forces = (values[counts] for values in (episode, judged, *state[:3]))
        outcome[episode] = judged  # the last of each
        episodes.qpos[episode] = qpos
        steps += np.bincount(episode, minlength=count)
        if len(counted) == _SUMMED:
            _add_up(robot, counted, feet, sums, deviation)
        counted.append([episode, qpos, qvel, command[episode], forces])
    _add_up(robot, counted, feet, sums, deviation)
    sums[outcome == Outcome.INVALID] = np.nan
    upright = 1.0 - 2.0 * (episodes.qpos[:, 4] ** 2 + episodes.qpos[:, 5] ** 2)
    return RolloutResult(
        penalties=sums[None][..., penalty_columns(robot.penalties)],
        penalty_names=robot.penalties,
        outcome=outcome[None].astype(np.uint8),
        invalidity=np.where(outcome[None] == Outcome.INVALID, Invalidity.STATE, 0).astype(np.uint8),
        fallen=upright[None] < -float(FALLEN_GRAVITY_Z),
        duration_s=(steps[None] * robot.physics_dt).astype(np.float32),
        final_position=episodes.qpos[None, :, :3].astype(np.float32),
        deviation=deviation[None].astype(np.float32),
    )


_CHUNK = 25  # episodes at a time: enough for the policy's batch


class MujocoC:
    """Crosses terrains in plain MuJoCo C, from the starts that a rollout of their seeds has (:class:`Rollout`)."""

    def __init__(self, robot: RobotCfg, policy: str, *, replicas: int, solver: SolverCfg | None = None) -> None:
        """The first of ``replicas`` episodes a terrain begin as a rollout's do, which may have fewer."""
        prepare_torch("cpu")
        self._robot = robot
        self._policy = load_policy(policy, robot, "cpu")
        self._replicas = replicas
        self._time_constant_s = (solver or SolverCfg()).time_constant_s
        self._pending: deque[Terrains] = deque()

    def put(self, terrains: Terrains) -> None:
        """Queue terrains, which are crossed when they are taken."""
        if terrains.genes is not None and "softness" in terrains.space.ground:
            raise ValueError(NO_SOFTNESS)
        self._pending.append(terrains)

    def clear(self) -> None:
        """Drop all pending lots."""
        self._pending.clear()

    def take(self, progress: Callable[[float], None] | None = None) -> RolloutResult:
        """Cross the lot that was put in first."""
        terrains = self._pending.popleft()
        heights, ground = terrains.heights, terrains.ground
        if heights is None:
            heights, ground = make_terrains(terrains.values, terrains.space, device="cpu")
        results = []
        for index, (grid, seed) in enumerate(zip(heights, terrains.seeds, strict=True)):
            starts = draw_starts(self._robot, grid, int(seed), self._replicas)
            maps = None if ground is None else ground[index : index + 1]
            how: dict[str, Any] = {"time_constant_s": self._time_constant_s, "ground": maps}
            crossed = []
            for some in (slice(first, first + _CHUNK) for first in range(0, self._replicas, _CHUNK)):
                how["steering"] = None if terrains.steering is None else terrains.steering[index, some]
                crossed.append(cross_in_mujoco_c(self._robot, self._policy, grid, starts[some], **how))
            results.append(RolloutResult.join(crossed, axis=1))
            if progress is not None:
                progress((index + 1) / len(heights))
        return RolloutResult.join(results)
