"""How elites are varied: iso+line, exchange of whole parts, and mirroring."""

import numpy as np
from numpy.typing import NDArray

from qd.run.settings import SchedulerCfg
from sim.space import TerrainSpace, clipped


def check_variation(cfg: SchedulerCfg, space: TerrainSpace) -> None:
    """Refuses shares of a variation that a space does not have.

    Raises:
        ValueError: If there is one.
    """
    if cfg.crossover_share and space.genes_per_part is None:
        raise ValueError(
            f"crossover_share must be 0, got {cfg.crossover_share}: the space {space.name} does not say which genes "
            "are a part (genes_per_part)"
        )
    if cfg.gradient_share and space.name != "super_gaussian":
        raise ValueError(
            f"gradient_share must be 0, got {cfg.gradient_share}: only the rasteriser of super_gaussian has a "
            f"derivative, not that of {space.name}"
        )
    if cfg.mirror_share and space.mirrored(np.zeros((1, space.num_genes), np.float32)) is None:
        raise ValueError(
            f"mirror_share must be 0, got {cfg.mirror_share}: the space {space.name} cannot mirror its terrains "
            "(mirrored)"
        )


def iso_line(
    elites: NDArray[np.float32], others: NDArray[np.float32], cfg: SchedulerCfg, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Children beside the lines from elites to others (Vassiliades and Mouret 2018), clipped.

    Args:
        elites: Genes, shape (num_children, num_genes).
        others: Of other elites, likewise.
        cfg: Both step sizes.
        rng: What they are drawn from.
    """
    own = cfg.iso_sigma * rng.standard_normal(elites.shape, np.float32)
    along = cfg.line_sigma * rng.standard_normal((len(elites), 1), np.float32)
    return clipped(elites + own + along * (others - elites))


def recombined(
    children: NDArray[np.float32],
    others: NDArray[np.float32],
    crossover_share: float,
    mirror_share: float,
    space: TerrainSpace,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Children of which some take whole parts from another elite, and some are mirrored.

    Args:
        children: Genes, shape (num_children, num_genes).
        others: Of an elite for each, likewise.
        crossover_share: Share of them that take each part of the other with a chance of a half.
        mirror_share: Share of them that are mirrored afterwards.
        space: What genes mean.
        rng: What they are drawn from.
    """
    found = children.copy()
    if crossover_share and space.genes_per_part:
        crossed = rng.random(len(found)) < crossover_share
        taken = rng.random((len(found), space.num_genes // space.genes_per_part)) < 0.5
        taken = np.repeat(taken, space.genes_per_part, axis=1) & crossed[:, None]
        found[taken] = others[taken]
    if mirror_share:
        turned = rng.random(len(found)) < mirror_share
        mirrored = space.mirrored(found)
        if mirrored is not None:
            found[turned] = mirrored[turned]
    return found
