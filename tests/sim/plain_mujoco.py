"""The same robots in plain MuJoCo, as the truth to compare with."""

import xml.etree.ElementTree as ET

import mujoco
import numpy as np

from sim.simulation import GROUND_FRICTION


def _finish(root: ET.Element, ground: dict[str, str]) -> mujoco.MjModel:
    # The robot's geoms collide with nothing by themselves (conaffinity 0); the ground must offer itself.
    ET.SubElement(
        root.find("worldbody"),
        "geom",
        name="ground",
        conaffinity="1",
        solmix="0",
        friction=str(GROUND_FRICTION),
        **ground,
    )
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def on_plane(robot, quat_wxyz=(1, 0, 0, 0), position=(8, 4, 0)) -> mujoco.MjModel:
    """The robot on an infinite plane."""
    plane = {"type": "plane", "size": "20 20 1", "pos": " ".join(map(str, position))}
    return _finish(ET.parse(robot.model_file).getroot(), plane | {"quat": " ".join(map(str, quat_wxyz))})


def on_heights(robot, grid) -> mujoco.MjModel:
    """The robot on MuJoCo's own heightfield of a 16 m x 8 m grid [row, col]."""
    grid = np.float64(grid)
    lowest, extent = grid.min(), max(np.ptp(grid), 1e-3)
    root = ET.parse(robot.model_file).getroot()
    rows, cols = map(str, grid.shape)
    # size: half x, half y, height of data 1, thickness of the base below data 0.
    ET.SubElement(ET.SubElement(root, "asset"), "hfield", name="grid", nrow=rows, ncol=cols, size=f"8 4 {extent} 1")
    model = _finish(root, {"type": "hfield", "hfield": "grid", "pos": f"8 4 {lowest}"})
    model.hfield_data[:] = ((grid - lowest) / extent).ravel()
    return model


def to_c(joint_q):
    """Joint coordinates in MuJoCo's order: its quaternion begins with w."""
    return np.concatenate([joint_q[:3], joint_q[[6, 3, 4, 5]], joint_q[7:]])


def from_c(qpos):
    """The inverse of :func:`to_c`."""
    return np.concatenate([qpos[:3], qpos[[4, 5, 6, 3]], qpos[7:]])


def run(model: mujoco.MjModel, joint_q, duration_s: float):
    """Joint coordinates after holding the given ones as targets for a while, from rest."""
    data = mujoco.MjData(model)
    data.qpos[:] = to_c(joint_q)
    data.ctrl[:] = joint_q[7:]
    for _ in range(round(duration_s / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return from_c(data.qpos)


def geom_positions(model: mujoco.MjModel, joint_q, names):
    """World positions of geoms, shape (num, 3)."""
    data = mujoco.MjData(model)
    data.qpos[:] = to_c(joint_q)
    mujoco.mj_forward(model, data)
    return np.array([data.geom_xpos[model.geom(name).id] for name in names])
