import numpy as np
import pytest

from qd.bandit import MEMORY, ZETA, Bandit

ALL = slice(0, 4)


def test_who_has_never_asked_goes_first_then_who_had_most_elites():
    bandit = Bandit(np.zeros((2, 4)), 2)
    assert bandit.best(ALL) == bandit.best(ALL) == [0, 1]
    bandit.tell(ALL, [0, 1], np.array([True, True, True, False]))
    assert bandit.best(ALL) == [2, 3]
    bandit.tell(ALL, [2, 3], np.array([True, False, False, False]))
    np.testing.assert_allclose(bandit.counts, [[2 * MEMORY, 1 * MEMORY, 1, 0], [2 * MEMORY, 2 * MEMORY, 2, 2]])
    # Rates 1, .5, .5 and 0; of those with .5 the older counts are the less certain.
    assert bandit.best(ALL) == [0, 1]


def test_ucb1_by_hand():
    # .5 + .05 sqrt(ln 106 / 100) = .511 against .4 + .05 sqrt(ln 106 / 4) = .454 and .45 + .05 sqrt(ln 106 / 2) = .526
    bandit = Bandit(np.array([[50.0, 1.6, 0.9], [100.0, 4.0, 2.0]]), 1)
    assert ZETA == 0.05
    assert bandit.best(slice(0, 3)) == [2]
    bandit.counts[0, 2] = 0.8
    assert bandit.best(slice(0, 3)) == [0]


def test_an_emitter_that_rests_is_forgotten_and_tried_again():
    bandit = Bandit(np.array([[10.0, 9.0], [20.0, 20.0]]), 1)
    chosen = []
    for _ in range(200):
        own = bandit.best(slice(0, 2))
        chosen += own
        bandit.tell(slice(0, 2), own, np.arange(20) < (8 if own == [0] else 2))
    assert chosen.count(0) > chosen.count(1) > 0


def test_pools_know_nothing_of_each_other():
    bandit = Bandit(np.zeros((2, 8)), 4)
    first, last = slice(0, 4), slice(4, 8)
    bandit.tell(first, bandit.best(first), np.ones(4, bool))
    assert bandit.best(last) == [4, 5]
    assert not bandit.counts[:, last].any()
    bandit.tell(last, [4, 5], np.zeros(4, bool))
    assert bandit.counts[:, first].tolist() == [[2, 2, 0, 0], [2, 2, 0, 0]]


@pytest.mark.parametrize(
    ("counts", "active", "message"),
    [(np.zeros((2, 4)), 3, "a whole part must be active, got 3"), (np.zeros(4), 2, r"shape \(2, num_emitters\)")],
)
def test_counts_must_fit(counts, active, message):
    with pytest.raises(ValueError, match=message):
        Bandit(counts, active)
