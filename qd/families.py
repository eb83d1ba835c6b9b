"""Families: elites that descend from each other are much alike, and are not independent of each other.

Who descends from whom is not recorded. Two terrains are taken for kin if their heights differ by less than
:data:`KIN_M` (root mean square), and a family is all that are joined by kin.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sim.space import TerrainSpace

KIN_M = 0.06
"""Terrains that differ by less are kin [m]. Of 850 hard-random terrains no two do; half of the elites have kin."""

_EVERY = 2  # nodes; distances are compared at 0.1 m
_BANK = 50  # height maps that are made at once


def families_of(genes: NDArray[np.float32], space: "TerrainSpace") -> NDArray[np.int64]:
    """Number of the family of each terrain, from 0 in the order of its first member, shape (N,).

    Args:
        genes: Shape (N, num_genes).
        space: What they mean.
    """
    from sim.bank import heights_of  # with Warp: not for `--help`

    banks = [heights_of(genes[first : first + _BANK], space, every=_EVERY) for first in range(0, len(genes), _BANK)]
    maps = [bank.reshape(len(bank), -1).astype(np.float64) for bank in banks]
    return joined(rms_distances(np.concatenate(maps), np.concatenate(maps)) < KIN_M) if maps else np.zeros(0, np.int64)


def joined(kin: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number of the group that each of N belongs to, from 0 in the order of its first member, shape (N,).

    Args:
        kin: Which are joined directly, shape (N, N).
    """
    from scipy.sparse.csgraph import connected_components

    _, labels = connected_components(kin, directed=False)
    _, first, places = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[places].astype(np.int64)


def rms_distances(maps: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distances of height maps to others [m], shape (T, N).

    Args:
        maps: Heights [m] as rows, shape (T, num_nodes); double, since their squares are subtracted from each other.
        others: Likewise, shape (N, num_nodes).
    """
    squares = (maps**2).sum(axis=1)[:, None] + (others**2).sum(axis=1) - 2.0 * maps @ others.T
    return np.sqrt(np.maximum(squares, 0.0) / maps.shape[1])
