"""The search space: a terrain is a row of genes in [-1, 1], a mixture of Super-Gaussian bumps (the paper's Table I)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

NUM_BUMPS = 8
"""Super-Gaussian bumps of one terrain."""
GENES_PER_BUMP = 8
"""Genes of one bump: mu_x, mu_y, sigma_x, sigma_y, p_x, p_y, theta, w."""
NUM_GENES = NUM_BUMPS * GENES_PER_BUMP
"""Length of one row of genes."""


def validate(genes: ArrayLike) -> NDArray[np.float32]:
    """Genes as a float32 array, checked but not clipped.

    Args:
        genes: Shape (batch, 64); per bump in the order of the paper's Table I.

    Returns:
        The same genes, float32, shape (batch, 64).

    Raises:
        ValueError: If the shape is another one, or a gene is not finite.
    """
    array = np.asarray(genes, dtype=np.float32)
    if array.ndim != 2 or array.shape[1] != NUM_GENES:
        raise ValueError(
            f"genes must have shape (batch, {NUM_GENES}), got {array.shape}: "
            f"one row is {NUM_BUMPS} bumps x {GENES_PER_BUMP}"
        )
    finite = np.isfinite(array).all(axis=1)
    if not finite.all():
        raise ValueError(f"genes must be finite, got NaN or infinity in row {int(np.argmin(finite))}")
    return array


def clip(genes: ArrayLike) -> NDArray[np.float32]:
    """Genes as the terrain sees them: clipped to [-1, 1] (the search itself is unbounded).

    Args:
        genes: Shape (batch, 64).

    Returns:
        Clipped copy, float32, shape (batch, 64).

    Raises:
        ValueError: If the shape is another one, or a gene is not finite.
    """
    return np.clip(validate(genes), -1.0, 1.0)
