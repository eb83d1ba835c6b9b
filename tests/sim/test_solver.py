"""Our solver of contacts finds what mujoco_warp's finds, from the same problem."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp

from sim.solver import fits, solve_contacts, solve_theirs, use_own_solver

Mujoco: Any = mujoco  # it names its types at run time
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
WORLDS = 16


def solved(solve: Any, m: Any, d: Any) -> dict[str, np.ndarray]:
    d.overflow.zero_()
    d.qacc_warmstart.zero_()  # a step has left its solution there
    solve(m, d)
    rows = d.nefc.numpy()
    force, state = d.efc.force.numpy(), d.efc.state.numpy()
    for world, count in enumerate(rows):
        force[world, count:], state[world, count:] = 0.0, 0
    arrays = {"qacc": d.qacc, "qfrc": d.qfrc_constraint, "momentum": d.efc.Ma, "iterations": d.solver_niter}
    return {name: array.numpy().copy() for name, array in arrays.items()} | {"force": force, "state": state}


def assert_alike(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], relative: float) -> None:
    """To rounding, relative to the largest number of a world; where rounding made one more iteration, to ten times."""
    differs = np.abs(ours["iterations"] - theirs["iterations"])
    assert differs.max() <= 1
    assert (differs > 0).mean() <= 0.25
    for name in ("qacc", "qfrc", "momentum", "force"):
        size = np.abs(theirs[name]).max(axis=1) + 1.0
        error = np.abs(ours[name] - theirs[name]).max(axis=1) / size
        assert (error < np.where(differs > 0, 10.0, 1.0) * relative).all(), (name, error)


def everything(device: str, cone: str = "elliptic") -> tuple[Any, Any]:
    """Worlds of a thing with equality, friction losses, a limit and contacts of 1, 3, 4 and 6 dimensions."""
    model = Mujoco.MjModel.from_xml_string(EVERYTHING.format(cone=cone))
    data = Mujoco.MjData(model)
    rng = np.random.default_rng(5)
    with wp.ScopedDevice(device):
        m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=WORLDS, nconmax=24, njmax=90)
        qpos, qvel = d.qpos.numpy(), rng.normal(0.0, 1.0, d.qvel.shape)
        qpos[:, 2] += rng.uniform(-0.05, 0.05, WORLDS)
        qpos[:, 3:7] += rng.normal(0.0, 0.15, (WORLDS, 4))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qpos[:, 7:] += rng.normal(0.0, 0.3, (WORLDS, 3))
        d.qpos.assign(qpos)
        d.qvel.assign(qvel)
    return m, d


def test_every_kind_of_constraint(device: str) -> None:
    m, d = everything(device)
    assert fits(m, d)
    seen, states = set[int](), set[int]()
    use_own_solver(False)
    try:
        with wp.ScopedDevice(device):
            for _ in range(25):
                mjw.step(m, d)
                theirs = solved(solve_theirs, m, d)
                ours = solved(solve_contacts, m, d)
                assert_alike(ours, theirs, 2e-3)
                for world, count in enumerate(d.nefc.numpy()):
                    seen |= set(d.efc.type.numpy()[world, :count].tolist())
                    states |= set(ours["state"][world, :count].tolist())
    finally:
        use_own_solver()
    kinds = Mujoco.mjtConstraint
    assert seen >= {kinds.mjCNSTR_EQUALITY, kinds.mjCNSTR_FRICTION_DOF, kinds.mjCNSTR_LIMIT_JOINT}
    assert seen >= {kinds.mjCNSTR_CONTACT_FRICTIONLESS, kinds.mjCNSTR_CONTACT_ELLIPTIC}
    assert states == {0, 1, 2, 3, 4}


def test_robots_that_fall(eight: Any) -> None:
    """Steps of the robots that searches cross with, in all states of their contacts."""
    m, d = eight.solver.mjw_model, eight.solver.mjw_data
    assert fits(m, d)
    rng, states, mean_iterations = np.random.default_rng(2), set[int](), list[float]()
    pose, qd = eight.joint_q.numpy().copy(), eight.joint_qd.numpy()
    pose[:, :3] = (3.0, 4.0, eight.robot.default_base_height + 0.02)
    pose[:, 3:7] = (0.0, 0.0, 0.0, 1.0)
    pose[:, 7:] = eight.robot.default_joint_pos
    eight.joint_q.assign(pose)
    eight.joint_qd.assign(rng.normal(0.0, 0.7, qd.shape).astype(np.float32))
    eight.targets.assign(pose)
    eight.refresh()
    with wp.ScopedDevice(eight.device):
        for _ in range(120):
            eight.physics_step()
            theirs = solved(solve_theirs, m, d)
            ours = solved(solve_contacts, m, d)
            assert_alike(ours, theirs, 2e-3)
            states |= set(ours["state"].ravel().tolist())
            mean_iterations.append(ours["iterations"].mean())
    assert states >= {0, 1, 4}
    assert np.mean(mean_iterations) > 1.5


def test_a_model_that_does_not_fit_is_solved_as_before(device: str) -> None:
    m, d = everything(device, cone="pyramidal")
    assert not fits(m, d)
    with wp.ScopedDevice(device):
        mjw.step(m, d)
    assert np.isfinite(d.qacc.numpy()).all()
    assert d.solver_niter.numpy().max() > 0


def test_a_world_that_is_not_finite_ends(device: str) -> None:
    m, d = everything(device)
    with wp.ScopedDevice(device):
        mjw.step(m, d)
        d.qacc_warmstart.fill_(float("nan"))
        solve_contacts(m, d)
    assert (d.solver_niter.numpy() <= m.opt.iterations).all()
    assert not np.isfinite(d.qacc.numpy()).any()


@pytest.mark.parametrize("count", [0, 3])
def test_no_rows_and_few(device: str, count: int) -> None:
    """Worlds without constraints take their smooth accelerations."""
    m, d = everything(device)
    with wp.ScopedDevice(device):
        mjw.step(m, d)
        d.nefc.fill_(count)
        d.ne.fill_(0)
        d.nf.fill_(count)
        solve_contacts(m, d)
    if count == 0:
        np.testing.assert_allclose(d.qacc.numpy(), d.qacc_smooth.numpy(), rtol=1e-3, atol=1e-2)
    else:
        assert (d.efc.state.numpy()[:, :count] > 0).all()
