"""Masked reset of per-environment rows."""

from typing import Any

import warp as wp


@wp.kernel
def _clear_rows_kernel(mask: wp.array[int], rows_out: wp.array2d[float]):
    """Grid (num_envs, num_columns)."""
    env, k = wp.tid()
    if mask[env] != 0:
        rows_out[env, k] = 0.0


def clear_rows(mask: Any, rows_out: Any) -> None:
    """Set the rows of ``rows_out`` (num_envs, num_columns) to zero where the int ``mask`` (num_envs,) is not 0.

    Raises:
        ValueError: If the mask has not one entry a row.
    """
    if mask.shape[0] != rows_out.shape[0]:
        raise ValueError(f"mask must have shape ({rows_out.shape[0]},), got {tuple(mask.shape)}")
    wp.launch(_clear_rows_kernel, dim=rows_out.shape, inputs=[mask], outputs=[rows_out], device=rows_out.device)
