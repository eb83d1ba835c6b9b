"""Dynamics and step find what mujoco_warp's find, from the same state; torques, randomisation, errors, recording.

Tests on models that are no robots are slow: mujoco_warp compiles half a hundred kernels for them.
"""

import gc
from functools import partial
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp

from kernels.contact import make_contacts
from kernels.ground import FIRM, make_ground
from sim.crossing import GROUND_FRICTION, SolverCfg
from sim.device import resolve_device
from sim.simulation import Simulation
from sim.solver import Dynamics, StockDynamics, make_dynamics
from sim.terrains.bank import TerrainBank
from tests.sim.scenes import GAINS, Stepper, put, standing

Mujoco: Any = mujoco  # it names its types at run time
WORLDS, CAPACITY = 16, 24
# A thing with friction losses, a limit and contacts of 1, 3, 4 and 6 dimensions, one of which has its own way.
EVERYTHING = """
<mujoco>
  <compiler angle="radian"/>
  <option cone="elliptic" iterations="30" ls_iterations="20" timestep="0.004" integrator="implicitfast" impratio="2"/>
  <default><geom contype="1" conaffinity="0"/></default>
  <worldbody>
    <geom type="plane" size="3 3 .1" contype="0" conaffinity="1" condim="1" friction=".6 .02 .01" solmix="2"/>
    <body pos="0 0 .21"><freejoint/>
      <geom type="box" size=".2 .1 .1" condim="3" friction=".6 .02 .01" solref=".03 .8"/>
      <body pos=".25 0 0"><joint name="left" axis="0 1 0" frictionloss=".4" range="-.3 .3" limited="true" margin=".01"/>
        <geom type="capsule" size=".04" fromto="0 0 0 .3 0 -.1" condim="4" friction=".8 .03 .01"
          solimp=".8 .9 .01 .3 3"/></body>
      <body pos="-.25 0 0"><joint name="right" axis="0 1 0" frictionloss=".2" damping=".1"/>
        <geom type="sphere" size=".08" pos="-.1 0 -.1" condim="6" friction=".9 .05 .02" solref="-900 -30"/></body>
      <body pos="0 .3 .1"><joint name="third" axis="1 0 0"/>
        <geom type="sphere" size=".05" condim="1" priority="1" solimp=".7 .7 .01 .5 1"/></body>{inner}
    </body>
  </worldbody>
  <actuator><motor joint="third"/></actuator>
</mujoco>
"""
# 23 of them make it one of 32 dofs, as many as a warp has threads, and 31 one of 40.
ARM = """
<body euler="0 0 {0}"><joint axis="0 1 0" range="-.1 .2" limited="true" frictionloss=".1" damping=".1" armature=".01"/>
  <geom type="sphere" size=".03" pos=".3 0 {2}" mass=".1" contype="{1}"/></body>
"""
# A robot of several joints a body, an arm fixed to the world and a post that cannot move: what no shipped robot has.
MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" integrator="implicitfast" gravity=".3 -.2 -9.7" {option}/>
  <worldbody>
    <geom type="plane" size="3 3 .1"/>
    <body name="post" pos="3 0 0"><geom size=".1"/></body>
    <body pos="0 0 .3" euler=".2 .1 -.4"><freejoint/>
      <inertial pos=".03 -.02 .01" euler=".3 -.2 .5" mass="4" diaginertia=".05 .08 .1"/>
      <geom type="box" size=".2 .1 .05"/>
      <body pos=".2 .1 0" euler=".1 0 .3">
        <joint name="roll" axis="1 .2 0" pos=".02 .01 0" damping=".4" armature=".02" stiffness="3" springref=".2"/>
        <joint name="slide" type="slide" axis="0 .1 1" damping="2" stiffness="80" ref=".01"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .2 0 -.1"/>
        <body pos=".2 0 -.1"><joint name="knee" axis="0 1 0" ref=".3" armature=".01" actuatorfrcrange="-3 2"/>
          <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.2"/>{inner}</body>
      </body>
      <body pos="-.2 0 0"><joint name="tail" axis="0 1 0"/><geom type="sphere" size=".06" pos="-.1 0 0"/></body>
    </body>
    <body pos="0 2 1"><joint name="shoulder" axis="0 1 0" damping=".1"/>
      <geom type="capsule" size=".04" fromto="0 0 0 .4 0 0"/>
      <body pos=".4 0 0" euler="0 0 .5"><joint name="elbow" axis="0 0 1" pos="0 .02 0"/>
        <geom type="box" size=".1 .03 .03" pos=".1 0 0"/></body>
    </body>
    <body pos="0 -2 1">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
      <geom size=".1" mass="2"/></body>{outer}
  </worldbody>
  <actuator>
    <position joint="roll" kp="30" kv="2" gear="1.5" forcerange="-4 5"/>
    <motor joint="slide" gear="-20" ctrlrange="-.5 .7"/>
    <general joint="knee" gainprm="12" biastype="affine" biasprm=".4 -11 -.7"/>
    <velocity joint="shoulder" kv="3"/>{actuator}
  </actuator>{more}
</mujoco>
"""


def build(xml, device, **parts):
    """A model whose contacts are those that mujoco_warp finds, its data, and ours of it."""
    parts = dict.fromkeys(("inner", "outer", "actuator", "more"), "") | {"option": 'cone="elliptic"'} | parts
    model = Mujoco.MjModel.from_xml_string(xml.format(**parts))
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        d = mjw.put_data(model, Mujoco.MjData(model), nworld=WORLDS, nconmax=24, njmax=200)
        return m, d, make_contacts(WORLDS, CAPACITY)


def make_ours(m, d, contacts):
    """Our dynamics of it, or stock by our road, and whether it is the former."""
    m.opt.run_collision_detection = False  # as Newton has it where it finds the contacts itself
    parked = wp.zeros(WORLDS, dtype=int, device=d.qpos.device)
    found = make_dynamics(m, d, contacts, parked, 1 + np.arange(m.ngeom - 1), 0)
    m.opt.run_collision_detection = True
    return found


def copy_contacts(d, contacts):
    """Copy mujoco_warp's contacts into ours; returns their indices by world."""
    count = int(d.nacon.numpy()[0])
    indices_by_world = [np.flatnonzero(d.contact.worldid.numpy()[:count] == k) for k in range(WORLDS)]
    assert (d.contact.geom.numpy()[:count, 0] == 0).all()
    shapes, normals = d.contact.geom.numpy()[:, 1] - 1, d.contact.frame.numpy()[:, 0]
    stock = (shapes, d.contact.pos.numpy(), normals, d.contact.dist.numpy())
    for name, values in zip(("shape", "point", "normal", "distance"), stock, strict=True):
        copied = np.zeros(getattr(contacts, name).numpy().shape, values.dtype)
        for k, chosen in enumerate(indices_by_world):
            copied[k, : len(chosen)] = values[chosen]
        getattr(contacts, name).assign(copied)
    contacts.friction.fill_(1.0)
    contacts.count.assign(np.array([len(chosen) for chosen in indices_by_world], np.int32))
    return indices_by_world


def read_force(d, contact):
    """Force of a contact by mujoco_warp, world frame."""
    rows = d.contact.efc_address.numpy()[contact][: min(3, d.contact.dim.numpy()[contact])]
    world = d.contact.worldid.numpy()[contact]
    return d.efc.force.numpy()[world, rows] @ d.contact.frame.numpy()[contact][: len(rows)] if rows[0] >= 0 else 0.0


STATE = ("qpos", "qvel", "qacc_warmstart")


def read_state(d):
    return [getattr(d, name).numpy().copy() for name in STATE]


def restore(d, state):
    for name, value in zip(STATE, state, strict=True):
        getattr(d, name).assign(value)


def assert_equal_steps(m, d, contacts, ours, relative=2e-3, find=None):
    """Their step and ours from the same state, to a share of a world's largest number, forces of contacts too.

    Where rounding made one more iteration, ten times that.
    """
    before = read_state(d)
    mjw.step(m, d)
    expected, iterations = read_state(d), d.solver_niter.numpy().copy()
    indices_by_world = copy_contacts(d, contacts)
    forces = [np.array([read_force(d, c) * np.ones(3) for c in chosen]).reshape(-1, 3) for chosen in indices_by_world]
    restore(d, before)
    (find or ours.find)()
    ours.step()
    differs = np.abs(d.solver_niter.numpy() - iterations)
    assert differs.max() <= 1 and (differs > 0).mean() <= 0.25
    limit = np.where(differs > 0, 10.0 * relative, relative)
    for name, array, value in zip(STATE, read_state(d), expected, strict=True):
        error = np.abs(array - value).max(axis=1) / (np.abs(value).max(axis=1) + 1.0)
        assert (error < limit).all(), (name, error)
    found = contacts.force.numpy()
    for k, force in enumerate(forces):
        size = np.abs(force).max(initial=0.0) + 1.0
        np.testing.assert_allclose(found[k, : len(force)], force, atol=limit[k] * size)
    return iterations


def everything(device, arms=0, height=0.1):
    arm = "".join(ARM.format(k, k % 2, height) for k in range(arms))
    m, d, contacts = build(EVERYTHING, device, inner=arm)
    rng = np.random.default_rng(5)
    qpos = d.qpos.numpy()
    qpos[:, 2] += rng.uniform(-0.05, 0.05, WORLDS)
    qpos[:, 3:] += rng.normal(0.0, 0.2, (WORLDS, 7 + arms))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    d.qpos.assign(qpos)
    d.qvel.assign(rng.normal(0.0, 1.0, d.qvel.shape))
    return m, d, contacts


@pytest.mark.parametrize(("arms", "height"), [(0, 0.1), (23, 0.1), (31, 0.1), (31, -0.2)])
@pytest.mark.slow
def test_every_kind_of_constraint(device, arms, height):
    m, d, contacts = everything(device, arms, height)
    ours = make_ours(m, d, contacts)
    assert isinstance(ours, Dynamics)
    kinds, states, dims, most = set(), set(), set(), 0
    with wp.ScopedDevice(device):
        for _ in range(20):
            assert_equal_steps(m, d, contacts, ours)
            for world, count in enumerate(d.nefc.numpy()):  # of their step
                kinds |= set(d.efc.type.numpy()[world, :count].tolist())
                states |= set(d.efc.state.numpy()[world, :count].tolist())
            dims |= set(d.contact.dim.numpy()[: int(d.nacon.numpy()[0])].tolist())
            most = max(most, int(contacts.count.numpy().max()))
    assert states == {0, 1, 2, 3, 4}
    if height < 0.0:
        assert most > 8  # of a model of this size no more are kept in shared memory
        return
    names = ("FRICTION_DOF", "LIMIT_JOINT", "CONTACT_FRICTIONLESS", "CONTACT_ELLIPTIC")
    assert kinds >= {getattr(Mujoco.mjtConstraint, f"mjCNSTR_{name}") for name in names}
    assert dims == {1, 3, 4, 6}


@pytest.mark.slow
def test_the_order_in_which_contacts_were_found_changes_no_bit(device):
    """Sums over contacts follow their ranks, wherever they lie, in shared memory and beyond."""
    m, d, contacts = everything(device, 31, -0.2)
    ours, rng, before, results = make_ours(m, d, contacts), np.random.default_rng(4), read_state(d), []
    with wp.ScopedDevice(device):
        mjw.step(m, d)
        copy_contacts(d, contacts)
        count, columns = contacts.count.numpy(), ("shape", "point", "normal", "distance")
        found = {name: getattr(contacts, name).numpy().copy() for name in columns}
        rows = np.arange(WORLDS)[:, None]
        for turn in range(3):
            order = np.tile(np.arange(CAPACITY), (WORLDS, 1))
            if turn:
                for row, number in zip(order, count, strict=True):
                    rng.shuffle(row[:number])
            contacts.rank.assign(10 * order)
            for name, values in found.items():
                getattr(contacts, name).assign(values[rows, order])
            restore(d, before)
            ours.find()
            ours.step()
            forces = np.zeros((WORLDS, CAPACITY, 3), np.float32)
            forces[rows, order] = contacts.force.numpy()
            results.append([*read_state(d), *(force[:number] for force, number in zip(forces, count, strict=True))])
    assert count.max() > 8
    for result in results[1:]:
        for array, first in zip(result, results[0], strict=True):
            np.testing.assert_array_equal(array, first)


@pytest.mark.slow  # mujoco_warp compiles half a hundred kernels for it
def test_robots_that_fall(eight, monkeypatch):
    """Steps of the robots that searches cross with, in all states of their contacts, against mujoco_warp's.

    The ground is slippery and soft in patches.
    """
    ground, rng = make_ground(8, eight.device), np.random.default_rng(2)
    ground.friction.assign(np.float32(rng.uniform(0.2, 1.0, ground.friction.shape)))
    ground.time_constant.assign(np.float32(rng.choice([FIRM, 0.02, 0.06], ground.friction.shape)))
    monkeypatch.setattr(eight.bank, "ground", ground)
    m, d = eight.solver.mjw_model, eight.solver.mjw_data
    ours = eight.dynamics
    assert isinstance(ours, Dynamics)
    stock = StockDynamics(m, d, eight.contacts, ours.surfaces, ground=0)
    states, iterations = set(), []
    q = standing(eight.robot, x=3, z=eight.robot.default_base_height + 0.02)
    put(eight, q, rng.normal(0.0, 0.7, eight.joint_qd.shape))
    with wp.ScopedDevice(eight.device):
        eight.physics_step()
        for _ in range(120):
            before = read_state(d)
            eight.physics_step()
            found, forces = read_state(d), eight.contacts.force.numpy().copy()
            counted = d.solver_niter.numpy().copy()
            restore(d, before)
            stock.find()
            stock.step()
            for world, count in enumerate(d.nefc.numpy()):
                states |= set(d.efc.state.numpy()[world, :count].tolist())
            iterations.append(d.solver_niter.numpy().mean())
            differs = np.abs(d.solver_niter.numpy() - counted)
            assert differs.max() <= 1
            limit = np.where(differs > 0, 2e-2, 2e-3)
            for array, value in zip([*found, forces], [*read_state(d), eight.contacts.force.numpy()], strict=True):
                error, size = (np.abs(x.reshape(8, -1)).max(axis=1) for x in (array - value, value))
                assert (error < limit * (size + 1.0)).all()
            restore(d, found)
    assert states >= {1, 4}
    assert np.mean(iterations) > 1.2


@pytest.mark.slow
def test_worlds_without_rows_and_worlds_that_are_not_finite_end(device):
    m, d, contacts = everything(device)
    d.qvel.zero_()
    qpos = d.qpos.numpy()
    qpos[:, 2], qpos[:, 7:] = 50.0, 0.0
    d.qpos.assign(qpos)
    m.dof_frictionloss.zero_()
    ours = make_ours(m, d, contacts)
    with wp.ScopedDevice(device):
        ours.find()
        ours.step()
        np.testing.assert_allclose(d.qvel.numpy()[:, 2], -9.81 * 0.004, rtol=1e-3)
        assert (d.solver_niter.numpy() == 1).all()
        d.qvel.fill_(float("nan"))
        contacts.count.fill_(2)
        ours.find()
        ours.step()
    assert (d.solver_niter.numpy() <= m.opt.iterations).all()
    assert not np.isfinite(d.qvel.numpy()).any()


def shake(d):
    rng = np.random.default_rng(3)
    for array, spread in ((d.qpos, 0.3), (d.qvel, 1.5), (d.ctrl, 1.0)):
        array.assign((array.numpy() + rng.normal(0.0, spread, array.shape)).astype(np.float32))


@pytest.mark.slow
def test_every_quantity_of_a_step(device):
    """Free and fixed trees, joints of all kinds with springs, actuators of all kinds at and off their limits."""
    m, d, contacts = build(MODEL, device)
    masses = np.repeat(m.body_mass.numpy(), WORLDS, 0) * np.linspace(0.9, 1.1, WORLDS)[:, None]
    m.body_mass = wp.array(masses, dtype=float, device=device)
    ours = make_ours(m, d, contacts)
    shake(d)
    limited, touched = np.zeros(3, int), 0
    roots = m.body_rootid.numpy()[1:]
    with wp.ScopedDevice(device):
        for _ in range(25):
            before, expected = read_state(d), {}
            mjw.step(m, d)
            restore(d, before)
            mjw.forward(m, d)
            for name in ("xpos", "xquat", "cdof", "M", "qfrc_actuator", "qfrc_smooth"):
                expected[name] = getattr(d, name).numpy().copy()
            com = d.subtree_com.numpy()[:, roots].copy()
            roll, slide, knee = *d.actuator_force.numpy()[:, :2].T, expected["qfrc_actuator"][:, 8]
            limits = (np.isin(roll, (-4.0, 5.0)), np.isin(knee, (-3.0, 2.0)), np.isclose(abs(slide), 0.5))
            limited += np.sum(limits, axis=1)

            def find_ours(expected=expected, com=com):
                ours.find()
                np.testing.assert_allclose(d.subtree_com.numpy()[:, roots], com, atol=1e-5)
                for name, value in expected.items():
                    size = np.abs(value).max() + 1e-3
                    np.testing.assert_allclose(getattr(d, name).numpy(), value, atol=3e-6 * size, err_msg=name)

            restore(d, before)
            assert_equal_steps(m, d, contacts, ours, find=find_ours)
            touched = max(touched, int(contacts.count.numpy().max()))
    assert limited.min() > 5  # forces, joints and controls at their limits
    assert touched > 0


@pytest.mark.slow
def test_the_slope_of_forces_is_that_of_mujoco_warp(device):
    """Without constraints a step is that of the forces alone, and agrees to rounding."""
    m, d, contacts = build(MODEL, device)
    qpos = d.qpos.numpy()
    qpos[:, 2] += 50.0
    d.qpos.assign(qpos)
    ours = make_ours(m, d, contacts)
    shake(d)
    with wp.ScopedDevice(device):
        for _ in range(10):
            assert_equal_steps(m, d, contacts, ours, relative=3e-5)
    assert d.nefc.numpy().max() == 0


@pytest.mark.parametrize("solver", ["Newton", "CG"])
@pytest.mark.slow
def test_too_many_contacts_are_noted(device, solver):
    m, d, contacts = build(MODEL, device, option=f'cone="elliptic" solver="{solver}"')
    dynamics = make_ours(m, d, contacts)
    assert isinstance(dynamics, Dynamics) == (solver == "Newton")
    m.opt.run_collision_detection = False
    with wp.ScopedDevice(device):
        for count in (CAPACITY, CAPACITY + 1):
            contacts.normal.fill_(wp.vec3(0.0, 0.0, 1.0))
            contacts.distance.fill_(-1e-3)
            contacts.friction.fill_(1.0)
            contacts.count.fill_(1)
            contacts.count[:2].fill_(count)
            dynamics.find()
            dynamics.step()
            noted = (d.overflow.numpy() & mjw.OverflowType.NARROWPHASE) > 0
            assert noted[:2].all() == (count > CAPACITY) and not noted[2:].any()


@pytest.mark.parametrize(
    "parts",
    [
        {"option": 'cone="elliptic" solver="CG"'},
        {"option": 'cone="pyramidal"'},
        {"option": 'cone="elliptic" noslip_iterations="3"'},
        {"more": '<option><flag gravity="disable"/></option>'},
        {"option": 'cone="elliptic" density="1.2"'},
        {"inner": '<body><joint type="ball"/><geom size=".02"/></body>'},
        {"outer": '<body pos="1 1 1"><freejoint/><geom size=".1"/></body>'},
        {"outer": '<body pos="1 1 1" mocap="true"><geom size=".1"/></body>'},
        {"inner": '<body gravcomp="1"><geom size=".02"/></body>'},
        {"actuator": '<motor joint="knee"/>'},
        {"actuator": '<general joint="elbow" dyntype="filter" dynprm="1"/>'},
        {"actuator": '<general joint="elbow" gaintype="affine" gainprm="1 1 1"/>'},
        {"inner": '<geom size=".1" surfacevel="0 0 0 0 0 3"/>'},
        {"more": '<sensor><jointpos joint="knee"/></sensor>'},
        {"inner": "<body>" * 400 + '<geom size=".1"/>' + "</body>" * 400},
        {"more": '<equality><joint joint1="elbow" joint2="tail"/></equality>'},
    ],
)
@pytest.mark.slow
def test_other_models_take_their_step(device, parts):
    assert isinstance(make_ours(*build(MODEL, device)), Dynamics)
    assert isinstance(make_ours(*build(MODEL, device, **parts)), StockDynamics)


def test_torque_is_the_pd_law_and_clamped(eight, robot):
    # In the air, at rest, on ANYmal: 80 N m/rad * 0.5 rad = 40 N m; at 5 rad the 80 N m limit. Moving at 3 rad/s:
    # 40 - 2 * 3 = 34.
    eight.bank.set_heights(np.zeros(eight.bank.heights.shape, np.float32))
    kp, kd, limit = map(np.array, GAINS[robot.name])
    q, qd = standing(robot, 8, z=3.0), np.zeros((8, 18))
    qd[2, 6:] = 3.0
    put(eight, q, qd)
    targets = q.copy()
    targets[0, 7:] += 0.5
    targets[1, 7:] -= 5.0
    targets[2, 7:] += 0.5
    eight.targets.assign(np.float32(targets))
    with wp.ScopedDevice(eight.device):
        eight.physics_step()
    torque = np.array(eight.joint_torque.numpy())
    np.testing.assert_allclose(torque[0, 6:], 0.5 * kp, rtol=1e-4)
    np.testing.assert_allclose(torque[1, 6:], -limit, rtol=1e-4)
    np.testing.assert_allclose(torque[2, 6:], 0.5 * kp - 3.0 * kd, rtol=1e-3)
    np.testing.assert_allclose(torque[3, 6:], 0, atol=1e-3)
    assert not torque[:, :6].any()  # nothing drives the base


def test_a_step_that_follows_another_takes_up_its_state(eight):
    eight.bank.set_heights(np.zeros(eight.bank.heights.shape, np.float32))
    q, qd = standing(eight.robot, 8, z=1.5), np.random.default_rng(3).normal(0.0, 0.7, eight.joint_qd.shape)
    ends = []
    for follows in (False, True):
        put(eight, q, qd)
        with wp.ScopedDevice(eight.device):
            for step in range(20):
                eight.physics_step(follows=follows and step > 0)
        ends.append([array.numpy().copy() for array in (eight.joint_q, eight.joint_qd)])
    for plain, following in zip(*ends, strict=True):
        np.testing.assert_allclose(following, plain, atol=2e-4)
    assert np.abs(ends[1][0] - q).max() > 0.1


def test_friction_and_mass_of_each_robot(anymal, device):
    # Three robots on the same ground: they weigh 47.13, 52.13 and 57.13 kg, and every contact has its robot's friction.
    bank = TerrainBank(1, device=device)
    friction, mass = np.array([0.5, 0.9, 1.25]), np.array([-5.0, 0.0, 5.0])
    sim = Simulation(anymal, bank, np.zeros(3, int), friction=friction, added_base_mass=mass)
    put(sim, standing(anymal, 3, z=0.6))
    stepper, forces = Stepper(sim), np.zeros((3, 3))
    stepper.run(4.0)
    stepper.run(0.4, lambda: np.add(forces, np.array(sim.geom_force.numpy()).sum(1) / 20, out=forces))
    np.testing.assert_allclose(forces[:, 2], (52.13 + mass) * 9.81, rtol=0.01)
    mixed = sim.dynamics.surfaces.friction.numpy()
    np.testing.assert_allclose(mixed[..., :2] / friction[:, None, None], 1.0, rtol=1e-5)
    assert friction.min() > GROUND_FRICTION


def test_solver_options_arrive(anymal, device):
    bank = TerrainBank(1, device=device)
    sim = Simulation(anymal, bank, np.zeros(1, int), cfg=SolverCfg(iterations=7, ls_iterations=13))
    assert (sim.solver.mjw_model.opt.iterations, sim.solver.mjw_model.opt.ls_iterations) == (7, 13)


@pytest.mark.parametrize(
    ("terrains", "added_base_mass", "field"),
    [
        ([0, 2], None, "terrain_of_env"),
        ([0, 0], np.array([0.0, -60.0]), "added_base_mass"),  # more than the base has
    ],
)
def test_what_cannot_be_simulated_is_named(anymal, device, terrains, added_base_mass, field):
    with pytest.raises(ValueError, match=field):
        Simulation(anymal, TerrainBank(2, device=device), np.array(terrains), added_base_mass=added_base_mass)


def test_devices():
    expected, missing = ("cuda:0", "cuda:99") if wp.is_cuda_available() else ("cpu", "cuda")
    assert (resolve_device("cpu"), resolve_device(None)) == ("cpu", expected)
    for name in ("tpu", missing):
        with pytest.raises(ValueError, match=f"device .{name}"):
            resolve_device(name)


def test_no_garbage_is_collected_while_a_graph_is_recorded_and_a_spoilt_one_is_recorded_again(device):
    # Python collects garbage at any time, and freeing what holds memory of the GPU can spoil a recording.
    collects = []

    def launch(spoilt=(), error=RuntimeError):
        collects.append(gc.isenabled())
        if len(collects) in spoilt:
            raise error("CUDA graph capture failed.")

    sim = SimpleNamespace(device=device)
    Simulation.capture(sim, partial(launch, [2]))
    assert collects == [False] * 3 and gc.isenabled()
    for spoilt, error in (([5, 6], RuntimeError), ([8], ValueError)):
        with pytest.raises(error, match="capture failed"):
            Simulation.capture(sim, partial(launch, spoilt, error))
        assert gc.isenabled()
    assert len(collects) == 8
