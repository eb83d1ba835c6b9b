"""Steps along gradients of what networks say of a terrain, through the rasteriser (after OMG-MEGA).

Fontaine and Nikolaidis 2021, "Differentiable Quality Diversity": a child steps along a random combination of the
gradients of the objective and of the measures. One backward pass gives it, since the gradient of a combination is the
combination of the gradients.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kernels.super_gaussian import LOWER, UPPER
from sim.corridor import NODE_SPACING, SHAPE, X, Y
from sim.space import clipped

Judge = Callable[[Tensor], tuple[Tensor, Tensor]]
_AT_ONCE = 512  # terrains whose nodes and bumps are remembered for the way back
_LEAST_DISTANCE = 1e-6  # a power of zero has no derivative by its exponent


def heights_of(genes: Tensor) -> Tensor:
    """Heights [m] around the way of Super-Gaussian mixtures, as :func:`sim.corridor.corridor_heights`.

    Args:
        genes: Shape (num_terrains, 8 * num_bumps).
    """
    lower, upper = (torch.as_tensor(bound, dtype=genes.dtype, device=genes.device) for bound in (LOWER, UPPER))
    bumps = lower + (genes.clamp(-1.0, 1.0).unflatten(1, (-1, len(LOWER))) + 1.0) * 0.5 * (upper - lower)
    x, y = (
        low + NODE_SPACING * torch.arange(count, dtype=genes.dtype, device=genes.device)
        for (low, _), count in ((X, SHAPE[1]), (Y, SHAPE[0]))
    )
    mu_x, mu_y, sigma_x, sigma_y, p_x, p_y, theta, height = bumps[..., None, None].unbind(2)
    dx, dy = x - mu_x, y[:, None] - mu_y
    across = (theta.cos() * dx - theta.sin() * dy) / sigma_x
    along = (theta.sin() * dx + theta.cos() * dy) / sigma_y
    u, v = (distance.abs().clamp_min(_LEAST_DISTANCE) for distance in (across, along))
    return (height * torch.exp(-(u ** (2.0 * p_x)) - v ** (2.0 * p_y))).sum(1)


def stepped(
    genes: NDArray[np.float32], judge: Judge, num_ratios: int, sigma: float, rng: np.random.Generator, device: str
) -> NDArray[np.float32]:
    """Genes one step further each, along a random combination of gradients.

    Args:
        genes: Shape (N, num_genes).
        judge: What networks say of heights (N, 41, 121): ratios (N, num_ratios) and fitness (N,), both differentiable.
        num_ratios: Number of ratios.
        sigma: Length of a step, root mean square over the genes; that of each child is drawn from a normal
            distribution of this width.
        rng: What combinations are drawn from.
        device: Torch device.
    """
    weights = rng.standard_normal((len(genes), num_ratios + 1), np.float32)
    weights[:, -1] = np.abs(weights[:, -1])  # never worse on purpose
    length = np.abs(rng.normal(scale=sigma, size=(len(genes), 1))).astype(np.float32) * math.sqrt(genes.shape[1])
    found = []
    for first in range(0, len(genes), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        with torch.inference_mode(False), torch.enable_grad():
            asked = torch.tensor(genes[some], device=device, requires_grad=True)
            ratios, fitness = judge(heights_of(asked))
            told = torch.cat([ratios, fitness[:, None]], dim=1)
            (told * torch.from_numpy(weights[some]).to(device)).sum().backward()
            assert asked.grad is not None
            way = asked.grad / asked.grad.norm(dim=1, keepdim=True).clamp_min(1e-12)
        found.append(way.cpu().numpy())
    return clipped(genes + length * np.concatenate(found))
