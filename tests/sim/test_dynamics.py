"""Our dynamics of a step find what mujoco_warp's find, from the same state."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp

from sim.solver import Dynamics, TheirDynamics, dynamics_of, fits_dynamics

Mujoco: Any = mujoco  # it names its types at run time
WORLDS = 12
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
_NOTHING = dict.fromkeys(("option", "inner", "outer", "actuator", "more"), "")


def model_of(device: str, **changes: str) -> tuple[Any, Any]:
    model = Mujoco.MjModel.from_xml_string(MODEL.format(**_NOTHING | changes))
    data = Mujoco.MjData(model)
    with wp.ScopedDevice(device):
        m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=WORLDS, nconmax=24, njmax=90)
    m.opt.run_collision_detection = False  # as Newton has it where it finds the contacts itself
    return m, d


def shake(m: Any, d: Any) -> None:
    rng = np.random.default_rng(3)
    qpos = d.qpos.numpy() + rng.normal(0.0, 0.3, d.qpos.shape)
    d.qpos.assign(qpos.astype(np.float32))
    d.qvel.assign(rng.normal(0.0, 1.5, d.qvel.shape).astype(np.float32))
    d.ctrl.assign(rng.normal(0.0, 1.0, d.ctrl.shape).astype(np.float32))


FOUND = ("xpos", "xquat", "cdof", "M", "qfrc_actuator", "qfrc_smooth")


STATE = ("qpos", "qvel", "qacc_warmstart")


def state_of(d: Any) -> list[np.ndarray]:
    return [getattr(d, name).numpy().copy() for name in STATE]


def put_back(d: Any, state: list[np.ndarray]) -> None:
    for name, value in zip(STATE, state, strict=True):
        getattr(d, name).assign(value)


def test_every_quantity_of_a_step(device: str) -> None:
    """Free and fixed trees, joints of all kinds with springs, actuators of all kinds at and off their limits."""
    m, d = model_of(device)
    mass = m.body_mass.numpy()
    m.body_mass = wp.array(
        np.repeat(mass, WORLDS, 0) * np.linspace(0.9, 1.1, WORLDS)[:, None], dtype=float, device=device
    )
    assert fits_dynamics(m, d)
    ours, theirs = Dynamics(m, d), TheirDynamics(m, d)
    shake(m, d)
    limited = {"force": 0, "joint": 0, "control": 0}
    with wp.ScopedDevice(device):
        for _ in range(40):
            before = state_of(d)
            theirs.find()
            mjw.com_pos(m, d)
            mjw.collision(m, d)
            theirs.step()
            expected = {name: getattr(d, name).numpy().copy() for name in FOUND}
            roots = m.body_rootid.numpy()
            com = d.subtree_com.numpy()[:, roots].copy()
            after = state_of(d)
            force = d.actuator_force.numpy()
            limited["force"] += int(np.isin(force[:, 0], (-4.0, 5.0)).sum())
            limited["joint"] += int(np.isin(expected["qfrc_actuator"][:, 8], (-3.0, 2.0)).sum())
            limited["control"] += int(np.isclose(np.abs(force[:, 1]), (0.5, 0.7)[0]).sum())
            put_back(d, before)
            ours.find()
            for name, value in expected.items():
                size = np.abs(value).max() + 1e-3
                np.testing.assert_allclose(getattr(d, name).numpy(), value, atol=3e-6 * size, err_msg=name)
            np.testing.assert_allclose(d.subtree_com.numpy()[:, roots[1:]], com[:, 1:], atol=1e-5)
            ours.step()
            for array, value in zip(state_of(d), after, strict=True):
                size = np.abs(value).max(axis=1, keepdims=True) + 1.0
                assert (np.abs(array - value) / size).max() < 2e-3
    assert min(limited.values()) > 10
    assert d.nefc.numpy().max() > 0


def test_the_slope_of_forces_is_that_of_mujoco_warp(device: str) -> None:
    """Without constraints a step is that of the forces alone, and agrees to rounding."""
    m, d = model_of(device)
    qpos = d.qpos.numpy()
    qpos[:, 2] += 50.0
    d.qpos.assign(qpos)
    ours, theirs = Dynamics(m, d), TheirDynamics(m, d)
    shake(m, d)
    with wp.ScopedDevice(device):
        for _ in range(10):
            before = state_of(d)
            theirs.step()
            after = state_of(d)
            put_back(d, before)
            ours.find()
            ours.step()
            for array, value in zip(state_of(d), after, strict=True):
                size = np.abs(value).max(axis=1, keepdims=True) + 1.0
                np.testing.assert_allclose(array / size, value / size, atol=3e-5)
    assert d.nefc.numpy().max() == 0


def test_too_many_rows_and_contacts_are_told(device: str) -> None:
    m, d = model_of(device)
    codes = mjw.OverflowType
    ours = Dynamics(m, d)
    with wp.ScopedDevice(device):
        mjw.kinematics(m, d)
        d.overflow.zero_()
        ours.find()
        ours.step()
        assert not (d.overflow.numpy() & (codes.NEFC | codes.NARROWPHASE)).any()
        d.overflow.zero_()
        d.nacon.fill_(d.naconmax + 1)
        ours.step()
        assert (d.overflow.numpy() & codes.NARROWPHASE).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"option": 'solver="CG"'},
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
def test_other_models_take_their_step(device: str, changes: dict[str, str]) -> None:
    m, d = model_of(device, **changes)
    assert not fits_dynamics(m, d) and isinstance(dynamics_of(m, d), TheirDynamics)


def test_disabled_forces_take_their_step(device: str) -> None:
    m, d = model_of(device)
    assert isinstance(dynamics_of(m, d), Dynamics)
    m.opt.disableflags |= Mujoco.mjtDisableBit.mjDSBL_GRAVITY
    assert isinstance(dynamics_of(m, d), TheirDynamics)
