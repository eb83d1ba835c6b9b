"""The shipped robots, ANYmal and Cassie."""

from sim.robots.robot import ROBOTS_DIR, RobotCfg
from sim.robots.training import LearningCfg, PaperCfg, RewardCfg, TrainingCfg, TuningCfg


def _steps(low: int, high: int) -> tuple[float, ...]:
    return tuple(k / 10 for k in range(low, high + 1))


_LEGS = ("LF", "RF", "LH", "RH")
_SIDES = ("left", "right")
_PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble")

ROBOTS = {
    "anymal": RobotCfg(
        name="anymal",
        label="ANYmal C",
        model_file=ROBOTS_DIR / "anymal.xml",
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
        label="Cassie",
        model_file=ROBOTS_DIR / "cassie.xml",
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
        tuning=TuningCfg(tracking_lin_vel=4.0, large_rounds=False),
        paper=PaperCfg(num_envs=600, terrains=100, swap_every=200, iterations=3000, test_terrains=180),
    ),
}
