"""Genes to heights: mixtures of rotated Super-Gaussians rasterised on the device (the paper's eq. 1 and Table I)."""

from typing import Any

import numpy as np
import warp as wp

from kernels.launch import kernel_over

PARAMETERS = ("mu_x", "mu_y", "sigma_x", "sigma_y", "p_x", "p_y", "theta", "w")
"""Parameters of one bump in gene order: centre [m], half widths [m], exponents, rotation [rad], height [m]."""
GENES_PER_BUMP = len(PARAMETERS)
LOWER = np.array([6.0, 2.0, 0.5, 0.5, 1.0, 1.0, -np.pi, -0.25])
"""Table I, minimum of each parameter: the value of a gene of -1."""
UPPER = np.array([10.0, 6.0, 3.0, 3.0, 4.0, 4.0, np.pi, 0.25])
"""Table I, maximum of each parameter: the value of a gene of 1."""

NEGLIGIBLE = wp.constant(30.0)
"""An exponent beyond which a bump adds less than 3e-14 m, nothing in single precision."""

_genes = wp.types.vector(GENES_PER_BUMP, float)
_POWER = """
#if defined(__CUDA_ARCH__)
return exp2f(exponent * __log2f(base));
#else
return powf(base, exponent);
#endif
"""


@wp.struct
class Bump:
    """One bump, with everything worked out that is the same at every node."""

    centre: wp.vec2
    across: wp.vec2
    """First row of the rotation over sigma_x [1/m]."""
    along: wp.vec2
    """Second row of the rotation over sigma_y [1/m]."""
    power: wp.vec2
    """Exponents, 2 p_x and 2 p_y."""
    reach: wp.vec2
    """Scaled distances beyond which the bump adds nothing."""
    height: float


@wp.func_native(_POWER)
def _power(base: float, exponent: float) -> float:
    """A power of a positive number or 0; a GPU's is right to 3e-6 of it where it is at most 30."""
    ...


@wp.func
def super_gaussian(bump: Bump, x: float, y: float) -> float:
    """Height [m] one bump adds at (x, y) [m] (equation 1)."""
    offset = wp.vec2(x, y) - bump.centre
    u = wp.abs(wp.dot(bump.across, offset))
    v = wp.abs(wp.dot(bump.along, offset))
    if bump.height == 0.0 or u > bump.reach[0] or v > bump.reach[1]:
        return 0.0
    return bump.height * wp.exp(-_power(u, bump.power[0]) - _power(v, bump.power[1]))


@kernel_over("bumps_out")
def _decode_genes(genes: wp.array2d[float], lower: _genes, upper: _genes, bumps_out: wp.array2d[Bump]):
    """Grid (num_terrains, num_bumps)."""
    t, b = wp.tid()
    value = _genes()
    for k in range(GENES_PER_BUMP):
        share = (wp.clamp(genes[t, b * GENES_PER_BUMP + k], -1.0, 1.0) + 1.0) * 0.5
        value[k] = lower[k] + share * (upper[k] - lower[k])
    cos_theta = wp.cos(value[6])
    sin_theta = wp.sin(value[6])
    bump = Bump()
    bump.centre = wp.vec2(value[0], value[1])
    bump.across = wp.vec2(cos_theta, -sin_theta) / value[2]
    bump.along = wp.vec2(sin_theta, cos_theta) / value[3]
    bump.power = wp.vec2(2.0 * value[4], 2.0 * value[5])
    bump.reach = wp.vec2(wp.pow(NEGLIGIBLE, 1.0 / bump.power[0]), wp.pow(NEGLIGIBLE, 1.0 / bump.power[1]))
    bump.height = value[7]
    bumps_out[t, b] = bump


@kernel_over("heights_out")
def _rasterise_bumps(bumps: wp.array2d[Bump], spacing: float, factor: float, heights_out: wp.array3d[float]):
    """Grid (num_terrains, nrow, ncol)."""
    t, row, col = wp.tid()
    x = float(col) * spacing
    y = float(row) * spacing
    height = float(0.0)
    for b in range(bumps.shape[1]):
        height += super_gaussian(bumps[t, b], x, y)
    heights_out[t, row, col] = factor * height


def rasterise(genes: Any, spacing: float, heights_out: Any, factor: float = 1.0, *origin: float) -> None:
    """Rasterise one Super-Gaussian mixture a terrain (equation 1; genes clipped to [-1, 1], rescaled by Table I).

    Genes have shape (num_terrains, 8 * num_bumps), per bump in the order of :data:`PARAMETERS`. Nodes are ``spacing``
    [m] apart; ``origin`` is x and y of the first one [m], 0 if left out. Heights [m], shape (num_terrains, nrow, ncol),
    row along y, column along x, are times ``factor``.
    """
    if genes.ndim != 2 or genes.shape[1] == 0 or genes.shape[1] % GENES_PER_BUMP != 0:
        raise ValueError(f"genes must have shape (batch, 8 * num_bumps), got {tuple(genes.shape)}")
    if heights_out.ndim != 3 or heights_out.shape[0] != genes.shape[0]:
        raise ValueError(f"heights_out must have shape ({genes.shape[0]}, nrow, ncol), got {tuple(heights_out.shape)}")
    num_bumps = genes.shape[1] // GENES_PER_BUMP
    bumps = wp.empty((genes.shape[0], num_bumps), dtype=Bump, device=genes.device)
    shift = np.pad(origin, (0, GENES_PER_BUMP - len(origin)))
    _decode_genes(genes, _genes(*(LOWER - shift)), _genes(*(UPPER - shift)), bumps)
    _rasterise_bumps(bumps, spacing, factor, heights_out)
