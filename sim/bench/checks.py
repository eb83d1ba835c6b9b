"""Comparison of outputs with the float64 oracle before anything is timed; on a random part where the oracle is slow."""

from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels.penalties import FOOT
from sim.bench import oracle
from sim.bench.scene import Scene
from sim.mujoco_c.model import observations, step_penalties, to_mujoco
from sim.terrain import NUM_COLS, NUM_ROWS, SPACING

# A sphere this close to touching, and two probes this close in depth, may go either way in float32 [m].
_UNDECIDED = 2e-5


class OutputError(ValueError):
    """An output is not what the oracle says: nothing may be reported."""


def require_close(what: str, got: NDArray, expected: NDArray, *, atol: float, rtol: float = 0.0) -> None:
    """Stop if an output differs from the oracle.

    Raises:
        OutputError: If it does, or has another shape, or is not finite.
    """
    if got.shape != expected.shape:
        raise OutputError(f"{what}: shape {got.shape}, but the oracle's is {expected.shape}")
    error = np.abs(_exact(got) - expected) - rtol * np.abs(expected)
    wrong = ~(error <= atol)  # also where it is NaN
    if wrong.any():
        worst = np.unravel_index(np.argmax(np.where(np.isfinite(error), error, np.inf)), error.shape)
        raise OutputError(
            f"{what}: {wrong.sum()} of {wrong.size} values differ from the oracle, the worst at "
            f"{tuple(map(int, worst))}: expected {expected[worst]:.7g}, got {got[worst]:.7g}, tolerance {atol:g}; "
            "nothing is reported before they agree"
        )


def _exact(values: Any) -> NDArray:
    """A copy in double precision of an array, here or on a device."""
    return np.array(values.numpy() if isinstance(values, wp.array) else values, dtype=np.float64)


class Truth:
    """The oracle's outputs of a scene, computed on first use and compared with every variant's output.

    Args of the checks: ``who`` names the variant in errors; the outputs are NumPy arrays.
    """

    def __init__(self, scene: Scene, num_checked: int = 48) -> None:
        """Copy the state of a scene.

        Args:
            scene: Whose kernels are checked.
            num_checked: Environments checked where the oracle is slow.
        """
        sim: Any = scene.rollout.sim
        rng = np.random.default_rng(scene.seed)
        self._robot, self._genes = scene.robot, scene.genes[: scene.num_terrains]
        self.envs = np.sort(rng.permutation(sim.num_envs)[:num_checked])
        self._terrains = np.sort(rng.permutation(scene.num_terrains)[:6])
        self._state = to_mujoco(sim.joint_q.numpy(), sim.joint_qd.numpy(), _exact(list(sim.sensors.base_com)))
        self._body_q = sim.body_q.numpy().reshape(sim.num_envs, -1, 7).copy()
        self._command, self._last_action = _exact(scene.command), _exact(scene.last_action)
        self._terrain_of_env, self._heights = sim.terrain_of_env.numpy().copy(), sim.bank.heights.numpy().copy()
        self._geom_force, self._roles = _exact(sim.geom_force), sim.geom_role.numpy()
        self._position, self._strip_start = sim.probes.position.numpy(), sim.probes.strip_start.numpy().tolist()
        self._strip_body, self._strip_radius = (
            array.numpy().tolist() for array in (sim.probes.strip_body, sim.probes.strip_radius)
        )
        contacts = sim.solver_contacts
        count = min(int(contacts.count.numpy()[0]), contacts.capacity)
        self._contacts = {
            name: getattr(contacts, name).numpy()[:count].copy() for name in ("world", "frame", "efc_address")
        }
        self._contacts["column"] = sim.column_of_geom.numpy()[contacts.geom.numpy()[:count, 1]]
        self._contacts["efc_force"] = contacts.efc_force.numpy().copy()

    @cached_property
    def _rasterised(self) -> NDArray:
        x, y = np.arange(NUM_COLS)[None, :] * SPACING, np.arange(NUM_ROWS)[:, None] * SPACING
        return np.stack([oracle.mixture_height(self._genes[t], x, y) for t in self._terrains])

    def check_rasterise(self, who: str, heights: NDArray) -> None:
        """Heights (T, rows, cols), six terrains of them; steep flanks cost float32 two digits."""
        require_close(f"{who} rasterise", heights[self._terrains], self._rasterised, atol=1e-5)

    @cached_property
    def _rows(self) -> NDArray:
        state = (self._state.qpos, self._state.qvel, self._command, self._last_action)
        default = _exact(np.asarray(self._robot.default_joint_pos, dtype=np.float32))
        scan = np.stack(self._robot.scan_points(), axis=1)
        rows = [
            observations(
                _exact(self._heights[self._terrain_of_env[env]]), *(array[env : env + 1] for array in state),
                default_joint_pos=default, scan=scan,
            )
            for env in self.envs
        ]  # fmt: skip
        return np.concatenate(rows)

    def check_scan(self, who: str, scan: NDArray) -> None:
        """Scans (E, points); where cells are steep, a micrometre along is many up, times 5."""
        require_close(f"{who} scan", scan[self.envs], self._rows[:, -scan.shape[1] :], atol=3e-4)

    def check_observation(self, who: str, observation: NDArray) -> None:
        """Rows (E, columns)."""
        split = observation.shape[1] - self._robot.num_scan_points
        self.check_scan(f"{who} observation,", observation[:, split:])
        require_close(f"{who} observation", observation[self.envs, :split], self._rows[:, :split], atol=2e-5, rtol=1e-5)

    @cached_property
    def _penalties(self) -> NDArray:
        state = (self._state.qpos, self._state.qvel, self._command, self._geom_force)
        feet, limit = (self._roles & FOOT) != 0, self._robot.contact_force_limit
        return self._robot.physics_dt * step_penalties(*state, feet=feet, force_limit=limit)

    def check_penalties(self, who: str, sums: NDArray) -> None:
        """Sums (E, 6) after one step from zero; of 1,000 N float32 keeps a tenth of a millinewton."""
        require_close(f"{who} penalties", sums, self._penalties, atol=1e-6, rtol=2e-5)

    @cached_property
    def _forces(self) -> NDArray:
        return oracle.geom_forces(shape=self._geom_force.shape[:2], **self._contacts)

    def check_geom_forces(self, who: str, forces: NDArray) -> None:
        """Forces (E, G, 3) [N]."""
        require_close(f"{who} contact forces", forces, self._forces, atol=2e-3, rtol=1e-5)

    def centres(self, env: int, strip: int) -> NDArray:
        """World centres of a strip's probes."""
        pose = _exact(self._body_q[env, self._strip_body[strip]])
        probes = slice(self._strip_start[strip], self._strip_start[strip + 1])
        return pose[:3] + self._position[probes] @ oracle.rotation_matrix(pose[3:]).T

    @cached_property
    def _distances(self) -> dict[tuple[int, int], NDArray]:
        """Signed distance of each probe of the strips of the checked environments; infinite where out of reach."""
        return {
            (int(env), strip): np.array(
                [
                    oracle.nearest_on_surface(
                        self._heights[self._terrain_of_env[env]], SPACING, centre, radius + _UNDECIDED
                    )[0]
                    for centre in self.centres(int(env), strip)
                ]
            )
            for env in self.envs
            for strip, radius in enumerate(self._strip_radius)
        }

    def reached_cells(self, env: int) -> tuple[int, int]:
        """Cells that the probes of an environment could touch, probe by probe, and the nodes of all of them."""
        grid, cells, nodes = self._heights[self._terrain_of_env[env]], 0, []
        for strip, radius in enumerate(self._strip_radius):
            for x, y, z in self.centres(env, strip):
                low = np.floor((np.array([y, x]) - radius) / SPACING).astype(int)
                high = np.floor((np.array([y, x]) + radius) / SPACING).astype(int) + 1
                rows = np.clip(np.arange(low[0], high[0] + 1), 0, grid.shape[0] - 1)
                cols = np.clip(np.arange(low[1], high[1] + 1), 0, grid.shape[1] - 1)
                h = grid[np.ix_(rows, cols)]
                highest = np.maximum(np.maximum(h[:-1, :-1], h[:-1, 1:]), np.maximum(h[1:, :-1], h[1:, 1:]))
                near = z - highest < radius
                cells += int(near.sum())
                if near.any():
                    nodes.append((rows[:, None] * grid.shape[1] + cols).ravel())
        return cells, len(np.unique(np.concatenate(nodes))) if nodes else 0

    def check_contact(self, who: str, env: NDArray, probe: NDArray, records: dict[str, NDArray]) -> None:
        """Contact records in any order: the right probes of each strip, and what is recorded of each.

        Args:
            who: Names the variant.
            env: Environment of each record, shape (n,).
            probe: Probe of each record, shape (n,).
            records: ``point0``, ``point1``, ``normal`` and ``offset1``, shape (n, 3) each.
        """
        compared = 0
        for (k, strip), distance in self._distances.items():
            mine = np.flatnonzero(
                (env == k) & (probe >= self._strip_start[strip]) & (probe < self._strip_start[strip + 1])
            )
            got = probe[mine] - self._strip_start[strip]
            if self._decided(distance, self._strip_radius[strip]):
                self._require_probes(f"{who} contact: strip {strip} of environment {k}", distance, strip, got)
                compared += len(got)
            for row in mine[np.isfinite(distance[got])]:
                self._require_record(who, k, strip, int(probe[row]), {name: of[row] for name, of in records.items()})
        if compared == 0:
            raise OutputError(f"{who} contact: none of {len(self.envs)} environments touches anything: walk on")

    def _decided(self, distance: NDArray, radius: float) -> bool:
        # Below the window the oracle has no depth: two such probes cannot be told apart.
        return not (np.abs(distance - radius) < _UNDECIDED).any() and np.isneginf(distance).sum() < 2

    def _require_probes(self, what: str, distance: NDArray, strip: int, got: NDArray) -> None:
        touching = np.flatnonzero(distance < self._strip_radius[strip])
        tied = np.flatnonzero(distance <= distance.min() + _UNDECIDED)
        allowed = [{touching[0], touching[-1], k} for k in tied] if len(touching) else [set()]
        if len(set(got)) != len(got) or set(got) not in allowed:
            raise OutputError(f"{what}: contacts of probes {sorted(got)}, but the oracle's are {sorted(allowed[0])}")

    def _require_record(self, who: str, env: int, strip: int, probe: int, record: dict[str, NDArray]) -> None:
        radius, begin = self._strip_radius[strip], self._strip_start[strip]
        centre = self.centres(env, strip)[probe - begin]
        distance = self._distances[env, strip][probe - begin]
        grid, normal = self._heights[self._terrain_of_env[env]], _exact(record["normal"])
        what = f"{who} contact of probe {probe} of environment {env}"
        off_surface, _ = oracle.nearest_on_surface(grid, SPACING, record["point0"], 0.05)
        reached = np.array([np.dot(centre - record["point0"], normal), np.dot(normal, normal), off_surface])
        require_close(f"{what}: distance, length of the normal, point on the surface", reached,
                      np.array([distance, 1.0, 0.0]), atol=5e-5)  # fmt: skip
        require_close(f"{what}: centre in the body", record["point1"], _exact(self._position[probe]), atol=1e-6)
        turn = oracle.rotation_matrix(self._body_q[env, self._strip_body[strip], 3:])
        require_close(f"{what}: offset", turn @ record["offset1"], -radius * normal, atol=1e-5)
