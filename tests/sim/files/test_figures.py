"""Lengths of error bars."""

import numpy as np

from sim.files.figures import bar_lengths


def test_bars_reach_from_the_value_to_its_limits():
    lengths = bar_lengths([0.5, 0.2, 1.0], [(0.3, 0.9), None, (1.0, 1.0 - 1e-17)])
    assert np.allclose(lengths[:, 0], [0.2, 0.4])
    assert np.isnan(lengths[:, 1]).all()  # nothing is drawn
    assert (lengths[:, 2] == 0.0).all()  # not below zero, which is refused by who draws them


def test_there_may_be_none():
    assert bar_lengths([], []).shape == (2, 0)
