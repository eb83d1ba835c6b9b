"""Looking early at who has converged saves Hessians and changes nothing, however the iterations are launched."""

import numpy as np
import pytest

from kernels.convergence import stop_converged
from sim.convergence import stop_early
from sim.rollout import CrossingCfg, Rollout
from sim.space import SUPER_GAUSSIAN


def crossings(robot, *, early, loop):
    stop_early(early)
    try:
        cfg = CrossingCfg(max_duration_s=3.0)
        rollout = Rollout(robot, robot.policy_file, num_terrains=2, num_replicas=4, device="cpu", cfg=cfg)
        rollout.sim.solver.mjw_model.opt.graph_conditional = loop
        rollout._step_graph = rollout.sim.capture(rollout._launch_control_step)
    finally:
        stop_early()
    genes = SUPER_GAUSSIAN.hard_random(2, np.random.default_rng(3))
    result = rollout.evaluate(genes, np.arange(2, dtype=np.uint32))
    return rollout.sim.joint_q.numpy().copy(), result.penalties, rollout.sim.solver.mjw_data.solver_niter.numpy().copy()


@pytest.mark.parametrize("loop", [True, False])
def test_results_are_the_solvers_own(robot, loop):
    late = crossings(robot, early=False, loop=True)
    for ours, theirs in zip(crossings(robot, early=True, loop=loop), late, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_every_iteration_is_looked_at(eight, monkeypatch):
    looks, opt = [], eight.solver.mjw_model.opt
    monkeypatch.setattr("sim.convergence.stop_converged", lambda *arrays: looks.append(stop_converged(*arrays)))
    monkeypatch.setattr(opt, "graph_conditional", False)
    eight.physics_step()
    assert len(looks) == opt.iterations
