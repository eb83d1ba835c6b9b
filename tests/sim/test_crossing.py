"""The crossing's settings as the kernels take them."""

import numpy as np
import pytest

from sim.crossing import CrossingCfg, make_start_ranges, make_task


def test_the_crossing_is_the_papers(anymal):
    # 20 s of 0.005 s steps at 0.75 m/s; out where |y - 4| > 6 or x outside of [-2, 18]; base collision above 1 N.
    task = make_task(CrossingCfg(), anymal)
    assert (task.max_steps, task.first_counted_step) == (4000, 1)
    assert (tuple(task.goal), task.goal_radius) == ((14, 4), 0.5)
    assert (task.speed, task.yaw_gain, task.max_yaw_rate) == (0.75, 0.5, 1.0)
    assert (tuple(task.lower), tuple(task.upper)) == ((-2, -2), (18, 10))
    assert (task.base_force, task.max_speed) == (1.0, 100.0)
    assert task.overflow_mask == 0xFFFF & ~(512 | 1024)  # caps of iterations are no overflow
    # From 2 s on: step 401 is the first after 400 steps of 0.005 s.
    assert make_task(CrossingCfg(penalties_from_s=2.0), anymal).first_counted_step == 401


def test_the_start_is_as_defined(anymal):
    ranges = make_start_ranges(CrossingCfg(), anymal)
    assert tuple(ranges.position) == (2, 4) and ranges.base_height == pytest.approx(0.6)
    widths = [ranges.position_range, ranges.yaw_range, ranges.joint_scale_range, ranges.velocity_range]
    np.testing.assert_allclose(widths, [0.1, 0.2, 0.2, 0.2], rtol=1e-6)
    np.testing.assert_allclose(tuple(ranges.footprint), anymal.footprint, rtol=1e-6)
