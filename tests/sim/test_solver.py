"""Our dynamics and our solver of contacts find what mujoco_warp's find, from the same state."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp

from sim.solver import (
    Dynamics,
    TheirDynamics,
    dynamics_of,
    fits,
    fits_dynamics,
    solve_contacts,
    solve_theirs,
    use_own_solver,
)
from tests.sim.scenes import put, standing

Mujoco: Any = mujoco  # it names its types at run time
WORLDS = 16
# A thing with equality, friction losses, a limit and contacts of 1, 3, 4 and 6 dimensions.
EVERYTHING = """
<mujoco>
  <option cone="{cone}" iterations="30" ls_iterations="20" timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="3 3 .1" condim="1" friction=".6 .02 .01"/>
    <body pos="0 0 .21"><freejoint/>
      <geom type="box" size=".2 .1 .1" condim="3" friction=".6 .02 .01"/>
      <body pos=".25 0 0"><joint name="left" axis="0 1 0" frictionloss=".4" range="-.3 .3" limited="true"/>
        <geom type="capsule" size=".04" fromto="0 0 0 .3 0 -.1" condim="4" friction=".8 .03 .01"/></body>
      <body pos="-.25 0 0"><joint name="right" axis="0 1 0" frictionloss=".2" damping=".1"/>
        <geom type="sphere" size=".08" pos="-.1 0 -.1" condim="6" friction=".9 .05 .02"/></body>
      <body pos="0 .3 .1"><joint axis="1 0 0"/><geom type="sphere" size=".05" condim="1"/></body>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right" polycoef=".1 .5 0 0 0"/></equality>
</mujoco>
"""
# A robot of several joints a body, an arm fixed to the world and a post that cannot move: what no shipped robot has.
MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option cone="elliptic" timestep="0.004" integrator="implicitfast" gravity=".3 -.2 -9.7" {option}/>
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
    parts = dict.fromkeys(("option", "inner", "outer", "actuator", "more"), "") | parts
    model = Mujoco.MjModel.from_xml_string(xml.format(**parts))
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        return m, mjw.put_data(model, Mujoco.MjData(model), nworld=WORLDS, nconmax=24, njmax=90)


def everything(device, cone="elliptic"):
    m, d = build(EVERYTHING, device, cone=cone)
    rng = np.random.default_rng(5)
    qpos = d.qpos.numpy()
    qpos[:, 2] += rng.uniform(-0.05, 0.05, WORLDS)
    qpos[:, 3:] += rng.normal(0.0, 0.2, (WORLDS, 7))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    d.qpos.assign(qpos)
    d.qvel.assign(rng.normal(0.0, 1.0, d.qvel.shape))
    return m, d


def solved(solve, m, d):
    d.overflow.zero_()
    d.qacc_warmstart.zero_()  # a step has left its solution there
    solve(m, d)
    force, state = d.efc.force.numpy(), d.efc.state.numpy()
    for world, count in enumerate(d.nefc.numpy()):
        force[world, count:], state[world, count:] = 0.0, 0
    arrays = {"qacc": d.qacc, "qfrc": d.qfrc_constraint, "momentum": d.efc.Ma, "iterations": d.solver_niter}
    return {name: array.numpy().copy() for name, array in arrays.items()} | {"force": force, "state": state}


def assert_solved_alike(m, d):
    """To 2e-3 of the largest number of a world; where rounding made one more iteration, ten times that."""
    theirs, ours = solved(solve_theirs, m, d), solved(solve_contacts, m, d)
    differs = np.abs(ours["iterations"] - theirs["iterations"])
    assert differs.max() <= 1
    assert (differs > 0).mean() <= 0.25
    for name in ("qacc", "qfrc", "momentum", "force"):
        size = np.abs(theirs[name]).max(axis=1) + 1.0
        error = np.abs(ours[name] - theirs[name]).max(axis=1) / size
        assert (error < np.where(differs > 0, 2e-2, 2e-3)).all(), (name, error)
    return ours


def test_every_kind_of_constraint(device):
    m, d = everything(device)
    assert fits(m, d)
    kinds, states = set(), set()
    use_own_solver(False)
    try:
        with wp.ScopedDevice(device):
            for _ in range(15):
                mjw.step(m, d)
                ours = assert_solved_alike(m, d)
                for world, count in enumerate(d.nefc.numpy()):
                    kinds |= set(d.efc.type.numpy()[world, :count].tolist())
                    states |= set(ours["state"][world, :count].tolist())
    finally:
        use_own_solver()
    names = ("EQUALITY", "FRICTION_DOF", "LIMIT_JOINT", "CONTACT_FRICTIONLESS", "CONTACT_ELLIPTIC")
    assert kinds >= {getattr(Mujoco.mjtConstraint, f"mjCNSTR_{name}") for name in names}
    assert states == {0, 1, 2, 3, 4}


def test_robots_that_fall(eight):
    """Steps of the robots that searches cross with, in all states of their contacts."""
    m, d = eight.solver.mjw_model, eight.solver.mjw_data
    assert fits(m, d)
    states, mean_iterations = set(), []
    q = standing(eight.robot, x=3, z=eight.robot.default_base_height + 0.02)
    put(eight, q, np.random.default_rng(2).normal(0.0, 0.7, eight.joint_qd.shape))
    with wp.ScopedDevice(eight.device):
        for _ in range(120):
            eight.physics_step()
            ours = assert_solved_alike(m, d)
            states |= set(ours["state"].ravel().tolist())
            mean_iterations.append(ours["iterations"].mean())
    assert states >= {0, 1, 4}
    assert np.mean(mean_iterations) > 1.5


def test_a_model_that_does_not_fit_is_solved_as_before(device):
    m, d = everything(device, cone="pyramidal")
    assert not fits(m, d)
    with wp.ScopedDevice(device):
        mjw.step(m, d)
    assert np.isfinite(d.qacc.numpy()).all()
    assert d.solver_niter.numpy().max() > 0


def test_worlds_without_rows_and_worlds_that_are_not_finite_end(device):
    m, d = everything(device)
    with wp.ScopedDevice(device):
        mjw.step(m, d)
        rows = d.nefc.numpy().copy()
        for count in (d.nefc, d.ne, d.nf):
            count.zero_()
        solve_contacts(m, d)
        np.testing.assert_allclose(d.qacc.numpy(), d.qacc_smooth.numpy(), rtol=1e-3, atol=1e-2)
        d.nefc.assign(rows)
        d.qacc_warmstart.fill_(float("nan"))
        solve_contacts(m, d)
    assert (d.solver_niter.numpy() <= m.opt.iterations).all()
    assert not np.isfinite(d.qacc.numpy()).any()


def robot_of(device, **parts):
    m, d = build(MODEL, device, **parts)
    m.opt.run_collision_detection = False  # as Newton has it where it finds the contacts itself
    return m, d


def shake(d):
    rng = np.random.default_rng(3)
    for array, spread in ((d.qpos, 0.3), (d.qvel, 1.5), (d.ctrl, 1.0)):
        array.assign((array.numpy() + rng.normal(0.0, spread, array.shape)).astype(np.float32))


STATE = ("qpos", "qvel", "qacc_warmstart")


def state_of(d):
    return [getattr(d, name).numpy().copy() for name in STATE]


def assert_steps_alike(d, theirs, ours, before_step, relative):
    """Their step and ours from the same state, to a share of a world's largest number."""
    before = state_of(d)
    theirs()
    expected = state_of(d)
    for name, value in zip(STATE, before, strict=True):
        getattr(d, name).assign(value)
    before_step()
    ours.step()
    for array, value in zip(state_of(d), expected, strict=True):
        size = np.abs(value).max(axis=1, keepdims=True) + 1.0
        assert (np.abs(array - value) / size).max() < relative


def test_every_quantity_of_a_step(device):
    """Free and fixed trees, joints of all kinds with springs, actuators of all kinds at and off their limits."""
    m, d = robot_of(device)
    masses = np.repeat(m.body_mass.numpy(), WORLDS, 0) * np.linspace(0.9, 1.1, WORLDS)[:, None]
    m.body_mass = wp.array(masses, dtype=float, device=device)
    assert fits_dynamics(m, d)
    ours, theirs = Dynamics(m, d), TheirDynamics(m, d)
    shake(d)
    limited, expected = np.zeros(3, int), {}
    roots = m.body_rootid.numpy()[1:]

    def step_theirs():
        theirs.find()
        mjw.com_pos(m, d)
        mjw.collision(m, d)
        theirs.step()
        for name in ("xpos", "xquat", "cdof", "M", "qfrc_actuator", "qfrc_smooth"):
            expected[name] = getattr(d, name).numpy().copy()
        expected["com"] = d.subtree_com.numpy()[:, roots].copy()
        force, of_joint = d.actuator_force.numpy(), expected["qfrc_actuator"][:, 8]
        limits = np.isin(force[:, 0], (-4.0, 5.0)), np.isin(of_joint, (-3.0, 2.0)), np.isclose(abs(force[:, 1]), 0.5)
        limited[:] += np.sum(limits, axis=1)

    def find_ours():
        ours.find()
        np.testing.assert_allclose(d.subtree_com.numpy()[:, roots], expected.pop("com"), atol=1e-5)
        for name, value in expected.items():
            size = np.abs(value).max() + 1e-3
            np.testing.assert_allclose(getattr(d, name).numpy(), value, atol=3e-6 * size, err_msg=name)

    with wp.ScopedDevice(device):
        for _ in range(25):
            assert_steps_alike(d, step_theirs, ours, find_ours, 2e-3)
    assert limited.min() > 5  # forces, joints and controls at their limits
    assert d.nefc.numpy().max() > 0


def test_the_slope_of_forces_is_that_of_mujoco_warp(device):
    """Without constraints a step is that of the forces alone, and agrees to rounding."""
    m, d = robot_of(device)
    qpos = d.qpos.numpy()
    qpos[:, 2] += 50.0
    d.qpos.assign(qpos)
    ours = Dynamics(m, d)
    shake(d)
    with wp.ScopedDevice(device):
        for _ in range(10):
            assert_steps_alike(d, TheirDynamics(m, d).step, ours, ours.find, 3e-5)
    assert d.nefc.numpy().max() == 0


def test_too_many_contacts_are_noted(device):
    m, d = robot_of(device)
    ours, too_many = Dynamics(m, d), mjw.OverflowType.NEFC | mjw.OverflowType.NARROWPHASE
    with wp.ScopedDevice(device):
        d.overflow.zero_()
        ours.find()
        ours.step()
        assert not (d.overflow.numpy() & too_many).any()
        d.nacon.fill_(d.naconmax + 1)
        ours.step()
        assert (d.overflow.numpy() & mjw.OverflowType.NARROWPHASE).all()


@pytest.mark.parametrize(
    "parts",
    [
        {"option": 'solver="CG"'},
        {"more": '<option><flag gravity="disable"/></option>'},
        {"option": 'density="1.2"'},
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
def test_other_models_take_their_step(device, parts):
    m, d = robot_of(device)
    assert isinstance(dynamics_of(m, d), Dynamics)
    m, d = robot_of(device, **parts)
    assert not fits_dynamics(m, d) and isinstance(dynamics_of(m, d), TheirDynamics)
