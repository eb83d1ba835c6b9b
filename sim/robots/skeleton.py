"""A robot to look at, as MuJoCo reads its file: bodies, shapes, and where recorded joint coordinates put them."""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.robots.compiled import mj, read_mesh, robot_spec, touching_geoms
from sim.robots.robot import RobotCfg

_SEGMENTS = 20  # round a capsule
_PRIMITIVES: dict[Any, Callable[[NDArray[np.float64]], trimesh.Trimesh]] = {
    mj.mjtGeom.mjGEOM_CAPSULE: lambda size: trimesh.creation.capsule(2.0 * size[1], size[0], (_SEGMENTS, _SEGMENTS)),
    mj.mjtGeom.mjGEOM_CYLINDER: lambda size: trimesh.creation.cylinder(size[0], 2.0 * size[1], _SEGMENTS),
    mj.mjtGeom.mjGEOM_BOX: lambda size: trimesh.creation.box(2.0 * size),
    mj.mjtGeom.mjGEOM_ELLIPSOID: lambda size: trimesh.creation.icosphere(2).apply_scale(size),
    mj.mjtGeom.mjGEOM_SPHERE: lambda size: trimesh.creation.icosphere(2).apply_scale(size[0]),
}  # of sizes [m], about their own centre, along z
_CREASE = 0.6  # angle between faces from which on an edge is sharp [rad]

_LOOK_SUFFIX = ".look.xml"  # of an MJCF beside the model file, with shapes to show in place of the model's
_BARE, _VISUAL, _HIDDEN = 0, 2, 3  # groups; MuJoCo shows 0 to 2
_BASE_COLOR = (0.27, 0.29, 0.33, 1.0)
_LIMB_COLOR = (0.47, 0.50, 0.55, 1.0)
_FOOT_COLOR = (0.30, 0.32, 0.36, 1.0)
_NO_COLOR = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's, of a geom that names none


def shown_spec(robot: RobotCfg) -> Any:
    """An ``MjSpec`` to look at: bodies show shapes of ``<model>.look.xml``, else those that touch nothing, else all."""
    try:
        spec = robot_spec(robot, visuals=True)
    except ValueError:  # for example a visual mesh of too many faces
        spec = robot_spec(robot)
    look_file = robot.model_file.with_suffix(_LOOK_SUFFIX)
    looks = defaultdict[str, list[dict[str, Any]]](list)  # shapes by the name of their body, as add_geom takes them
    if look_file.is_file():
        look: Any = _compiled(lambda: mj.MjModel.from_xml_path(str(look_file)), look_file)
        for k in range(look.ngeom):
            shape = {name: getattr(look, f"geom_{name}")[k] for name in ("type", "size", "pos", "quat", "rgba")}
            looks[look.body(look.geom_bodyid[k]).name].append(shape)
    for body in spec.bodies[1:]:  # hides what others replace, and colours by role what has no colour
        shapes = looks.pop(body.name, [])
        touching = touching_geoms(body)
        visual = [geom for geom in body.geoms if geom not in touching and geom.group < _HIDDEN]
        for geom in visual:
            geom.group = _HIDDEN if shapes else _VISUAL
        for shape in shapes:
            body.add_geom(group=_VISUAL, mass=0.0, contype=0, conaffinity=0, **shape)
        for geom in touching:
            is_foot = geom.name in robot.foot_geoms
            geom.group = _HIDDEN if (visual or shapes) and not is_foot else _BARE
            if not geom.material and tuple(geom.rgba) == _NO_COLOR:
                is_base = geom.name in robot.base_geoms
                geom.rgba = _FOOT_COLOR if is_foot else _BASE_COLOR if is_base else _LIMB_COLOR
    if looks:
        names = [body.name for body in spec.bodies[1:]]
        raise ValueError(f"{look_file} must have the bodies of {robot.model_file}, {names}, got {[*looks]}")
    return spec


def robot_model(spec: Any, robot: RobotCfg) -> Any:
    """The ``MjModel`` of a specification of the robot, which may have been added to."""
    model = _compiled(spec.compile, robot.model_file)
    visual = {columns for geom, columns in find_touches(model, robot).items() if model.geom_group[geom] == _VISUAL}
    for column, name in enumerate(robot.geom_names):
        if name in robot.foot_geoms and (column,) in visual:
            model.geom(name).group = _HIDDEN
    return model


def find_touches(model: Any, robot: RobotCfg) -> dict[int, tuple[int, ...]]:
    """Visible geoms by index, with the columns of ``robot.geom_names`` whose touch each shows."""
    ids = [model.geom(name).id for name in robot.geom_names]
    num_bodily = len(robot.geom_names) - len(robot.foot_geoms)
    touches = {}
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        if body > 0 and model.geom_group[geom] < _HIDDEN:
            columns = [k for k, touching in enumerate(ids) if model.geom_bodyid[touching] == body]
            distance = {k: np.linalg.norm(model.geom_pos[geom] - model.geom_pos[ids[k]]) for k in columns}
            feet = tuple(k for k in columns if k >= num_bodily and distance[k] < model.geom_rbound[ids[k]])
            itself = (ids.index(geom),) if geom in ids else ()
            touches[geom] = itself or feet or tuple(k for k in columns if k < num_bodily)
    return touches


def _compiled(compile_model: Callable[[], Any], file: Path) -> Any:
    """A model of MuJoCo's; an error names its file."""
    try:
        return compile_model()
    except Exception as error:  # MuJoCo's own type has no name
        raise ValueError(f"{file} cannot be shown: {' '.join(str(error).split())}") from None


class Skeleton:
    """A robot's bodies without the world."""

    def __init__(self, robot: RobotCfg) -> None:
        self.model: Any = robot_model(shown_spec(robot), robot)  # the ``MjModel``, whose body 0 is the world
        self.num_bodies: int = self.model.nbody - 1
        self.touches = find_touches(self.model, robot)

    def shape(self, geom: int) -> tuple[trimesh.Trimesh, NDArray[np.float64]]:
        """A geom in its body's frame [m], and its colour, RGB 0 to 1."""
        model = self.model
        kind = mj.mjtGeom(model.geom_type[geom])
        if kind == mj.mjtGeom.mjGEOM_MESH:
            shape = trimesh.Trimesh(*read_mesh(model, geom), process=False)
        else:
            shape = trimesh.graph.smooth_shade(_PRIMITIVES[kind](model.geom_size[geom]), angle=_CREASE)
        transform = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])  # w x y z too
        transform[:3, 3] = model.geom_pos[geom]
        color = model.geom_rgba[geom]
        if model.geom_matid[geom] >= 0 and tuple(color) == _NO_COLOR:
            color = model.mat_rgba[model.geom_matid[geom]]
        return shape.apply_transform(transform), color[:3].astype(np.float64)

    def body_poses(self, qpos: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origins [m] and quaternions w x y z of the bodies, (num_frames, num_bodies, 3 or 4), of MuJoCo's ``qpos``."""
        data = mj.MjData(self.model)
        poses = np.empty((len(qpos), self.num_bodies, 7))
        for frame, row in enumerate(qpos):
            data.qpos[:] = row
            mj.mj_kinematics(self.model, data)
            poses[frame] = np.hstack([data.xpos[1:], data.xquat[1:]])
        return poses[..., :3], poses[..., 3:]
