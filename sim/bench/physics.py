"""The whole control step, the bare physics in it, and the same physics with the solver's own heightfield collision.

Bare physics is terrain contact and solver alone, on the motion of recorded crossings: the yardstick of everything else.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from kernels.episode import PARKING_HEIGHT
from kernels.ground import PATCHES
from sim.bank import TerrainBank
from sim.bench.scene import Scene
from sim.rollout import Rollout
from sim.simulation import CAPACITY_OVERFLOWS, GROUND_FRICTION, Simulation
from sim.terrain import SPACING

_SEGMENT_STEPS = 10
_SEGMENT_EVERY = 20
_LOST_M = 1.0
_PROFILED_STEPS = 50  # control steps
_NAMED_KERNELS = 40


@dataclass(frozen=True, kw_only=True)
class BareRates:
    """Physics steps a second over all environments, of the captured graph of terrain contacts and solver alone."""

    walking: float
    """In the motion of the crossings themselves: states and joint targets recorded from a rollout, physics replayed."""
    standing: float
    """Holding the default pose at the start of the crossings; cheaper, since hardly any contact changes."""


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A stretch of recorded motion: the state at its start and the joint targets from there on."""

    joint_q: Any
    """Joint coordinates at its begin, on the device, shape (num_envs, 7 + num_joints)."""
    joint_qd: Any
    """Joint velocities, shape (num_envs, 6 + num_joints)."""
    targets: list[Any]
    """Joint targets of each control step, shape (num_envs, 7 + num_joints)."""


def measure_bare_physics(rollout: Rollout, terrains: np.ndarray, seeds: np.ndarray, *, steps: int = 1000) -> BareRates:
    """Bare physics rates on a rollout's own terrains, environments and solver.

    Args:
        rollout: Built for the terrains.
        terrains: Genes or heights, as :meth:`Rollout.evaluate` takes them.
        seeds: One a terrain, uint32.
        steps: Physics steps timed at least.
    """
    sim, robot = rollout.sim, rollout.robot
    motion = Motion(sim, record_segments(rollout, terrains, seeds))
    [walking] = replay_rates([motion], rounds=-(-steps // motion.physics_steps))
    rollout.clear()
    rollout.put(terrains, seeds)
    sim.joint_qd.zero_()
    targets = np.zeros(sim.targets.shape, dtype=np.float32)
    targets[:, 7:] = robot.default_joint_pos
    sim.targets.assign(targets)
    launches = -(-steps // robot.decimation)
    motion.launch(100)  # 2 s, in which they settle
    seconds = _time(lambda: motion.launch(launches), sim.device)
    return BareRates(walking=walking, standing=sim.num_envs * launches * robot.decimation / seconds)


def measure_ground(rollout: Rollout, terrains: np.ndarray, seeds: np.ndarray, *, steps: int = 1000) -> float:
    """What a physics step costs on ground with maps of friction and softness, over what it costs without.

    The maps change nothing, so that both simulations make the same motion.

    Args:
        rollout: As of :func:`measure_bare_physics`, of a space without ground of its own.
        terrains: Likewise.
        seeds: Likewise.
        steps: Physics steps of each that are timed at least.
    """
    sim, segments = rollout.sim, record_segments(rollout, terrains, seeds)
    bank = TerrainBank(sim.bank.num_terrains, device=sim.device, ground_shape=PATCHES)
    bank.set_heights(sim.bank.heights.numpy())
    mapped = Simulation(sim.robot, bank, sim.terrain_of_env.numpy())
    motions = [Motion(sim, segments), Motion(mapped, segments)]
    without, with_maps = replay_rates(motions, rounds=-(-steps // motions[0].physics_steps))
    return without / with_maps


def profile_kernels(rollout: Rollout) -> list[dict[str, Any]]:
    """Name and share of the GPU's time of each kernel, the most first, over a second of crossings that are under way.

    It begins a second on.
    """
    from torch.profiler import ProfilerActivity, profile

    for _ in range(_PROFILED_STEPS):
        rollout.control_step()
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        for _ in range(_PROFILED_STEPS):
            rollout.control_step()
        wp.synchronize_device(rollout.sim.device)
    times: dict[str, float] = {}
    for event in profiled.key_averages():
        name = re.sub(r"_[0-9a-f]{8}(_cuda_kernel_forward)?$|_cuda_kernel_forward$", "", event.key)
        times[name] = times.get(name, 0.0) + event.self_device_time_total
    total = sum(times.values())
    ranked = sorted(times.items(), key=lambda one: -one[1])[:_NAMED_KERNELS]
    return [{"name": name, "share": time / total} for name, time in ranked]


def _time(work: Callable[[], object], device: str) -> float:
    """Seconds from when the device is idle to when it has done the work."""
    with wp.ScopedDevice(device):
        wp.synchronize_device(device)
        began = time.perf_counter()
        work()
        wp.synchronize_device(device)
        return time.perf_counter() - began


def record_segments(rollout: Rollout, terrains: np.ndarray, seeds: np.ndarray) -> list[Segment]:
    """State and targets of the first 10 of every 20 control steps of the crossings.

    Segments are short: over 0.2 s a replayed robot still moves as the recorded one did, which over a whole crossing
    without its controller it would not.
    """
    sim, segments = rollout.sim, []
    most = round(rollout.cfg.max_duration_s / rollout.robot.control_dt)
    rollout.clear()
    rollout.put(terrains, seeds)
    for step in range(most):
        if step % _SEGMENT_EVERY == 0:
            segments.append(Segment(joint_q=wp.clone(sim.joint_q), joint_qd=wp.clone(sim.joint_qd), targets=[]))
        rollout.control_step()
        if step % _SEGMENT_EVERY < _SEGMENT_STEPS:
            segments[-1].targets.append(wp.clone(sim.targets))
    return segments


class Motion:
    """Recorded segments to be replayed in one simulation, by a captured graph of the physics of a control step."""

    def __init__(self, sim: Simulation, segments: list[Segment]) -> None:
        """Capture the graph and replay two segments, so that the kernels are loaded."""
        self.sim, self.segments = sim, segments
        self.physics_steps = sim.robot.decimation * sum(len(segment.targets) for segment in segments)
        """Of one replay of all segments."""

        def control_step() -> None:
            for _ in range(sim.robot.decimation):
                sim.physics_step()

        with wp.ScopedDevice(sim.device):
            self._graph: Any = sim.capture(control_step)
        self.replay(slice(2))

    def launch(self, times: int = 1) -> None:
        """Simulates some control steps from the present state."""
        with wp.ScopedDevice(self.sim.device):
            for _ in range(times):
                wp.capture_launch(self._graph)

    def replay(self, part: slice = slice(None)) -> float:
        """Plays segments back, each from its recorded state; returns the seconds it took."""
        return _time(lambda: self._replay(self.segments[part]), self.sim.device)

    def _replay(self, segments: list[Segment]) -> None:
        sim = self.sim
        everyone = wp.ones(sim.num_envs, dtype=int, device=sim.device)
        for segment in segments:
            wp.copy(sim.joint_q, segment.joint_q)
            wp.copy(sim.joint_qd, segment.joint_qd)
            sim.clear_solver(everyone)
            for targets in segment.targets:
                wp.copy(sim.targets, targets)
                wp.capture_launch(self._graph)


def replay_rates(motions: list[Motion], *, rounds: int) -> list[float]:
    """Physics steps a second over all environments of each motion, replayed in turns; the median of ``rounds``."""
    seconds = np.median([[motion.replay() for motion in motions] for _ in range(rounds)], axis=0)
    return [m.sim.num_envs * m.physics_steps / float(s) for m, s in zip(motions, seconds, strict=True)]


class HeightfieldSimulation(Simulation):
    """Robots on one mosaic of all terrains; an environment's coordinates are shifted by ``offset`` to its tile.

    Attributes:
        offset: Where each environment's tile begins [m], shape (num_envs, 2).
    """

    solver_collides = True

    def __init__(self, sim: Simulation) -> None:
        """The robots, terrains and step of another simulation, whose bank holds its terrains already."""
        self._terrain_of_env = sim.terrain_of_env.numpy()
        self._tiles = sim.bank.heights.numpy()[: self._terrain_of_env.max() + 1]
        flat = TerrainBank(sim.bank.num_terrains, device=sim.device, nrow=2, ncol=2)  # only its number is asked for
        super().__init__(sim.robot, flat, self._terrain_of_env)

    def _build_model(self, builder: newton.ModelBuilder) -> None:
        tiles = self._tiles
        num_rows, num_cols = tiles.shape[1] - 1, tiles.shape[2] - 1  # cells: neighbours share their edge nodes
        across = int(np.ceil(np.sqrt(len(tiles) * num_rows / num_cols)))
        up = -(-len(tiles) // across)
        mosaic = np.zeros((up * num_rows + 1, across * num_cols + 1), np.float32)
        for t, tile in enumerate(tiles):
            row, col = t // across * num_rows, t % across * num_cols
            mosaic[row : row + num_rows + 1, col : col + num_cols + 1] = tile
        row, col = np.divmod(self._terrain_of_env, across)
        self.offset = np.stack([col * num_cols, row * num_rows], axis=1) * SPACING
        half_x, half_y = 0.5 * SPACING * across * num_cols, 0.5 * SPACING * up * num_rows
        scene = newton.ModelBuilder()
        newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
        scene.rigid_gap = 0.0
        scene.default_shape_cfg.mu = GROUND_FRICTION
        # No explicit bounds: Newton rescales the data by its own minimum and maximum in any case.
        ground = newton.Heightfield(data=mosaic, nrow=mosaic.shape[0], ncol=mosaic.shape[1], hx=half_x, hy=half_y)
        middle: Any = wp.vec3(half_x, half_y, 0.0)
        scene.add_shape_heightfield(
            heightfield=ground,
            xform=wp.transform(middle, wp.quat_identity()),
            custom_attributes={"mujoco:geom_solmix": 0.0},  # as the ground of the simulation it is compared with
        )
        scene.replicate(builder, self.num_envs)
        self.model = scene.finalize()

    def _build_contact(self, builder: newton.ModelBuilder) -> None:
        """Nothing: the solver collides, and no contact force is read."""

    def shift(self, segment: Segment) -> Segment:
        """A recorded segment in this simulation's coordinates."""
        joint_q = segment.joint_q.numpy().copy()
        joint_q[:, :2] += self.offset
        moved = wp.array(joint_q, dtype=float, device=self.device)
        return Segment(joint_q=moved, joint_qd=segment.joint_qd, targets=segment.targets)

    def physics_step(self) -> None:
        """One solver step, its collision included."""
        self.solver.step(self._state, self._state, self._control, None, self.robot.physics_dt)


def measure_collision(
    sim: Simulation, other: HeightfieldSimulation | None, segments: list[Segment], *, rounds: int
) -> dict[str, Any]:
    """Physics rates of two simulations on the same motion, in turns.

    Args:
        sim: The simulation that the segments were recorded from.
        other: The same robots on the solver's heightfield, or None.
        segments: The motion.
        rounds: How often all of it is replayed in each; the median counts.

    Returns:
        ``physics_steps_per_s`` over all environments, by our contact and, ``_solver_collision``, by the solver's, and
        their ratio ``speedup``. Of the 0.2 s in the middle of the crossings: ``height_difference_m``, the mean
        difference of the bases' heights, ``solver_invalid_envs`` that the solver's collision lost (not finite, or
        thrown over a metre away), and ``solver_overflows`` of its buffers, which are as large as ours. What is not
        measured is None.
    """
    motions = [Motion(sim, segments)]
    if other is not None:
        motions.append(Motion(other, [other.shift(segment) for segment in segments]))
    rates = replay_rates(motions, rounds=rounds)
    found: dict[str, Any] = {"physics_steps_per_s": rates[0]}
    names = ("speedup", "height_difference_m", "solver_invalid_envs", "solver_overflows")
    found |= dict.fromkeys(("physics_steps_per_s_solver_collision", *names))
    if other is None:
        return found
    middle = len(segments) // 2
    for motion in motions:
        motion.replay(slice(middle, middle + 1))
    with np.errstate(invalid="ignore"):
        apart = np.abs(sim.joint_q.numpy()[:, 2] - other.joint_q.numpy()[:, 2])
    apart = apart[segments[middle].joint_q.numpy()[:, 2] < 0.5 * PARKING_HEIGHT]  # parked robots tell nothing
    valid = apart < _LOST_M
    return found | {
        "physics_steps_per_s_solver_collision": rates[1],
        "speedup": rates[0] / rates[1],
        "height_difference_m": float(apart[valid].mean()) if valid.any() else None,
        "solver_invalid_envs": int((~valid).sum()),
        "solver_overflows": int(((other.overflow.numpy() & CAPACITY_OVERFLOWS) != 0).sum()),
    }


def measure_step(scene: Scene, *, rounds: int, heightfield: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """The row of the whole step, and the physics rates with either collision.

    The whole step is policy, four physics steps, penalties, ends and observation, over whole crossings.

    Args:
        scene: Robots and terrains; its state changes.
        rounds: Repetitions, of which the median counts.
        heightfield: Whether to measure the solver's own collision too.
    """
    rollout, sim = scene.rollout, scene.rollout.sim
    steps = round(rollout.cfg.max_duration_s / scene.robot.control_dt)

    def cross() -> float:
        rollout.clear()
        rollout.put(scene.genes, scene.seeds)
        return _time(lambda: [rollout.control_step() for _ in range(steps)], sim.device) / steps

    seconds = sorted(cross() for _ in range(3))[1]
    segments = record_segments(rollout, scene.genes, scene.seeds)
    other, failure = None, None if heightfield else "not asked for"
    if heightfield:
        try:
            other = HeightfieldSimulation(sim)
        except Exception as error:  # a failure of the solver's collision stops nothing
            failure = f"{type(error).__name__}: {error}"[:300]
    collision = measure_collision(sim, other, segments, rounds=rounds)
    bare_s = sim.num_envs * scene.robot.decimation / collision["physics_steps_per_s"]
    row = {
        "kernel": "whole_step",
        "ours_ms": seconds * 1e3,
        **dict.fromkeys(("torch_ms", "torch_compile_ms", "speedup", "speedup_compile")),
        "ceiling_share": bare_s / seconds,
        "bound_by": "bare physics",
        "bare_ms": bare_s * 1e3,
    }
    return row, collision | {"solver_failure": failure}
