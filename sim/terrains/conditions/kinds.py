"""What a condition is, and all conditions by name: each in the parallel simulation and in MuJoCo C.

A condition has genes in [-1, 1], each of which becomes one number. The numbers of all conditions, in the order in which
they are registered, are the row of conditions of a terrain. Behind them stands what the robot is asked for, a
:class:`kernels.episode.Kind`.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels.conditions import BASE, DisturbedStep, VariedRobots, age_of
from kernels.episode import Kind, Outcome
from sim.robots.training import NoiseCfg
from sim.terrains.quantities import Quantity, Sweep

MAX_LATENCY_S = 0.06
"""Longest delay of actions, beside the robot's own, and largest age of observations [s]."""
Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class Gene(Quantity):
    """How a gene in [-1, 1] becomes a number of a condition: ``middle`` at 0, and linear on both sides."""

    middle: float
    absent: float = 0.0
    """The gene that changes nothing."""
    limits: tuple[float, float] = (-100.0, 100.0)
    """Values that can be simulated."""
    mirrored: bool = False
    """Whether the value changes its sign on a terrain that is mirrored at the way."""
    hard_at_limits: bool = True
    """Whether hard-random terrains have it at a limit; else uniform."""

    def to_value(self, genes: Any) -> NDArray[np.float64]:
        """Values of genes, any shape."""
        values = np.interp(genes, (-1.0, 0.0, 1.0), (self.low, self.middle, self.high))
        return np.floor(values / self.step + 0.5) * self.step if self.step else values

    def to_gene(self, values: Any) -> NDArray[np.float64]:
        """Genes of values, any shape; outside of the range those at its ends."""
        return np.interp(values, (self.low, self.middle, self.high), (-1.0, 0.0, 1.0))


class Condition:
    """A condition under which robots cross. A class and its instance in :data:`CONDITIONS` add one."""

    name: str
    """What a space is called by it: ``course+payload``."""
    cause: str
    """What a fault is called that it causes."""
    genes: tuple[Gene, ...]
    form: ClassVar[str]
    """Its values as text."""
    least: ClassVar[float]
    """What its first value differs by from the nominal one, or nothing is said of it."""
    dose: Sweep | None = None
    """One of its genes as a dose on level ground."""
    varied: ClassVar[tuple[float, float] | None] = None
    """Limits between which its first value is drawn for varied conditions; None if it stays nominal."""
    begin: ClassVar[Any] = None
    """Warp function that varies a robot where its episode begins (:mod:`kernels.conditions`)."""
    meet: ClassVar[Any] = None
    """Warp function of what meets a robot before a control step."""
    disturb: ClassVar[Any] = None
    """Warp function that disturbs a column of an observation."""
    drive: ClassVar[Any] = None
    """Warp function that changes joint targets in a physics step."""
    force: ClassVar[Any] = None
    """Warp function that adds forces in a physics step."""
    observed: ClassVar[str] = ""
    """The only term of an observation (:data:`sim.controllers.described.TERMS`) that it disturbs, if there is one."""
    needs_arms: ClassVar[bool] = False
    """Whether it acts on the robot's ``arm_joints``."""
    disturbs_last: ClassVar[bool] = False
    """Whether it disturbs what others have disturbed."""
    moment: str | None = None
    """Its gene that says when it comes [s], if it is a push: its third, behind those along the way and to the left."""
    asks: ClassVar[Kind] = Kind.CROSS
    """What the robots of a space with it are asked for."""

    def text(self, values: Array) -> str:
        """Its values in a few words; empty where it changes nothing to speak of."""
        nominal = self.genes[0].to_value(self.genes[0].absent)
        return self.form.format(*values) if abs(values[0] - nominal) >= self.least else ""

    def span(self, values: Array, duration_s: float) -> tuple[float, float]:
        """When it acts in an episode of this length [s]; a moment begins and ends at once."""
        if self.moment is None:
            return 0.0, duration_s
        time_s = float(values[[gene.name for gene in self.genes].index(self.moment)])
        return time_s, time_s

    def to_genes(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        """Genes of some values by name, each of shape (...), as (..., number of genes); the others change nothing."""
        genes = (gene.to_gene(values[gene.name]) if gene.name in values else gene.absent for gene in self.genes)
        return np.stack(np.broadcast_arrays(*genes), axis=-1)

    def acts(self, row: Array) -> bool:
        """Whether it changes anything under a row of conditions; if not, MuJoCo C leaves it out."""
        first = condition_column(self.genes[0].name)
        nominal = np.float32([gene.to_value(gene.absent) for gene in self.genes])
        return bool((row[first : first + len(nominal)] != nominal).any())

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Varies the model, ``strength`` or ``delay_steps`` of a :class:`sim.mujoco_c.crossing.EpisodeStates`."""

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Observations (num_episodes, observation_size) as shown to the controller; may push the episodes ``running``.

        ``step`` counts physics steps since the episodes began.
        """
        return rows

    def drive_plain(self, episodes: Any, values: Array, targets: Array, step: int) -> Array:
        """Joint targets in effect in a physics step [rad], shape (num_episodes, num_actuators)."""
        return targets

    def force_plain(self, episodes: Any, values: Array, running: Any, step: int) -> None:
        """Adds to ``xfrc_applied`` of the episodes ``running`` before a physics step; it was 0."""


CONDITIONS: dict[str, Condition] = {}
"""All conditions by name, in the order of their numbers in a row of conditions."""


GROUPS: dict[str, tuple[str, ...]] = {}
"""Names of several conditions that a space may be called by in place of each of them."""


TASKS = {"stand": Kind.STAND}
"""What robots are asked for without any gene, by its name in that of a space."""


def condition_genes(names: Sequence[str] | None = None) -> tuple[Gene, ...]:
    """Genes of some conditions in their order, or of all."""
    return tuple(gene for name in (CONDITIONS if names is None else names) for gene in CONDITIONS[name].genes)


def condition_column(name: str) -> int:
    """Column of a gene's value in a row of conditions."""
    return [gene.name for gene in condition_genes()].index(name)


def nominal_row() -> NDArray[np.float32]:
    """A row of conditions that change nothing, of a crossing."""
    return np.array([*(gene.to_value(gene.absent) for gene in condition_genes()), Kind.CROSS], np.float32)


def split_row(row: Array) -> list[tuple[Condition, Array]]:
    """Each condition with its numbers in a row."""
    ends = np.cumsum([len(condition.genes) for condition in CONDITIONS.values()])
    return list(zip(CONDITIONS.values(), np.split(row, ends)[:-1], strict=True))


def condition_texts(row: NDArray[np.floating], names: Sequence[str]) -> list[str]:
    """Some conditions of a row as text; empty where one changes nothing to speak of."""
    texts = {condition.name: condition.text(values) for condition, values in split_row(row)}
    return [texts[name] for name in names]


def condition_effects(stage: Literal["begin", "meet", "disturb", "drive", "force"]) -> tuple[tuple[Any, int], ...]:
    """Warp functions of a stage in the order in which they act, each with its first column in a row."""
    columns = sorted(split_row(np.arange(len(nominal_row()))), key=lambda pair: pair[0].disturbs_last)
    return tuple((effect, int(own[0])) for condition, own in columns if (effect := getattr(condition, stage)))


def round_steps(seconds: float, dt: float) -> int:
    """Steps of a time, rounded as the parallel simulation does."""
    return int(np.float32(seconds) / np.float32(dt) + np.float32(0.5))


def _direction_text(values: Array, form: str, least: float, directions: Sequence[str]) -> str:
    """Two numbers along the axes, each with one of four ``directions``: ahead, back, left, right."""
    large = [(axis, value) for axis, value in enumerate(values) if abs(value) >= least]
    return " and ".join(f"{abs(value):{form}} {directions[2 * axis + (value < 0)]}" for axis, value in large)


def push_text(values: Array) -> str:
    """The first two numbers of a push [m/s] as text; empty where there is none to speak of."""
    directions = ("m/s ahead", "m/s back", "m/s to the left", "m/s to the right")
    pushed = _direction_text(values[:2], ".1f", 0.05, directions)
    return pushed and f"pushed by {pushed}"


@wp.func
def _point_inertia(d: wp.vec3) -> wp.mat33:
    """Inertia of a unit mass at ``d`` [m]."""
    return wp.length_sq(d) * wp.identity(n=3, dtype=float) - wp.outer(d, d)


@wp.func
def _begin_payload(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    mass, rotation = robots.base_mass[env], robots.base_frame[env]
    added = wp.max(row[first] * robots.total_mass[env], -0.5 * mass)
    frame = wp.quat(rotation[0], rotation[1], rotation[2], rotation[3])
    moved, moments = wp.vec3(0.0), 1.0 * robots.base_inertia[env]
    if added < 0.0:
        moments *= (mass + added) / mass
    if added > 0.0:
        offset = wp.vec3(row[first + 1], row[first + 2], 0.0)
        moved = (added / (mass + added)) * offset
        to_base = wp.quat_to_matrix(wp.quat(rotation[1], rotation[2], rotation[3], rotation[0]))
        inertia = to_base * wp.diag(moments) * wp.transpose(to_base)
        inertia += mass * _point_inertia(moved) + added * _point_inertia(offset - moved)
        axes, principal = wp.eig3(inertia)
        turned = wp.quat_from_matrix(axes)
        frame = wp.quat(turned[3], turned[0], turned[1], turned[2])
        moments = principal
    robots.body_mass[env, BASE] = mass + added
    robots.body_subtreemass[env, BASE] = robots.total_mass[env] + added
    robots.body_ipos[env, BASE] = robots.base_centre[env] + moved
    robots.body_iquat[env, BASE] = frame
    robots.body_inertia[env, BASE] = moments


class Payload(Condition):
    """Mass over that of the robot, and where it is from the base's mass centre, ahead and to the left [m].

    A negative one leaves less of the base, half of it at least.
    """

    name, cause = "payload", "payload"
    genes = (
        Gene(name="payload", low=-0.05, middle=0.0, high=0.4, limits=(-0.1, 10.0)),
        Gene(name="payload_x", low=-0.2, middle=0.0, high=0.2, unit="m"),
        Gene(name="payload_y", low=-0.2, middle=0.0, high=0.2, unit="m", mirrored=True),
    )
    dose = Sweep("payload", (0.0, 0.1, 0.2, 0.3, 0.4), title="payload over the mass")
    varied = (-0.01, 0.03)
    begin = _begin_payload

    def text(self, values: Array) -> str:
        """Its share of the robot's mass, and where it is."""
        share, where = values[0], values[1:]
        if abs(share) < 0.0005:
            return ""
        if share < 0:
            return f"base lighter by {-share:.1%} of the robot's mass"
        offset = _direction_text(where, ".2f", 0.005, ("m ahead of", "m behind", "m left of", "m right of"))
        return f"payload of {share:.1%} of the robot's mass{offset and f', {offset} the centre of the base'}"

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Adds the mass to the base of the model."""
        from sim.robots.compiled import mj, rotation_matrix

        model, base = episodes.model, 1
        added = max(values[0] * model.body_subtreemass[base], -0.5 * model.body_mass[base])
        if added:
            model.body_sameframe[base] = 0  # or MuJoCo takes the frame of the body for that of its inertia
            model.body_subtreemass[[0, base]] += added
        if added < 0.0:
            model.body_inertia[base] *= (model.body_mass[base] + added) / model.body_mass[base]
            model.body_mass[base] += added
        elif added > 0.0:
            mass, offset = model.body_mass[base], np.append(values[1:], 0.0)
            moved = added / (mass + added) * offset
            axes = rotation_matrix(model.body_iquat[base])
            inertia = axes @ np.diag(model.body_inertia[base]) @ axes.T
            for kilograms, d in ((mass, moved), (added, offset - moved)):
                inertia += kilograms * (d @ d * np.eye(3) - np.outer(d, d))
            moments, axes = np.linalg.eigh(inertia)
            axes[:, 2] *= np.linalg.det(axes)  # right-handed
            mj.mju_mat2Quat(model.body_iquat[base], axes.ravel())
            model.body_inertia[base], model.body_mass[base] = moments, mass + added
            model.body_ipos[base] += moved


@wp.func
def _begin_motors(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    robots.strength[env] = row[first]


class MotorStrength(Condition):
    """Factor of the torques of all motors, and of their limits."""

    name, cause = "motors", "weak motors"
    genes = (Gene(name="strength", low=0.4, middle=1.0, high=1.2, limits=(1e-3, 10.0)),)
    form, least = "motors at {:.0%}", 0.005
    dose = Sweep("strength", (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4), title="strength of motors")
    varied = (0.9, 1.1)
    begin = _begin_motors

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Scales gains and limits of the model's actuators."""
        episodes.strength, model = float(values[0]), episodes.model
        model.actuator_gainprm[:, 0] *= values[0]
        model.actuator_biasprm[:, :3] *= values[0]
        model.actuator_forcerange[:] *= values[0]
        model.jnt_actfrcrange[:] *= values[0]


class Latency(Condition):
    """A time by which something is late [s], in steps of the shipped robots."""

    least = 0.5

    def text(self, values: Array) -> str:
        """The time in milliseconds."""
        return super().text(1000 * values)


def _latency_gene(name: str, step: float) -> Gene:
    low, high = limits = (0.0, MAX_LATENCY_S)
    return Gene(name=name, low=low, middle=high / 2, high=high, absent=-1.0, step=step, unit="s", limits=limits)


@wp.func
def _begin_delay(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    robots.delay_steps[env] = robots.drive_delay + int(wp.round(row[first] / robots.physics_dt))


class ActionDelay(Latency):
    """Time after which an action counts, beside the robot's own [s]."""

    name, cause, form = "delay", "late actions", "actions {:.0f} ms late"
    genes = (_latency_gene("delay", 0.005),)
    dose = Sweep("delay", (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06), title="delay of actions")
    varied = (0.0, 0.02)
    begin = _begin_delay

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Adds physics steps to the delay of the robot's drives."""
        episodes.delay_steps += round_steps(values[0], episodes.robot.physics_dt)


@wp.func
def _disturb_lag(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int):
    lag = int(wp.round(row[first] / (float(step.every) * step.dt)))
    if lag > 0:
        age, size = age_of(step, env), step.memory.former.shape[1]
        step.memory.former[env, age % size, column] = step.observation[env, column]
        step.observation[env, column] = step.memory.former[env, wp.max(age - lag, 0) % size, column]


class ObservationLag(Latency):
    """Age of what the controller observes [s]; the first observation is shown until there is one so old."""

    name, cause, form = "lag", "old observations", "observations {:.0f} ms old"
    genes = (_latency_gene("lag", 0.02),)
    dose = Sweep("lag", (0.0, 0.02, 0.04, 0.06), title="age of observations")
    disturb = _disturb_lag
    disturbs_last = True

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Keeps as many observations as are needed."""
        episodes.former_rows = deque(maxlen=1 + round_steps(values[0], episodes.robot.control_dt))

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Shows the oldest rows that are kept."""
        episodes.former_rows.append(rows)
        return episodes.former_rows[0].copy()


@wp.func
def _disturb_noise(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int):
    if row[first] > 0.0:
        # Drawn by the episode's own stream: neither robot nor slot changes an episode.
        number = age_of(step, env) * step.observation.shape[1] + column
        state = wp.rand_init(int(step.episodes.rng[env]), number)
        step.observation[env, column] += row[first] * step.memory.noise[column] * wp.randf(state, -1.0, 1.0)


class ObservationNoise(Condition):
    """Factor of legged_gym's uniform noise of observations."""

    name, cause = "noise", "noise"
    genes = (Gene(name="noise", low=0.0, middle=2.0, high=4.0, absent=-1.0, limits=(0.0, 100.0)),)
    form, least = "noise {:.1f} times legged_gym's", 0.05
    dose = Sweep("noise", (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0), title="noise over legged_gym's")
    varied = (1.0, 1.0)
    disturb = _disturb_noise

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Adds noise, drawn otherwise than in the parallel simulation."""
        widths = values[0] * NoiseCfg().column_widths(episodes.robot.column_sizes)
        return rows + widths * episodes.rng.uniform(-1.0, 1.0, rows.shape)


@wp.func
def _meet_push(step: DisturbedStep, row: wp.array[float], first: int, env: int):
    if step.episodes.outcome[env] == Outcome.RUNNING:
        due = int(wp.round(row[first + 2] / step.dt))
        steps = step.episodes.steps[env]
        if steps <= due and due < steps + step.every:
            step.joint_qd[env, 0] += row[first]
            step.joint_qd[env, 1] += row[first + 1]


class Push(Condition):
    """A kick of the base's velocity along the way and to its left [m/s], and when [s]; it is observed a step later."""

    name, cause = "push", "push"
    genes = (
        Gene(name="push_x", low=-2.0, middle=0.0, high=2.0, unit="m/s"),
        Gene(name="push_y", low=-2.0, middle=0.0, high=2.0, unit="m/s", mirrored=True),
        Gene(name="push_time", low=0.0, middle=6.0, high=12.0, unit="s", hard_at_limits=False),
    )
    moment = "push_time"
    dose = Sweep("push_y", (0.0, 0.5, 1.0, 1.5, 2.0), {"push_time": 5.0}, "push to the side")
    meet = _meet_push

    def text(self, values: Array) -> str:
        """Its velocity and its time."""
        pushed = push_text(values)
        return pushed and f"{pushed} after {values[2]:.0f} s"

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Adds to the velocities of the bases of the running episodes."""
        if step <= round_steps(values[2], episodes.robot.physics_dt) < step + episodes.robot.decimation:
            for k in running:
                episodes.data[k].qvel[:2] += values[:2]
                episodes.qvel[k] = episodes.data[k].qvel
        return rows


@wp.func
def _begin_grip(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    robots.friction[terrain] = row[first]


class Grip(Condition):
    """Factor of the friction of all contacts."""

    name, cause = "grip", "little grip"
    genes = (Gene(name="friction", low=0.2, middle=1.0, high=1.2, limits=(1e-3, 10.0)),)
    form, least = "friction times {:.2f}", 0.005
    varied = (0.7, 1.2)
    begin = _begin_grip

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Scales the friction of all geoms of the model."""
        episodes.model.geom_friction[:, 0] *= values[0]


_KINDS = (Payload, MotorStrength, ActionDelay, ObservationLag, ObservationNoise, Push, Grip)
CONDITIONS.update((kind.name, kind()) for kind in _KINDS)
