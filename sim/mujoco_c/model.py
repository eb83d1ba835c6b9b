"""The crossing written a second time, from the definitions, for plain MuJoCo C with its own heightfield contact.

Nothing of the parallel simulation is used, neither its kernels nor its contact: model, observation, command and
penalties in float64 NumPy. The benchmark and the tests hold the kernels against them. States are MuJoCo's: the
quaternion is wxyz, the base's linear velocity that of its origin in the world frame, its angular velocity in the base
frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import LOOKAHEAD, SEGMENTS, Kind
from kernels.ground import FIRM
from kernels.penalties import PENALTIES, PlainStep
from kernels.route import CALM_S, LEAST_SPEED, WINDOW_S
from kernels.route import SEGMENTS as ROUTE_SEGMENTS
from sim.crossing import GROUND_FRICTION, CrossingCfg, find_highest_command
from sim.robots.compiled import mj, robot_spec, rotation_matrix
from sim.robots.robot import RobotCfg
from sim.terrains.conditions.kinds import condition_genes, split_row
from sim.terrains.hand_crafted import SPACING
from sim.terrains.maps.heightmap import QUARTER_TURN, Margins, as_hfield
from sim.terrains.terrains import PATCHES, GroundMaps

_MARGIN = 70  # nodes, 3.5 m of edge height on each side: a crossing may leave the grid by 2 m
_MEMORY = 4 << 20  # bytes

Array = NDArray[np.float64]
Heights = NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Initial states in MuJoCo's convention, one row an episode."""

    qpos: Array
    """Base position [m], quaternion wxyz, joint angles [rad]; shape (num_episodes, 7 + num_joints)."""
    qvel: Array
    """Velocity of the base's origin, world frame [m/s]; its angular velocity, base frame [rad/s]; joint velocities
    [rad/s]; shape (num_episodes, 6 + num_joints)."""
    streams: NDArray[np.uint32] | None = None
    """Random streams of the episodes, by which conditions draw, shape (num_episodes,); zeros if None."""

    def __getitem__(self, rows: slice) -> "Starts":
        streams = None if self.streams is None else self.streams[rows]
        return Starts(qpos=self.qpos[rows], qvel=self.qvel[rows], streams=streams)

    @classmethod
    def of_newton(
        cls,
        joint_q: NDArray[Any],
        joint_qd: NDArray[Any],
        base_com: NDArray[Any],
        streams: NDArray[np.uint32] | None = None,
    ) -> "Starts":
        """Newton's joint state as MuJoCo's.

        Newton's has shapes (num, 7 + num_joints), quaternion xyzw, and (num, 6 + num_joints), velocity of the base's
        mass centre, which is at ``base_com`` in its frame [m], and angular velocity, world frame.
        """
        qpos = joint_q.astype(np.float64)
        qvel = joint_qd.astype(np.float64)
        qpos[:, 3:7] = joint_q[:, [6, 3, 4, 5]]
        for k, quaternion in enumerate(qpos[:, 3:7]):
            to_world = rotation_matrix(quaternion)
            qvel[k, :3] -= np.cross(qvel[k, 3:6], to_world @ base_com)
            qvel[k, 3:6] = to_world.T @ qvel[k, 3:6]
        return cls(qpos=qpos, qvel=qvel, streams=streams)


def crossing_model(
    robot: RobotCfg, heights: Heights, *, time_constant_s: float | None = None, ground: GroundMaps | None = None
) -> Any:
    """The robot's file on MuJoCo's heightfield, with a sensor of the net contact force on each geom with a role.

    The solver may take as many iterations as it needs: the caps of the parallel simulation are themselves in question.
    Level ground is a plane. Ground with maps is a geom a patch, whose friction and softness have priority over those of
    the robot: a box where the patch is level, else a heightfield. Patches that follow each other along the way are one
    where they are alike in every row.

    Heights [m] have shape (nrow, ncol), at :data:`sim.terrains.hand_crafted.SPACING`; ``ground`` is that of this one
    terrain. The contact time constant [s] is of all geoms, critically damped; the file's if None.
    """
    spec = robot_spec(robot)
    spec.memory = _MEMORY
    option = spec.option
    option.timestep = robot.physics_dt
    option.iterations = 100
    option.ls_iterations = 50
    option.integrator = mj.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mj.mjtCone.mjCONE_ELLIPTIC
    option.disableflags = mj.mjtDisableBit.mjDSBL_AUTORESET  # or a state that blows up would begin anew unseen
    plain = ground is None or ((ground.friction == 1.0).all() and (ground.time_constant_s == FIRM).all())
    patches = None
    if ground is not None and not plain:
        patches = _add_patches(spec, heights, ground)
    elif np.ptp(heights) == 0.0:  # small feet on soft contacts sink into a heightfield, whose facets push them aside
        _add_geom(spec, GROUND, (0.0, 0.0, float(heights[0, 0])), type=mj.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1))
    else:
        _add_field(spec, heights, GROUND)
    for name in robot.geom_names:
        spec.add_sensor(
            name=name, type=mj.mjtSensor.mjSENS_CONTACT, objtype=mj.mjtObj.mjOBJ_GEOM, objname=name,
            intprm=[1 << mj.mjtConDataField.mjCONDATA_FORCE.value, 3, 1],
        )  # fmt: skip
    model = spec.compile()
    if time_constant_s is not None:
        model.geom_solref[:] = time_constant_s, 1.0
    if patches is not None:
        _lay_ground(model, robot, *patches)
    return model


NO_SOFTNESS = (
    "plain MuJoCo cannot have soft ground that is not level, since a foot that sinks into its heightfield is pushed "
    "aside by the facets beside it: leave MuJoCo C out, or +softness"
)
"""Why spaces of soft ground are refused."""
GROUND = "faultline/ground"  # no name of a robot's geom begins so
_DEPTH = 2.0  # of a level patch [m]


def _add_field(
    spec: Any, heights: Heights, name: str, low: tuple[float, float] = (0.0, 0.0), margin: int | Margins = _MARGIN
) -> None:
    """Adds a heightfield whose first node stands at ``low`` [m]."""
    field = as_hfield(heights, margin=margin)
    rows, columns = field.data.shape
    spec.add_hfield(name=name, nrow=rows, ncol=columns, size=field.size, userdata=field.data.ravel())
    x, y, z = field.position
    looks = {"type": mj.mjtGeom.mjGEOM_HFIELD, "hfieldname": name, "quat": QUARTER_TURN}
    _add_geom(spec, name, (x + low[0], y + low[1], z), **looks)


def _add_geom(spec: Any, name: str, position: tuple[float, float, float], **looks: Any) -> None:
    # The robot's geoms collide with nothing by themselves (conaffinity 0); the ground must offer itself.
    # solmix 0: the stiffness of a contact is the robot's. All is said, or defaults of the robot's file would hold.
    spec.worldbody.add_geom(
        name=name, pos=position, contype=0, conaffinity=1, condim=3, friction=(GROUND_FRICTION, 0.005, 0.0001),
        margin=0.0, gap=0.0, priority=0, solmix=0.0, **looks,
    )  # fmt: skip


def _add_patches(spec: Any, heights: Heights, ground: GroundMaps) -> tuple[Array, Array]:
    """Adds boxes where patches are level, else heightfields; returns friction and time constant of each geom."""
    maps = np.stack([ground.friction[0], ground.time_constant_s[0]], axis=-1).astype(np.float64)
    changes = 1 + np.flatnonzero((maps[:, 1:] != maps[:, :-1]).any(axis=(0, 2)))
    rows, cols = pairwise(range(PATCHES[0] + 1)), pairwise([0, *changes.tolist(), PATCHES[1]])
    values = []
    for number, (row, col) in enumerate(product(rows, cols)):
        name = f"{GROUND}-{number}" if number else GROUND
        # Nodes of the patch along y and x, and those that continue the edge, before and behind.
        axes = tuple(zip((row, col), PATCHES, heights.shape, strict=True))
        (y0, y1), (x0, x1) = ([end * (nodes - 1) // count for end in span] for span, count, nodes in axes)
        margin_y, margin_x = ((_MARGIN * (span[0] == 0), _MARGIN * (span[1] == count)) for span, count, _ in axes)
        patch = heights[y0 : y1 + 1, x0 : x1 + 1]
        values.append(maps[row[0], col[0]])
        if np.ptp(patch) > 0.0:
            if values[-1][1]:
                raise ValueError(NO_SOFTNESS)
            _add_field(spec, patch, name, (SPACING * x0, SPACING * y0), (margin_y, margin_x))
            continue
        sides = ((x0 - margin_x[0], x1 + margin_x[1]), (y0 - margin_y[0], y1 + margin_y[1]))
        (x, half_x), (y, half_y) = ((SPACING * (low + high) / 2, SPACING * (high - low) / 2) for low, high in sides)
        middle = (x, y, float(patch[0, 0]) - _DEPTH / 2)
        _add_geom(spec, name, middle, type=mj.mjtGeom.mjGEOM_BOX, size=(half_x, half_y, _DEPTH / 2))
    friction, time_constant = np.transpose(values)
    return friction, time_constant


def _lay_ground(model: Any, robot: RobotCfg, friction: Array, time_constant: Array) -> None:
    """Gives the geoms of the patches their contacts' friction and softness."""
    geoms = np.flatnonzero([model.geom(k).name.startswith(GROUND) for k in range(model.ngeom)])
    of_robot = (model.geom_contype != 0) & (model.geom_bodyid > 0)
    for name in ("friction", "solref", "solimp"):
        if np.ptp(getattr(model, f"geom_{name}")[of_robot], axis=0).any():
            rule = f"needs one {name} of all its geoms on ground with friction or softness of its own"
            remedy = "leave +friction and +softness out"
            raise ValueError(f"robot '{robot.name}': plain MuJoCo {rule}, got several: {remedy}")
    first = int(np.flatnonzero(of_robot)[0])
    model.geom_friction[geoms] = model.geom_friction[first]
    model.geom_friction[geoms, 0] = max(model.geom_friction[first, 0], GROUND_FRICTION) * friction
    model.geom_solref[geoms] = model.geom_solref[first]
    model.geom_solimp[geoms] = model.geom_solimp[first]
    soft = time_constant > max(model.geom_solref[first, 0], 0.0)
    impedance = model.geom_solimp[first, 1]
    model.geom_solref[geoms[soft]] = np.stack([time_constant[soft], np.ones(soft.sum())], axis=1)
    model.geom_solimp[geoms[soft]] = impedance, impedance, 0.001, 1.0, 0.5
    model.geom_priority[geoms] = 1


def surface_heights(heights: Heights, x: Array, y: Array) -> Array:
    """Height [m] of the triangulated grid at world-local points.

    Each cell is cut from its (low x, high y) to its (high x, low y) corner. Heights [m] have shape (nrow, ncol); beyond
    its edge the edge height continues. Points are x and y [m] of any one shape.
    """
    num_rows, num_cols = heights.shape
    column = np.clip(x / SPACING, 0.0, num_cols - 1)
    row = np.clip(y / SPACING, 0.0, num_rows - 1)
    j = np.minimum(column.astype(int), num_cols - 2)
    i = np.minimum(row.astype(int), num_rows - 2)
    u = column - j
    v = row - i
    corner, nodes = num_cols * i + j, heights.ravel()
    near, along_x, along_y, far = (nodes[corner + further] for further in (0, 1, num_cols, num_cols + 1))
    lower = near + u * (along_x - near) + v * (along_y - near)
    upper = far + (1 - u) * (along_y - far) + (1 - v) * (along_x - far)
    return np.where(u + v <= 1, lower, upper)


def _unit_quaternions(qpos: Array) -> Array:
    """Rows w, x, y, z, shape (4, num)."""
    return (qpos[:, 3:7] / np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)).T


def _rotations(qpos: Array) -> Array:
    """Matrices (num, 3, 3) that turn base-frame vectors into the world frame."""
    w, x, y, z = _unit_quaternions(qpos)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _base_velocity(rotations: Array, qvel: Array) -> Array:
    """Velocity of the base's origin in the base frame [m/s], shape (num, 3)."""
    return np.einsum("nij,ni->nj", rotations, qvel[:, :3])


def _heading(qpos: Array) -> Array:
    w, x, y, z = _unit_quaternions(qpos)
    return np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def goal_commands(qpos: Array, speed: float) -> Array:
    """Commanded v_x, v_y [m/s] and yaw rate [rad/s] toward the goal, yaw frame, shape (num, 3)."""
    to_goal = np.array(CrossingCfg.goal) - qpos[:, :2]
    error = _wrap(np.arctan2(to_goal[:, 1], to_goal[:, 0]) - _heading(qpos))
    yaw_rate = np.clip(CrossingCfg.yaw_gain * error, -CrossingCfg.max_yaw_rate, CrossingCfg.max_yaw_rate)
    return np.stack([speed * np.cos(error), speed * np.sin(error), yaw_rate], axis=1)


def steered_commands(qpos: Array, steering: NDArray[np.floating], highest: Sequence[float]) -> Array:
    """Commands of robots that are steered, (num, 3), by ways of shape (num, SEGMENTS, 3): :data:`STEERING`.

    They are no larger than ``highest`` (:func:`sim.crossing.find_highest_command`).
    """
    start, goal = np.array(CrossingCfg.start), np.array(CrossingCfg.goal)
    length = np.linalg.norm(goal - start)
    along = (goal - start) / length
    reached = (qpos[:, :2] - start) @ along
    segment = np.clip(np.floor(reached / length * SEGMENTS).astype(int), 0, SEGMENTS - 1)
    speed, offset, heading = steering[np.arange(len(qpos)), segment].astype(np.float64).T
    ahead = reached + float(LOOKAHEAD)
    place = start + np.outer(ahead, along) + np.outer(offset, [-along[1], along[0]])
    way = np.where((ahead < length)[:, None], place, goal) - qpos[:, :2]
    error = _wrap(np.arctan2(way[:, 1], way[:, 0]) - _heading(qpos))
    turn = CrossingCfg.yaw_gain * _wrap(error + heading)
    commands = np.stack([speed * np.cos(error), speed * np.sin(error), turn], axis=1)
    return np.clip(commands, CrossingCfg.lowest_command, highest)


class Routes:
    """Commands of robots that are to follow a route or to stand, and how far they are off it, by control steps."""

    def __init__(self, robot: RobotCfg, row: Array, count: int, stray_m: float) -> None:
        """``row`` are conditions of a terrain with ``count`` robots, ``stray_m`` how far they may miss it [m]."""
        self.kind, self._robot, self._stray_m = Kind(int(row[-1])), robot, stray_m
        values = {gene.name: value for gene, value in zip(condition_genes(), row, strict=False)}
        names = ([f"segment_{k + 1}_{axis}" for axis in ("x", "y", "turn")] for k in range(ROUTE_SEGMENTS))
        self._segments = np.array([[values[name] for name in segment] for segment in names])
        pushes = [values_of for condition, values_of in split_row(row) if condition.moment]
        self._pushed_s = [time_s for x, y, time_s, *_ in pushes if x or y]
        self._walked, self._told = list[Array](), [np.zeros((count, 3))]
        self.strayed = np.zeros(count, int)

    def command(self, qpos: Array, time_s: float) -> Array:
        """Commands of all robots for the next control step, (count, 3); counts their steps in a row off the route."""
        robot = self._robot
        self._walked.append(np.column_stack([qpos[:, :2], _heading(qpos)]))
        window = round(WINDOW_S / robot.control_dt)
        if len(self._walked) > window:
            ours, theirs = (_moves(poses[-1 - window], poses[-1]) for poses in (self._walked, self._told))
            off = np.linalg.norm(ours - theirs, axis=1) > self._stray_m
            if not any(0.0 <= time_s - pushed < float(CALM_S) for pushed in self._pushed_s):
                self.strayed = np.where(off, self.strayed + 1, 0)
        command = np.zeros(3)
        if self.kind == Kind.ROUTE:
            x, y, turn = self._segments[min(int(time_s / robot.max_duration_s * ROUTE_SEGMENTS), ROUTE_SEGMENTS - 1)]
            moves = robot.speed * (np.hypot(x, y) >= float(LEAST_SPEED))
            command = np.array([moves * x, moves * y, turn * (abs(turn) >= float(LEAST_SPEED))])
            command = np.clip(command, CrossingCfg.lowest_command, find_highest_command(CrossingCfg(), robot))
        here, dt = self._told[-1], robot.control_dt
        yaw = here[:, 2] + 0.5 * dt * command[2]
        ahead, aside = np.stack([np.cos(yaw), np.sin(yaw)]), np.stack([-np.sin(yaw), np.cos(yaw)])
        moved = dt * (command[0] * ahead + command[1] * aside)
        self._told.append(here + np.column_stack([moved.T, np.full(len(here), dt * command[2])]))
        return np.tile(command, (len(qpos), 1))


def _moves(before: Array, after: Array) -> Array:
    """Displacements between poses, x, y [m] and yaw, (count, 3), in the frames of the first; shape (count, 2)."""
    (x, y), yaw = (after[:, :2] - before[:, :2]).T, before[:, 2]
    return np.column_stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x])


def distances_from_line(qpos: Array) -> Array:
    """Distance of bases from the straight line through start and goal [m], shape (num,)."""
    start, along = np.array(CrossingCfg.start), np.subtract(CrossingCfg.goal, CrossingCfg.start)
    beside = qpos[:, :2] - start
    return np.abs(along[0] * beside[:, 1] - along[1] * beside[:, 0]) / np.linalg.norm(along)


def _wrap(angle: Array) -> Array:
    return np.arctan2(np.sin(angle), np.cos(angle))


def observations(
    heights: Heights, qpos: Array, qvel: Array, command: Array, last_action: Array, *,
    default_joint_pos: Array, scan: NDArray[np.floating],
) -> Array:  # fmt: skip
    """Observation rows, shape (num, observation_size); order and scales as the controllers of the field expect them.

    States have shapes (num, 7 + num_joints) and (num, 6 + num_joints), commands (num, 3), actions (num, num_joints);
    heights [m] (nrow, ncol); scan points ahead and left of the base, yaw frame [m], (num_scan_points, 2).
    """
    rotations = _rotations(qpos)
    heading = _heading(qpos)[:, None]
    scan_x, scan_y = scan.T.astype(np.float64)
    x = qpos[:, 0:1] + np.cos(heading) * scan_x - np.sin(heading) * scan_y
    y = qpos[:, 1:2] + np.sin(heading) * scan_x + np.cos(heading) * scan_y
    return np.concatenate(
        [
            2.0 * _base_velocity(rotations, qvel),
            0.25 * qvel[:, 3:6],
            -rotations[:, 2, :],  # gravity's direction in the base frame
            command * [2.0, 2.0, 0.25],
            qpos[:, 7:] - default_joint_pos,
            0.05 * qvel[:, 6:],
            last_action,
            5.0 * np.clip(qpos[:, 2:3] - 0.5 - surface_heights(heights, x, y), -1.0, 1.0),
        ],
        axis=1,
    )


def step_penalties(
    qpos: Array, qvel: Array, command: Array, forces: Array, *, feet: NDArray[np.bool_], force_limit: float
) -> Array:
    """Raw penalties of one physics step, before times dt, shape (num, num_penalties), columns :data:`PENALTIES`.

    States and commands are those of :func:`observations`; contact forces on each geom with a role, world frame [N],
    have shape (num, num_geoms, 3). ``feet``, shape (num_geoms,), may be touched; up to the limit [N] it costs nothing.
    """
    base = {"velocity": _base_velocity(_rotations(qpos), qvel), "ang_vel": qvel[:, 3:6], "command": command}
    step = PlainStep(**base, forces=forces, feet=feet, force_limit=force_limit)
    return np.stack([penalty.plain(step).astype(float) for penalty in PENALTIES.values()], axis=1)
