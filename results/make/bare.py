"""Bare physics: terrain contacts and solver alone, on the motion of recorded crossings or of standing robots."""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import warp as wp
from torch.profiler import ProfilerActivity, profile

from kernels.episode import Kind, Outcome, make_episodes
from kernels.route import follow_routes
from sim.crossing import CrossingCfg, make_task, make_trail
from sim.mujoco_c.model import crossing_model
from sim.rollout import Rollout
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, condition_column, condition_genes
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.terrains import Terrains

SEGMENT_STEPS = 10  # control steps: over 0.2 s a replayed robot still moves as the recorded one did
SEGMENT_EVERY = 20
PROFILED_STEPS = 50
NAMED_KERNELS = 40
SETTLE, STANDING = 100, 250  # control steps
MUJOCO: Any = mujoco  # its types are not written down


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A stretch of recorded motion: the state at its start and the joint targets from there on, on the device."""

    joint_q: Any
    """Shape (num_envs, 7 + num_joints)."""
    joint_qd: Any
    """Shape (num_envs, 6 + num_joints)."""
    parked: Any
    """2 for robots whose episodes have ended, else 0, shape (num_envs,)."""
    num_running: int
    """The other robots."""
    targets: list[Any]
    """Of each control step, shape (num_envs, 7 + num_joints)."""


def record_segments(rollout: Rollout, terrains: Terrains) -> list[Segment]:
    """State and targets of the first 10 of every 20 control steps of crossings, as :meth:`Rollout.put` takes them.

    Each robot runs one episode, and is left out once that has ended.
    """
    sim, segments = rollout.sim, []
    rollout.clear()
    rollout.put(terrains)
    for step in range(round(rollout.robot.max_duration_s / rollout.robot.control_dt)):
        if step % SEGMENT_EVERY == 0:
            ended = rollout.outcome.numpy() != Outcome.RUNNING
            if ended.all():
                break
            state = {"joint_q": wp.clone(sim.joint_q), "joint_qd": wp.clone(sim.joint_qd)}
            parked = wp.array(2 * ended, dtype=int, device=sim.device)
            segments.append(Segment(**state, parked=parked, num_running=int((~ended).sum()), targets=[]))
        rollout.control_step()
        if step % SEGMENT_EVERY < SEGMENT_STEPS:
            segments[-1].targets.append(wp.clone(sim.targets))
    return segments


class Motion:
    """Recorded segments that are replayed in one simulation, by a captured graph of the physics of a control step."""

    def __init__(self, sim: Simulation, segments: list[Segment], beside: Callable[[], None] | None = None) -> None:
        """Captures the graph and replays two segments, so that the kernels are loaded.

        ``beside`` launches what a control step has beside its physics.
        """
        self.sim, self.segments = sim, segments
        self.beside = beside
        """Kept, since the graph works on its arrays."""
        self.robot_steps = sim.robot.decimation * sum(part.num_running * len(part.targets) for part in segments)
        """Physics steps of the robots that are not left out, in one replay of all segments."""

        def control_step() -> None:
            for k in range(sim.robot.decimation):
                sim.physics_step(follows=k > 0)
            if beside is not None:
                beside()

        with wp.ScopedDevice(sim.device):
            self._graph: Any = sim.capture(control_step)
        self._replay(segments[:2])

    def replay(self) -> float:
        """Plays all segments back, each from its recorded state; returns the seconds it took."""
        return seconds_of(lambda: self._replay(self.segments), self.sim.device)

    def stand(self, control_steps: int) -> float:
        """Goes on from the present state for some control steps; returns the seconds it took."""
        return seconds_of(lambda: [wp.capture_launch(self._graph) for _ in range(control_steps)], self.sim.device)

    def _replay(self, segments: list[Segment]) -> None:
        sim = self.sim
        with wp.ScopedDevice(sim.device):
            all_robots = wp.ones(sim.num_envs, dtype=int)
            for segment in segments:
                wp.copy(sim.joint_q, segment.joint_q)
                wp.copy(sim.joint_qd, segment.joint_qd)
                sim.clear_solver(all_robots)
                wp.copy(sim.parked, segment.parked)
                for targets in segment.targets:
                    wp.copy(sim.targets, targets)
                    wp.capture_launch(self._graph)


def seconds_of(work: Callable[[], object], device: str) -> float:
    """Seconds from when the device is idle to when it has done the work."""
    with wp.ScopedDevice(device):
        wp.synchronize_device(device)
        began = time.perf_counter()
        work()
        wp.synchronize_device(device)
        return time.perf_counter() - began


def bare_rates(rollout: Rollout, terrains: Terrains, rounds: int) -> dict[str, float]:
    """Physics steps a second, over all robots that have an episode, of contacts and solver alone; medians of rounds.

    Returns:
        ``walking``, in the motion of the crossings; ``standing``, holding the default pose at their start; and in the
        motion of the crossings ``ground``, on ground with maps of friction and softness that change nothing. On such
        ground robots observe, too, in ``observed``, in ``conditions``, under noise and lag, in ``all_conditions``,
        under errors of what they see, too, and in ``route``, with the commands of a route in place of these. Other
        conditions change nothing.
    """
    sim, robot = rollout.sim, rollout.robot
    segments = record_segments(rollout, terrains)
    bank = TerrainBank(sim.bank.num_terrains, device=sim.device, with_ground=True)
    bank.set_heights(sim.bank.heights.numpy())
    motion, where = Motion(sim, segments), sim.terrain_of_env.numpy()
    seen = [name for name, condition in CONDITIONS.items() if condition.observed]
    motions = {
        "walking": motion,
        "ground": Motion(Simulation(robot, bank, where), segments),
        "observed": observed_motion(Simulation(robot, bank, where), segments),
        "conditions": motion_under_conditions(sim, segments),
        "all_conditions": motion_under_conditions(sim, segments, seen),
        "route": motion_under_conditions(sim, segments, GROUPS["command"], Kind.ROUTE),
    }
    seconds = np.median([[each.replay() for each in motions.values()] for _ in range(rounds)], axis=0)  # in turns
    rates = {name: motion.robot_steps / float(s) for (name, motion), s in zip(motions.items(), seconds, strict=True)}
    return {**rates, "standing": standing_rate(rollout, motion, terrains)}


def motion_under_conditions(
    sim: Simulation, segments: list[Segment], names: Sequence[str] = (), asks: Kind = Kind.CROSS
) -> Motion:
    """The same motion of robots under noise and lag and some other conditions of what nobody reads or obeys."""
    bank = TerrainBank(sim.bank.num_terrains, device=sim.device, with_conditions=True)
    bank.set_heights(sim.bank.heights.numpy())
    rows = bank.conditions.numpy()
    rows[:, condition_column("noise")] = 1.0
    rows[:, condition_column("lag")] = sim.robot.control_dt
    for gene in condition_genes(names):
        rows[:, condition_column(gene.name)] = gene.to_value(0.5)
    rows[:, -1] = asks
    bank.conditions.assign(rows)
    return observed_motion(Simulation(sim.robot, bank, sim.terrain_of_env.numpy()), segments, asks)


def observed_motion(sim: Simulation, segments: list[Segment], asks: Kind = Kind.CROSS) -> Motion:
    """The motion of robots that observe in every control step, and begin and follow what conditions ask for."""
    robot, disturbed = sim.robot, sim.disturbed
    with wp.ScopedDevice(sim.device):
        episodes, everybody = make_episodes(sim.num_envs), wp.ones(sim.num_envs, dtype=int)
        for values, value in ((episodes.outcome, Outcome.RUNNING), (episodes.kind, asks), (episodes.steps, 1)):
            values.fill_(int(value))
        command, action = (wp.zeros((sim.num_envs, count), dtype=float) for count in (3, robot.num_joints))
        observation = wp.zeros((sim.num_envs, robot.observation_size), dtype=float)
        nobody, counter = wp.zeros(sim.num_envs, dtype=int), wp.zeros(1, dtype=int)
        sim.begin_conditions(everybody)
    trail, task = make_trail(sim.num_envs, robot, sim.device), make_task(CrossingCfg(), robot)
    step = sim.make_step(command, action)

    def beside() -> None:
        sim.begin_conditions(nobody)
        if disturbed is not None and asks == Kind.ROUTE:
            follow_routes(sim.joint_q, disturbed.row, task, robot.control_dt, episodes, trail, command)
        sim.observe(step, episodes, robot.physics_dt, None, counter, observation)

    return Motion(sim, segments, beside)


def standing_rate(rollout: Rollout, motion: Motion, terrains: Terrains) -> float:
    """Physics steps a second over all robots that hold the default pose where crossings start."""
    sim, robot = rollout.sim, rollout.robot
    rollout.clear()
    rollout.put(terrains)
    sim.joint_qd.zero_()
    targets = np.zeros(sim.targets.shape, dtype=np.float32)
    targets[:, 7:] = robot.default_joint_pos
    sim.targets.assign(targets)
    motion.stand(SETTLE)  # 2 s, in which they come to rest
    return STANDING * robot.decimation * sim.num_envs / motion.stand(STANDING)


def standing_rates(rollout: Rollout) -> dict[str, float] | None:
    """Physics steps a second over all robots that stand on level ground, ours and mujoco_warp's by itself.

    Both step the same model with the same caps of iterations; mujoco_warp finds its contacts with a plane. None if the
    robots do not end at the same height: a biped falls.
    """
    sim, robot, device = rollout.sim, rollout.robot, rollout.sim.device
    level = np.zeros((rollout.num_terrains, NUM_ROWS, NUM_COLS), np.float32)
    terrains = Terrains(heights=level, seeds=np.zeros(rollout.num_terrains, np.uint32))
    ours = standing_rate(rollout, Motion(sim, []), terrains)
    height = sim.joint_q.numpy()[:, 2].mean()
    rollout.clear()
    rollout.put(terrains)
    model = crossing_model(robot, level[0])
    model.opt.disableflags = MUJOCO.mjtDisableBit.mjDSBL_SENSOR  # which only MuJoCo C is asked for
    for cap in ("iterations", "ls_iterations"):
        setattr(model.opt, cap, getattr(sim.solver.mj_model.opt, cap))
    start = MUJOCO.MjData(model)
    start.ctrl[:] = np.array(robot.default_joint_pos)[model.actuator_trnid[:, 0] - 1]
    with wp.ScopedDevice(device):
        on_device = mujoco_warp.put_model(model)
        room = {"njmax": sim.solver.mjw_data.njmax, "nconmax": robot.nconmax}
        data = mujoco_warp.put_data(model, start, nworld=sim.num_envs, **room)
        data.qpos.assign(sim.joint_q.numpy()[:, [0, 1, 2, 6, 3, 4, 5, *range(7, 7 + robot.num_joints)]])

        def control_step() -> None:
            for _ in range(robot.decimation):
                mujoco_warp.step(on_device, data)

        launch = partial(wp.capture_launch, sim.capture(control_step))
        seconds_of(lambda: [launch() for _ in range(SETTLE)], device)
        seconds = seconds_of(lambda: [launch() for _ in range(STANDING)], device)
        theirs = data.qpos.numpy()[:, 2].mean()
    if not abs(theirs - height) < 0.002:
        return None
    alone = STANDING * robot.decimation * sim.num_envs / seconds
    return {"num_envs": sim.num_envs, "world_steps_per_s": ours, "world_steps_per_s_mujoco_warp": alone}


def kernel_shares(rollout: Rollout, terrains: Terrains) -> list[dict[str, Any]]:
    """Name and share of the GPU's time of each kernel, the most first, over the second second of crossings."""
    rollout.put(terrains)
    for _ in range(PROFILED_STEPS):
        rollout.control_step()
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        for _ in range(PROFILED_STEPS):
            rollout.control_step()
        wp.synchronize_device(rollout.sim.device)
    times: dict[str, float] = {}
    for event in profiled.key_averages():
        name = re.sub(r"_[0-9a-f]{8}(_cuda_kernel_forward)?$|_cuda_kernel_forward$", "", event.key)
        times[name] = times.get(name, 0.0) + event.self_device_time_total
    total = sum(times.values())
    ranked = sorted(times.items(), key=lambda item: -item[1])[:NAMED_KERNELS]
    return [{"name": name, "share": time / total} for name, time in ranked]
