"""The 3-D view of a tab: terrain, start and any goal, robot, what touches, arrows and paths; and one crossing as shown.

Colours of vertices are in linear light, as glTF and the browser want them.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from PIL import ImageColor
from scipy.spatial.transform import Rotation

from kernels.episode import Outcome
from qd.show.crossed import find_failure_time, get_ending, leans
from sim.crossing import CrossingCfg
from sim.mujoco_c.model import surface_heights
from sim.recording.recorder import Recording
from sim.recording.renderer import FOOT_TOUCH, OTHER_CONTROLLER, TOUCH, Color
from sim.robots.robot import RobotCfg
from sim.robots.skeleton import Skeleton
from sim.terrains.hand_crafted import SPACING
from sim.terrains.maps.heightmap import surface_of
from sim.terrains.maps.picture import height_colors, places, tinted
from sim.terrains.terrains import GroundMaps, asked_of

FORCE_COLOR = (0.84, 0.10, 0.11)  # arrows of contact forces, RGB, 0 to 1
COMMAND_COLOR = (0.0, 0.62, 0.45)  # arrow of the commanded velocity
_GOAL_COLOR = (0, 158, 115)
SKY = np.linspace((140, 178, 214), (232, 238, 243), 256).astype(np.uint8)[:, None]
"""Background, blue above and pale below, as an image of one column."""
_BEHIND = np.array([-1.6, -2.4, 1.5])  # from the robot to the camera that follows it [m]
PHONE = 576  # below this width viser's panels cover the lower 60 % of the picture [pixels]
_START_RADIUS = 0.25
_DISC: Any = {"height": 0.02, "opacity": 0.5, "cast_shadow": False}

Points = NDArray[np.floating]
View = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Where the camera stands and what it looks at [m]."""
_VIEWS: dict[str, tuple[View, View, View]] = {  # on a phone, where the terrain's length goes up the picture, and else
    "overview": (
        ((-9.0, 4.0, 9.0), (-2.4, 4.0, 0.0)),
        ((-2.6, 4.0, 9.6), (6.6, 4.0, 0.0)),
        ((8.0, -6.3, 10.5), (8.0, 3.4, 0.0)),
    ),
    "near": (  # over the start along the robot's way
        ((-3.0, 3.4, 4.2), (0.3, 3.7, 0.0)),
        ((-0.6, 0.4, 3.4), (5.6, 4.3, -0.2)),
        ((-0.6, 0.4, 3.4), (5.6, 4.3, -0.2)),
    ),
}
_LINE_DARKNESS = 0.84
_SEGMENTS = 20  # round an arrow
_FORCE_LENGTH = 1e-3  # of an arrow [m/N]
_LEAST_FORCE = 5.0  # shown [N]
_COMMAND_HEIGHT = 0.45  # over the base [m]


class Crossing(NamedTuple):
    """One episode as it is shown, F frames."""

    recording: Recording  # of one terrain
    replica: int
    positions: NDArray[np.float64]
    """Origins of the bodies, world [m], shape (F, num_bodies, 3)."""
    quaternions: NDArray[np.float64]
    """Bodies to world, w x y z, shape (F, num_bodies, 4)."""
    forces: NDArray[np.float64]
    """Arrows of the feet's contact forces, begin and end [m], shape (F, num_feet, 2, 3); small forces have length 0."""
    command: NDArray[np.float64]
    """Arrow of the velocity command from above the base, 1 m is 1 m/s, begin and end [m], shape (F, 2, 3)."""
    penalties: NDArray[np.float64]
    """Scaled sums so far, in the archive's order, shape (F, P)."""

    @property
    def duration_s(self) -> float:
        """Simulated time up to the end [s]."""
        return float(self.recording.duration_s[0, self.replica])

    @property
    def ending(self) -> str:
        """Outcome in words, when it came, and whether the robot has fallen."""
        return describe_ending(self.recording, self.replica, after=f" after {self.duration_s:.1f} s")

    @property
    def failure_s(self) -> float:
        """When it went wrong [s] (:func:`qd.show.crossed.find_failure_time`)."""
        return find_failure_time(self.recording, self.replica)

    @property
    def marks(self) -> tuple[tuple[float, str], ...]:
        """When something happens [s], and what."""
        return find_marks(self.recording, self.replica)

    def find_frame(self, time_s: float) -> int:
        """The frame of a time, no further than the last."""
        return min(round(time_s / self.recording.dt), len(self.positions) - 1)


def trace_crossing(
    recording: Recording, replica: int, skeleton: Skeleton, scales: Mapping[str, float]
) -> Crossing | None:
    """One episode, its penalties divided by their ``scales``; None if it broke before its first frame."""
    frames = int(recording.num_frames[0, replica])
    if frames == 0:
        return None
    qpos = recording.qpos(0, replica)
    positions, quaternions = skeleton.body_poses(qpos)
    newtons = recording.foot_force[0, replica, :frames].astype(np.float64)
    is_shown = np.linalg.norm(newtons, axis=-1, keepdims=True) >= _LEAST_FORCE
    shapes = [skeleton.model.geom(name) for name in recording.foot_names]
    bodies = [foot.bodyid[0] - 1 for foot in shapes]
    turns = [Rotation.from_quat(np.roll(quaternions[:, body], -1, axis=-1)) for body in bodies]
    offsets = [turn.apply(foot.pos) for turn, foot in zip(turns, shapes, strict=True)]
    feet = positions[:, bodies] + np.stack(offsets, axis=1)
    yaw = Rotation.from_quat(np.roll(qpos[:, 3:7], -1, axis=-1)).as_euler("ZYX")[:, :1]  # commands are in its frame
    command = recording.command[0, replica, :frames].astype(np.float64) * [1.0, 1.0, 0.0]
    begin = qpos[:, :3] + [0.0, 0.0, _COMMAND_HEIGHT]
    columns = [recording.penalty_names.index(name) for name in scales]
    sums = recording.penalties[0, replica, :frames].astype(np.float64)[:, columns]
    return Crossing(
        recording,
        replica,
        positions,
        quaternions,
        forces=np.stack([feet, feet + np.where(is_shown, _FORCE_LENGTH * newtons, 0.0)], axis=2),
        command=np.stack([begin, begin + Rotation.from_euler("Z", yaw).apply(command)], axis=1),
        penalties=sums / np.array([*scales.values()]),
    )


def describe_ending(recording: Recording, replica: int, after: str = "") -> str:
    """How an episode of one terrain ended, and whether the robot had fallen then."""
    fallen = " · fallen" if recording.fallen[0, replica] else ""
    return get_ending(recording, replica).label + after + fallen


def find_marks(recording: Recording, replica: int) -> tuple[tuple[float, str], ...]:
    """First stumble, first collision, fall, stuck and end of an episode that has frames, in the order of time.

    Stumbles and collisions are those that the penalties count; a robot without a penalty for collisions has one
    at the first recorded touch of base or limb. It falls when it leans further than the limit for the first time.
    """
    frames = int(recording.num_frames[0, replica])
    sums = recording.penalties[0, replica, :frames]
    grows = dict(zip(recording.penalty_names, (np.diff(sums, axis=0, prepend=sums[:1]) > 0.0).T, strict=True))
    bodies = [k for k, name in enumerate(recording.geom_names) if name not in recording.foot_names]
    touches = recording.touching[0, replica, :frames][:, bodies].any(axis=1)
    events: dict[str, NDArray[np.bool_]] = {
        "first stumble": grows.get("stumble", np.zeros(frames, bool)),
        "first collision": grows.get("collision", touches),
        "fall": leans(recording, replica),
    }
    marks = [(recording.dt * int(np.argmax(when)), label) for label, when in events.items() if when.any()]
    if recording.outcome[0, replica] == Outcome.TIME_OUT and not events["fall"].any():
        marks.append((find_failure_time(recording, replica), "stuck"))
    marks.append((recording.dt * (frames - 1), f"end: {get_ending(recording, replica).label}"))
    return tuple(sorted(marks, key=lambda mark: mark[0]))


def group_episodes(recording: Recording) -> list[tuple[str, list[tuple[int, str]]]]:
    """Numbers of the episodes of one terrain, from 1, and how each ended, by ending, the commonest first."""
    groups = defaultdict[str, list[tuple[int, str]]](list)
    for k in range(recording.num_episodes):
        groups[get_ending(recording, k).label].append((k + 1, f"episode {k + 1}: {describe_ending(recording, k)}"))
    commonest_first = sorted(groups.items(), key=lambda group: -len(group[1]))
    return [(f"{len(members)} of {recording.num_episodes}: {label}", members) for label, members in commonest_first]


def trace_paths(recording: Recording, every: int = 10) -> list[tuple[NDArray[np.float32], tuple[int, ...]]]:
    """The base at every tenth frame and the last [m], (num_points, 3), and the outcome's colour, by episode."""
    colors = [ImageColor.getrgb(get_ending(recording, k).color) for k in range(recording.num_episodes)]
    chosen = [[*range(0, last, every), last] if last >= 0 else [] for last in (recording.num_frames[0] - 1).tolist()]
    return [(recording.base_position[0, k, chosen[k]], color) for k, color in enumerate(colors)]


class BodyShape(NamedTuple):
    """Shapes of one body that show the same touch, columns of ``robot.geom_names``, in its frame."""

    body: int
    touches: tuple[int, ...]
    is_foot: bool
    mesh: trimesh.Trimesh


def in_linear_light(colors: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Colours as on a screen (sRGB, 0 to 255) in linear light, in the same shape."""
    share = colors / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # sRGB's own curve
    return np.rint(255.0 * linear).astype(np.uint8)


def _mesh(vertices: NDArray[np.floating], faces: NDArray[np.integer], colors: NDArray[np.integer]) -> trimesh.Trimesh:
    """Triangles with a colour (sRGB) a vertex, or one of all."""
    colors = np.broadcast_to(in_linear_light(colors), (len(vertices), 3))
    return _joined([trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)])


def _joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    mesh = trimesh.util.concatenate(meshes)
    assert isinstance(mesh, trimesh.Trimesh)
    _ = mesh.vertex_normals  # once computed, an export has them
    return mesh


def arrow_mesh() -> trimesh.Trimesh:
    """An arrow along z, 1 m long when it is not scaled."""
    shaft = trimesh.creation.cylinder(radius=0.02, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, 0.75]], sections=_SEGMENTS)
    head = trimesh.creation.cone(radius=0.05, height=0.25, sections=_SEGMENTS)
    return _joined([shaft, head.apply_translation([0.0, 0.0, 0.75])])


def robot_shapes(skeleton: Skeleton, robot: RobotCfg) -> list[BodyShape]:
    """The visible shapes of a robot."""
    groups = dict[tuple[int, tuple[int, ...]], list[trimesh.Trimesh]]()
    for geom, touches in skeleton.touches.items():
        body = int(skeleton.model.geom_bodyid[geom]) - 1
        mesh, color = skeleton.shape(geom)
        groups.setdefault((body, touches), []).append(_mesh(mesh.vertices, mesh.faces, np.rint(255.0 * color)))
    first_foot = len(robot.geom_names) - len(robot.foot_geoms)
    return [
        BodyShape(body=body, touches=touches, is_foot=max(touches, default=0) >= first_foot, mesh=_joined(meshes))
        for (body, touches), meshes in groups.items()
    ]


def compute_view(name: str, width: int, height: int) -> View:
    """A view of :data:`_VIEWS`, for a picture of that size [pixels]."""
    phone, upright, wide = _VIEWS[name]
    return phone if width < PHONE else upright if width < height else wide


class Scene:
    """The 3-D view of a tab: at first an invisible robot."""

    def __init__(self, client: viser.ClientHandle, shapes: Sequence[BodyShape], num_bodies: int, num_feet: int) -> None:
        self._client = client
        self._shapes = shapes
        self._num_bodies = num_bodies
        scene = client.scene
        self.robot, self.bodies = self._add_bodies("/robot")
        self.shapes: list[Any] = []
        self.touched: list[Any] = []  # coloured copies of the shapes, visible in their place while they touch
        for k, shape in enumerate(shapes):
            name = f"/robot/{shape.body}/{k}"
            self.shapes.append(scene.add_mesh_trimesh(name, shape.mesh, receive_shadow=False))
            color = FOOT_TOUCH if shape.is_foot else TOUCH
            self.touched.append(self._add_mesh(f"{name}-touched", shape.mesh, color, cast_shadow=True))
        self.ghost, self.ghost_bodies = self._add_bodies("/ghost")
        self._ghost_name = scene.add_label("/ghost/name", "", anchor="bottom-center")
        self._has_ghost = False  # its shapes are sent with the first one
        # Meshes that are moved, as the bodies are: arrows of changing points stay behind in the browser at times.
        arrow = arrow_mesh()
        self.forces = [self._add_mesh(f"/forces/{k}", arrow, FORCE_COLOR) for k in range(num_feet)]
        self._command = self._add_mesh("/command", arrow, COMMAND_COLOR)
        self.paths: list[Any] = []
        self._followed: Points | None = None
        self.follow = False

    def _add_bodies(self, name: str) -> tuple[Any, list[Any]]:
        """An invisible frame, and a frame in it for each body of the robot."""
        add = self._client.scene.add_frame
        whole = add(name, show_axes=False, visible=False)
        return whole, [add(f"{name}/{k}", show_axes=False) for k in range(self._num_bodies)]

    def set_terrain(self, heights: NDArray[np.floating], ground: GroundMaps | None = None) -> None:
        """Show another terrain and no crossing on it: heights [m], shape (nrow, ncol), row along y.

        It is blue below 0 and brown above, with a darker line every metre; friction and softness tint it.
        """
        start = CrossingCfg.start
        goal = places(asked_of(ground)).get("goal")
        scene = self._client.scene
        color = 255.0 * (height_colors(heights) if ground is None else tinted(height_colors(heights), ground))
        every = round(1.0 / SPACING)
        color[::every] *= _LINE_DARKNESS
        color[:, ::every] *= _LINE_DARKNESS
        surface = _mesh(*surface_of(heights), color.reshape(-1, 3).astype(np.uint8))
        with self._client.atomic():
            self.hide_crossing()
            scene.add_mesh_trimesh("/terrain", surface, cast_shadow=False, receive_shadow=0.45)
            low = float(surface_heights(heights, *np.array(start)))
            scene.add_cylinder("/start/disc", _START_RADIUS, color=(255, 255, 255), position=(*start, low), **_DISC)
            before = (start[0] - _START_RADIUS, start[1], low)
            scene.add_label("/start/label", "start", position=before, anchor="top-center")
            if goal is None:
                return
            high, radius = float(surface_heights(heights, *np.array(goal))), CrossingCfg.goal_radius
            scene.add_cylinder("/goal/disc", radius, color=_GOAL_COLOR, position=(*goal, high), **_DISC)
            scene.add_cylinder("/goal/post", 0.03, 1.0, _GOAL_COLOR, position=(*goal, high + 0.5))
            scene.add_label("/goal/label", "goal", position=(*goal, high + 1.0), anchor="bottom-center")
            way = np.linspace(start, goal, round(math.dist(start, goal) / SPACING) + 1)  # along the ground
            points = np.column_stack([way, surface_heights(heights, *way.T) + 0.03])
            dashes = np.stack([points[:-1], points[1:]], axis=1)[::2]
            scene.add_line_segments("/way/line", dashes, colors=(240, 200, 60), thickness=0.02)

    def hide_crossing(self) -> None:
        """Show the terrain alone."""
        self._followed = None
        for handle in (self.robot, self.ghost, self._command, *self.forces):
            handle.visible = False
        self.set_paths(None)

    def set_paths(self, recording: Recording | None) -> None:
        """Show the path of the base in every episode of a recording, or none."""
        for handle in self.paths:
            handle.remove()
        self.paths = []
        if recording is not None:
            paths = trace_paths(recording)
            ends = np.concatenate([np.stack([points[:-1], points[1:]], axis=1) for points, _ in paths])
            colors = np.concatenate([np.tile(color, (len(points[1:]), 2, 1)) for points, color in paths])
            look: Any = {"thickness": 1.2, "thickness_units": "screen", "visible": not self.follow}
            self.paths = [self._client.scene.add_line_segments("/paths", ends, in_linear_light(colors), **look)]

    def set_follow(self, follow: bool) -> None:
        """Follow the robot from now on, or stay."""
        self.follow = follow
        for handle in self.paths:
            handle.visible = not follow  # near the robot, paths would hide it
        if follow and self._followed is not None:
            self.go_to((tuple(self._followed + _BEHIND), tuple(self._followed)))

    def show_frame(self, crossing: Crossing, frame: int) -> None:
        """Put the robot where it is at a frame of a crossing, with what touches, its forces and command."""
        touching = crossing.recording.touching[0, crossing.replica, frame]
        with self._client.atomic():
            self.robot.visible = True
            _move_bodies(self.bodies, crossing, frame)
            for shape, alone, touched in zip(self._shapes, self.shapes, self.touched, strict=True):
                touched.visible = bool(touching[list(shape.touches)].any())
                alone.visible = not touched.visible
            set_arrow(self._command, crossing.command[frame])
            for handle, arrow in zip(self.forces, crossing.forces[frame], strict=True):
                set_arrow(handle, arrow)
        before = self._followed
        self._followed = base = crossing.positions[frame, 0].copy()
        if self.follow and before is None:
            self.set_follow(True)
        elif self.follow:  # what the camera looks at goes with it
            self._client.camera.position = self._client.camera.position + (base - before)

    def show_ghost(self, crossing: Crossing, frame: int, label: str) -> None:
        """Put a second, translucent robot where it is at a frame of its own crossing, with a label over it."""
        with self._client.atomic():
            for k, shape in enumerate(() if self._has_ghost else self._shapes):
                name = f"/ghost/{shape.body}/{k}"
                self._add_mesh(name, shape.mesh, OTHER_CONTROLLER, opacity=0.4, visible=True)
            self._has_ghost = True
            self.ghost.visible = True
            _move_bodies(self.ghost_bodies, crossing, frame)
            self._ghost_name.text = label
            self._ghost_name.position = tuple(crossing.positions[frame, 0] + [0.0, 0.0, 0.35])

    def _add_mesh(self, name: str, mesh: trimesh.Trimesh, color: Color, **look: Any) -> Any:
        """A shape of one colour; by default invisible and without shadow."""
        look = {"visible": False, "cast_shadow": False, "receive_shadow": False} | look
        shape: Any = (np.asarray(mesh.vertices), np.asarray(mesh.faces))
        return self._client.scene.add_mesh_simple(name, *shape, color=color, **look)

    def go_to(self, view: View) -> None:
        """Move the camera."""
        with self._client.atomic():
            self._client.camera.position, self._client.camera.look_at = view


def _move_bodies(bodies: Sequence[Any], crossing: Crossing, frame: int) -> None:
    for handle, position, turn in zip(bodies, crossing.positions[frame], crossing.quaternions[frame], strict=True):
        handle.position = tuple(position)
        handle.wxyz = tuple(turn)


def set_arrow(handle: Any, arrow: Points) -> None:
    """Show an :func:`arrow_mesh` from one point to another, shape (2, 3), unless it has no length."""
    way = arrow[1] - arrow[0]
    handle.visible = bool(way.any())
    if handle.visible:
        turn = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], way)
        handle.wxyz = trimesh.transformations.quaternion_from_matrix(turn)
        handle.position = tuple(arrow[0])
        handle.scale = (1.0, 1.0, float(np.linalg.norm(way)))
