"""How a surrogate varies elites: iso+line, and exchange of whole parts such as bumps."""

import torch
from torch import Tensor

from qd.run.presets import SchedulerCfg


def vary_elites(
    pool: Tensor, count: int, cfg: SchedulerCfg, genes_per_part: int | None, draw: torch.Generator
) -> Tensor:
    """Children beside the lines between elites (Vassiliades and Mouret 2018), clipped.

    A share of them takes each of its parts from a further elite with a chance of a half, where the space has parts.

    Args:
        pool: Genes of the elites, shape (E, num_genes).
        count: Number of children.
        cfg: Step sizes and that share.
        genes_per_part: As of :attr:`sim.spaces.base.TerrainSpace.genes_per_part`.
        draw: What they are drawn from, on the pool's device.

    Returns:
        Genes in [-1, 1], shape (count, num_genes).
    """
    on = {"generator": draw, "device": pool.device}
    elites, others, further = pool[torch.randint(len(pool), (3, count), **on)]
    noise = cfg.iso_sigma * torch.randn(elites.shape, **on)
    along = cfg.line_sigma * torch.randn((count, 1), **on)
    children = elites + noise + along * (others - elites)
    if cfg.crossover_share and genes_per_part:
        crossed = torch.rand((count, 1), **on) < cfg.crossover_share
        swapped = (torch.rand((count, pool.shape[1] // genes_per_part), **on) < 0.5) & crossed
        children = torch.where(swapped.repeat_interleave(genes_per_part, dim=1), further, children)
    return children.clamp(-1.0, 1.0)
