"""Heights and ground along the way of a crossing, for networks that judge a terrain by them."""

import numpy as np
import torch
import warp as wp

from kernels.ground import COLS, MAX_TIME_CONSTANT_S, ROWS, make_ground
from sim.terrains.conditions.kinds import condition_genes
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.terrains import patch_index

X = (2.0, 14.0)
"""From the start to the goal [m]."""
Y = (2.0, 6.0)
"""Up to 2 m to each side of the way [m]."""
NODE_SPACING = 0.1
"""Distance of neighbouring nodes of the corridor [m]."""
SHAPE = tuple(round((high - low) / NODE_SPACING) + 1 for low, high in (Y, X))
"""Nodes along y and x."""
_AT_ONCE = 2048  # terrains, whole grids of which take 420 MB


def corridor_heights(genes: torch.Tensor, space: TerrainSpace) -> torch.Tensor:
    """Heights [m] around the way of terrains, every 0.1 m; row 20 is the way, row 0 is to its right.

    A space that is made for 0.05 m gives the means of 3 x 3 nodes, so that nothing narrow falls between two nodes.
    Genes are float32 in [-1, 1], shape (num_terrains, num_genes), on the device that does the work; heights come on it,
    float32, shape (num_terrains, 41, 121).
    """
    heights = genes.new_empty(len(genes), *SHAPE)
    rows, cols = (slice(round(low / SPACING) - 1, round(high / SPACING) + 2) for low, high in (Y, X))
    with wp.ScopedDevice(wp.device_from_torch(genes.device)):
        for first in range(0, len(genes), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            if space.any_spacing:
                heights[part] = _rasterised(genes[part], space, SHAPE, NODE_SPACING, X[0], Y[0])
            else:
                grids = _rasterised(genes[part], space, (NUM_ROWS, NUM_COLS), SPACING)[:, None, rows, cols]
                heights[part] = torch.nn.functional.avg_pool2d(grids, 3, stride=2)[:, 0]
    return heights


def num_maps(space: TerrainSpace) -> int:
    """Maps of :func:`corridor_maps`."""
    return len(space.ground) + len(condition_genes(space.conditions))


def corridor_maps(genes: torch.Tensor, space: TerrainSpace) -> torch.Tensor:
    """Ground and conditions on the nodes of :func:`corridor_heights`, which has the same arguments.

    Float32 tensor on their device, shape (num_terrains, num_maps, 41, 121), 0 where ground is as always: the friction
    that is missing, and the time constant over that of the softest ground. A gene of a condition is the same
    everywhere, but where it is of a side: it then grows from minus itself on the right to itself on the left, so that
    mirrored maps are those of mirrored conditions.
    """
    device = str(wp.device_from_torch(genes.device))
    ground = make_ground(len(genes), device)
    with wp.ScopedDevice(device):
        space.lay_ground(wp.from_torch(genes.contiguous()), ground)
    softness = wp.to_torch(ground.time_constant) / float(MAX_TIME_CONSTANT_S)
    patches = {"friction": 1.0 - wp.to_torch(ground.friction), "softness": softness}
    row, col = (
        patch_index(low / SPACING + np.arange(count) * (NODE_SPACING / SPACING), nodes - 1, num_patches)
        for (low, _), count, nodes, num_patches in zip((Y, X), SHAPE, (NUM_ROWS, NUM_COLS), (ROWS, COLS), strict=True)
    )
    maps = [patches[kind][:, row][:, :, col] for kind in space.ground]
    across = torch.linspace(-1.0, 1.0, SHAPE[0], device=genes.device)[:, None]
    kinds = condition_genes(space.conditions)
    for gene, values in zip(kinds, genes[:, space.num_genes - len(kinds) :].T, strict=True):
        profile = across if gene.mirrored else torch.ones_like(across)
        maps.append(values[:, None, None] * profile.expand(SHAPE))
    return torch.stack(maps, dim=1) if maps else genes.new_empty(len(genes), 0, *SHAPE)


def _rasterised(
    genes: torch.Tensor, space: TerrainSpace, shape: tuple[int, ...], spacing: float, *origin: float
) -> torch.Tensor:
    """Heights [m] of terrains on nodes of a grid, shape (num_terrains, *shape)."""
    heights = genes.new_empty(len(genes), *shape)
    space.rasterise(wp.from_torch(genes.contiguous()), spacing, wp.from_torch(heights), *origin)
    return heights
