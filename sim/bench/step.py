"""The whole control step against the bare physics it is made of, and that against the solver's own collision."""

import time
from dataclasses import asdict
from typing import Any

import warp as wp

from sim.bench.bare import record_segments
from sim.bench.collision import HeightfieldSimulation, measure_collision
from sim.bench.scene import Scene
from sim.simulation import Simulation


def time_control_step(scene: Scene) -> float:
    """Seconds a control step over whole crossings: policy, four physics steps, penalties, ends, observation."""
    rollout, device = scene.rollout, scene.rollout.sim.device
    steps = round(scene.cfg.duration_s / scene.robot.control_dt)
    rollout.begin(scene.genes, scene.seeds)
    wp.synchronize_device(device)
    began = time.perf_counter()
    for _ in range(steps):
        rollout.control_step()
    wp.synchronize_device(device)
    return (time.perf_counter() - began) / steps


def _build_heightfield(sim: Simulation) -> tuple[HeightfieldSimulation | None, str | None]:
    """The comparison, or why there is none: the failure of another library's collision takes nothing from ours."""
    try:
        return HeightfieldSimulation(sim), None
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"[:300]


def measure_step(scene: Scene, *, rounds: int, heightfield: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """The row of the whole step, and the physics rates with either collision.

    Bare physics is contact and solver alone in the motion of the same crossings (:mod:`sim.bench.bare`).

    Args:
        scene: Robots and terrains; its state is that of another moment afterwards.
        rounds: Repetitions, of which the median counts.
        heightfield: Whether to measure the solver's own collision too.
    """
    sim = scene.rollout.sim
    seconds = sorted(time_control_step(scene) for _ in range(3))[1]
    segments = record_segments(scene.rollout, scene.genes, scene.seeds)
    other, failure = _build_heightfield(sim) if heightfield else (None, "not asked for")
    rates = measure_collision(sim, other, segments, rounds=rounds)
    bare_s = sim.num_envs * scene.robot.decimation / rates.ours
    row = {
        "kernel": "whole_step",
        "ours_ms": seconds * 1e3,
        "torch_ms": None,
        "torch_compile_ms": None,
        "speedup": None,
        "speedup_compile": None,
        "ceiling_share": bare_s / seconds,
        "bound_by": "bare physics",
        "bare_ms": bare_s * 1e3,
    }
    collision = {
        "physics_steps_per_s": rates.ours,
        "physics_steps_per_s_solver_collision": rates.solver,
        "speedup": None if rates.solver is None else rates.ours / rates.solver,
        **{name: value for name, value in asdict(rates).items() if name not in ("ours", "solver")},
        "solver_failure": failure,
    }
    return row, collision
