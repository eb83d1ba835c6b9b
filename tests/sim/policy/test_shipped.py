"""The shipped controllers do what they are shipped for, and what happens when one falls is counted."""

import numpy as np

from sim.rollout import Rollout
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import crossing_terrain
from tests.sim.scenes import FLAT


def test_the_shipped_controller_walks_to_the_goal(robot, device):
    terrains = np.stack([FLAT, crossing_terrain("stairs_up_down", 4, 3)])
    rollout = Rollout(robot, robot.policy_file, num_terrains=2, num_replicas=4, device=device)
    result = rollout.evaluate(terrains, np.array([1, 2], np.uint32))
    assert result.reached_goal.all() and not result.fallen.any()
    # 11.5 m at 0.75 m/s: it keeps up with its command, and does not run ahead of it.
    assert ((result.duration_s > 14.0) & (result.duration_s < 18.0)).all()


def test_a_robot_whose_legs_whip_as_it_falls_has_failed(cassie, device):
    # On this terrain all eight fall, and two of them swing an ankle at more than 100 rad/s before the pelvis is down.
    genes = SUPER_GAUSSIAN.hard_random(300, 0)[7:8]
    result = Rollout(cassie, cassie.policy_file, num_terrains=1, num_replicas=8, device=device).evaluate(
        genes, np.array([7], np.uint32)
    )
    assert result.base_collision.sum() >= 6 and not result.invalid.any()
