"""A robot as MuJoCo reads its file: bodies, shapes, and where recorded joint coordinates put them.

For showing a robot, not for simulating one: forward kinematics and geometry are those of MuJoCo C.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.robots.model_files import read_model_files
from sim.robots.robot import RobotCfg

_mj: Any = mujoco  # its types are not written down

_FIRST_HIDDEN_GROUP = 3  # MuJoCo shows groups 0 to 2


def robot_spec(robot: RobotCfg) -> Any:
    """An ``MjSpec`` with the robot's joints in the robot's order behind that of its base.

    Shapes without a name are named as the simulation names them: those of a URDF by their link, those of an MJCF that
    touch anything ``<body>_geom_<k>``. A body with visual shapes shows those alone: what a URDF shows of a link, and
    meshes of an MJCF that touch nothing.
    """
    try:
        spec = _urdf_spec(robot) if read_model_files(robot.model_file).is_urdf else _mjcf_spec(robot)
    except Exception as error:  # MuJoCo's own type has no name
        raise _not_shown(robot, error) from None
    joints = tuple(joint.name for joint in spec.joints if joint.type != _mj.mjtJoint.mjJNT_FREE)
    if joints != robot.joint_names or len(spec.joints) != len(joints) + 1:
        raise ValueError(
            f"robot '{robot.name}': {robot.model_file} has joints {', '.join(joints)} for MuJoCo, expected a free base "
            f"and {', '.join(robot.joint_names)}"
        )
    return spec


def robot_model(spec: Any, robot: RobotCfg) -> Any:
    """The ``MjModel`` of a specification of the robot, which may have been added to."""
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
        if any(geom.type == _mj.mjtGeom.mjGEOM_MESH and geom not in touching for geom in body.geoms):
            _hide(touching)
    return spec


def _hide(geoms: list[Any]) -> None:
    for geom in geoms:
        geom.group = _FIRST_HIDDEN_GROUP


def _urdf_spec(robot: RobotCfg) -> Any:
    """With what it shows of its links, unless MuJoCo cannot read that."""
    try:
        spec = _imported_urdf(read_model_files(robot.model_file, visuals=True).root)
        spec.copy().compile()
    except Exception:  # such as a mesh of too many faces; MuJoCo's own type has no name
        return _imported_urdf(read_model_files(robot.model_file).root)
    return spec


def _imported_urdf(root: ET.Element) -> Any:
    extension = ET.SubElement(root, "mujoco")
    ET.SubElement(extension, "compiler", strippath="false", fusestatic="false", discardvisual="false")
    spec = _mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    spec.worldbody.first_body().add_freejoint()
    for body in spec.bodies:
        touching = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
        for number, geom in enumerate(touching):
            geom.name = body.name if len(touching) == 1 else f"{body.name}_{number}"
        if len(touching) < len(body.geoms):
            _hide(touching)
    return spec


_KINDS = {
    int(getattr(_mj.mjtGeom, f"mjGEOM_{kind.upper()}")): kind
    for kind in ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
}
_FREE_COORDINATES = 7  # position and quaternion of the base


@dataclass(frozen=True, kw_only=True)
class Geom:
    """One shape, fixed to a body."""

    name: str
    """As the simulation calls it; may be empty of one that touches nothing."""
    body: int
    """Index into the skeleton's bodies."""
    kind: str
    """One of sphere, capsule, ellipsoid, cylinder, box and mesh."""
    size: NDArray[np.float64]
    """MuJoCo's: radius; radius and half length; half sides; unused of a mesh; shape (3,) [m]."""
    position: NDArray[np.float64]
    """Centre in the body's frame [m], shape (3,)."""
    quaternion: NDArray[np.float64]
    """Geom to body frame, w x y z; capsules and cylinders lie along z."""
    vertices: NDArray[np.float64] | None = None
    """Of a mesh, in the geom's frame [m], shape (num_vertices, 3)."""
    faces: NDArray[np.int64] | None = None
    """Of a mesh, indices into ``vertices``, shape (num_faces, 3)."""


class Skeleton:
    """A robot's bodies; the world is none of them."""

    def __init__(self, robot: RobotCfg) -> None:
        self._model = model = robot_model(robot_spec(robot), robot)
        self.num_coordinates = _FREE_COORDINATES + robot.num_joints
        """Columns of ``qpos``."""
        self.body_names: tuple[str, ...] = tuple(model.body(k).name for k in range(1, model.nbody))
        self.parents: tuple[int, ...] = tuple(int(parent) - 1 for parent in model.body_parentid[1:])
        """Index of each body's parent; -1 of one that hangs on the world."""
        self.offsets: NDArray[np.float64] = np.array(model.body_pos[1:])
        """Origin of each body in its parent's frame [m], shape (num_bodies, 3)."""
        self.geoms: tuple[Geom, ...] = tuple(map(self._geom, self._shown()))
        """What is to be seen of it, in the file's order."""

    def geom(self, name: str) -> Geom:
        """A shape by the name that the simulation has for it, to be seen or not."""
        model = self._model
        names = [model.geom(k).name for k in range(model.ngeom)]
        if name not in names:
            raise ValueError(f"no geom named {name}: the robot's file has {', '.join(filter(None, names))}")
        return self._geom(names.index(name))

    def _shown(self) -> list[int]:
        """Geoms on a body, without those of the groups that MuJoCo hides, unless there are no others."""
        model = self._model
        known = [k for k in range(model.ngeom) if model.geom_bodyid[k] > 0 and int(model.geom_type[k]) in _KINDS]
        return [k for k in known if model.geom_group[k] < _FIRST_HIDDEN_GROUP] or known

    def _geom(self, index: int) -> Geom:
        model = self._model
        kind = _KINDS[int(model.geom_type[index])]
        vertices = faces = None
        if kind == "mesh":
            mesh = model.mesh(model.geom_dataid[index])
            first, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
            vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
            first, count = int(mesh.faceadr[0]), int(mesh.facenum[0])
            faces = np.array(model.mesh_face[first : first + count], dtype=np.int64)
        return Geom(
            name=model.geom(index).name,
            body=int(model.geom_bodyid[index]) - 1,
            kind=kind,
            size=np.array(model.geom_size[index]),
            position=np.array(model.geom_pos[index]),
            quaternion=np.array(model.geom_quat[index]),
            vertices=vertices,
            faces=faces,
        )

    def body_poses(self, qpos: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the bodies are: origins in the world [m] and body-to-world quaternions w x y z.

        Shapes (num_frames, num_bodies, 3) and (num_frames, num_bodies, 4), of MuJoCo's joint coordinates, shape
        (num_frames, num_coordinates), as :meth:`sim.recording.recorder.Recording.qpos` gives them.
        """
        if qpos.ndim != 2 or qpos.shape[1] != self.num_coordinates:
            raise ValueError(f"qpos must have shape (num_frames, {self.num_coordinates}), got {qpos.shape}")
        data = _mj.MjData(self._model)
        positions = np.empty((len(qpos), len(self.body_names), 3))
        quaternions = np.empty((len(qpos), len(self.body_names), 4))
        for frame, row in enumerate(qpos):
            data.qpos[:] = row
            _mj.mj_kinematics(self._model, data)
            positions[frame], quaternions[frame] = data.xpos[1:], data.xquat[1:]
        return positions, quaternions
