"""Settings of a robot, those of the shipped ones, and which robot a record is of: by the hash of its content."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from sim.files.command import command_line
from sim.files.settings import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, from_builtins, read_toml
from sim.robots.model_files import read_model_files
from sim.robots.training import LearningCfg, PaperCfg, TrainingCfg, TuningCfg

_ROBOTS_DIR = Path(__file__).parent  # of the files of the shipped robots
PENALTY_DEFINITION = "squared"  # how yaw_rate, vel_x and vel_y measure an error; records by another are not read
SENSES = {"pose": ("heading", "yaw", "quat", "base_pos"), "contacts": ("contacts",), "torques": ("torques",)}
"""What a robot may sense beside the usual row, and terms of a controller's observation that need it."""
_NOT_IN_DIGEST = ("model_file", "settings_file", "training", "learning", "tuning", "label", "paper")


@dataclass(frozen=True, kw_only=True)
class ActuatorNetCfg:
    """A network of all drives, from target less position [rad] and velocity [rad/s] to torque [N m], as Isaac Lab's."""

    file: Path  # TorchScript, relative to the robot's settings
    pos_scale: float = 1.0
    vel_scale: float = 1.0
    torque_scale: float = 1.0
    input_order: Literal["pos_vel", "vel_pos"] = "pos_vel"
    input_idx: tuple[NonNegativeInt, ...] = ()  # evaluations ago that dense layers see; if empty the last ones
    decimation: PositiveInt = 1  # physics steps for which a torque is held


@dataclass(frozen=True, kw_only=True)
class RobotCfg:
    """What simulation, search and training need to know of a robot beside its model; x forward, y left, z up."""

    name: str  # name of its files and folders
    model_file: Path  # MJCF, whose first body has the free joint, or URDF; relative to the settings' file
    base_geoms: tuple[str, ...]  # geoms whose touch ends an episode
    foot_geoms: tuple[str, ...]  # geoms it walks on
    limb_geoms: tuple[str, ...]  # geoms whose touch is penalised, beside the base's
    joint_names: tuple[str, ...]  # actuated joints in policy order, which is the file's order
    default_joint_pos: tuple[float, ...]  # default pose [rad]; an action of 0 holds it
    default_base_height: NonNegativeFloat = 0.0  # at the start [m]; if 0, the lowest one with no foot in the ground
    footprint: tuple[PositiveFloat, PositiveFloat]  # half length and half width of the stance [m]
    scan_x: tuple[float, ...]  # height-scan points ahead of the base, yaw frame [m]
    scan_y: tuple[float, ...]  # height-scan points left of the base, yaw frame [m]
    contact_force_limit: PositiveFloat  # contact force of a foot beyond which it is penalised [N]
    penalties: tuple[str, ...]  # raw penalties that count, a subset of :data:`kernels.penalties.PENALTIES`
    collision_bit: bool  # whether base collision is a descriptor of its own (the paper: Cassie)
    senses: tuple[Literal["pose", "contacts", "torques"], ...] = ()  # after the scan: :mod:`kernels.observation`
    arm_joints: tuple[str, ...] = ()  # that its controller does not move; the conditions of ``+arms`` do
    action_scale: PositiveFloat = 0.5  # radians per unit of action
    physics_dt: Annotated[float, Meta(gt=0, le=0.05)] = 0.005
    decimation: Annotated[int, Meta(ge=1, le=1000)] = 4  # physics steps per control step
    speed: PositiveFloat = 0.75  # commanded speed of a crossing, toward the goal [m/s]
    max_duration_s: PositiveFloat = 20.0  # time after which a crossing ends [s]; the goal is 12 m away
    max_speed: PositiveFloat = 100.0  # a larger velocity is invalid [m/s or rad/s]: no robot reaches it in a fall
    nconmax: PositiveInt = 40  # largest number of contacts of a robot with the ground
    # Of each joint; the file's if None. A URDF, or an MJCF without position actuators, needs stiffness and damping.
    stiffness: tuple[PositiveFloat, ...] | None = None  # position gain [N m/rad]
    damping: tuple[NonNegativeFloat, ...] | None = None  # velocity gain [N m s/rad]
    effort_limit: tuple[PositiveFloat, ...] | None = None  # largest torque [N m], never more than the actuators'
    armature: tuple[NonNegativeFloat, ...] | None = None  # inertia of the rotor, behind its gears [kg m^2]
    # Isaac Lab's DCMotor since its pull request 2300; None for ideal PD. At a joint velocity v, the torque of the gains
    # is clipped to saturation * (-1 - v / limit) and saturation * (1 - v / limit), and these to the effort limit, which
    # may be more or less. So beyond the speed limit a motor brakes, whatever its target.
    saturation_effort: tuple[PositiveFloat, ...] | None = None  # stall torque [N m]
    velocity_limit: tuple[PositiveFloat, ...] | None = None  # speed without torque [rad/s]
    actuator_net: ActuatorNetCfg | None = None  # network in place of PD gains; its torque is clipped as theirs is
    drive_delay_steps: Annotated[int, Meta(ge=0, le=1000)] = 0  # physics steps by which joint targets are late
    friction: PositiveFloat | None = None  # of all geoms, sliding, at least .3; the file's if None, 1 of a URDF
    contact_time_constant_s: PositiveFloat | None = None  # of all geoms [s]; the file's if None, .01 of a URDF
    training: TrainingCfg = field(default_factory=TrainingCfg)
    learning: LearningCfg = field(default_factory=LearningCfg)
    tuning: TuningCfg = field(default_factory=TuningCfg)
    label: str = ""  # name of a shipped robot as its makers write it
    paper: PaperCfg = field(default_factory=PaperCfg)  # what the paper did with a shipped robot
    settings_file: Path | None = None  # of a user's robot, TOML or Python, set by get_robot; None of a shipped robot

    @property
    def spec(self) -> str:
        """Argument of :func:`sim.robots.find.get_robot` that gives this robot: name or settings file."""
        return self.name if self.settings_file is None else str(self.settings_file)

    @property
    def num_joints(self) -> int:
        """Number of actuated joints."""
        return len(self.joint_names)

    @property
    def half_width(self) -> float:
        """Half width of the stance [m]."""
        return self.footprint[1]

    @property
    def column_sizes(self) -> tuple[int, ...]:
        """Columns of the observation row: of velocities, gravity, command (2, 1), joints, scan, senses (pose: 3, 4)."""
        joints, points, pose = self.num_joints, len(self.scan_x) * len(self.scan_y), "pose" in self.senses
        feet, torques = len(self.foot_geoms) * ("contacts" in self.senses), joints * ("torques" in self.senses)
        return (3, 3, 3, 2, 1, joints, joints, joints, points, 3 * pose, 4 * pose, feet, torques)

    @property
    def observation_size(self) -> int:
        """Columns of the observation row."""
        return sum(self.column_sizes)

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
        """Folder of its controller, training record and penalty scales: that of the settings of a user's robot."""
        return _ROBOTS_DIR if self.settings_file is None else self.settings_file.parent

    @property
    def policy_file(self) -> Path:
        """The controller that comes with the robot: a controller.toml beside its robot.toml, or ``<name>.pt``."""
        described = self.home / "controller.toml"
        is_data = self.settings_file is not None and self.settings_file.suffix == ".toml"
        return described if is_data and described.exists() else self.home / f"{self.name}.pt"

    @property
    def scales_file(self) -> Path:
        """The penalty scales measured with that controller (``faultline check``)."""
        return self.home / f"{self.name}.scales.json"

    @property
    def panel(self) -> Path:
        """Folder of the controllers that certify its faults (``faultline judge``), ``<name>.pt`` or ``<name>.toml``."""
        return self.home / self.name / "panel"

    @property
    def packs(self) -> Path:
        """Folder of its published packs by version (``faultline evaluate --pack``)."""
        return self.home / self.name / "packs"

    def scan_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Scan points in observation order (x slowest), two arrays of shape (num_scan_points,) [m]."""
        x, y = np.meshgrid(self.scan_x, self.scan_y, indexing="ij")
        return x.ravel().astype(np.float32), y.ravel().astype(np.float32)

    @property
    def train_command(self) -> str:
        """The command that trains the controller that comes with the robot."""
        return command_line("train", robot=self.spec, export=self.policy_file)


def needed_senses(terms: Iterable[str]) -> list[str]:
    """What a robot must sense for these terms of an observation, where ``rpy`` is called by its axes."""
    names = {name for term in terms for name in term.split()}
    return [sense for sense, quantities in SENSES.items() if names & {*quantities}]


def robot_digest(robot: RobotCfg) -> str:
    """SHA-256 of a robot: its model, its meshes, and its settings but those of training and those at their default."""
    defaults = {f.name: f.default if f.default_factory is MISSING else f.default_factory() for f in fields(robot)}
    counted = {name: value for name, value in vars(robot).items() if name not in _NOT_IN_DIGEST}
    settings = {name: value for name, value in counted.items() if value != defaults[name]}  # so defaults must stay
    if robot.actuator_net is not None:
        net = robot.actuator_net.file
        settings["actuator_net"] = asdict(robot.actuator_net) | {"file": hashlib.sha256(net.read_bytes()).hexdigest()}
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for file in read_model_files(robot.model_file).files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def robot_identity(robot: RobotCfg) -> dict[str, str]:
    """The keys ``robot_sha256`` and ``penalty_definition``, which every record of a robot has."""
    return {"robot_sha256": robot_digest(robot), "penalty_definition": PENALTY_DEFINITION}


def check_robot_digest(record: Mapping[str, Any], robot: RobotCfg, file: Path, remedy: str) -> None:
    """Refuses a file's record of the robot before it changed; ``remedy`` is what else helps."""
    expected, now = record.get("robot_sha256"), robot_digest(robot)
    if expected != now:
        was = f"as it was before its settings, model or meshes changed, of SHA-256 {str(expected)[:12]}, not {now[:12]}"
        raise ValueError(f"{file} is of robot '{robot.name}' {was}: put that back, or {remedy}")


def check_robot_identity(record: Mapping[str, Any], robot: RobotCfg, file: Path, remedy: str) -> None:
    """Refuses a file's record of the robot before it changed, or of penalties that are defined otherwise."""
    if (definition := record.get("penalty_definition")) != PENALTY_DEFINITION:
        raise ValueError(f"{file} is of penalties by {definition} errors, expected {PENALTY_DEFINITION} ones; {remedy}")
    check_robot_digest(record, robot, file, remedy)


ROBOTS = {
    name: from_builtins(RobotCfg, {"name": name, "model_file": str(_ROBOTS_DIR / f"{name}.xml"), **settings}, name)
    for name, settings in read_toml(_ROBOTS_DIR / "shipped.toml").items()
}  # the shipped ones
