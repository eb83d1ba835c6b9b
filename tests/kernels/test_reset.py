"""Masked clearing of rows."""

import numpy as np
import pytest
import warp as wp

from kernels.reset import clear_rows


def test_only_masked_rows_are_cleared(device):
    rows = wp.array(np.arange(1, 13, dtype=np.float32).reshape(4, 3), device=device)
    clear_rows(wp.array([0, 1, 0, 7], dtype=int, device=device), rows)
    np.testing.assert_array_equal(rows.numpy(), [[1, 2, 3], [0, 0, 0], [7, 8, 9], [0, 0, 0]])


def test_rows_that_are_not_finite_are_cleared(device):
    rows = wp.array(np.full((1, 2), np.nan, np.float32), device=device)
    clear_rows(wp.array([1], dtype=int, device=device), rows)
    assert not rows.numpy().any()


def test_wrong_mask_is_named(device):
    with pytest.raises(ValueError, match=r"\(4,\), got \(3,\)"):
        clear_rows(wp.zeros(3, dtype=int, device=device), wp.zeros((4, 2), dtype=float, device=device))
