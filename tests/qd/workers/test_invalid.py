"""What is said of invalid episodes, the error where there is nothing else, and results that cannot be true."""

from dataclasses import replace

import numpy as np
import pytest

from kernels.episode import Invalidity, Outcome
from qd.workers.invalid import AllInvalidError, explain_invalid, find_flaw, invalid_iterations, report_invalid
from tests.qd.stand_in import evaluate, make_result

FINE, ACTION, SPEED = Invalidity.NONE, Invalidity.ACTION, Invalidity.SPEED


def result_of(codes):
    result = make_result(np.ones((*np.shape(codes), 1)), invalid=np.array(codes) != FINE)
    result.invalidity[:] = codes
    return result


def test_more_than_one_in_twenty_is_reported_with_the_remedy_of_the_most_frequent_reason():
    # 1 of 20 is 5 %, 2 of 20 are 10 %.
    assert explain_invalid({"speed": 1}, 20) is None
    words = explain_invalid({"speed": 1, "action": 1}, 20)
    assert "2 of 20" in words and "10.0%" in words and "max_speed" in words


def test_of_a_searchs_iterations_those_with_many_are_summed():
    # 3 of 40 are more than 5 %, 2 of 40 are not. 3 + 40 of 80 are 53.75 %.
    rows = [
        {"episodes": 40, "invalid_episodes": 3, "invalid_reasons": {"overflow": 2, "speed": 1}},
        {"episodes": 40, "invalid_episodes": 2, "invalid_reasons": {"speed": 2}},
        {"episodes": 40, "invalid_episodes": 40, "invalid_reasons": {"state": 40}},
    ]
    words = invalid_iterations(rows)
    assert "2 of 3" in words and "43 of 80" in words and "53.8%: 40 non-finite state, 2 solver overflow" in words
    assert invalid_iterations(rows[1:2]) is None


def test_nothing_but_invalid_episodes_is_an_error_unless_it_may_be(capsys):
    nothing = result_of([[ACTION, ACTION, SPEED]])
    with pytest.raises(AllInvalidError):
        report_invalid(nothing, "flat")
    report_invalid(nothing, "flat", all_ok=True)
    report_invalid(result_of([[ACTION, ACTION, FINE]]), "steep")
    assert [line[:5] for line in capsys.readouterr().err.splitlines()] == ["flat:", "steep"]
    report_invalid(result_of([[FINE] * 3]), "flat")
    assert capsys.readouterr().err == ""


RESULT = evaluate(np.zeros((3, 64), np.float32), np.arange(3), 4)
CHANGES = [
    {"penalties": np.ones((2, 4, 6))},
    {"penalties": np.ones((3, 4, 5))},
    {"penalties": np.full((3, 4, 6), -1.0)},
    {"penalties": np.full((3, 4, 6), np.inf)},
    {"outcome": np.full((3, 4), Outcome.INVALID, np.uint8)},  # without a reason
    {"duration_s": np.zeros((3, 4), np.float32)},
    {"physics_steps": 0},
    {"reward": np.full((3, 4), np.nan)},
    {"reward": np.zeros((3, 3))},
]


@pytest.mark.parametrize("changes", CHANGES, ids=lambda changes: next(iter(changes)))
def test_a_result_that_cannot_be_true_is_known(changes):
    assert find_flaw(RESULT, 3, 4) is None
    assert find_flaw(replace(RESULT, **changes), 3, 4) and find_flaw("all went well", 3, 4)
