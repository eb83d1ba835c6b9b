"""A strip: what collision shapes are made of for :mod:`kernels.contact`."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Strip:
    """A row of equal spheres on one shape, straight but for meshes."""

    centres: np.ndarray
    """Centres in the shape's frame [m], shape (num_probes, 3), in order along the strip."""
    radius: float
    """Probe radius [m]."""
    spread: float = 0.0
    """Farthest that a centre lies from the straight line between the first and the last one [m]."""
