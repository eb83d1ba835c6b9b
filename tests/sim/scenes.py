"""Ground to stand on and bodies to drop on it, for the physics tests."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import newton
import numpy as np
import pytest
import warp as wp

from sim.crossing import CrossingCfg
from sim.mujoco_c.crossing import EpisodeStates
from sim.mujoco_c.model import Starts, crossing_model
from sim.robots.compiled import mj, robot_spec
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank
from sim.terrains.conditions.kinds import condition_column, nominal_row
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.terrains import GroundMaps
from tests.sim.policies import stand

NODE_X = np.arange(NUM_COLS) * SPACING
NODE_Y = np.arange(NUM_ROWS) * SPACING
PHYSICS_DT = 0.005
FLAT = np.zeros((NUM_ROWS, NUM_COLS), np.float32)
GAINS = {
    "anymal": ([80] * 12, [2] * 12, [80] * 12),
    "cassie": ([100, 100, 200, 200, 200, 40] * 2, [3, 3, 6, 6, 6, 1] * 2, [112, 112, 195, 195, 195, 45] * 2),
}
"""Stiffness [N m/rad] and damping [N m s/rad] (legged_gym's), and limit of effort [N m] (published), joint by joint."""
ONLY_ANYMAL = pytest.mark.parametrize("robot", ["anymal"], indirect=True)
"""For tests of a robot that stands by itself, or of its own figures."""
ONLY_CASSIE = pytest.mark.parametrize("robot", ["cassie"], indirect=True)


def spike(x: float = 2.0):
    """A needle of 1 m under (x, 4), by default the start; a robot over its tip falls on it."""
    grid, col = FLAT.copy(), round(x / SPACING)
    grid[79:82, col - 1 : col + 2] = 1.0
    return grid


def slope(angle_x: float = 0.0, angle_y: float = 0.0) -> np.ndarray:
    """A plane through (8, 4, 0) that rises along x and y by the given angles [rad]."""
    return np.float32(np.tan(angle_x) * (NODE_X[None, :] - 8) + np.tan(angle_y) * (NODE_Y[:, None] - 4))


def free_body(folder: Path, geom: str, *, mass: float, friction: float = 0.5) -> RobotCfg:
    """A robot without joints: one free body of one geom, e.g. ``type="sphere" size="0.03"``."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "body.xml"
    file.write_text(
        '<mujoco><worldbody><body name="body"><freejoint/>'
        f'<geom name="body" {geom} mass="{mass}" friction="{friction}"/></body></worldbody></mujoco>'
    )
    names = ("base_geoms", "limb_geoms", "joint_names", "default_joint_pos", "scan_x", "scan_y", "penalties")
    sizes = {"default_base_height": 1.0, "footprint": (0.1, 0.1), "contact_force_limit": 500.0, "collision_bit": False}
    return RobotCfg(name="body", model_file=file, foot_geoms=("body",), **dict.fromkeys(names, ()), **sizes)


def simulate(robot: RobotCfg, grids: np.ndarray, device: str, ground: GroundMaps | None = None) -> Simulation:
    """One robot on each grid."""
    bank = TerrainBank(len(grids), device=device, with_ground=ground is not None)
    bank.set_heights(np.float32(grids), ground=ground)
    return Simulation(robot, bank, np.arange(len(grids)))


def put(sim: Simulation, joint_q: np.ndarray, joint_qd: np.ndarray | None = None) -> None:
    """Put the robots there, at rest or with the given velocities, holding their joints where they are."""
    sim.joint_q.assign(np.float32(joint_q))
    sim.joint_qd.assign(np.zeros(sim.joint_qd.shape, np.float32) if joint_qd is None else np.float32(joint_qd))
    sim.targets.assign(np.float32(joint_q))
    sim.clear_solver(wp.ones(sim.num_envs, dtype=int, device=sim.device))


def present(sim: Simulation, name: str) -> np.ndarray:
    """``body_q`` or ``body_qd`` of Newton's state at the present coordinates, shape (num_envs, num_bodies, ...)."""
    state: Any = sim.model.state()
    rows = []
    for joint_q, joint_qd in zip(sim.joint_q.numpy(), sim.joint_qd.numpy(), strict=True):
        state.joint_q.assign(joint_q)
        state.joint_qd.assign(joint_qd)
        newton.eval_fk(sim.model, state.joint_q, state.joint_qd, state)
        rows.append(getattr(state, name).numpy().copy())
    return np.array(rows)


class Stepper:
    """Steps a simulation by a captured graph of four physics steps, or of one."""

    def __init__(self, sim: Simulation, steps: int = 4) -> None:
        def launch() -> None:
            for _ in range(steps):
                sim.physics_step()
            sim.read_geom_forces()

        self.sim, self.steps = sim, steps
        self.graph = sim.capture(launch)

    def run(self, duration_s: float, each: Callable[[], object] = lambda: None) -> None:
        """Let the time pass; ``each()`` is called after every launch of the graph."""
        for _ in range(round(duration_s / (PHYSICS_DT * self.steps))):
            self.sim.launch(self.graph)
            each()


def positions(sim: Simulation) -> np.ndarray:
    """A copy of the joint coordinates, shape (num_envs, 7 + num_joints), float64 (on the CPU numpy() is a view)."""
    return np.array(sim.joint_q.numpy(), dtype=np.float64)


def velocities(sim: Simulation) -> np.ndarray:
    """A copy of the joint velocities, shape (num_envs, 6 + num_joints), float64."""
    return np.array(sim.joint_qd.numpy(), dtype=np.float64)


def lying(num: int, x: float, y: float, z: float, axis: tuple[float, float, float] = (0, 0, 1), angle: float = 0.0):
    """Poses of free bodies turned about ``axis`` by ``angle`` [rad], shape (num, 7)."""
    q = np.zeros((num, 7))
    q[:, :3] = x, y, z
    q[:, 3:6] = np.array(axis) * np.sin(angle / 2)
    q[:, 6] = np.cos(angle / 2)
    return q


def standing(robot: RobotCfg, num: int = 8, x: float = 8.0, y: float = 4.0, z: float | None = None):
    """Robots in their default pose at their default height or ``z`` [m], shape (num, 7 + num_joints)."""
    base = lying(num, x, y, robot.default_base_height if z is None else z)
    return np.column_stack([base, np.tile(robot.default_joint_pos, (num, 1))])


def crossing(robot, device, policy=stand, num_terrains=1, replicas=4, **cfg):
    """A rollout of 0.6 s, by default of robots that hold their pose; ``cfg`` are settings of the crossing."""
    robot = dataclasses.replace(robot, max_duration_s=cfg.pop("max_duration_s", 0.6))
    cfg = CrossingCfg(**{"poll_every_s": 0.1} | cfg)
    return Rollout(robot, policy, num_terrains=num_terrains, replicas=replicas, device=device, cfg=cfg)


def rows_of(*pushes):
    """Rows of conditions with some values by their names, the others nominal."""
    rows = np.tile(nominal_row(), (len(pushes), 1))
    for row, push in zip(rows, pushes, strict=True):
        for name, value in push.items():
            row[condition_column(name)] = value
    return rows


def simulate_under(robot, rows, device="cpu"):
    """A robot on level ground under each row of conditions."""
    bank = TerrainBank(len(rows), device=device, with_conditions=True)
    grounds = dataclasses.replace(GroundMaps.plain(len(rows)), conditions=rows)
    bank.set_heights(np.tile(FLAT, (len(rows), 1, 1)), ground=grounds)
    sim = Simulation(robot, bank, np.arange(len(rows)))
    sim.begin_conditions(wp.ones(len(rows), dtype=int, device=device))
    return sim


def fall(robot, rows, steps, device="cpu"):
    """Falls from a random state high above ground under each row; yields states after ``steps``, ours and theirs."""
    rng = np.random.default_rng(0)
    turn, joints = rng.normal(size=4), robot.default_joint_pos + rng.uniform(-0.1, 0.1, robot.num_joints)
    states = [4.0, 4.0, 20.0, *turn / np.linalg.norm(turn), *joints], rng.uniform(-1.0, 1.0, 6 + robot.num_joints)
    joint_q, joint_qd = (np.tile(values, (len(rows), 1)).astype(np.float32) for values in states)
    sim = simulate_under(robot, rows, device)
    put(sim, joint_q, joint_qd)
    com = robot_spec(robot).compile().body_ipos[1]
    start = Starts.of_newton(joint_q[:1], joint_qd[:1], com)
    plain = [EpisodeStates(robot, crossing_model(robot, FLAT), start, row.astype(float)) for row in rows]
    for episodes in plain:
        episodes.targets[:] = joint_q[:1, 7:]
    for made in range(1, 1 + steps[-1]):
        sim.physics_step()
        for episodes in plain:
            episodes.step(np.arange(1))
        if made in steps:
            qpos, qvel = (np.concatenate([getattr(each, name) for each in plain]) for name in ("qpos", "qvel"))
            yield Starts.of_newton(positions(sim), velocities(sim), com), Starts(qpos=qpos, qvel=qvel)


def mean_velocity(robot, states):
    """Velocity of the whole robot's mass centre [m/s], shape (num_states, 3)."""
    model, found = robot_spec(robot).compile(), []
    data = mj.MjData(model)
    for data.qpos[:], data.qvel[:] in zip(states.qpos, states.qvel, strict=True):
        mj.mj_forward(model, data)
        mj.mj_subtreeVel(model, data)
        found.append(data.subtree_linvel[1].copy())
    return np.array(found)
