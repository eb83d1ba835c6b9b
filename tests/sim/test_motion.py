"""What rewards are computed from: soft limits by hand, and which joints are to keep still."""

from dataclasses import replace

import numpy as np
import pytest

from sim.motion import make_motion, soft_joint_limits
from sim.robots.training import TrainingCfg
from tests.sim.scenes import ONLY_ANYMAL, ONLY_CASSIE

NOTHING = dict.fromkeys(("command", "action", "previous_action", "previous_joint_vel", "fallen"))


@ONLY_CASSIE
def test_soft_limits_by_hand(eight):
    # Abduction spans -.2618 to .3927: .06545 +- .95 * .32725. The toe -2.4435 to -.5236: -1.48355 +- .95 * .95995.
    lower, upper = soft_joint_limits(eight, 0.95)
    np.testing.assert_allclose([lower[0], upper[0]], [-0.2454375, 0.3763375], atol=1e-6)
    np.testing.assert_allclose([lower[5], upper[5]], [-2.3955025, -0.5715975], atol=1e-6)
    np.testing.assert_allclose([lower[6], upper[6]], [-0.3763375, 0.2454375], atol=1e-6)  # mirrored
    assert lower.shape == upper.shape == (12,)


@ONLY_ANYMAL
def test_joints_that_turn_freely_have_far_limits(eight):
    lower, upper = soft_joint_limits(eight, 0.9)
    np.testing.assert_allclose([lower[0], upper[0]], [-0.115 - 0.9 * 0.605, -0.115 + 0.9 * 0.605], atol=1e-6)
    assert (lower[1:3] < -1e9).all() and (upper[1:3] > 1e9).all()
    assert np.isfinite(lower).all() and np.isfinite(upper).all()


def test_a_robots_own_settings_reach_the_kernels(eight, robot):
    motion = make_motion(eight, robot.training, **NOTHING)
    steady = {name for name, flag in zip(robot.joint_names, motion.joint_is_steady.numpy(), strict=True) if flag}
    hips = {f"hip_{joint}_{side}" for joint in ("abduction", "rotation") for side in ("left", "right")}
    assert steady == (hips if robot.name == "cassie" else set())
    assert motion.force_limit == robot.contact_force_limit and motion.dt == pytest.approx(0.02)
    lower, upper = soft_joint_limits(eight, robot.training.soft_joint_limit)
    np.testing.assert_array_equal(motion.joint_lower.numpy(), lower)
    np.testing.assert_array_equal(motion.joint_upper.numpy(), upper)
    np.testing.assert_allclose(motion.default_joint_pos.numpy(), robot.default_joint_pos, rtol=1e-6)


@ONLY_CASSIE
def test_a_joint_that_is_not_there_is_named(eight, robot):
    cfg = replace(robot.training, steady_joints=("hip_rotation_left", "knee"))
    with pytest.raises(ValueError, match="robot 'cassie' has no joint named knee: expected some of hip_abduction_left"):
        make_motion(eight, cfg, **NOTHING)
    assert TrainingCfg().steady_joints == ()
