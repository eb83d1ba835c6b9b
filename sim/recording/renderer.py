"""Pictures of recorded poses by MuJoCo's renderer, without a screen: through EGL, on a GPU or in software.

A scene is a MuJoCo model to look at: the robot on its terrain, ground painted by height, light and goal.
"""

import importlib
import os
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import zoom

from sim.crossing import CrossingCfg
from sim.robots.compiled import mj
from sim.robots.robot import RobotCfg
from sim.robots.skeleton import find_touches, robot_model, shown_spec
from sim.terrains.hand_crafted import SPACING
from sim.terrains.maps.heightmap import surface_of
from sim.terrains.maps.picture import height_colors, places, tinted
from sim.terrains.terrains import GroundMaps, asked_of

Color = tuple[float, float, float]
"""RGB, 0 to 1."""
TOUCH = (0.84, 0.09, 0.48)
FOOT_TOUCH = (1.0, 0.84, 0.04)
"""Of base and limbs, and of feet, while they touch."""
OTHER_CONTROLLER = (0.05, 0.62, 0.55)
"""Of ghosts: another controller's crossing."""

MARGIN_NODES = 40
"""Edge height shown on each side: a crossing may leave the terrain by 2 m."""
GROUND = "faultline_ground"
"""Name of its geom."""
_PIXELS = 4  # of the paint a cell, along each side
_SHADOWED = 2.0  # half side of the square about the robot that shadows fall in [m]
_HIDDEN_GROUP = 5  # MuJoCo shows groups 0 to 2
_GREEN = (0.0, 0.62, 0.45)  # of the goal
_MAX_GEOMS = 20_000
_GHOST_OPACITY = 0.4
_NAME_HEIGHT = 0.55  # over the base, in standing heights of the robot
_LEAST_LETTERS = 14  # [pixels]
_ARROW = 0.8  # length of the arrow of a force at the robot's limit [m]
_ARROW_WIDTH = 0.012
_LEAST_FORCE = 5.0  # shown [N]
_SUN_AWAY = 8.0  # from what one looks at [m]
_CALM = np.array([0.95, 0.80, 0.20, 0.9], np.float32)
_ALARMED = np.array([0.85, 0.10, 0.10, 0.9], np.float32)


def ground_paint(heights: NDArray[np.floating], ground: GroundMaps | None = None) -> NDArray[np.uint8]:
    """Colours of a height grid: blue below 0, brown above, a line every metre, steep parts darker, with its tint.

    Of heights [m], shape (nrow, ncol), margins included, whose node (0, 0) stands on a whole metre, this is RGB of
    shape (4 (nrow - 1), 4 (ncol - 1), 3), row along y.
    """
    cells = 0.25 * (heights[:-1, :-1] + heights[1:, :-1] + heights[:-1, 1:] + heights[1:, 1:])
    color = height_colors(cells) if ground is None else tinted(height_colors(cells), ground, MARGIN_NODES)
    rise_y, rise_x = np.gradient(cells, SPACING)
    color *= (0.75 + 0.25 / np.sqrt(1.0 + rise_x**2 + rise_y**2))[..., None]
    paint = np.asarray(zoom(color, (_PIXELS, _PIXELS, 1), order=1, mode="nearest", grid_mode=True))
    metre = round(1.0 / SPACING) * _PIXELS
    for axis in (0, 1):
        on_line = np.arange(paint.shape[axis]) % metre < _PIXELS // 2
        paint[(slice(None),) * axis + (on_line,)] *= 0.82
    return np.rint(255.0 * paint).astype(np.uint8)


def scene_model(
    robot: RobotCfg, heights: NDArray[np.floating], *, width: int, height: int, ground: GroundMaps | None = None
) -> Any:
    """The model of a scene of a robot and a height grid [m], shape (nrow, ncol), for images of at most that size."""
    spec = shown_spec(robot)
    for geom in spec.worldbody.geoms:
        geom.group = _HIDDEN_GROUP  # a floor of the robot's file is not the ground
    paint = ground_paint(np.pad(heights, MARGIN_NODES, mode="edge"), ground)
    _add_ground(spec, heights, paint.shape)
    if goal := places(asked_of(ground)).get("goal"):
        x, y = goal
        z = float(heights[round(y / SPACING), round(x / SPACING)])
        cylinder = {"type": mj.mjtGeom.mjGEOM_CYLINDER, "group": 0}
        rim = [CrossingCfg.goal_radius, 0.02, 0.0]  # of the circle that counts as reaching the goal
        spec.worldbody.add_geom(pos=[x, y, z + 0.5], size=[0.02, 0.5, 0.0], rgba=[*_GREEN, 1.0], **cylinder)
        spec.worldbody.add_geom(pos=[x, y, z + 0.01], size=rim, rgba=[*_GREEN, 0.25], **cylinder)
    sky = {"type": mj.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mj.mjtBuiltin.mjBUILTIN_GRADIENT, "width": 64}
    spec.add_texture(name="faultline_sky", rgb1=[0.72, 0.81, 0.91], rgb2=[0.96, 0.97, 0.98], height=384, **sky)
    for light in spec.lights:
        light.active = False
    sun = {"type": mj.mjtLightType.mjLIGHT_DIRECTIONAL, "pos": [8.0, 4.0, 20.0], "dir": [-0.25, 0.45, -1.0]}
    colors = {"diffuse": [0.55, 0.55, 0.53], "ambient": [0.0] * 3, "specular": [0.1] * 3}
    spec.worldbody.add_light(name="faultline_sun", castshadow=True, **sun, **colors)
    for name, brightness in {"ambient": 0.42, "diffuse": 0.22, "specular": 0.0}.items():
        setattr(spec.visual.headlight, name, [brightness] * 3)
    spec.visual.quality.shadowsize = 2048
    spec.visual.quality.offsamples = 0
    spec.visual.global_.offwidth = width
    spec.visual.global_.offheight = height
    model = robot_model(spec, robot)
    model.vis.map.shadowclip = _SHADOWED / model.stat.extent
    first = int(model.texture(GROUND).adr[0])
    model.tex_data[first : first + paint.size] = paint.ravel()
    return model


def _add_ground(spec: Any, heights: NDArray[np.floating], paint: tuple[int, ...]) -> None:
    """A mesh, not a height field, whose facets MuJoCo shows."""
    vertices, faces = surface_of(heights, MARGIN_NODES)
    steps = vertices[:, :2] - vertices[0, :2]
    mesh = {"uservert": vertices.ravel(), "userface": faces.ravel(), "usertexcoord": (steps / steps[-1]).ravel()}
    spec.add_mesh(name=GROUND, inertia=mj.mjtMeshInertia.mjMESH_INERTIA_SHELL, **mesh)
    flat = {"type": mj.mjtTexture.mjTEXTURE_2D, "builtin": mj.mjtBuiltin.mjBUILTIN_FLAT, "nchannel": 3}
    spec.add_texture(name=GROUND, width=paint[1], height=paint[0], **flat)
    material = spec.add_material(name=GROUND, specular=0.0, shininess=0.0, reflectance=0.0)
    material.textures[mj.mjtTextureRole.mjTEXROLE_RGB] = GROUND
    kind = {"type": mj.mjtGeom.mjGEOM_MESH, "meshname": GROUND, "material": GROUND}
    spec.worldbody.add_geom(name=GROUND, group=0, contype=0, conaffinity=0, **kind)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Where a picture is taken from."""

    target: tuple[float, float, float]
    """What is in the middle [m]."""
    distance: float
    """From it [m]."""
    azimuth: float = 55.0
    """Direction of view in the horizontal plane, from x toward y [deg]."""
    elevation: float = -22.0
    """Of the view over the horizon [deg]; negative looks down."""


def open_context(width: int, height: int) -> Any:
    """A current OpenGL context without a screen: EGL, or what MUJOCO_GL names; free it with ``free()``."""
    name = os.environ.get("MUJOCO_GL", "").strip().lower() or "egl"
    if name not in ("egl", "osmesa", "glfw"):
        raise ValueError(f"MUJOCO_GL must be egl, osmesa or glfw for pictures, got '{name}': leave it unset")
    try:
        context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # a library that is not there fails with anything
        problem = f"'{name}' does not work here: {type(error).__name__}: {error}"
        cure = "install it (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri), or name another way in MUJOCO_GL"
        raise ValueError(f"pictures need OpenGL without a screen, but {problem}: {cure} (egl, osmesa, glfw)") from None
    return context


class Renderer(AbstractContextManager):
    """Renders poses of one robot on one terrain; a context manager that frees what it took of the graphics driver."""

    def __init__(
        self,
        robot: RobotCfg,
        heights: NDArray[np.floating],
        *,
        width: int = 1280,
        height: int = 480,
        shadows: bool = True,
        ground: GroundMaps | None = None,
    ) -> None:
        """Build the scene of heights [m], (nrow, ncol), for images of this size [pixels]; shadows double the time."""
        self.model = scene_model(robot, heights, width=width, height=height, ground=ground)
        self._context = open_context(width, height)
        self._robot = robot
        self._feet = [self.model.geom(name).id for name in robot.foot_geoms]
        self._first_foot = len(robot.geom_names) - len(robot.foot_geoms)
        self._touches, self._ground = find_touches(self.model, robot), self.model.geom(GROUND).id
        self._data, self._ghost_data = mj.MjData(self.model), mj.MjData(self.model)
        self._scene = mj.MjvScene(self.model, maxgeom=_MAX_GEOMS)
        self._scene.flags[mj.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mj.mjtRndFlag.mjRND_REFLECTION] = False
        self._options = mj.MjvOption()
        self._camera = mj.MjvCamera()
        self._camera.type = mj.mjtCamera.mjCAMERA_FREE
        self._gpu = mj.MjrContext(self.model, mj.mjtFontScale.mjFONTSCALE_100.value)
        mj.mjr_setBuffer(mj.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gpu)
        self._rectangle = mj.MjrRect(0, 0, width, height)
        self._image = np.empty((height, width, 3), np.uint8)

    def __exit__(self, *exception: object) -> None:
        self._gpu.free()
        self._context.free()

    def render(
        self,
        qpos: NDArray[np.floating],
        camera: Camera,
        *,
        ghost: NDArray[np.floating] | None = None,
        ghost_name: str = "",
        touching: NDArray[np.bool_] | None = None,
        foot_force: NDArray[np.floating] | None = None,
    ) -> NDArray[np.uint8]:
        """A picture of one pose in MuJoCo's joint coordinates, shape (7 + num_joints,): RGB, (height, width, 3).

        ``ghost`` is the pose of another controller's robot, translucent and with its name over it.
        ``touching`` says whether each geom of ``robot.geom_names`` touches something, shape (num_geoms,): feet that do
        are yellow, base and limbs magenta. Arrows show ``foot_force``, world frame [N], shape (num_feet, 3).
        """
        data = self._data
        self._pose(data, qpos)
        # The sun goes with the camera, so that its shadows are sharp where one looks.
        data.light_xpos[-1] = np.array(camera.target) - _SUN_AWAY * data.light_xdir[-1]
        self._camera.lookat[:] = camera.target
        for name in ("distance", "azimuth", "elevation"):
            setattr(self._camera, name, getattr(camera, name))
        everything = mj.mjtCatBit.mjCAT_ALL.value
        mj.mjv_updateScene(self.model, data, self._options, None, self._camera, everything, self._scene)
        self._dress(touching)
        if ghost is not None:
            self._pose(self._ghost_data, ghost)
            first = self._scene.ngeom
            moving = mj.mjtCatBit.mjCAT_DYNAMIC.value
            mj.mjv_addGeoms(self.model, self._ghost_data, self._options, mj.MjvPerturb(), moving, self._scene)
            for geom in self._scene.geoms[first : self._scene.ngeom]:
                geom.rgba[:] = *OTHER_CONTROLLER, _GHOST_OPACITY
                geom.matid = -1
                geom.transparent = 1
        if foot_force is not None:
            for foot, force in zip(data.geom_xpos[self._feet], np.asarray(foot_force, np.float64), strict=True):
                self._add_arrow(foot, force)
        mj.mjr_render(self._rectangle, self._scene, self._gpu)
        mj.mjr_readPixels(self._image, None, self._rectangle, self._gpu)
        picture = self._image[::-1]  # OpenGL's lowest row is first
        return picture.copy() if ghost is None else self._named(picture, ghost[:3], ghost_name)

    def _pose(self, data: Any, qpos: NDArray[np.floating]) -> None:
        data.qpos[:] = qpos
        mj.mj_kinematics(self.model, data)
        mj.mj_comPos(self.model, data)
        mj.mj_camlight(self.model, data)

    def _dress(self, touching: NDArray[np.bool_] | None) -> None:
        """Colours what touches, and has the ground cast no shadow: it would speckle slopes."""
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype != mj.mjtObj.mjOBJ_GEOM.value:
                continue
            if geom.objid == self._ground:
                geom.category = mj.mjtCatBit.mjCAT_DECOR.value
            columns = self._touches.get(geom.objid, ())
            if touching is not None and touching[list(columns)].any():
                geom.rgba[:3] = FOOT_TOUCH if columns[0] >= self._first_foot else TOUCH
                geom.matid = -1

    def _named(self, picture: NDArray[np.uint8], base: NDArray[np.floating], name: str) -> NDArray[np.uint8]:
        """The picture with a name over a robot whose base is there [m]."""
        image = Image.fromarray(picture)
        camera = self._scene.camera[0]  # that of one eye, at most a few centimetres from the middle of both
        over = np.array([0.0, 0.0, _NAME_HEIGHT * self._robot.default_base_height])
        away = np.asarray(base, np.float64) + over - camera.pos
        depth = float(away @ camera.forward)
        if depth > camera.frustum_near:
            pixels = 0.5 * image.height * camera.frustum_near / camera.frustum_top / depth  # of a metre there
            right = away @ np.cross(camera.forward, camera.up)
            point = 0.5 * image.width + pixels * right, 0.5 * image.height - pixels * (away @ camera.up)
            color = tuple(round(150.0 * share) for share in OTHER_CONTROLLER)
            font = ImageFont.load_default(max(_LEAST_LETTERS, image.height // 22))
            ImageDraw.Draw(image).text(point, name, color, font, anchor="mb", stroke_width=2, stroke_fill="white")
        return np.array(image)

    def _add_arrow(self, foot: NDArray[np.float64], force: NDArray[np.float64]) -> None:
        size = float(np.linalg.norm(force))
        limit = self._robot.contact_force_limit
        if size < _LEAST_FORCE:
            return
        tip = foot + force * (_ARROW / limit * min(1.0, 2.5 * limit / size))
        geom = self._scene.geoms[self._scene.ngeom]
        kind = mj.mjtGeom.mjGEOM_ARROW.value
        color = _ALARMED if size > limit else _CALM
        mj.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), color)
        mj.mjv_connector(geom, kind, _ARROW_WIDTH, foot, tip)
        self._scene.ngeom += 1
