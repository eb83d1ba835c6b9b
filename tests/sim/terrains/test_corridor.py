"""Heights and ground along the way, as networks see them."""

import numpy as np
import pytest
import torch

from sim.terrains.bank import make_heights, make_terrains
from sim.terrains.corridor import SHAPE, corridor_heights, corridor_maps, num_maps
from sim.terrains.spaces.registry import get_space

PLACES = ((0, 0), (20, 57), (40, 120), (7, 70), (19, 71))


@pytest.mark.parametrize(
    ("name", "around"),
    # A space of one spacing gives means of 3 x 3 nodes, 0.05 m apart.
    [("super_gaussian", 0), ("course", 1), ("super_gaussian+friction+softness", 0), ("course+softness", 1)],
)
def test_heights_and_ground_around_the_way(name, around):
    space = get_space(name)
    genes = space.uniform_random(3, 2)
    nodes, ground = make_heights(genes, space), make_terrains(genes, space)[1]
    heights = corridor_heights(torch.from_numpy(genes), space).numpy()
    maps = corridor_maps(torch.from_numpy(genes), space).numpy()
    assert heights.shape == (3, *SHAPE) == (3, 41, 121) and maps.shape == (3, len(space.ground), *SHAPE)
    for row, col in PLACES:  # from x = y = 2 m on, 0.1 m apart
        y, x = 40 + 2 * row, 40 + 2 * col
        expected = nodes[:, y - around : y + around + 1, x - around : x + around + 1].mean(axis=(1, 2))
        np.testing.assert_allclose(heights[:, row, col], expected, atol=1e-6)
        for place, kind in enumerate(space.ground):
            values = 1.0 - ground.friction if kind == "friction" else ground.time_constant_s / 0.06
            np.testing.assert_allclose(maps[:, place, row, col], values[:, y // 40, x // 40], atol=1e-6)


def test_conditions_are_maps_whose_mirror_images_are_those_of_mirrored_conditions():
    space = get_space("super_gaussian+friction+payload+delay+push")
    genes = torch.from_numpy(space.uniform_random(2, 0))
    mirrored = genes.clone()
    mirrored[:, [64 + 32 + 2, 64 + 32 + 5]] *= -1.0  # payload and push to the side
    maps, others = corridor_maps(genes, space), corridor_maps(mirrored, space)
    assert maps.shape == (2, 1 + 7, *SHAPE) and num_maps(space) == 8
    torch.testing.assert_close(maps[:, 1:].flip(2), others[:, 1:])
    assert not torch.equal(maps[:, 1:], others[:, 1:])
    assert torch.equal(maps[:, 1], genes[:, 96, None, None].expand(-1, *SHAPE))
    assert torch.equal(maps[:, 3, -1], genes[:, 98, None].expand(-1, SHAPE[1]))  # in full on the left
    assert torch.equal(maps[:, :1], corridor_maps(genes[:, :96], get_space("super_gaussian+friction")))
