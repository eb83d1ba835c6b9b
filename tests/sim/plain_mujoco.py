"""Robots in plain MuJoCo C, as the truth to compare with."""

import dataclasses

import mujoco
import numpy as np
import pytest

from sim.controllers.loaders import load_policy
from sim.mujoco_c.crossing import EpisodeStates, cross_in_mujoco_c
from sim.mujoco_c.model import GROUND, crossing_model
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS


def on_plane(robot, quat_wxyz=(1, 0, 0, 0)) -> mujoco.MjModel:
    """The robot on an infinite plane through (8, 4, 0), as MuJoCo has level ground."""
    model = crossing_model(robot, np.zeros((NUM_ROWS, NUM_COLS)))
    ground = model.geom(GROUND).id
    model.geom_pos[ground], model.geom_quat[ground] = (8.0, 4.0, 0.0), quat_wxyz
    model.geom_sameframe[ground] = 0  # else MuJoCo keeps the frame of its body
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)  # its tree knows the level ground
    return model


def to_c(joint_q):
    """Joint coordinates in MuJoCo's order: its quaternion begins with w."""
    return np.concatenate([joint_q[:3], joint_q[[6, 3, 4, 5]], joint_q[7:]])


def run(model: mujoco.MjModel, joint_q, duration_s: float):
    """Joint coordinates after holding the given ones as targets for a while, from rest."""
    data = mujoco.MjData(model)
    data.qpos[:] = to_c(joint_q)
    data.ctrl[:] = joint_q[7:]
    for _ in range(round(duration_s / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos[:3], data.qpos[[4, 5, 6, 3]], data.qpos[7:]])


def cross_and_keep(robot, policy, heights, starts, seconds, **how):
    """Crosses for so long [s]; the robots as they are then, and the result."""
    kept = []

    class Kept(EpisodeStates):
        def __init__(self, *given):
            super().__init__(*given)
            kept.append(self)

    robot = dataclasses.replace(robot, max_duration_s=seconds)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sim.mujoco_c.crossing.EpisodeStates", Kept)
        result = cross_in_mujoco_c(robot, load_policy(policy, robot, "cpu"), heights, starts, **how)
    return kept[0], result


def rays_from_above(model: mujoco.MjModel, points, qpos=None, groups=None):
    """Where rays straight down from 9 m meet a model's geoms (of some groups alone): heights [m] and geoms."""
    data, down, heights, geoms = mujoco.MjData(model), np.array([0, 0, -1.0]), [], []
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    for x, y in points:
        geom = np.zeros(1, np.int32)
        heights.append(9.0 - mujoco.mj_ray(model, data, np.array([x, y, 9.0]), down, groups, 1, -1, geom))
        geoms.append(int(geom[0]))
    return np.array(heights), np.array(geoms)
