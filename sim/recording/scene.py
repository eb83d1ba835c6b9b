"""A robot on its terrain as a MuJoCo model to look at: ground painted by height, light and goal.

Nothing in it is simulated: poses come from a recording.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from sim.crossing import CrossingCfg
from sim.robots.elements import mj
from sim.robots.robot import RobotCfg
from sim.robots.skeleton import robot_model, shown_spec
from sim.terrains.ground import GroundMaps
from sim.terrains.hand_crafted import SPACING
from sim.terrains.maps.hfield import surface_of
from sim.terrains.maps.picture import height_colors, tinted

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


def ground_paint(heights: NDArray[np.floating], ground: GroundMaps | None = None) -> NDArray[np.uint8]:
    """Colours of a height grid: blue below 0, brown above, a line every metre, steep parts darker, with its tint.

    Of heights [m], shape (nrow, ncol), margins included, whose node (0, 0) stands on a whole metre, this is RGB of
    shape (4 (nrow - 1), 4 (ncol - 1), 3), row along y.
    """
    cells = 0.25 * (heights[:-1, :-1] + heights[1:, :-1] + heights[:-1, 1:] + heights[1:, 1:])
    color = height_colors(cells)
    color = color if ground is None else tinted(color, ground, MARGIN_NODES)
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
    """The model of a scene: the robot's file and its height grid [m], shape (nrow, ncol), in world-local coordinates.

    Images are at most of that width and height [pixels].
    """
    spec = shown_spec(robot)
    for geom in spec.worldbody.geoms:
        geom.group = _HIDDEN_GROUP  # a floor of the robot's file is not the ground
    paint = ground_paint(np.pad(heights, MARGIN_NODES, mode="edge"), ground)
    _add_ground(spec, heights, paint.shape)
    _add_goal(spec, heights)
    _add_light(spec)
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
    places = vertices[:, :2] - vertices[0, :2]
    spec.add_mesh(
        name=GROUND,
        uservert=vertices.ravel(),
        userface=faces.ravel(),
        usertexcoord=(places / places[-1]).ravel(),
        inertia=mj.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    flat = {"type": mj.mjtTexture.mjTEXTURE_2D, "builtin": mj.mjtBuiltin.mjBUILTIN_FLAT, "nchannel": 3}
    spec.add_texture(name=GROUND, width=paint[1], height=paint[0], **flat)
    material = spec.add_material(name=GROUND, specular=0.0, shininess=0.0, reflectance=0.0)
    material.textures[mj.mjtTextureRole.mjTEXROLE_RGB] = GROUND
    kind = {"type": mj.mjtGeom.mjGEOM_MESH, "meshname": GROUND, "material": GROUND}
    spec.worldbody.add_geom(name=GROUND, group=0, contype=0, conaffinity=0, **kind)


def _add_goal(spec: Any, heights: NDArray[np.floating]) -> None:
    """A post at the goal, and the rim of the circle that counts as reaching it."""
    x, y = CrossingCfg.goal
    ground = float(heights[round(y / SPACING), round(x / SPACING)])
    green = [0.0, 0.62, 0.45, 1.0]
    post = {"type": mj.mjtGeom.mjGEOM_CYLINDER, "group": 0}
    spec.worldbody.add_geom(pos=[x, y, ground + 0.5], size=[0.02, 0.5, 0.0], rgba=green, **post)
    disc = [*green[:3], 0.25]
    spec.worldbody.add_geom(pos=[x, y, ground + 0.01], size=[CrossingCfg.goal_radius, 0.02, 0.0], rgba=disc, **post)


def _add_light(spec: Any) -> None:
    sky = {"type": mj.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mj.mjtBuiltin.mjBUILTIN_GRADIENT}
    spec.add_texture(
        name="faultline_sky", rgb1=[0.72, 0.81, 0.91], rgb2=[0.96, 0.97, 0.98], width=64, height=384, **sky
    )
    for light in spec.lights:
        light.active = False
    spec.worldbody.add_light(
        name="faultline_sun",
        type=mj.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[8.0, 4.0, 20.0],
        dir=[-0.25, 0.45, -1.0],
        diffuse=[0.55, 0.55, 0.53],
        ambient=[0.0, 0.0, 0.0],
        specular=[0.1, 0.1, 0.1],
        castshadow=True,
    )
    headlight = spec.visual.headlight
    headlight.ambient = [0.42] * 3
    headlight.diffuse = [0.22] * 3
    headlight.specular = [0.0] * 3
    spec.visual.quality.shadowsize = 2048
    spec.visual.quality.offsamples = 0
