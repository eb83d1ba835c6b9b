"""A robot as MuJoCo reads its file: bodies, shapes, and where recorded joint coordinates put them.

For showing a robot, not for simulating one: forward kinematics and geometry are those of MuJoCo C.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.robots.model_files import read_model_files
from sim.robots.robot import RobotCfg

_mj: Any = mujoco  # its types are not written down

LOOK_SUFFIX = ".look.xml"
"""Of a file beside the model file: an MJCF whose bodies have names of the model's, with the shapes to show of them."""
_FIRST_HIDDEN_GROUP = 3  # MuJoCo shows groups 0 to 2
_BASE, _LIMB, _FOOT = (0.27, 0.29, 0.33, 1.0), (0.47, 0.50, 0.55, 1.0), (0.30, 0.32, 0.36, 1.0)
_NO_COLOR = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's, of a geom that names none
_BONE, _LEAST_BONE = 0.35, 0.02  # radius of a bone in that of limbs and feet, and at least [m]


def robot_spec(robot: RobotCfg) -> Any:
    """An ``MjSpec`` to look at, with the robot's joints in the robot's order behind that of its base.

    Shapes without a name are named as the simulation names them: those of a URDF by their link, those of an MJCF that
    touch anything ``<body>_geom_<k>``. A body shows the shapes of the file :data:`LOOK_SUFFIX` if there are some, else
    those of its own that touch nothing, else all it has, with bones to its joints and feet.
    """
    try:
        spec = _urdf_spec(robot) if read_model_files(robot.model_file).is_urdf else _mjcf_spec(robot)
    except Exception as error:  # MuJoCo's own type has no name
        raise _not_shown(robot.model_file, error) from None
    joints = tuple(joint.name for joint in spec.joints if joint.type != _mj.mjtJoint.mjJNT_FREE)
    if joints != robot.joint_names or len(spec.joints) != len(joints) + 1:
        raise ValueError(
            f"robot '{robot.name}': {robot.model_file} has joints {', '.join(joints)} for MuJoCo, expected a free base "
            f"and {', '.join(robot.joint_names)}"
        )
    _dress(spec, robot)
    return spec


def robot_model(spec: Any, robot: RobotCfg) -> Any:
    """The ``MjModel`` of a specification of the robot, which may have been added to."""
    try:
        model = spec.compile()
    except Exception as error:  # MuJoCo's own type has no name
        raise _not_shown(robot.model_file, error) from None
    for foot in _geom_ids(model, robot.foot_geoms):
        if len(_inside(model, foot)) > 1:  # it has a look
            model.geom_group[foot] = _FIRST_HIDDEN_GROUP
    return model


def touches_of(model: Any, robot: RobotCfg) -> dict[int, tuple[int, ...]]:
    """What is seen of the robot: geoms by index, with the columns of ``robot.geom_names`` whose touch each shows.

    A shape whose middle is in a foot shows that foot's touch, any other the touch of its body's base and limbs.
    """
    columns = dict(zip(_geom_ids(model, robot.geom_names), range(len(robot.geom_names)), strict=True))
    feet = {geom: columns[foot] for foot in _geom_ids(model, robot.foot_geoms) for geom in _inside(model, foot)}
    touches = {}
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        if body > 0 and model.geom_group[geom] < _FIRST_HIDDEN_GROUP and int(model.geom_type[geom]) in _KINDS:
            others = [column for k, column in columns.items() if k >= 0 and model.geom_bodyid[k] == body]
            limbs = tuple(column for column in others if robot.geom_names[column] not in robot.foot_geoms)
            same = columns.get(geom, feet.get(geom))
            touches[geom] = limbs if same is None else (same,)
    return touches


def _geom_ids(model: Any, names: tuple[str, ...]) -> list[int]:
    """Indices of geoms, below 0 of shapes that the file does not name."""
    ids = [_mj.mj_name2id(model, _mj.mjtObj.mjOBJ_GEOM.value, name) for name in names]
    return [index if index >= 0 else -1 - k for k, index in enumerate(ids)]


def _inside(model: Any, foot: int) -> list[int]:
    """Seen geoms of a foot's body whose middle is in the foot, that itself among them."""
    near = np.linalg.norm(model.geom_pos - model.geom_pos[foot], axis=1) < model.geom_rbound[foot]
    near &= (model.geom_bodyid == model.geom_bodyid[foot]) & (model.geom_group < _FIRST_HIDDEN_GROUP)
    return np.flatnonzero(near).tolist() if foot >= 0 else []


def _not_shown(file: Path, error: Exception) -> ValueError:
    return ValueError(f"{file} cannot be shown: {' '.join(str(error).split())}")


def _dress(spec: Any, robot: RobotCfg) -> None:
    looks = _read_look(robot)
    sizes = [geom.size[0] for name in (*robot.limb_geoms, *robot.foot_geoms) if (geom := spec.geom(name)) is not None]
    radius = max(_LEAST_BONE, _BONE * float(np.median(sizes))) if sizes else _LEAST_BONE
    for body in spec.bodies[1:]:
        touching = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
        seen = [geom for geom in body.geoms if geom not in touching and geom.group < _FIRST_HIDDEN_GROUP]
        look = looks.pop(body.name, [])
        for geom in touching:
            hidden = (seen or look) and geom.name not in robot.foot_geoms
            geom.group = _FIRST_HIDDEN_GROUP if hidden else 0
            if not geom.material and tuple(geom.rgba) == _NO_COLOR:
                geom.rgba = (
                    _BASE if geom.name in robot.base_geoms else _FOOT if geom.name in robot.foot_geoms else _LIMB
                )
        if look:
            for geom in seen:
                geom.group = _FIRST_HIDDEN_GROUP
            for shape in look:
                _add_shape(body, **shape)
        elif not seen and not any(geom.type == _mj.mjtGeom.mjGEOM_MESH for geom in touching):
            feet = [geom for geom in touching if geom.name in robot.foot_geoms]
            for end in (part.pos for part in (*body.bodies, *feet)):
                if np.linalg.norm(end) > radius:
                    kind = _mj.mjtGeom.mjGEOM_CAPSULE
                    _add_shape(body, type=kind, fromto=[0.0, 0.0, 0.0, *end], size=[radius, 0.0, 0.0], rgba=_LIMB)
    if looks:
        raise ValueError(
            f"{_look_file(robot)} has a body '{next(iter(looks))}', which {robot.model_file} has not: expected one of "
            f"{', '.join(body.name for body in spec.bodies[1:])}"
        )


def _add_shape(body: Any, **shape: Any) -> None:
    body.add_geom(group=0, mass=0.0, contype=0, conaffinity=0, **shape)


def _look_file(robot: RobotCfg) -> Path:
    return robot.model_file.with_suffix(LOOK_SUFFIX)


def _read_look(robot: RobotCfg) -> dict[str, list[dict[str, Any]]]:
    """Shapes by the name of their body, as ``add_geom`` takes them."""
    file, looks = _look_file(robot), dict[str, list[dict[str, Any]]]()
    if not file.is_file():
        return looks
    try:
        model = _mj.MjModel.from_xml_path(str(file))
    except Exception as error:  # MuJoCo's own type has no name
        raise _not_shown(file, error) from None
    for k in range(model.ngeom):
        shape = {name: getattr(model, f"geom_{name}")[k] for name in ("type", "size", "pos", "quat", "rgba")}
        looks.setdefault(model.body(model.geom_bodyid[k]).name, []).append(shape)
    return looks


def _mjcf_spec(robot: RobotCfg) -> Any:
    spec = _mj.MjSpec.from_file(str(robot.model_file))
    for body in spec.bodies:
        touching = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
        for number, geom in enumerate(touching):
            geom.name = geom.name or f"{body.name}_geom_{number}"
    return spec


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
    color: tuple[float, float, float] = _NO_COLOR[:3]
    """RGB, 0 to 1."""
    touches: tuple[int, ...] = ()
    """Columns of ``robot.geom_names`` whose touch it shows."""
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
        touches = touches_of(model, robot)
        self.geoms: tuple[Geom, ...] = tuple(self._geom(k, columns) for k, columns in touches.items())
        """What is to be seen of it, in the file's order."""

    def geom(self, name: str) -> Geom:
        """A shape by the name that the simulation has for it, to be seen or not."""
        model = self._model
        names = [model.geom(k).name for k in range(model.ngeom)]
        if name not in names:
            raise ValueError(f"no geom named {name}: the robot's file has {', '.join(filter(None, names))}")
        return self._geom(names.index(name))

    def _geom(self, index: int, touches: tuple[int, ...] = ()) -> Geom:
        model = self._model
        kind = _KINDS[int(model.geom_type[index])]
        vertices = faces = None
        if kind == "mesh":
            mesh = model.mesh(model.geom_dataid[index])
            first, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
            vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
            first, count = int(mesh.faceadr[0]), int(mesh.facenum[0])
            faces = np.array(model.mesh_face[first : first + count], dtype=np.int64)
        material, color = int(model.geom_matid[index]), tuple(model.geom_rgba[index].tolist())
        if material >= 0 and color == _NO_COLOR:
            color = tuple(model.mat_rgba[material].tolist())
        return Geom(
            color=color[:3],
            touches=touches,
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
