"""Parallel robots on height grids, one world each: Newton's MuJoCo model, contact, steps and rewards of our own."""

import gc
import importlib
import math
from collections.abc import Callable, Collection
from dataclasses import asdict
from typing import Any

import mujoco_warp
import newton
import numpy as np
import warp as wp

from kernels.actuator_net import make_torques
from kernels.conditions import BASE as BASE_BODY
from kernels.conditions import Disturbed, DisturbedStep, ForcedStep, make_begin, make_disturb, make_robot_stage
from kernels.contact import Poses, collide_strips, make_contacts, sum_forces
from kernels.coordinates import Delay, SolverState, from_solver, limit_torques, to_solver
from kernels.episode import Episodes, Outcome
from kernels.ground import Ground
from kernels.launch import make_struct, make_zeros
from kernels.observation import Sensors, write_observation
from kernels.penalties import BASE, FOOT, LIMB
from kernels.queue import StartRanges, clear_rows, restart_episodes
from kernels.rewards import Motion, Rewards, make_rewards, make_weights, reward_steps
from kernels.state import RobotStep
from sim.crossing import GROUND_FRICTION, SolverCfg
from sim.device import recording
from sim.robots.actuator_net import ActuatorNet
from sim.robots.compiled import number_arm_actuators, number_arm_ends, number_links, robot_spec
from sim.robots.model import make_builder
from sim.robots.probes import make_probes
from sim.robots.robot import ActuatorNetCfg, RobotCfg
from sim.robots.training import NoiseCfg, TrainingCfg
from sim.solver import StockDynamics, make_dynamics
from sim.terrains.bank import TerrainBank
from sim.terrains.conditions.kinds import MAX_LATENCY_S, condition_effects
from sim.terrains.conditions.perception import MAX_MAP_DELAY_S

_SET_UP = (
    *("newton._src.solvers.mujoco.kernels", "newton._src.geometry.bvh", "newton._src.sim.articulation"),
    "mujoco_warp._src.set_const",
)
"""Modules with many kernels that run when a simulation is built, and never again."""
_NEEDED_LAST = (
    "mujoco_warp._src.smooth",
    *(f"kernels.{name}" for name in ("heightfield", "super_gaussian", "queue", "contact", "coordinates", "episode")),
    "kernels.observation",
)
"""Modules of kernels that a simulation takes late: first the slowest, then in the opposite order."""

if not wp.is_cuda_available():
    for _name in _SET_UP:  # the same numbers, in a third of the time
        wp.set_module_options({"optimization_level": 0}, module=importlib.import_module(_name))


def load_kernels(device: str) -> None:
    """Load the kernels that a simulation takes last, while another process compiles those that it takes first."""
    for name in _NEEDED_LAST:
        wp.load_module(name, device=device)


class Simulation:
    """``num_envs`` robots, each alone in a world of its own, in world-local coordinates on its terrain's grid.

    Attributes:
        joint_q: Joint coordinates, shape (num_envs, 7 + num_joints); layout in :mod:`kernels.state`.
        joint_qd: Joint velocities, shape (num_envs, 6 + num_joints).
        targets: Joint position targets [rad] in columns 7 and up, shape (num_envs, 7 + num_joints).
        geom_force: Contact force on each geom with a role in the last step, world frame [N], vectors of shape
            (num_envs, num_geoms) in the order of ``robot.geom_names``.
        geom_role: Role bits of :mod:`kernels.penalties`, shape (num_geoms,).
        joint_torque: Actuator torques of the last step [N m] in columns 6 and up, shape (num_envs, 6 + num_joints).
        overflow: mujoco_warp's overflow bits of the last step, shape (num_envs,).
        contacts: Terrain contacts of the last step.
        parked: 2 for robots that steps leave out, shape (num_envs,).
        poses: Poses of bodies at the beginning of the last step.
        column_of_shape: Column in ``geom_force`` of each collision shape of a robot, -1 for none.
        geom_of_shape: The solver's number of each.
        base_com: Mass centre of the base in its frame [m].
        dynamics: The solver's step, ours or mujoco_warp's.
        disturbed: What the conditions of running episodes need; None of a bank without conditions.
        motors: Effort limit [N m], stall torque [N m] and speed limit [rad/s] of each actuator, vectors of shape
            (num_actuators,); None without DC motors.
    """

    def __init__(
        self,
        robot: RobotCfg,
        bank: TerrainBank,
        terrain_of_env: np.ndarray,
        *,
        friction: np.ndarray | None = None,
        added_base_mass: np.ndarray | None = None,
        cfg: SolverCfg | None = None,
    ) -> None:
        """Build the model on the bank's device.

        Of shape (num_envs,) are the terrain of each environment, the Coulomb friction of each robot, the file's where
        None, and the mass added to each base [kg].
        """
        if terrain_of_env.min() < 0 or terrain_of_env.max() >= bank.num_terrains:
            got = f"{terrain_of_env.min()}..{terrain_of_env.max()}"
            raise ValueError(f"terrain_of_env must lie in 0..{bank.num_terrains - 1}, got {got}")
        if bank.device != "cpu":
            gc.collect()  # simulations that were closed lie in cycles, and hold their memory until they are collected
        self.robot = robot
        self.bank = bank
        self.device = bank.device
        self.num_envs = len(terrain_of_env)
        file_model = robot_spec(robot).compile()
        builder = make_builder(file_model)
        with wp.ScopedDevice(self.device):
            self.terrain_of_env = wp.array(terrain_of_env, dtype=int)
            self._build_model(builder)
            self._build_solver(cfg or SolverCfg(), file_model)
            self._randomise_model(friction, added_base_mass)
            self._build_contact(builder)
            self._build_views()
            self._build_conditions()

    def _build_model(self, builder: newton.ModelBuilder) -> None:
        scene = newton.ModelBuilder(gravity=builder.gravity)
        newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
        scene.rigid_gap = 0.0
        scene.default_shape_cfg.mu = GROUND_FRICTION
        # The plane only carries the ground's material: kernels.contact is the only collider. Without weight in the mix,
        # it leaves the stiffness of a contact to the robot's file alone.
        weight = {"mujoco:geom_solmix": 0.0}
        scene.add_shape_plane(plane=(0.0, 0.0, 1.0, 0.0), width=0.0, length=0.0, custom_attributes=weight)
        scene.add_world(builder)  # Newton and mujoco_warp set one robot up; all worlds share its numbers
        scene.validate_inertia_detailed = True  # the same for one robot in Python, without a kernel to compile
        self.model = scene.finalize()

    def _build_solver(self, cfg: SolverCfg, file_model: Any) -> None:
        impratio = float(file_model.opt.impratio)
        # Rows for mujoco_warp's own step: a limit and friction of every joint, and contacts.
        rows = file_model.neq + 2 * file_model.nv + int(file_model.geom_condim.max(initial=3)) * self.robot.nconmax
        # By the material's gain kf Newton gives friction a time constant of its own; a negative one leaves it MuJoCo's.
        self.model.shape_material_kf.fill_(-1.0)
        # Newton counts no contacts, and rows that do not fit have no effect.
        room = {"njmax": rows, "njmax_nnz": rows * file_model.nv, "nconmax": self.robot.nconmax}
        self.solver = newton.solvers.SolverMuJoCo(
            self.model,
            **room,
            iterations=cfg.iterations * (1 if impratio == 1.0 else 2),  # at 100, 8 are as good as any number
            ls_iterations=cfg.ls_iterations,
            cone="elliptic",
            integrator="implicitfast",
            impratio=impratio,
            use_mujoco_contacts=False,
            kinematic_switchable_roots=False,
            separate_worlds=True,
        )
        self.solver.mjw_model.opt.warn_overflow = 0
        # For mujoco_warp's own step: of thousands of robots one always needs the last iteration. A loop that the device
        # may leave early then only costs: 4 % of a step of 4,096 robots on an H200, 1 % of 32,768.
        self.solver.mjw_model.opt.graph_conditional = not self.model.device.is_cuda
        if cfg.time_constant_s is not None:
            self.solver.mjw_model.geom_solref.fill_(wp.vec2(cfg.time_constant_s, 1.0))
        self.solver.mjw_model.opt.timestep.fill_(self.robot.physics_dt)
        changed = newton.ModelFlags.BODY_INERTIAL_PROPERTIES
        # Newton makes a base's joint without armature, damping and friction, which only a change gives it.
        base = [self.model.joint_armature, self.model.joint_damping, self.model.joint_friction]
        if any(values.numpy()[:6].any() for values in base):
            changed |= newton.ModelFlags.JOINT_DOF_PROPERTIES
        self.solver.notify_model_changed(changed)
        solver: Any = self.solver
        solver.mjw_data = mujoco_warp.put_data(solver.mj_model, solver.mj_data, nworld=self.num_envs, **room)
        if self.robot.saturation_effort is not None:  # limits of torques, which follow speeds
            self._give_rows("actuator_forcerange")

    def _randomise_model(self, friction: np.ndarray | None, added_base_mass: np.ndarray | None) -> None:
        model = self.solver.mjw_model
        if friction is not None:
            values = self._give_rows("geom_friction")
            values[:, model.geom_bodyid.numpy() > 0, 0] = friction[:, None]
            model.geom_friction.assign(values)
        if added_base_mass is not None:
            mass = self._give_rows("body_mass")
            if not (mass[:, BASE_BODY] + added_base_mass > 0.0).all():
                base = f"{mass[0, BASE_BODY]:g}"
                rule = f"added_base_mass must leave some of the base's {base} kg, got {added_base_mass.min():g} kg"
                raise ValueError(f"{rule}: narrow its range in the robot's training settings")
            mass[:, BASE_BODY] += added_base_mass
            model.body_mass.assign(mass)
            for name in ("body_subtreemass", "body_invweight0", "dof_invweight0"):
                self._give_rows(name)
            # Enough as limits have solref of their own, and there are no tendons and no connects.
            with self.solver._scoped_mujoco_warp_execution():
                mujoco_warp.set_const(model, self.solver.mjw_data)

    def _give_rows(self, name: str) -> np.ndarray:
        """Gives an array of mujoco_warp's model a row for each world; returns a copy of its values."""
        model: Any = self.solver.mjw_model
        array = getattr(model, name)
        rows = np.repeat(array.numpy()[:1], self.num_envs, axis=0)
        setattr(model, name, wp.array(rows, dtype=array.dtype))
        return rows

    def _build_contact(self, builder: newton.ModelBuilder) -> None:
        geoms = self.solver.newton_shape_to_mjc_geom.numpy()  # that of the ground, then those of each robot
        self.geom_of_shape = geoms[1 : 1 + builder.shape_count]
        self.probes = make_probes(builder)
        self.contacts = make_contacts(self.num_envs, self.robot.nconmax)
        self.parked = wp.zeros(self.num_envs, dtype=int)
        # A mesh of several parts is several shapes of one name.
        robot = self.robot
        names = robot.geom_names
        columns = [names.index(name) if name in names else -1 for name in builder.shape_label]
        self.column_of_shape = wp.array(columns, dtype=int)
        roles = [BASE] * len(robot.base_geoms) + [LIMB] * len(robot.limb_geoms) + [FOOT] * len(robot.foot_geoms)
        self.geom_role = wp.array(roles, dtype=int)
        mjw = (self.solver.mjw_model, self.solver.mjw_data)
        self.dynamics = make_dynamics(*mjw, self.contacts, self.parked, self.geom_of_shape, int(geoms[0]))

    def _build_views(self) -> None:
        robot = self.robot
        num_envs = self.num_envs
        self.joint_q = wp.array(np.tile(self.model.joint_q.numpy(), (num_envs, 1)), dtype=float)
        self.joint_qd = wp.zeros((num_envs, self.model.joint_dof_count), dtype=float)
        self.targets = wp.zeros(self.joint_q.shape, dtype=float)
        self.geom_force = wp.zeros((num_envs, len(robot.geom_names)), dtype=wp.vec3)
        self.joint_torque = self.solver.mjw_data.qfrc_actuator
        self.overflow = self.solver.mjw_data.overflow
        self.base_com = wp.vec3(*self.model.body_com.numpy()[0])
        # Columns of joints, bodies and targets in mujoco_warp's data, the same for all robots.
        solver: Any = self.solver
        columns = solver.mj_q_start.numpy()[1 : 1 + robot.num_joints]  # the first is the base's
        moved = solver.mj_model.jnt_qposadr[solver.mj_model.actuator_trnid[:, 0]]
        joints = [int(np.flatnonzero(columns == column)[0]) for column in moved]
        *_, num_position, num_quat, num_feet, num_torques = robot.column_sizes
        scan_x, scan_y = robot.scan_points()
        numbers = {"default_joint_pos": robot.default_joint_pos, "scan_x": scan_x, "scan_y": scan_y}
        feet = len(robot.geom_names) - num_feet + np.arange(num_feet)
        indices = {"foot_columns": feet, "torque_columns": columns[:num_torques] - 1}
        arrays = {name: wp.array(row, dtype=float) for name, row in numbers.items()}
        arrays |= {name: wp.array(row, dtype=int) for name, row in indices.items()}
        self.sensors = make_struct(Sensors, num_pose=num_position + num_quat, **arrays)
        bodies = np.argsort(solver.mjc_body_to_newton.numpy()[0])  # what is no body of the robot is -1, and comes first
        self._coordinates = make_struct(
            SolverState,
            solver.mjw_data,
            column_of_joint=wp.array(columns, dtype=int),
            target_of_actuator=wp.array(7 + np.array(joints, dtype=int), dtype=int),
            base_com=self.base_com,
        )
        of_robot = bodies[len(bodies) - self.model.body_count :]
        self.poses = make_struct(Poses, solver.mjw_data, column_of_body=wp.array(of_robot, dtype=int))
        # Speed-dependent torque limits and a delay of targets, which ideal drives lack.
        self.motors = None
        if robot.saturation_effort is not None:
            effort = solver.mjw_model.actuator_forcerange.numpy()[0, :, 1]
            motors = np.array([robot.saturation_effort, robot.velocity_limit])[:, joints]
            self.motors = wp.array(np.stack([effort, *motors], axis=1), dtype=wp.vec3)
        self._net = None if robot.actuator_net is None else self._build_net(robot.actuator_net)
        max_steps = robot.drive_delay_steps
        if self.bank.conditions is not None:
            max_steps += math.ceil(MAX_LATENCY_S / robot.physics_dt)
        self._delay = Delay()
        if max_steps:
            shapes = {"age": (num_envs, len(joints)), "former": (num_envs, 1 + max_steps, len(joints))}
            self._delay = make_zeros(Delay, self.device, steps=num_envs, **shapes)
            self._delay.steps.fill_(robot.drive_delay_steps)
            self._delay.at_first = self.sensors.default_joint_pos

    def _build_net(self, cfg: ActuatorNetCfg) -> tuple[Any, ...]:
        net = ActuatorNet(cfg)
        how = {name: getattr(net, name) for name in ("num_recurrent", "activation", "history")}
        width = max(layer.shape[1] + 3 for layer in net.layers)  # dense units come in fours
        self._write_torques = make_torques(width, decimation=cfg.decimation, **how)
        num_columns = 2 + 2 * net.history + 2 * sum(net.sizes[: net.num_recurrent])
        rows = [np.pad(layer, ((0, -len(layer) % 4), (0, 0))).reshape(4, -1, layer.shape[1]) for layer in net.layers]
        return (
            wp.array(np.concatenate([four.transpose(1, 2, 0).reshape(-1, 4) for four in rows]), dtype=wp.vec4),
            wp.array(net.sizes, dtype=int),
            wp.array(net.inputs, dtype=int),
            wp.zeros((*self.solver.mjw_data.ctrl.shape, num_columns), dtype=float),
        )

    def _build_conditions(self) -> None:
        self.disturbed = None
        if self.bank.conditions is None:
            return
        if isinstance(self.dynamics, StockDynamics):
            reason = "its model takes mujoco_warp's own step (sim/solver.py says why): leave conditions out"
            raise ValueError(f"robot '{self.robot.name}' cannot have conditions, since {reason}")
        assert self.bank.ground is not None
        robot = self.robot
        drives = {"drive_delay": robot.drive_delay_steps, "delay_steps": self._delay.steps}
        rows = (self.num_envs, self.bank.conditions.shape[1])
        former = (self.num_envs, 1 + math.ceil(MAX_LATENCY_S / robot.control_dt), robot.observation_size)
        poses = (self.num_envs, 1 + 2 * math.ceil(MAX_MAP_DELAY_S / robot.control_dt))
        maps = {"map_pose": poses, "map_drift": (self.num_envs, 2), "held": (self.num_envs, len(self.sensors.scan_x))}
        of_each = dict.fromkeys(("steps", "is_misled", "map_view"), self.num_envs)
        self.disturbed = make_zeros(Disturbed, self.device, row=rows, former=former, **of_each, **maps)
        drives |= {"friction": self.bank.ground.factor, "is_misled": self.disturbed.is_misled}
        self._varied = self.dynamics.vary_bases(**drives, physics_dt=robot.physics_dt)
        self.disturbed.noise = self.make_noise(NoiseCfg())
        arms = number_arm_actuators(robot, self._coordinates.target_of_actuator.numpy() - 7)
        numbers = {"links": number_links(robot), "arm_actuators": arms, "arm_ends": number_arm_ends(robot)}
        arrays = {name: wp.array(values, dtype=int) for name, values in numbers.items()}
        self._forced = self.dynamics.view_forces(memory=self.disturbed, dt=robot.physics_dt, **arrays)

    def set_drive_delays(self, steps: np.ndarray) -> None:
        """Let targets of each robot be late by so many physics steps, at most the robot's ``drive_delay_steps``."""
        if self._delay.steps is not None:
            self._delay.steps.assign(steps)

    def make_noise(self, cfg: NoiseCfg) -> Any:
        """Half widths of the noise of each column of an observation, shape (observation_size,)."""
        return wp.array(cfg.column_widths(self.robot.column_sizes), dtype=float, device=self.device)

    def make_step(self, command: Any, action: Any) -> RobotStep:
        """A view of the robots at the end of a step that obeys the command (num_envs, 3) by the clipped action."""
        return make_struct(RobotStep, self, command=command, action=action, force_limit=self.robot.contact_force_limit)

    def restart(self, mask: Any, step: RobotStep, ranges: StartRanges, episodes: Episodes, rewards: Rewards) -> None:
        """Begin episodes anew where the int ``mask`` (num_envs,) is not 0, under the conditions of their terrains.

        Robots stand at new starts, and nothing is remembered of the episode before: its action, rewards, solver.
        """
        where = (self.terrain_of_env, self.bank.terrain)
        restart_episodes(mask, *where, ranges, self.sensors, step, episodes, rewards)
        self.clear_solver(mask)
        self.begin_conditions(mask)

    def observe(
        self, step: RobotStep, episodes: Episodes, dt: float, noise: Any, noise_seed: Any, observation: Any
    ) -> None:
        """Write what robots observe before their next control step, (num_envs, observation_size).

        By the conditions of their terrains they are pushed, and what they observe is disturbed. Episodes count steps of
        ``dt`` [s]. Noise is drawn from ``noise_seed``, (1,), and the environment's index.
        """
        where = (self.terrain_of_env, self.bank.terrain)
        is_misled = None if self.disturbed is None else self.disturbed.is_misled
        write_observation(step, *where, self.sensors, is_misled, noise, noise_seed, observation)
        self.disturb(episodes, dt, observation)

    def begin_conditions(self, begins: Any) -> None:
        """Make robots as the conditions of their terrains say where the int ``begins`` (num_envs,) is not 0."""
        if self.disturbed is not None:
            begin = make_begin(condition_effects("begin"))
            begin(begins, self.terrain_of_env, self.bank.conditions, self._varied, self.disturbed)

    def disturb(self, episodes: Episodes, dt: float, observation: Any) -> None:
        """Push robots and disturb observations as the conditions of their terrains say (:meth:`observe`)."""
        if self.disturbed is not None:
            values = {"dt": dt, "every": round(self.robot.control_dt / dt), "decimation": self.robot.decimation}
            values |= {"memory": self.disturbed, "episodes": episodes, "observation": observation}
            values["terrain"] = self.bank.terrain
            step = make_struct(DisturbedStep, self, **values)
            make_robot_stage(condition_effects("meet"), DisturbedStep)(step)
            make_disturb(condition_effects("disturb"))(step)

    def collide(self) -> None:
        """Find the terrain contacts of the present poses."""
        terrain, ground = self.bank.terrain, self.bank.ground or Ground()
        collide_strips(self.poses, self.terrain_of_env, terrain, self.probes, ground, self.parked, self.contacts)

    def physics_step(self, *, follows: bool = False) -> None:
        """Terrain contacts, then one solver step of ``robot.physics_dt``, in place.

        One that ``follows`` another at once takes state and targets as the solver has them: neither may have changed.
        It leaves out what these robots do not need: forces from outside (``body_f``, ``joint_f``) but those of
        conditions, targets of velocities, and poses of bodies after the step, which the next one finds again.
        """
        solver, coordinates = self.solver, self._coordinates
        with wp.ScopedDevice(self.device), solver._scoped_mujoco_warp_execution():
            if not follows or any(x is not None for x in (self._delay.age, self._net, self.disturbed)):
                # Controls at least: delays, networks and conditions of arms change them.
                to_solver(self.joint_q, self.joint_qd, self.targets, self._delay, coordinates, has_state=follows)
            if self.disturbed is not None and self.robot.arm_joints:
                make_robot_stage(condition_effects("drive"), ForcedStep)(self._forced)
            if self._net is not None:
                self._write_torques(self.joint_q, self.joint_qd, *self._net, coordinates)
            if self.motors is not None:
                limit_torques(self.joint_qd, coordinates, self.motors, solver.mjw_model.actuator_forcerange)
            self.dynamics.find()
            if self.disturbed is not None:
                make_robot_stage(condition_effects("force"), ForcedStep, counts=True)(self._forced)
            self.collide()
            self.dynamics.step()
            from_solver(coordinates, self.joint_q, self.joint_qd)

    def read_geom_forces(self) -> None:
        """Sum the last step's contact forces into ``geom_force``."""
        sum_forces(self.contacts, self.column_of_shape, self.geom_force)

    def clear_solver(self, mask: Any) -> None:
        """Forget warm start, former targets and parking in the environments where ``mask`` (num_envs,) is not 0."""
        data = self.solver.mjw_data
        clear_rows(mask, data.qacc_warmstart)
        clear_rows(mask, self.parked.reshape((-1, 1)).view(float))  # whose 0 has the same bits
        if self._delay.age is not None:
            clear_rows(mask, self._delay.age.view(float))
        if self._net is not None:
            clear_rows(mask, self._net[-1].reshape((self.num_envs, -1)))
        if isinstance(self.dynamics, StockDynamics):
            # It multiplies whole tiles of the constraint Jacobian, unused rows by zero: a world that was once not
            # finite would stay so, whatever state it is reset to.
            clear_rows(mask, data.efc.J.reshape((self.num_envs, -1)))

    def capture(self, launch_all: Callable[[], None]) -> Any:
        """Record the launches of ``launch_all`` once as a graph for :meth:`launch`, on CUDA and CPU alike.

        It is run eagerly first, so that no kernel is loaded while recording.
        """

        def record() -> Any:
            with wp.ScopedCapture() as capture:
                launch_all()
            return capture.graph

        with wp.ScopedDevice(self.device), recording():
            launch_all()
            try:
                return record()
            except RuntimeError:  # seldom CUDA finds a recording spoilt, and does not say by what
                return record()

    def launch(self, graph: Any) -> None:
        """Run a captured graph once."""
        with wp.ScopedDevice(self.device):
            wp.capture_launch(graph)


class Reward:
    """Pays every control step of every robot.

    Attributes:
        motion: The state that rewards are computed from, a kernel argument; it shares the simulation's arrays.
        state: Rewards so far (:class:`kernels.rewards.Rewards`).
    """

    def __init__(self, sim: Simulation, cfg: TrainingCfg, step: RobotStep, *, falls: Collection[Outcome]) -> None:
        """Allocate on the simulation's device; ``falls`` are the outcomes that count as such.

        The command of the ``step`` is what its clipped action answers.
        """
        robot = sim.robot
        limits = (sim.model.joint_limit_lower, sim.model.joint_limit_upper)
        lower, upper = (np.asarray(limit.numpy(), dtype=np.float64)[6 : 6 + robot.num_joints] for limit in limits)
        # Soft limits span a share of each joint's range about its middle; a joint without limits has them far away.
        middle = 0.5 * (lower + upper)
        half = 0.5 * cfg.soft_joint_limit * (upper - lower)
        steady = [int(name in cfg.steady_joints) for name in robot.joint_names]
        self.motion = make_struct(
            Motion,
            cfg,
            step=step,
            default_joint_pos=sim.sensors.default_joint_pos,
            dt=robot.control_dt,
            joint_lower=wp.array(middle - half, dtype=float, device=sim.device),
            joint_upper=wp.array(middle + half, dtype=float, device=sim.device),
            joint_is_steady=wp.array(steady, dtype=int, device=sim.device),
        )
        self._weights = make_weights(asdict(cfg.rewards), only_positive=cfg.only_positive, falls=falls)
        self.state = make_rewards(sim.num_envs, robot.num_joints, len(robot.geom_names), sim.device)

    def pay(self, outcome: Any) -> None:
        """Reward the control step just made, before the next command is written; ``outcome`` is that after it."""
        reward_steps(self.motion, self._weights, outcome, self.state)
