"""How much more of each penalty a crossing costs that misses the goal."""

import json
from dataclasses import replace

import numpy as np
import pytest

from qd.studies.penalty_ratios import PenaltyRatios, crossed_with_absolute, ratios_of
from qd.workers.invalid import AllInvalidError
from sim.crossing import CrossingCfg
from sim.robots.robot import get_robot
from sim.rollout import Rollout
from tests.qd.stand_in import make_result
from tests.sim.policies import stand
from tests.sim.scenes import FLAT

SHORT = CrossingCfg(max_duration_s=0.6, poll_every_s=0.1)


def test_ratios_by_hand():
    # Two terrains in turns. Episodes that reached the goal cost 1 and 3, mean 2, in the first penalty, and nothing in
    # the second; those that missed it 10 and 30, mean 20, and 6. Invalid ones are left out.
    first = make_result([[[1, 0], [10, 6], [9, 9]]], invalid=[[False, False, True]])
    second = make_result([[[3, 0], [30, 6], [9, 9]]], invalid=[[False, False, True]])
    results = [replace(one, reached_goal=np.array([[True, False, False]])) for one in (first, second)]
    absolute = [np.array([[[2, 0, 0], [3, 5, 0], [8, 8, 8]]]), np.array([[[2, 0, 0], [5, 5, 0], [8, 8, 8]]])]
    report = ratios_of(list(zip(results, absolute, strict=True)))
    assert (report["episodes"], report["invalid_episodes"], report["failing_episodes"]) == (6, 2, 2)
    assert report["penalties"]["yaw_rate"] == {"failing": 20.0, "reached": 2.0, "ratio": 10.0}
    assert report["penalties"]["vel_x"] == {"failing": 6.0, "reached": 0.0, "ratio": None}
    assert report["absolute"]["yaw_rate"] == {"failing": 4.0, "reached": 2.0, "ratio": 2.0}
    assert set(report["absolute"]) == {"yaw_rate", "vel_x"}  # those that the robot has


def test_where_nothing_is_valid_that_is_said():
    nothing = make_result([[[1, 2]]], invalid=[[True]])
    with pytest.raises(AllInvalidError, match="all 1 episodes are invalid"):
        ratios_of([(nothing, np.zeros((1, 1, 3)))])


def test_no_failure_gives_no_ratio():
    report = ratios_of([(make_result([[[1, 2]]]), np.ones((1, 1, 3)))])
    assert report["penalties"]["yaw_rate"] == {"failing": None, "reached": 1.0, "ratio": None}


@pytest.fixture(scope="module")
def crossings():
    """The same eight episodes, by eight robots at once and by four one after the other."""

    def crossed(num_envs):
        rollout = Rollout(
            get_robot("anymal"), stand, num_terrains=2, num_replicas=4, num_envs=num_envs, device="cpu", cfg=SHORT
        )
        return crossed_with_absolute(rollout, np.stack([FLAT, FLAT]), np.array([1, 2], np.uint32))

    return crossed(8), crossed(4)


def test_absolute_errors_of_a_robot_that_stands(crossings):
    # Commanded .75 m/s toward the goal and not moving: 0.6 s cost .45 m, and squared .3375 (m/s)^2 s, but for the first
    # moment, in which it starts with up to .2 m/s. The square of a mean is never more than the mean square.
    (result, absolute), _ = crossings
    squared = result.penalties[..., [result.penalty_names.index(name) for name in ("yaw_rate", "vel_x", "vel_y")]]
    np.testing.assert_allclose(absolute[..., 1], 0.45, atol=0.06)
    np.testing.assert_allclose(squared[..., 1], 0.3375, atol=0.08)
    assert (absolute > 0).all()
    assert (absolute**2 <= squared * 0.6 * (1 + 1e-4)).all()


def test_an_episode_costs_the_same_whichever_robot_runs_it(crossings):
    (_, together), (_, queued) = crossings
    np.testing.assert_allclose(queued, together, rtol=1e-4)


@pytest.mark.slow  # whole crossings
def test_the_command_publishes_what_it_measured(tmp_path, capsys):
    out = tmp_path / "ratios.json"
    PenaltyRatios(device="cpu", terrains=4, replicas=4, out=out).execute()
    content = json.loads(out.read_text())
    assert (content["robot"], content["penalty_definition"], content["episodes"]) == ("anymal", "squared", 16)
    assert list(content["penalties"]) == list(get_robot("anymal").penalties)
    assert "of 16 episodes missed the goal" in capsys.readouterr().out
