"""A robot as MuJoCo reads its file: bodies, shapes, and where recorded joint coordinates put them.

For showing a robot, not for simulating one: forward kinematics and geometry are those of MuJoCo C.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.robots.compiled import robot_spec
from sim.robots.elements import mj, read_mesh, touching_geoms
from sim.robots.robot import RobotCfg

_KIND = mj.mjtGeom
_SEGMENTS = 20  # round a capsule
_CREASE = 0.6  # angle between faces from which on an edge is sharp [rad]

LOOK_SUFFIX = ".look.xml"
"""Of a file beside the model file: an MJCF whose bodies have names of the model's, with the shapes to show of them."""
_BARE, _, _VISUAL, _HIDDEN = range(4)  # groups, of which MuJoCo shows 0 to 2
_BASE, _LIMB, _FOOT = (0.27, 0.29, 0.33, 1.0), (0.47, 0.50, 0.55, 1.0), (0.30, 0.32, 0.36, 1.0)
_NO_COLOR = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's, of a geom that names none


def shown_spec(robot: RobotCfg) -> Any:
    """An ``MjSpec`` to look at, with the robot's joints in the robot's order behind that of its base.

    Shapes without a name are named as the simulation names them: those of a URDF by their link, those of an MJCF that
    touch anything ``<body>_geom_<k>``. A body shows the shapes of the file :data:`LOOK_SUFFIX` if there are some, else
    those of its own that touch nothing, else all it has.
    """
    try:
        spec = robot_spec(robot, visuals=True)
    except ValueError:  # such as a mesh of too many faces, which only shows
        spec = robot_spec(robot)
    look_file = robot.model_file.with_suffix(LOOK_SUFFIX)
    looks = _read_look(look_file)
    for body in spec.bodies[1:]:
        _dress(body, touching_geoms(body), looks.pop(body.name, []), robot)
    if looks:
        names = ", ".join(body.name for body in spec.bodies[1:])
        raise ValueError(f"{look_file} has a body '{next(iter(looks))}': expected those of {robot.model_file}, {names}")
    return spec


def robot_model(spec: Any, robot: RobotCfg) -> Any:
    """The ``MjModel`` of a specification of the robot, which may have been added to."""
    model = _compiled(spec.compile, robot.model_file)
    visual = {columns for geom, columns in touches_of(model, robot).items() if model.geom_group[geom] == _VISUAL}
    for column, name in enumerate(robot.geom_names):
        if name in robot.foot_geoms and (column,) in visual:
            model.geom(name).group = _HIDDEN
    return model


def touches_of(model: Any, robot: RobotCfg) -> dict[int, tuple[int, ...]]:
    """What is seen of the robot: geoms by index, with the columns of ``robot.geom_names`` whose touch each shows.

    A shape whose middle is in a foot shows that foot's touch, any other the touch of its body's base and limbs.
    """
    ids, num_others = [model.geom(name).id for name in robot.geom_names], len(robot.geom_names) - len(robot.foot_geoms)
    touches = {}
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        if body > 0 and model.geom_group[geom] < _HIDDEN:
            same = [column for column, other in enumerate(ids) if model.geom_bodyid[other] == body]
            away = {column: np.linalg.norm(model.geom_pos[geom] - model.geom_pos[ids[column]]) for column in same}
            feet = [k for k in same if k >= num_others and away[k] < model.geom_rbound[ids[k]]]
            touches[geom] = tuple(k for k in feet or same if k < num_others or k in feet)
            if geom in ids:
                touches[geom] = (ids.index(geom),)
    return touches


def _compiled(compile_model: Callable[[], Any], file: Path) -> Any:
    """A model of MuJoCo's; an error names its file."""
    try:
        return compile_model()
    except Exception as error:  # MuJoCo's own type has no name
        raise ValueError(f"{file} cannot be shown: {' '.join(str(error).split())}") from None


def _dress(body: Any, touching: list[Any], look: list[dict[str, Any]], robot: RobotCfg) -> None:
    """Says what is seen of a body, and colours what has no colour by its role."""
    visual = [geom for geom in body.geoms if geom not in touching and geom.group < _HIDDEN]
    for geom in visual:
        geom.group = _HIDDEN if look else _VISUAL
    for shape in look:
        body.add_geom(group=_VISUAL, mass=0.0, contype=0, conaffinity=0, **shape)
    for geom in touching:
        foot = geom.name in robot.foot_geoms
        geom.group = _HIDDEN if (visual or look) and not foot else _BARE
        if not geom.material and tuple(geom.rgba) == _NO_COLOR:
            geom.rgba = _FOOT if foot else _BASE if geom.name in robot.base_geoms else _LIMB


def _read_look(file: Path) -> dict[str, list[dict[str, Any]]]:
    """Shapes by the name of their body, as ``add_geom`` takes them."""
    looks = dict[str, list[dict[str, Any]]]()
    if not file.is_file():
        return looks
    model = _compiled(lambda: mj.MjModel.from_xml_path(str(file)), file)
    for k in range(model.ngeom):
        shape = {name: getattr(model, f"geom_{name}")[k] for name in ("type", "size", "pos", "quat", "rgba")}
        looks.setdefault(model.body(model.geom_bodyid[k]).name, []).append(shape)
    return looks


class Skeleton:
    """A robot's bodies; the world is none of them."""

    def __init__(self, robot: RobotCfg) -> None:
        self.model: Any = robot_model(shown_spec(robot), robot)
        """The ``MjModel``, whose body 0 is the world."""
        self.touches = touches_of(self.model, robot)

    @property
    def num_bodies(self) -> int:
        """Without the world."""
        return self.model.nbody - 1

    def shape(self, geom: int) -> tuple[trimesh.Trimesh, NDArray[np.float64]]:
        """A geom in its body's frame [m], and its colour, RGB 0 to 1."""
        model = self.model
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        if kind == _KIND.mjGEOM_MESH:
            shape = trimesh.Trimesh(*read_mesh(model, geom), process=False)
        else:
            shape = trimesh.graph.smooth_shade(_primitive(kind, size), angle=_CREASE)
        transform = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])  # w x y z too
        transform[:3, 3] = model.geom_pos[geom]
        color, material = model.geom_rgba[geom], model.geom_matid[geom]
        if material >= 0 and tuple(color) == _NO_COLOR:
            color = model.mat_rgba[material]
        return shape.apply_transform(transform), color[:3].astype(np.float64)

    def body_poses(self, qpos: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the bodies are: origins in the world [m] and body-to-world quaternions w x y z.

        Shapes (num_frames, num_bodies, 3) and (num_frames, num_bodies, 4), of MuJoCo's joint coordinates, shape
        (num_frames, nq), as :meth:`sim.recording.recorder.Recording.qpos` gives them.
        """
        data = mj.MjData(self.model)
        positions, quaternions = (np.empty((len(qpos), self.num_bodies, count)) for count in (3, 4))
        for frame, row in enumerate(qpos):
            data.qpos[:] = row
            mj.mj_kinematics(self.model, data)
            positions[frame], quaternions[frame] = data.xpos[1:], data.xquat[1:]
        return positions, quaternions


def _primitive(kind: int, size: NDArray[np.float64]) -> trimesh.Trimesh:
    """A shape about its own centre, along z."""
    radius, length = float(size[0]), 2.0 * float(size[1])
    if kind == _KIND.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(height=length, radius=radius, count=(_SEGMENTS, _SEGMENTS))
    if kind == _KIND.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=radius, height=length, sections=_SEGMENTS)
    if kind == _KIND.mjGEOM_BOX:
        return trimesh.creation.box(extents=2.0 * size)
    return trimesh.creation.icosphere(subdivisions=2).apply_scale(size if kind == _KIND.mjGEOM_ELLIPSOID else radius)
