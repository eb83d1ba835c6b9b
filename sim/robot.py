"""Robots: their settings, and their MJCF file as a Newton model."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import newton
import numpy as np

from kernels.observation import NUM_BASE_COLUMNS
from kernels.penalties import BASE, FOOT, LIMB, PENALTIES
from sim.files import read_json
from sim.training import RewardCfg, TrainingCfg

_ROBOTS_DIR = Path(__file__).parent / "robots"


@dataclass(frozen=True, kw_only=True)
class RobotCfg:
    """What the simulation and the search need to know of a robot beside its MJCF file.

    Gains, effort limits and armature stand in the MJCF (position actuators), so that any MuJoCo reads the same robot.
    """

    name: str
    model_file: Path
    """MJCF file; the first body has the free joint."""
    base_geoms: tuple[str, ...]
    """Geoms whose touch ends an episode."""
    foot_geoms: tuple[str, ...]
    limb_geoms: tuple[str, ...]
    """Geoms whose touch is penalised, beside the base's."""
    joint_names: tuple[str, ...]
    """Actuated joints in policy order, which is the file's order."""
    default_joint_pos: tuple[float, ...]
    """Default pose [rad]; an action of 0 holds it."""
    default_base_height: float
    """Height of the base over flat ground at the start [m]."""
    footprint: tuple[float, float]
    """Half length and half width of the stance [m]."""
    scan_x: tuple[float, ...]
    """Height-scan points ahead of the base, yaw frame [m]."""
    scan_y: tuple[float, ...]
    """Height-scan points left of the base, yaw frame [m]."""
    contact_force_limit: float
    """Contact force of a foot beyond which it is penalised [N]."""
    penalties: tuple[str, ...]
    """Raw penalties that count, a subset of :data:`kernels.penalties.PENALTIES`."""
    collision_bit: bool
    """Whether base collision is a descriptor of its own (the paper: Cassie)."""
    action_scale: float = 0.5
    """Radians per unit of action."""
    physics_dt: float = 0.005
    decimation: int = 4
    """Physics steps per control step."""
    nconmax: int = 40
    """Contacts an environment on average; the buffer is shared by all."""
    njmax: int = 100
    """Constraint rows an environment."""
    training: TrainingCfg = field(default_factory=TrainingCfg)
    """What the training of its controller takes of the robot."""

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
    def policy_file(self) -> Path:
        """The shipped controller."""
        return _ROBOTS_DIR / f"{self.name}.pt"

    @property
    def scales_file(self) -> Path:
        """The penalty scales measured with the shipped controller (``make calibrate``)."""
        return _ROBOTS_DIR / f"{self.name}.scales.json"

    def role_of(self, geom: str) -> int:
        """Role bits of a geom (:mod:`kernels.penalties`)."""
        return BASE * (geom in self.base_geoms) + FOOT * (geom in self.foot_geoms) + LIMB * (geom in self.limb_geoms)

    def scan_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Scan points in observation order (x slowest), two arrays of shape (num_scan_points,) [m]."""
        x, y = np.meshgrid(self.scan_x, self.scan_y, indexing="ij")
        return x.ravel().astype(np.float32), y.ravel().astype(np.float32)

    def read_penalty_scales(self) -> tuple[float, ...]:
        """Scales of the penalties, in the order of ``penalties``.

        Raises:
            ValueError: If they were never measured, or not for these penalties.
        """
        remedy = f"run `make calibrate ROBOT={self.name}`"
        if not self.scales_file.exists():
            raise ValueError(f"no penalty scales of robot '{self.name}': expected {self.scales_file}; {remedy}")
        scales = read_json(self.scales_file).get("scales")
        scales = scales if isinstance(scales, dict) else {}
        missing = [name for name in self.penalties if not _is_positive(scales.get(name))]
        if missing:
            raise ValueError(f"{self.scales_file} holds no positive scale for {', '.join(missing)}: {remedy}")
        return tuple(float(scales[name]) for name in self.penalties)


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and value is not True and 0.0 < value <= sys.float_info.max


def _steps(low: int, high: int) -> tuple[float, ...]:
    return tuple(k / 10 for k in range(low, high + 1))


_LEGS = ("LF", "RF", "LH", "RH")
_SIDES = ("left", "right")

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
        penalties=PENALTIES,
        collision_bit=False,
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
        penalties=tuple(name for name in PENALTIES if name != "collision"),
        collision_bit=True,
        nconmax=7,  # the most there can be: a sphere, and 3 on each toe
        njmax=48,  # 3 rows a contact and 12 joint limits, in the solver's tiles of 16
        training=TrainingCfg(  # legged_gym's for Cassie, and the paper's two penalties
            rewards=RewardCfg(
                tracking_ang_vel=1.0,
                lin_vel_z=-0.5,
                ang_vel_xy=0.0,
                torques=-5e-6,
                dof_acc=-2e-7,
                feet_air_time=5.0,
                dof_pos_limits=-1.0,
                no_fly=0.25,
                termination=-200.0,
            ),
            only_positive=False,
            soft_joint_limit=0.95,
            steady_joints=tuple(f"hip_{joint}_{side}" for side in _SIDES for joint in ("abduction", "rotation")),
            added_base_mass=(0.0, 0.0),
        ),
    ),
}


def get_robot(name: str) -> RobotCfg:
    """Settings of a robot by name.

    Raises:
        ValueError: If there is no such robot.
    """
    if name not in ROBOTS:
        raise ValueError(f"unknown robot '{name}': expected one of {', '.join(sorted(ROBOTS))}")
    return ROBOTS[name]


def leaf_name(label: str) -> str:
    """Name of a Newton label's last part: ``anymal/worldbody/base/LF_HIP`` -> ``LF_HIP``."""
    return label.rsplit("/", 1)[-1]


def _require(kind: str, wanted: tuple[str, ...], present: list[str], robot: RobotCfg) -> None:
    missing = [name for name in wanted if name not in present]
    if missing:
        raise ValueError(
            f"robot '{robot.name}': no {kind} named {', '.join(missing)} in {robot.model_file}: "
            f"the file has {', '.join(present)}"
        )


def build_robot(robot: RobotCfg) -> newton.ModelBuilder:
    """One robot as a Newton builder, ready to be replicated into worlds.

    Raises:
        ValueError: If the file is missing or lacks a joint or geom that the settings name.
    """
    if not robot.model_file.exists():
        raise ValueError(f"robot '{robot.name}': model file expected at {robot.model_file}, no such file")
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.rigid_gap = 0.0  # the default of 0.1 m triples the contacts
    builder.add_mjcf(str(robot.model_file), enable_self_collisions=False, parse_mujoco_options=False)
    joints = [leaf_name(label) for label in builder.joint_label][1:]
    _require("joint", robot.joint_names, joints, robot)
    if tuple(joints) != robot.joint_names:
        raise ValueError(
            f"robot '{robot.name}': joint_names must follow the file's order {tuple(joints)}, got {robot.joint_names}"
        )
    if len(robot.default_joint_pos) != len(joints):
        raise ValueError(
            f"robot '{robot.name}': default_joint_pos needs {len(joints)} angles, got {len(robot.default_joint_pos)}"
        )
    _require("geom", robot.geom_names, [leaf_name(label) for label in builder.shape_label], robot)
    return builder
