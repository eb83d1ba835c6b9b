"""A robot's file as a MuJoCo specification, to be shown: its own file, MJCF or URDF, with a free base."""

import xml.etree.ElementTree as ET
from typing import Any

import mujoco

from sim.robots.model_files import read_model_files
from sim.robots.robot import RobotCfg

_mj: Any = mujoco  # its types are not written down


def robot_spec(robot: RobotCfg) -> Any:
    """An ``MjSpec`` with the robot's joints in the robot's order behind that of its base.

    Shapes without a name are named as the simulation names them: those of a URDF by their link, those of an MJCF that
    touch anything ``<body>_geom_<k>``.

    Args:
        robot: Robot settings.

    Raises:
        ValueError: If MuJoCo cannot read the file, or finds other joints.
    """
    try:
        files = read_model_files(robot.model_file)
        spec = _urdf_spec(files.root) if files.is_urdf else _mjcf_spec(robot)
    except Exception as error:  # MuJoCo's own type has no name
        raise _not_shown(robot, error) from None
    found = tuple(joint.name for joint in spec.joints if joint.type != _mj.mjtJoint.mjJNT_FREE)
    if found != robot.joint_names or len(spec.joints) != len(found) + 1:
        raise ValueError(
            f"robot '{robot.name}': {robot.model_file} has joints {', '.join(found)} for MuJoCo, expected a free base "
            f"and {', '.join(robot.joint_names)}"
        )
    return spec


def robot_model(spec: Any, robot: RobotCfg) -> Any:
    """The ``MjModel`` of a specification of the robot, which may have been added to.

    Raises:
        ValueError: If MuJoCo cannot make one.
    """
    try:
        return spec.compile()
    except Exception as error:  # MuJoCo's own type has no name
        raise _not_shown(robot, error) from None


def _not_shown(robot: RobotCfg, error: Exception) -> ValueError:
    reason = " ".join(str(error).split())
    return ValueError(f"robot '{robot.name}': {robot.model_file} cannot be shown: {reason}")


def _mjcf_spec(robot: RobotCfg) -> Any:
    spec = _mj.MjSpec.from_file(str(robot.model_file))
    for body in spec.bodies:
        touching = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
        for number, geom in enumerate(touching):
            geom.name = geom.name or f"{body.name}_geom_{number}"
    return spec


def _urdf_spec(root: ET.Element) -> Any:
    extension = ET.SubElement(root, "mujoco")
    ET.SubElement(extension, "compiler", strippath="false", fusestatic="false", discardvisual="false")
    spec = _mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    spec.worldbody.first_body().add_freejoint()
    for body in spec.bodies:
        geoms = list(body.geoms)
        for number, geom in enumerate(geoms):
            geom.name = body.name if len(geoms) == 1 else f"{body.name}_{number}"
    return spec
