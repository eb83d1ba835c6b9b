"""The bare physics rate: what terrain contact and solver alone can do, the yardstick of everything else."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from sim.rollout import Rollout
from sim.simulation import Simulation

_SEGMENT_STEPS = 10
_SEGMENT_EVERY = 20


@dataclass(frozen=True, kw_only=True)
class BareRates:
    """Physics steps a second over all environments, of the captured graph of terrain contacts and solver alone."""

    walking: float
    """In the motion of the crossings themselves: states and joint targets recorded from a rollout, physics replayed."""
    standing: float
    """Holding the default pose at the start of the crossings; cheaper, since hardly any contact changes."""


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A stretch of the robots' motion to replay: where it begins, and what the controller wanted from there on."""

    joint_q: Any
    """Joint coordinates at its begin, on the device, shape (num_envs, 7 + num_joints)."""
    joint_qd: Any
    """Joint velocities, shape (num_envs, 6 + num_joints)."""
    targets: list[Any]
    """Joint targets of each control step, shape (num_envs, 7 + num_joints)."""


def measure_bare_physics(
    rollout: Rollout, terrains: np.ndarray, seeds: np.ndarray, *, steps: int = 1000
) -> BareRates:
    """Bare physics rates on a rollout's own terrains, environments and solver.

    The walking rate replays short segments, each from a recorded state: over 0.2 s a replayed robot still moves as the
    recorded one did, which over a whole crossing without its controller it would not.

    Args:
        rollout: Built for the terrains.
        terrains: Genes or heights, as :meth:`Rollout.evaluate` takes them.
        seeds: One a terrain, uint32.
        steps: Physics steps timed at least.
    """
    sim = rollout.sim

    def control_step() -> None:
        for _ in range(rollout.robot.decimation):
            sim.physics_step()

    segments = record_segments(rollout, terrains, seeds)
    with wp.ScopedDevice(sim.device):
        graph = sim.capture(control_step)
        replay_segments(sim, graph, segments[:2])
        rounds = -(-steps // (len(segments) * _SEGMENT_STEPS * rollout.robot.decimation))
        wp.synchronize_device(sim.device)
        began = time.perf_counter()
        for _ in range(rounds):
            replay_segments(sim, graph, segments)
        wp.synchronize_device(sim.device)
        replayed = rounds * sum(len(segment.targets) for segment in segments) * rollout.robot.decimation
        walking = sim.num_envs * replayed / (time.perf_counter() - began)
        return BareRates(walking=walking, standing=_time_standing(rollout, graph, terrains, seeds, steps))


def record_segments(rollout: Rollout, terrains: np.ndarray, seeds: np.ndarray) -> list[Segment]:
    """State and targets of the first 10 of every 20 control steps of the crossings."""
    sim, segments = rollout.sim, []
    most = round(rollout.cfg.max_duration_s / rollout.robot.control_dt)
    rollout.begin(terrains, seeds)
    for step in range(most):
        if step % _SEGMENT_EVERY == 0:
            segments.append(Segment(joint_q=wp.clone(sim.joint_q), joint_qd=wp.clone(sim.joint_qd), targets=[]))
        rollout.control_step()
        if step % _SEGMENT_EVERY < _SEGMENT_STEPS:
            segments[-1].targets.append(wp.clone(sim.targets))
    return segments


def replay_segments(sim: Simulation, graph: Any, segments: list[Segment]) -> None:
    """Play segments back: ``graph`` is launched once a control step."""
    everyone = wp.ones(sim.num_envs, dtype=int, device=sim.device)
    for segment in segments:
        wp.copy(sim.joint_q, segment.joint_q)
        wp.copy(sim.joint_qd, segment.joint_qd)
        sim.clear_solver(everyone)
        sim.refresh()
        for targets in segment.targets:
            wp.copy(sim.targets, targets)
            wp.capture_launch(graph)


def _time_standing(rollout: Rollout, graph: Any, terrains: np.ndarray, seeds: np.ndarray, steps: int) -> float:
    sim, robot = rollout.sim, rollout.robot
    rollout.begin(terrains, seeds)
    sim.joint_qd.zero_()
    targets = np.zeros(sim.targets.shape, dtype=np.float32)
    targets[:, 7:] = robot.default_joint_pos
    sim.targets.assign(targets)
    launches = -(-steps // robot.decimation)
    for _ in range(100):  # 2 s, in which they settle
        wp.capture_launch(graph)
    wp.synchronize_device(sim.device)
    began = time.perf_counter()
    for _ in range(launches):
        wp.capture_launch(graph)
    wp.synchronize_device(sim.device)
    return sim.num_envs * launches * robot.decimation / (time.perf_counter() - began)
