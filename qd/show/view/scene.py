"""The 3-D part of a tab: terrain, start and goal, robot, what touches, arrows and paths."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from qd.show.view.meshes import Color, arrow_mesh, arrow_pose, body_meshes, path_mesh, terrain_mesh, touch_mesh
from qd.show.view.playing import Crossing
from sim.crossing import CrossingCfg
from sim.ground import GroundMaps
from sim.robots.robot import RobotCfg
from sim.robots.skeleton import Skeleton
from sim.terrain import SPACING

TOUCH_COLOR, FOOT_TOUCH_COLOR = (214, 22, 122), (255, 214, 10)
"""Of base and limbs, and of feet, while they touch."""
FORCE_COLOR, COMMAND_COLOR = (215, 25, 28), (0, 158, 115)
GHOST_COLOR = (0, 114, 178)
"""Of the second robot, which is translucent."""
_START_COLOR, _GOAL_COLOR = (240, 200, 60), (0, 158, 115)
_BEHIND = np.array([-1.6, -2.4, 1.5])
"""From the robot to the camera that follows it [m]."""
PHONE = 576
"""Below this width viser's panels cover the lower 60 % of the picture [pixels]."""
_PATH_RADIUS, _PATH_OPACITY = 0.008, 0.35
_WAY_LIFT = 0.03  # over the ground [m]
_POST_HEIGHT, _POST_RADIUS = 1.0, 0.03
_DISC_HEIGHT, _DISC_RADIUS = 0.03, 0.15  # at the start, where a post would stand in the robot
_GHOST_OPACITY = 0.4
_NAME_HEIGHT = 0.12  # of a foot's name over it [m]

Points = NDArray[np.floating]
View = tuple[tuple[float, float, float], tuple[float, float, float]]


def overview_of(width: int, height: int) -> View:
    """Where the camera stands and what it looks at [m], to see the whole terrain.

    Args:
        width: Of the picture [pixels].
        height: Of the picture [pixels].
    """
    if width < PHONE:
        return (-9.0, 4.0, 9.0), (-2.4, 4.0, 0.0)
    if width < height:  # the terrain's length goes up the picture
        return (-2.6, 4.0, 9.6), (6.6, 4.0, 0.0)
    return (8.0, -6.3, 10.5), (8.0, 3.4, 0.0)


def first_view_of(width: int, height: int) -> View:
    """Where the camera stands and what it looks at [m] at first: over the robot's start along its way.

    Args:
        width: Of the picture [pixels].
        height: Of the picture [pixels].
    """
    if width < PHONE:
        return (-3.0, 3.4, 4.2), (0.3, 3.7, 0.0)
    return (-0.6, 0.4, 3.4), (5.6, 4.3, -0.2)


@dataclass(frozen=True, kw_only=True)
class Shapes:
    """What all tabs show of the robot."""

    bodies: list[trimesh.Trimesh | None]
    """Shape of each body in its own frame, None of one without."""
    touches: list[tuple[str, int, trimesh.Trimesh]]
    """Name, body, and shape in the body's frame of each geom whose touch may be recorded."""
    feet: tuple[str, ...]
    """Names of the feet."""


def shapes_of(skeleton: Skeleton, robot: RobotCfg) -> Shapes:
    """The shapes of a robot."""
    geoms = [skeleton.geom(name) for name in robot.geom_names]
    touches = [(geom.name, geom.body, touch_mesh(geom)) for geom in geoms]
    return Shapes(bodies=body_meshes(skeleton, robot), touches=touches, feet=robot.foot_geoms)


class Scene:
    """What stands in the 3-D view of a tab."""

    def __init__(self, client: viser.ClientHandle, shapes: Shapes, cfg: CrossingCfg) -> None:
        """Put the robot there, unseen.

        Args:
            client: The tab's browser.
            shapes: The robot's.
            cfg: The crossing, for start and goal.
        """
        self._client, self._shapes, self._cfg = client, shapes, cfg
        scene = client.scene
        self._robot = scene.add_frame("/robot", show_axes=False, visible=False)
        self._bodies = [
            None if mesh is None else scene.add_mesh_trimesh(f"/robot/{k}", mesh, receive_shadow=False)
            for k, mesh in enumerate(shapes.bodies)
        ]
        self._touches = {
            name: self._add_mesh(f"/robot/touch/{name}", mesh, FOOT_TOUCH_COLOR if name in shapes.feet else TOUCH_COLOR)
            for name, _, mesh in shapes.touches
        }
        self._ghost = scene.add_frame("/ghost", show_axes=False, visible=False)
        self._ghosts: list[Any] = []  # its bodies, from when there is one
        # Meshes that are moved, as the bodies are: arrows of changing points stay behind in the browser at times.
        arrow = arrow_mesh()
        self._forces = [self._add_mesh(f"/forces/{k}", arrow, FORCE_COLOR) for k in range(len(shapes.feet))]
        self._command = self._add_mesh("/command", arrow, COMMAND_COLOR)
        self._names = [scene.add_label(f"/feet/{name}", name, visible=False) for name in shapes.feet]
        self._paths: list[Any] = []
        self._followed: Points | None = None
        self.follow = False
        """Whether the camera goes along with the robot."""
        self.show_forces = True
        """Whether forces of the feet are shown."""
        self.show_paths = True
        """Whether the ways of all episodes are shown, while the camera does not follow."""
        self.show_names = False
        """Whether the feet have their names on them."""

    def set_terrain(self, heights: NDArray[np.floating], ground: GroundMaps | None = None) -> None:
        """Show another terrain, and no crossing on it yet.

        Args:
            heights: Height grid [m], shape (nrow, ncol).
            ground: Its friction and softness.
        """
        with self._client.atomic():
            self.hide_crossing()
            mesh = terrain_mesh(heights, ground)
            self._client.scene.add_mesh_trimesh("/terrain", mesh, cast_shadow=False, receive_shadow=False)
            self._mark(
                "start",
                self._cfg.start,
                _START_COLOR,
                heights,
                height=_DISC_HEIGHT,
                radius=_DISC_RADIUS,
                label_from=(-0.9, 0.15),
            )
            self._mark(
                "goal",
                self._cfg.goal,
                _GOAL_COLOR,
                heights,
                height=_POST_HEIGHT,
                radius=_POST_RADIUS,
                label_from=(0.0, 1.35),
            )
            self._draw_way(heights)

    def _mark(
        self,
        name: str,
        place: tuple[float, float],
        color: tuple[int, int, int],
        heights: Points,
        *,
        height: float,
        radius: float,
        label_from: tuple[float, float],
    ) -> None:
        """A post or a disc [m] with a name, so far behind and above it."""
        ground = float(_heights_at(heights, np.array([place]))[0])
        scene = self._client.scene
        middle = (*place, ground + 0.5 * height)
        scene.add_cylinder(f"/{name}/post", radius=radius, height=height, color=color, position=middle)
        scene.add_label(f"/{name}/label", name, position=(place[0] + label_from[0], place[1], ground + label_from[1]))

    def _draw_way(self, heights: Points) -> None:
        """The straight way from start to goal along the ground."""
        start, goal = np.array(self._cfg.start), np.array(self._cfg.goal)
        length = float(np.linalg.norm(goal - start))
        share = np.linspace(0.0, 1.0, round(length / SPACING) + 1)
        places = start + share[:, None] * (goal - start)
        points = np.column_stack([places, _heights_at(heights, places) + _WAY_LIFT])
        segments = np.stack([points[:-1], points[1:]], axis=1)[::2]  # dashed
        self._client.scene.add_line_segments("/way/line", segments, colors=_START_COLOR, thickness=0.02)

    def hide_crossing(self) -> None:
        """Show the terrain alone."""
        self._robot.visible = False
        self.hide_ghost()
        self._followed = None
        for handle in (*self._touches.values(), *self._forces, self._command, *self._names):
            handle.visible = False
        self._drop_paths()

    def _drop_paths(self) -> None:
        for handle in self._paths:
            handle.remove()
        self._paths = []

    def set_paths(self, paths: Sequence[tuple[NDArray[np.float32], tuple[int, int, int]]]) -> None:
        """Show the way of the base in every episode, thin and translucent.

        Args:
            paths: Points [m], shape (num_points, 3), and colour of each.
        """
        self._drop_paths()
        for color in dict.fromkeys(color for _, color in paths):
            tubes = [path_mesh(points, _PATH_RADIUS) for points, own in paths if own == color and len(points) > 1]
            if tubes:
                mesh: Any = trimesh.util.concatenate(tubes)
                name = f"/paths/{len(self._paths)}"
                self._paths.append(self._add_mesh(name, mesh, color, opacity=_PATH_OPACITY))
        self._show_paths()

    def set_show_paths(self, show: bool) -> None:
        """Show or hide the paths of all episodes."""
        self.show_paths = show
        self._show_paths()

    def _show_paths(self) -> None:
        """Following, paths would hide the robot."""
        for handle in self._paths:
            handle.visible = self.show_paths and not self.follow

    def set_follow(self, follow: bool) -> None:
        """Go near the robot and along with it from now on, or stay."""
        self.follow = follow
        self._show_paths()
        if follow and self._followed is not None:
            self._go_near(self._followed)

    def show_frame(self, crossing: Crossing, frame: int) -> None:
        """Put the robot where it is at a frame of a crossing, with what touches, its forces and command."""
        positions, quaternions = crossing.positions[frame], crossing.quaternions[frame]
        with self._client.atomic():
            self._robot.visible = True
            for k, handle in enumerate(self._bodies):
                if handle is not None:
                    _place(handle, positions[k], quaternions[k])
            for k, (name, body, _) in enumerate(self._shapes.touches):
                handle = self._touches[name]
                handle.visible = bool(crossing.touching[frame, k]) if crossing.touching is not None else False
                if handle.visible:
                    _place(handle, positions[body], quaternions[body])
            for handle, arrow in zip(self._forces, crossing.forces[frame], strict=True):
                _set_arrow(handle, arrow, shown=self.show_forces)
            _set_arrow(self._command, crossing.command[frame], shown=True)
            for handle, arrow in zip(self._names, crossing.forces[frame], strict=True):
                handle.visible = self.show_names
                handle.position = tuple(arrow[0] + np.array([0.0, 0.0, _NAME_HEIGHT]))
        self._go_along(positions[0])

    def show_ghost(self, crossing: Crossing, frame: int) -> None:
        """Put a second, translucent robot where it is at a frame of its own crossing."""
        with self._client.atomic():
            if not self._ghosts:
                self._ghosts = [
                    None if mesh is None else self._add_mesh(f"/ghost/{k}", mesh, GHOST_COLOR, opacity=_GHOST_OPACITY)
                    for k, mesh in enumerate(self._shapes.bodies)
                ]
            self._ghost.visible = True
            for k, handle in enumerate(self._ghosts):
                if handle is not None:
                    handle.visible = True
                    _place(handle, crossing.positions[frame, k], crossing.quaternions[frame, k])

    def hide_ghost(self) -> None:
        """Show the robot alone."""
        self._ghost.visible = False

    def _add_mesh(self, name: str, mesh: trimesh.Trimesh, color: Color, *, opacity: float | None = None) -> Any:
        """A shape of one colour that is not to be seen yet."""
        look: dict[str, Any] = {"color": color, "opacity": opacity, "visible": False}
        add = self._client.scene.add_mesh_simple
        return add(
            name, np.asarray(mesh.vertices), np.asarray(mesh.faces), **look, cast_shadow=False, receive_shadow=False
        )

    def _go_along(self, base: Points) -> None:
        """Move the camera as the base has moved, if it is to follow."""
        before, self._followed = self._followed, base.copy()
        if not self.follow:
            return
        if before is None:
            self._go_near(base)
        else:
            camera = self._client.camera
            camera.position = camera.position + (base - before)  # what it looks at goes with it

    def _go_near(self, base: Points) -> None:
        self.go_to((tuple(base + _BEHIND), tuple(base)))

    def go_to(self, view: View) -> None:
        """Move the camera.

        Args:
            view: Where it is to stand and what to look at [m].
        """
        with self._client.atomic():
            self._client.camera.position, self._client.camera.look_at = view


def _place(handle: Any, position: Points, quaternion: Points) -> None:
    handle.position, handle.wxyz = tuple(position), tuple(quaternion)


def _set_arrow(handle: Any, arrow: Points, *, shown: bool) -> None:
    """Put an arrow from one point to another, shape (2, 3); one without length is not shown."""
    shown = shown and bool(np.any(arrow[0] != arrow[1]))
    if shown:
        handle.wxyz, length = arrow_pose(arrow[0], arrow[1])
        handle.position = tuple(arrow[0])
        handle.scale = (1.0, 1.0, length)
    handle.visible = shown


def _heights_at(heights: Points, places: NDArray[np.floating]) -> Points:
    """Height of the nearest node [m] at x, y of shape (num, 2)."""
    limits = np.array(heights.shape[::-1]) - 1
    col, row = np.clip(np.rint(places / SPACING).astype(int), 0, limits).T
    return heights[row, col]
