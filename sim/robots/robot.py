"""Settings of robots: the shipped ones, and how a user's own are found."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.files.records import check_identity
from sim.files.settings import setting
from sim.policy.spec import controller_hash
from sim.robots.training import LearningCfg, RewardCfg, TrainingCfg, TuningCfg

_ROBOTS_DIR = Path(__file__).parent


@dataclass(frozen=True, kw_only=True)
class RobotCfg:
    """What the simulation and the search need to know of a robot beside its model file.

    Base frame: x forward, y left, z up. Gains, effort limits and armature of the shipped robots stand in their MJCF
    (position actuators), so that any MuJoCo reads the same robot.
    """

    name: str
    """What files and folders are called after it."""
    model_file: Path
    """MJCF, whose first body has the free joint, or URDF; relative to the settings' file."""
    base_geoms: tuple[str, ...]
    """Geoms whose touch ends an episode."""
    foot_geoms: tuple[str, ...]
    """Geoms it walks on."""
    limb_geoms: tuple[str, ...]
    """Geoms whose touch is penalised, beside the base's."""
    joint_names: tuple[str, ...]
    """Actuated joints in policy order, which is the file's order."""
    default_joint_pos: tuple[float, ...]
    """Default pose [rad]; an action of 0 holds it."""
    default_base_height: float = setting(0.0, least=0)
    """Height of the base over flat ground at the start [m]; of a settings file without it, the lowest one at which no
    foot starts in the ground."""
    footprint: tuple[float, float] = setting(above=0)
    """Half length and half width of the stance [m]."""
    scan_x: tuple[float, ...]
    """Height-scan points ahead of the base, yaw frame [m]."""
    scan_y: tuple[float, ...]
    """Height-scan points left of the base, yaw frame [m]."""
    contact_force_limit: float = setting(above=0)
    """Contact force of a foot beyond which it is penalised [N]."""
    penalties: tuple[str, ...]
    """Raw penalties that count, a subset of :data:`kernels.penalties.PENALTIES`."""
    collision_bit: bool
    """Whether base collision is a descriptor of its own (the paper: Cassie)."""
    action_scale: float = setting(0.5, above=0)
    """Radians per unit of action."""
    physics_dt: float = setting(0.005, above=0, most=0.05)
    decimation: int = setting(4, least=1)
    """Physics steps per control step."""
    max_speed: float = setting(100.0, above=0)
    """A state with a velocity beyond is invalid [m/s or rad/s]: what the robot cannot reach, not even when it falls."""
    nconmax: int = setting(40, least=1)
    """Contacts an environment on average; the buffer is shared by all."""
    njmax: int = setting(100, least=1)
    """Constraint rows an environment."""
    stiffness: tuple[float, ...] | None = setting(None, above=0)
    """Position gain of each joint [N m/rad], for a URDF or an MJCF without position actuators; the file's if None."""
    damping: tuple[float, ...] | None = setting(None, least=0)
    """Velocity gain of each joint [N m s/rad], together with ``stiffness``."""
    effort_limit: tuple[float, ...] | None = setting(None, above=0)
    """Largest torque of each joint [N m]; the file's if None, and never more than that of its actuators."""
    armature: tuple[float, ...] | None = setting(None, least=0)
    """Inertia of each joint's rotor, behind its gears [kg m^2]; the file's if None."""
    friction: float | None = setting(None, above=0)
    """Sliding friction of all geoms on the ground; the file's if None, 1 of a URDF. Less than the ground's .3 counts as
    .3."""
    contact_time_constant_s: float | None = setting(None, above=0)
    """Contact time constant of all geoms [s]; the file's if None, .01 of a URDF. At least twice the physics step."""
    training: TrainingCfg = field(default_factory=TrainingCfg)
    """What the training of its controller takes of the robot."""
    learning: LearningCfg = field(default_factory=LearningCfg)
    """How that training goes on a GPU."""
    tuning: TuningCfg = field(default_factory=TuningCfg)
    """How the controller is fine-tuned."""
    settings_file: Path | None = None
    """The Python file of a user's robot, set by :func:`get_robot`; None for a shipped robot."""

    @property
    def spec(self) -> str:
        """What :func:`get_robot` knows it by: name or settings file."""
        return self.name if self.settings_file is None else str(self.settings_file)

    @property
    def num_joints(self) -> int:
        """Number of actuated joints."""
        return len(self.joint_names)

    @property
    def num_scan_points(self) -> int:
        """Number of height-scan points."""
        return len(self.scan_x) * len(self.scan_y)

    @property
    def observation_size(self) -> int:
        """Columns of the observation row."""
        from kernels.observation import NUM_BASE_COLUMNS  # Warp loads only where the simulation does

        return NUM_BASE_COLUMNS + 3 * self.num_joints + self.num_scan_points

    @property
    def control_dt(self) -> float:
        """Control step [s]."""
        return self.physics_dt * self.decimation

    @property
    def geom_names(self) -> tuple[str, ...]:
        """Geoms with a role: base, limbs, feet."""
        return (*self.base_geoms, *self.limb_geoms, *self.foot_geoms)

    @property
    def home(self) -> Path:
        """Folder of its controller, training record and penalty scales; a user's robot has them beside its settings."""
        return _ROBOTS_DIR if self.settings_file is None else self.settings_file.parent

    @property
    def policy_file(self) -> Path:
        """The controller that comes with the robot."""
        return self.home / f"{self.name}.pt"

    @property
    def scales_file(self) -> Path:
        """The penalty scales measured with that controller (``faultline calibrate``)."""
        return self.home / f"{self.name}.scales.json"

    def role_of(self, geom: str) -> int:
        """Role bits of a geom (:mod:`kernels.penalties`)."""
        from kernels.penalties import BASE, FOOT, LIMB

        return BASE * (geom in self.base_geoms) + FOOT * (geom in self.foot_geoms) + LIMB * (geom in self.limb_geoms)

    def scan_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Scan points in observation order (x slowest), two arrays of shape (num_scan_points,) [m]."""
        x, y = np.meshgrid(self.scan_x, self.scan_y, indexing="ij")
        return x.ravel().astype(np.float32), y.ravel().astype(np.float32)

    @property
    def train_command(self) -> str:
        """The command that trains the controller that comes with the robot."""
        return command_line("train", robot=self.spec, export=self.policy_file)

    def read_penalty_scales(self, policy: str | None = None) -> tuple[float, ...]:
        """Scales of the penalties, in the order of ``penalties``.

        Args:
            policy: Controller that the command line names, for the command that measures them.

        Raises:
            ValueError: If they were never measured, not for these penalties, or with a robot that has changed since.
        """
        given = policy if self.settings_file is not None else None  # a shipped robot's are of its own controller
        remedy = f"run `{command_line('calibrate', robot=self.spec, policy=given)}`"
        if given is None and not self.policy_file.exists():
            remedy = f"train its controller first with `{self.train_command}`, or name one with --policy; then {remedy}"
        if not self.scales_file.exists():
            raise ValueError(f"no penalty scales of robot '{self.name}': expected {self.scales_file}; {remedy}")
        content = read_json(self.scales_file)
        check_identity(content, self, self.scales_file, remedy)
        scales = content.get("scales")
        scales = scales if isinstance(scales, dict) else {}
        missing = [name for name in self.penalties if not _is_positive(scales.get(name))]
        if missing:
            raise ValueError(f"{self.scales_file} holds no positive scale for {', '.join(missing)}: {remedy}")
        return tuple(float(scales[name]) for name in self.penalties)

    def scaled_by_another(self, policy: str) -> str | None:
        """What to tell of a search whose controller is not the one that the scales were measured with; None if it is.

        Scales of the robot's own controller make searches against others comparable: this is no mistake.

        Args:
            policy: The search's controller.
        """
        there = read_json(self.scales_file) if self.scales_file.exists() else {}
        if there.get("policy_sha256") in (None, controller_hash(policy)):
            return None
        return f"Penalties are scaled by those of {there.get('policy')}, with which {self.scales_file} was measured."


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and value is not True and 0.0 < value <= sys.float_info.max


def _steps(low: int, high: int) -> tuple[float, ...]:
    return tuple(k / 10 for k in range(low, high + 1))


_LEGS = ("LF", "RF", "LH", "RH")
_SIDES = ("left", "right")
_PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble")

ROBOTS = {
    "anymal": RobotCfg(
        name="anymal",
        model_file=_ROBOTS_DIR / "anymal.xml",
        base_geoms=("base",),
        foot_geoms=tuple(f"{leg}_FOOT" for leg in _LEGS),
        limb_geoms=tuple(f"{leg}_{part}" for leg in _LEGS for part in ("THIGH", "SHANK")),
        joint_names=tuple(f"{leg}_{joint}" for leg in _LEGS for joint in ("HAA", "HFE", "KFE")),
        default_joint_pos=(0.0, 0.4, -0.8) * 2 + (0.0, -0.4, 0.8) * 2,
        default_base_height=0.6,
        footprint=(0.5, 0.4),
        scan_x=_steps(-8, 8),
        scan_y=_steps(-5, 5),
        contact_force_limit=500.0,
        penalties=(*_PENALTIES, "collision"),
        collision_bit=False,
        training=TrainingCfg(added_base_mass=(-5.0, 5.0)),
        tuning=TuningCfg(tracking_lin_vel=6.0),
    ),
    "cassie": RobotCfg(
        name="cassie",
        model_file=_ROBOTS_DIR / "cassie.xml",
        base_geoms=("pelvis",),
        foot_geoms=tuple(f"{side}_toe" for side in _SIDES),
        limb_geoms=(),
        joint_names=tuple(
            f"{joint}_{side}"
            for side in _SIDES
            for joint in ("hip_abduction", "hip_rotation", "hip_flexion", "thigh_joint", "ankle_joint", "toe_joint")
        ),
        default_joint_pos=(0.1, 0.0, 1.0, -1.8, 1.57, -1.57, -0.1, 0.0, 1.0, -1.8, 1.57, -1.57),
        default_base_height=1.0,
        footprint=(0.4, 0.3),
        scan_x=_steps(-5, 5),
        scan_y=_steps(-5, 5),
        contact_force_limit=300.0,
        penalties=_PENALTIES,
        collision_bit=True,
        nconmax=7,  # the most there can be: a sphere, and 3 on each toe
        njmax=48,  # 3 rows a contact and 12 joint limits, in the solver's tiles of 16
        max_speed=300.0,  # its light ankles get faster than 100 rad/s in falls, by their motors alone
        training=TrainingCfg(
            rewards=RewardCfg(
                tracking_lin_vel=2.0,
                tracking_ang_vel=2.0,
                lin_vel_z=-0.5,
                ang_vel_xy=0.0,
                torques=-5e-6,
                dof_acc=-1e-7,
                feet_air_time=2.5,
                dof_pos_limits=-1.0,
                no_fly=0.25,
                orientation=-1.0,
                joint_deviation=-0.2,
                termination=-200.0,
            ),
            only_positive=False,
            soft_joint_limit=0.95,
            steady_joints=tuple(f"hip_{joint}_{side}" for side in _SIDES for joint in ("abduction", "rotation")),
            start_joint_range=0.2,
        ),
        learning=LearningCfg(num_envs=2048, iterations=3400, init_noise_std=0.5, desired_kl=0.02, entropy=0.005),
        tuning=TuningCfg(tracking_lin_vel=4.0),
    ),
}


def get_robot(spec: "str | RobotCfg | None") -> RobotCfg:
    """Settings of a robot that the command line names; :func:`robot_of` is for what a file names.

    Args:
        spec: Name of a shipped robot, or the Python file of another, which is run and must set ``ROBOT``; None is
            ANYmal; settings are returned as they are.

    Raises:
        ValueError: If there is no such robot, or something in its settings or model is wrong.
    """
    if isinstance(spec, RobotCfg):
        return spec
    spec = spec or "anymal"
    if spec in ROBOTS:
        return ROBOTS[spec]
    if spec.endswith(".py"):
        from sim.robots.own import load_robot  # it needs this module's settings, and the model that is built of them

        return load_robot(Path(spec))
    raise ValueError(
        f"unknown robot '{spec}': expected one of {', '.join(sorted(ROBOTS))}, or a Python file that sets ROBOT "
        "(docs/own-robot.md)"
    )


def robot_of(there: Mapping[str, Any], given: "str | RobotCfg | None", file: Path, *, flag: str = "run") -> RobotCfg:
    """The robot that a file names, for example a run's, if it is still what it was.

    A shipped robot is known by its name. Any other must be named on the command line too: no code runs that only a
    file names.

    Args:
        there: What the file says: ``robot``, its name, and the rest of :func:`sim.files.records.identity`.
        given: What the command line names, if anything.
        file: The file, for errors.
        flag: The flag that names it, likewise.

    Raises:
        ValueError: If the two are not the same, the robot or the definition of its penalties has changed since, or the
            command line must name it.
    """
    name, robot = there["robot"], None if given is None else get_robot(given)
    if robot is not None and robot.name != name:
        raise ValueError(f"{file} is of {name}, got --robot {given}: give that robot or another --{flag}")
    if robot is None and name not in ROBOTS:
        raise ValueError(
            f"{file} is of robot '{name}', which is not shipped: name its settings file too (--robot .../{name}.py), "
            "since no code runs that the command line does not name"
        )
    robot = robot or ROBOTS[name]
    check_identity(there, robot, file, "make it anew")
    return robot
