"""Physics with the solver's own heightfield collision, on the same motion as physics with the contact of our own."""

import time
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from kernels.episode import PARKING_HEIGHT
from sim.bank import TerrainBank
from sim.bench.bare import Segment, replay_segments
from sim.simulation import CAPACITY_OVERFLOWS, GROUND_FRICTION, Simulation
from sim.terrain import SPACING

_LOST_M = 1.0


@dataclass(frozen=True, kw_only=True)
class CollisionRates:
    """Physics steps a second over all environments, contact and solver alone, in the same recorded motion."""

    ours: float
    """Sphere probes against the height grids (:mod:`kernels.contact`): the bare physics rate."""
    solver: float | None = None
    """The solver's own collision of the robot's shapes with a heightfield of all terrains; None: not measured."""
    height_difference_m: float | None = None
    """Mean difference of the bases' heights after the 0.2 s replayed from the middle of the crossings, over the robots
    still at it: the two stand on the same ground. None: all were lost."""
    solver_invalid_envs: int | None = None
    """Environments that the solver's collision lost in it: not finite, or thrown over a metre away."""
    solver_overflows: int | None = None
    """Environments in which its buffers, as large as ours, were too small in the last step."""


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


def _time_replay(sim: Simulation, graph: Any, segments: list[Segment]) -> float:
    with wp.ScopedDevice(sim.device):
        wp.synchronize_device(sim.device)
        began = time.perf_counter()
        replay_segments(sim, graph, segments)
        wp.synchronize_device(sim.device)
        return time.perf_counter() - began


def _capture_physics(sim: Simulation) -> Any:
    def control_step() -> None:
        for _ in range(sim.robot.decimation):
            sim.physics_step()

    return sim.capture(control_step)


def measure_collision(
    sim: Simulation, other: HeightfieldSimulation | None, segments: list[Segment], *, rounds: int
) -> CollisionRates:
    """Physics rates of two simulations on the same motion, in turns.

    Args:
        sim: The simulation the segments were recorded from.
        other: The same robots on the solver's heightfield, or None.
        segments: The motion.
        rounds: How often all of it is replayed in each; the median counts.
    """
    sims: list[tuple[Simulation, Any, list[Segment]]] = [(sim, _capture_physics(sim), segments)]
    if other is not None:
        sims.append((other, _capture_physics(other), [other.shift(segment) for segment in segments]))
    for replayed in sims:
        _time_replay(replayed[0], replayed[1], replayed[2][:2])
    seconds = np.median([[_time_replay(*replayed) for replayed in sims] for _ in range(rounds)], axis=0)
    steps = sim.num_envs * sim.robot.decimation * sum(len(segment.targets) for segment in segments)
    if other is None:
        return CollisionRates(ours=steps / float(seconds[0]))
    middle = len(segments) // 2
    for simulated, graph, own in sims:
        _time_replay(simulated, graph, own[middle : middle + 1])
    heights = [simulated.joint_q.numpy()[:, 2] for simulated in (sim, other)]
    with np.errstate(invalid="ignore"):
        apart = np.abs(heights[0] - heights[1])
    apart = apart[segments[middle].joint_q.numpy()[:, 2] < 0.5 * PARKING_HEIGHT]  # parked robots tell nothing
    valid = apart < _LOST_M
    return CollisionRates(
        ours=steps / float(seconds[0]),
        solver=steps / float(seconds[1]),
        height_difference_m=float(apart[valid].mean()) if valid.any() else None,
        solver_invalid_envs=int((~valid).sum()),
        solver_overflows=int(((other.overflow.numpy() & CAPACITY_OVERFLOWS) != 0).sum()),
    )
