"""The 3-D part of the page: terrain, start and goal, robot, arrows and paths."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from qd.show.view.meshes import Color, arrow_mesh, arrow_pose, in_linear_light, terrain_mesh
from qd.show.view.playing import Crossing
from sim.crossing import CrossingCfg
from sim.terrain import SPACING

_CAMERA, _LOOK_AT = (8.0, -6.3, 12.7), (8.0, 3.4, 0.0)
_BEHIND = np.array([-1.6, -2.4, 1.5])
"""From the robot to the camera that follows it [m]."""
_START_COLOR, _GOAL_COLOR, _FORCE_COLOR = (240, 200, 60), (0, 158, 115), (215, 25, 28)
_COMMAND_COLOR = (0, 158, 115)
_WAY_LIFT = 0.03  # over the ground [m]
_POST_HEIGHT = 1.0
_LABEL_HEIGHT = 1.35

Points = NDArray[np.floating]


class Scene:
    """What stands in the 3-D view."""

    def __init__(
        self, server: viser.ViserServer, bodies: Sequence[trimesh.Trimesh | None], num_feet: int, cfg: CrossingCfg
    ) -> None:
        """Put the robot there, unseen.

        Args:
            server: The page.
            bodies: Shape of each body in its own frame, None of one without.
            num_feet: Arrows of forces there are at most.
            cfg: The crossing, for start and goal.
        """
        self._server, self._cfg = server, cfg
        scene = server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        server.initial_camera.position, server.initial_camera.look_at = _CAMERA, _LOOK_AT
        self._robot = scene.add_frame("/robot", show_axes=False, visible=False)
        self._bodies = [
            None if mesh is None else scene.add_mesh_trimesh(f"/robot/{k}", mesh, receive_shadow=False)
            for k, mesh in enumerate(bodies)
        ]
        # Meshes that are moved, as the bodies are: arrows of changing points stay behind in the browser at times.
        self._forces = [self._add_arrow(f"/forces/{k}", _FORCE_COLOR) for k in range(num_feet)]
        self._command = self._add_arrow("/command", _COMMAND_COLOR)
        self._paths: Any = None
        self._followed: Points | None = None
        self._follow = False
        self.show_forces = True
        """Whether forces of the feet are shown."""
        self.show_paths = True
        """Whether the ways of all episodes are shown."""

    def set_terrain(self, heights: NDArray[np.floating]) -> None:
        """Show another terrain, and no crossing on it yet.

        Args:
            heights: Height grid [m], shape (nrow, ncol).
        """
        with self._server.atomic():
            self.hide_crossing()
            mesh = terrain_mesh(heights)
            self._server.scene.add_mesh_trimesh("/terrain", mesh, cast_shadow=False, receive_shadow=False)
            self._mark("start", self._cfg.start, _START_COLOR, heights)
            self._mark("goal", self._cfg.goal, _GOAL_COLOR, heights)
            self._draw_way(heights)

    def _mark(self, name: str, place: tuple[float, float], color: tuple[int, int, int], heights: Points) -> None:
        """A post with a name on it."""
        ground = float(_heights_at(heights, np.array([place]))[0])
        scene = self._server.scene
        foot = (*place, ground + 0.5 * _POST_HEIGHT)
        scene.add_cylinder(f"/{name}/post", radius=0.03, height=_POST_HEIGHT, color=color, position=foot)
        scene.add_label(f"/{name}/label", name, position=(*place, ground + _LABEL_HEIGHT))

    def _draw_way(self, heights: Points) -> None:
        """The straight way from start to goal along the ground, and at its end where the command points."""
        start, goal = np.array(self._cfg.start), np.array(self._cfg.goal)
        length = float(np.linalg.norm(goal - start))
        share = np.linspace(0.0, 1.0, round(length / SPACING) + 1)
        places = start + share[:, None] * (goal - start)
        points = np.column_stack([places, _heights_at(heights, places) + _WAY_LIFT])
        segments = np.stack([points[:-1], points[1:]], axis=1)[::2]  # dashed
        scene = self._server.scene
        scene.add_line_segments("/way/line", segments, colors=_START_COLOR, thickness=0.04)
        ahead = (goal - start) / length
        begin = np.array([*start, points[0, 2] + _POST_HEIGHT])
        arrow = np.stack([begin, begin + np.array([*ahead, 0.0])])[None]
        scene.add_arrows("/way/command", arrow, _COMMAND_COLOR, shaft_radius=0.03, head_radius=0.08, head_length=0.2)

    def hide_crossing(self) -> None:
        """Show the terrain alone."""
        self._robot.visible = False
        self._followed = None
        for handle in (*self._forces, self._command, self._paths):
            if handle is not None:
                handle.visible = False

    def set_paths(self, paths: Sequence[tuple[NDArray[np.float32], tuple[int, int, int]]]) -> None:
        """Show the way of the base in every episode.

        Args:
            paths: Points [m], shape (num_points, 3), and colour of each.
        """
        segments = [np.stack([points[:-1], points[1:]], axis=1) for points, _ in paths]
        colors = [
            np.tile(in_linear_light(np.array(color, np.uint8)), (len(part), 2, 1))
            for part, (_, color) in zip(segments, paths, strict=True)
        ]
        if sum(map(len, segments)):
            together, painted = np.concatenate(segments), np.concatenate(colors)
            self._paths = self._server.scene.add_line_segments(
                "/paths", together, colors=painted, thickness=0.02, visible=self.show_paths
            )

    def set_show_paths(self, show: bool) -> None:
        """Show or hide the paths of all episodes."""
        self.show_paths = show
        if self._paths is not None:
            self._paths.visible = show

    def set_follow(self, follow: bool) -> None:
        """Go near the robot and along with it from now on, or stay."""
        self._follow = follow
        if follow and self._followed is not None:
            self._go_near(self._followed)

    def show_frame(self, crossing: Crossing, frame: int) -> None:
        """Put the robot where it is at a frame of a crossing, with its forces and command."""
        with self._server.atomic():
            self._robot.visible = True
            for k, handle in enumerate(self._bodies):
                if handle is not None:
                    handle.position = tuple(crossing.positions[frame, k])
                    handle.wxyz = tuple(crossing.quaternions[frame, k])
            for handle, arrow in zip(self._forces, crossing.forces[frame], strict=True):
                _set_arrow(handle, arrow, shown=self.show_forces)
            _set_arrow(self._command, crossing.command[frame], shown=True)
        self._go_along(crossing.positions[frame, 0])

    def _add_arrow(self, name: str, color: Color) -> Any:
        """An arrow that is not to be seen yet."""
        mesh, add = arrow_mesh(), self._server.scene.add_mesh_simple
        return add(name, mesh.vertices, mesh.faces, color=color, cast_shadow=False, receive_shadow=False, visible=False)

    def _go_along(self, base: Points) -> None:
        """Move every visitor's camera as the base has moved, if asked to follow."""
        before, self._followed = self._followed, base.copy()
        if not self._follow:
            return
        if before is None:
            self._go_near(base)
        else:
            for client in self._server.get_clients().values():
                client.camera.position = client.camera.position + (base - before)  # what it looks at goes with it

    def _go_near(self, base: Points) -> None:
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position = base + _BEHIND
                client.camera.look_at = base


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
