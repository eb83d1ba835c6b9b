"""Errors of what the controller sees: of the height map around the robot, and of its velocity.

The height scan reads a map of the ground, whose errors act together: where there are any, the scan is left out of the
observation. :func:`_meet_map` finds where it reads the map under all of them, and :func:`_disturb_scan` adds what it
shows. The first of the conditions has both, and reads the numbers of those that are registered behind it. What is drawn
comes from the episode's own stream, in MuJoCo C too.
"""

from typing import Any, ClassVar

import numpy as np
import warp as wp

from kernels.conditions import DisturbedStep, MapView, VariedRobots, age_of
from kernels.heightfield import height_at
from kernels.observation import LIN_VEL_SCALE, NUM_BASE_COLUMNS, SCAN_OFFSET, SCAN_SCALE
from kernels.state import base_heading
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, Array, Condition, Gene, condition_column, round_steps
from sim.terrains.quantities import Sweep

MAX_MAP_DELAY_S = 0.2
"""Longest delay of a height map, and longest time between two of them [s]."""
HOLE_M = wp.constant(0.2)
"""Side of the square cells of the ground of which some are missing in the map [m]."""
_MAP_NUMBERS, _SPACING = wp.constant(10), wp.constant(8)
# Numbers of what is drawn: eight a second, six of the map's drift and two of the velocity's, and behind all one a cell.
_A_SECOND, _OF_VELOCITY, _OF_CELLS, _CELLS = wp.constant(8), wp.constant(6), wp.constant(1 << 20), wp.constant(1024)


@wp.func
def _draw(step: DisturbedStep, env: int, number: int) -> float:
    """A number in [-1, 1) of the episode; the noise of observations has the other streams."""
    return wp.randf(wp.rand_init(int(step.episodes.rng[env]), -1 - number), -1.0, 1.0)


@wp.func
def _drift(step: DisturbedStep, env: int, age: int) -> wp.spatial_vector:
    """Random walk of the map up to a control step, straight in a second; it goes on."""
    walked = wp.spatial_vector()
    if age > 0:
        walked = step.memory.map_drift[env, age % 2]
    second = wp.max(1, int(wp.round(1.0 / (float(step.every) * step.dt))))
    change = wp.spatial_vector()
    for k in range(6):
        change[k] = _draw(step, env, _A_SECOND * (age // second) + k) / float(second)
    step.memory.map_drift[env, (age + 1) % 2] = walked + change
    return walked


@wp.func
def _begin_map(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    robots.is_misled[env] = 0
    for k in range(_MAP_NUMBERS):
        if row[first + k] != wp.where(k == _SPACING, 1.0, 0.0):
            robots.is_misled[env] = 1


@wp.func
def _meet_map(step: DisturbedStep, row: wp.array[float], first: int, env: int):
    if step.memory.is_misled[env] == 0:
        return
    ahead, left, turn = row[first], row[first + 1], row[first + 2]
    drift, tilt = row[first + 3], row[first + 4]
    control_dt = float(step.every) * step.dt
    delay = int(wp.round(row[first + 5] / control_dt))
    period = wp.max(1, int(wp.round(row[first + 6] / control_dt)))
    heading = base_heading(step.joint_q, env)
    x, y, z = step.joint_q[env, 0], step.joint_q[env, 1], step.joint_q[env, 2]
    seen = wp.spatial_vector(x, y, z, wp.atan2(heading[1], heading[0]), 0.0, 0.0)
    age, num_poses = age_of(step, env), step.memory.map_pose.shape[1]
    if drift != 0.0 or tilt != 0.0:
        sizes = wp.spatial_vector(drift, drift, drift, tilt, tilt, tilt)
        seen -= wp.cw_mul(sizes, _drift(step, env, age))
    step.memory.map_pose[env, age % num_poses] = seen
    then = wp.max(age - delay, 0) // period * period
    if then < age:
        seen = step.memory.map_pose[env, then % num_poses]
    c, s = wp.cos(seen[3] - turn), wp.sin(seen[3] - turn)
    view = MapView()
    view.origin = wp.vec2(seen[0] - c * ahead + s * left, seen[1] - s * ahead - c * left)
    view.axis = row[first + _SPACING] * wp.vec2(c, s)
    view.height = seen[2]
    view.tilt = wp.vec2(seen[4], seen[5])
    step.memory.map_view[env] = view


@wp.func
def _disturb_scan(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int):
    k = column - NUM_BASE_COLUMNS - 3 * step.sensors.default_joint_pos.shape[0]
    if k < 0 or k >= step.sensors.scan_x.shape[0]:
        return
    if step.memory.is_misled[env] == 0:
        return
    share, grain = row[first + 7], row[first + 9]
    t = step.terrain_of_env[env]
    view = step.memory.map_view[env]
    ahead, left = step.sensors.scan_x[k], step.sensors.scan_y[k]
    x = view.origin[0] + view.axis[0] * ahead - view.axis[1] * left
    y = view.origin[1] + view.axis[1] * ahead + view.axis[0] * left
    height = height_at(step.terrain, t, x, y)
    if grain > 0.0:
        height = grain * wp.floor(height / grain + 0.5)
    above = view.height + view.tilt[0] * ahead + view.tilt[1] * left - height
    if share > 0.0:
        cell = int(wp.floor(y / HOLE_M)) * _CELLS + int(wp.floor(x / HOLE_M))
        is_missing = _draw(step, env, _OF_CELLS + cell) < 2.0 * share - 1.0
        if is_missing and step.memory.steps[env] == 0:
            base = step.joint_q[env]
            above = base[2] - height_at(step.terrain, t, base[0], base[1])
        elif is_missing:
            above = step.memory.held[env, k]
        step.memory.held[env, k] = above
    step.observation[env, column] += wp.clamp(above - SCAN_OFFSET, -1.0, 1.0) * SCAN_SCALE


class Scans:
    """What the height scans of the episodes in MuJoCo C have shown (:class:`sim.mujoco_c.crossing.EpisodeStates`)."""

    def __init__(self, episodes: Any, values: dict[str, float]) -> None:
        """``values`` are the numbers of all errors of the map."""
        self._episodes, self._values = episodes, values
        self._points = np.stack(episodes.robot.scan_points()).astype(np.float64)
        self._poses: list[Array] = []
        self._held: Array | None = None

    def errors(self, age: int) -> Array:
        """What the scans show less what is true, of the control step ``age``, shape (num_episodes, num_scan_points)."""
        episodes, values, (scan_x, scan_y) = self._episodes, self._values, self._points
        qpos, control_dt = episodes.qpos, episodes.robot.control_dt
        (x, y, z), (w, i, j, k) = qpos[:, :3].T, qpos[:, 3:7].T
        yaw = np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))
        second = max(1, round_steps(1.0, control_dt))
        changes = draw(episodes.streams[:, None, None], 8 * np.arange(age // second + 1)[:, None] + np.arange(6))
        whole = np.clip(age / second - np.arange(age // second + 1), 0.0, 1.0)  # share of each second that is over
        walk = np.einsum("nsk,s->nk", changes, whole) * np.repeat([values["drift"], values["tilt"]], 3)
        self._poses.append(np.stack([x, y, z, yaw, 0 * x, 0 * x], axis=1) - walk)
        every = max(1, round_steps(values["map_period"], control_dt))
        then = every * (max(age - round_steps(values["map_delay"], control_dt), 0) // every)
        seen = self._poses[then].T[:, :, None]
        place = values["spacing"] * (scan_x + 1j * scan_y) - (values["shift_x"] + 1j * values["shift_y"])
        point = seen[0] + 1j * seen[1] + place * np.exp(1j * (seen[3] - values["shift_turn"]))
        ground = episodes.find_ground(point.real, point.imag)
        if values["grain"]:
            ground = values["grain"] * np.floor(ground / values["grain"] + 0.5)
        above = seen[2] - ground + seen[4] * scan_x + seen[5] * scan_y
        cells = np.floor(point.imag / float(HOLE_M)) * 1024 + np.floor(point.real / float(HOLE_M))
        missing = draw(episodes.streams[:, None], (1 << 20) + cells) < 2 * values["holes"] - 1
        held = (z - episodes.find_ground(x, y))[:, None] if self._held is None else self._held
        self._held = np.where(missing, held, above)
        point = (x + 1j * y)[:, None] + (scan_x + 1j * scan_y) * np.exp(1j * yaw[:, None])
        true = z[:, None] - episodes.find_ground(point.real, point.imag)
        return 5.0 * (np.clip(self._held - 0.5, -1.0, 1.0) - np.clip(true - 0.5, -1.0, 1.0))


def draw(streams: Any, numbers: Any) -> Array:
    """What kernels draw of episodes with these random streams, uint32: numbers in [-1, 1), of any shapes that fit."""

    def mixed(state: Any) -> Any:  # as Warp does: Jarzynski and Olano 2020, "Hash Functions for GPU Rendering"
        state = state * np.uint32(747796405) + np.uint32(2891336453)
        state = ((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
        return (state >> np.uint32(22)) ^ state

    offsets = (-1 - np.asarray(numbers).astype(np.int64)).astype(np.uint32)
    return (mixed(mixed(streams + mixed(offsets))) >> np.uint32(8)) * 2.0**-23 - 1.0


class Misperception(Condition):
    """An error of what the robot sees; its text is the noun, and each number that is not nominal in words."""

    observed, noun = "scan", "height map"
    forms: ClassVar[tuple[tuple[str, float, float], ...]]
    """Text of each number, its factor, and what it must differ by from the nominal one."""

    def text(self, values: Array) -> str:
        """What is wrong, each number in a few words."""
        said = zip(self.genes, values, self.forms, strict=True)
        nominal = [gene.to_value(gene.absent) for gene in self.genes]
        parts = [
            form.format(factor * value)
            for (gene, value, (form, factor, least)), middle in zip(said, nominal, strict=True)
            if abs(value - middle) >= least
        ]
        return f"{self.noun} {' and '.join(parts)}" if parts else ""


class MapShift(Misperception):
    """How far the map lies ahead of where it is and to the left [m], and how far it is turned to the left [rad].

    Shift and turn are in the robot's frame, which is what a camera has that is mounted a little askew.
    """

    name, cause = "map_shift", "shifted map"
    genes = (
        Gene(name="shift_x", low=-0.2, middle=0.0, high=0.2, unit="m"),
        Gene(name="shift_y", low=-0.2, middle=0.0, high=0.2, unit="m", mirrored=True),
        Gene(name="shift_turn", low=-0.2, middle=0.0, high=0.2, unit="rad", mirrored=True, limits=(-4.0, 4.0)),
    )
    dose = Sweep("shift_x", (0.0, 0.04, 0.08, 0.12, 0.16, 0.2), title="height map shifted ahead")
    begin = _begin_map
    meet = _meet_map
    disturb = _disturb_scan

    def text(self, values: Array) -> str:
        """Where the map lies, and how it is turned."""
        words = (("ahead", "back"), ("to the left", "to the right"))
        shifts = [
            f"{abs(v):.2f} m {word[int(v < 0)]}" for v, word in zip(values, words, strict=False) if abs(v) >= 0.005
        ]
        parts = [f"{' and '.join(shifts)} of where it is"] if shifts else []
        if abs(degrees := np.rad2deg(values[2])) >= 0.5:
            parts.append(f"turned by {abs(degrees):.0f} degrees to the {'right' if degrees < 0 else 'left'}")
        return f"height map {', '.join(parts)}" if parts else ""

    def acts(self, row: Array) -> bool:
        """Whether the map has any error."""
        return any(Condition.acts(CONDITIONS[name], row) for name in GROUPS["map"])

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Begins to keep what the scans show."""
        numbers = {gene.name: condition_column(gene.name) for name in GROUPS["map"] for gene in CONDITIONS[name].genes}
        episodes.scans = Scans(episodes, {name: float(episodes.row[column]) for name, column in numbers.items()})

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Adds what is wrong by all errors of the map."""
        first = sum(episodes.robot.column_sizes[:8])
        scan = slice(first, first + episodes.robot.column_sizes[8])
        rows[running, scan] += episodes.scans.errors(step // episodes.robot.decimation)[running]
        return rows


class MapDrift(Misperception):
    """A random walk of the map: how far at most it moves along each axis [m] and turns about each [rad] in a second."""

    name, cause = "map_drift", "drifting map"
    genes = (
        Gene(name="drift", low=0.0, middle=0.05, high=0.1, absent=-1.0, unit="m", limits=(0.0, 10.0)),
        Gene(name="tilt", low=0.0, middle=0.025, high=0.05, absent=-1.0, unit="rad", limits=(0.0, 1.0)),
    )
    forms = (("drifting by up to {:.3f} m a second", 1.0, 5e-4),
             ("turning and tilting by up to {:.1f} degrees a second", 180 / np.pi, 1e-3))  # fmt: skip
    dose = Sweep("drift", (0.0, 0.02, 0.04, 0.06, 0.08, 0.1), title="drift of the height map")


def _map_time(name: str) -> Gene:
    low, high = limits = (0.0, MAX_MAP_DELAY_S)
    return Gene(name=name, low=low, middle=high / 2, high=high, absent=-1.0, step=0.02, unit="s", limits=limits)


class MapDelay(Misperception):
    """Age of the map, and the time from one to the next [s]; the first one is shown until there is one so old."""

    name, cause = "map_late", "late map"
    genes = (_map_time("map_delay"), _map_time("map_period"))
    forms = (("{:.0f} ms late", 1e3, 0.005), ("new every {:.0f} ms", 1e3, 0.03))
    dose = Sweep("map_delay", (0.0, 0.04, 0.08, 0.12, 0.16, 0.2), title="delay of the height map")


class MapHoles(Misperception):
    """Share of the ground that the map lacks: squares, of which a point of the scan shows what it showed before.

    At the start it shows the height of the ground below the base.
    """

    name, cause = "map_holes", "holes in the map"
    genes = (Gene(name="holes", low=0.0, middle=0.25, high=0.5, absent=-1.0, limits=(0.0, 1.0)),)
    forms = (("with {:.0f}% of it missing", 100.0, 5e-3),)
    dose = Sweep("holes", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5), title="holes in the height map")


class MapGrid(Misperception):
    """Distance of the points of the scan over what it should be, and what heights are multiples of [m]."""

    name, cause = "map_grid", "coarse map"
    genes = (
        Gene(name="spacing", low=0.8, middle=1.0, high=1.25, limits=(0.1, 10.0)),
        Gene(name="grain", low=0.0, middle=0.025, high=0.05, absent=-1.0, unit="m", limits=(0.0, 1.0)),
    )
    forms = (("at {:.2f} times its spacing", 1.0, 5e-3), ("in steps of {:.3f} m", 1.0, 5e-4))
    dose = Sweep("grain", (0.0, 0.01, 0.02, 0.03, 0.04, 0.05), title="steps of the heights in the map")


@wp.func
def _disturb_velocity(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int):
    if column > 2 or (row[first] == 1.0 and row[first + 1] == 0.0):
        return
    shown = row[first] * step.observation[env, column]
    if column < 2:
        second = wp.max(1, int(wp.round(1.0 / (float(step.every) * step.dt))))
        age = age_of(step, env)
        number = _A_SECOND * (age // second) + _OF_VELOCITY + column
        before, after = _draw(step, env, number), _draw(step, env, number + _A_SECOND)
        between = float(age % second) / float(second)
        shown += LIN_VEL_SCALE * row[first + 1] * ((1.0 - between) * before + between * after)
    step.observation[env, column] = shown


class VelocityEstimate(Misperception):
    """Factor of the base's velocity as it is observed, and how far it wanders ahead and to the left [m/s]."""

    name, cause = "estimate", "wrong velocity"
    observed, noun = "lin_vel", "seen velocity"
    genes = (
        Gene(name="estimate", low=0.0, middle=1.0, high=1.5, limits=(0.0, 10.0)),
        Gene(name="wander", low=0.0, middle=0.25, high=0.5, absent=-1.0, unit="m/s", limits=(0.0, 10.0)),
    )
    forms = (("{:.2f} times the true one", 1.0, 5e-3), ("off by up to {:.2f} m/s", 1.0, 5e-3))
    dose = Sweep("wander", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5), title="wandering of the seen velocity")
    disturb = _disturb_velocity

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Scales the velocities and lets them wander."""
        control_dt, age = episodes.robot.control_dt, step // episodes.robot.decimation
        second = max(1, round_steps(1.0, control_dt))
        numbers = 6 + np.arange(2) + 8 * (age // second + np.arange(2)[:, None])
        before, after = np.moveaxis(draw(episodes.streams[:, None, None], numbers), 1, 0)
        off = before + (age % second) / second * (after - before)
        rows[running, :3] *= values[0]
        rows[running, :2] += float(LIN_VEL_SCALE) * values[1] * off[running]
        return rows


_MAP = (MapShift, MapDrift, MapDelay, MapHoles, MapGrid)
CONDITIONS.update((kind.name, kind()) for kind in (*_MAP, VelocityEstimate))
GROUPS["map"] = tuple(kind.name for kind in _MAP)
