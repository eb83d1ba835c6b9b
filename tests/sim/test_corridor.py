import numpy as np
import pytest
import torch

from kernels.ground import PATCHES
from sim.bank import heights_of, terrains_of
from sim.corridor import SHAPE, corridor_ground, corridor_heights
from sim.spaces.course import COURSE
from sim.spaces.registry import get_space
from sim.spaces.super_gaussian import SUPER_GAUSSIAN


def test_every_second_node_around_the_way():
    genes = SUPER_GAUSSIAN.hard_random(3, 0)
    found = corridor_heights(torch.from_numpy(genes), SUPER_GAUSSIAN).numpy()
    assert found.shape == (3, *SHAPE) == (3, 41, 121)
    np.testing.assert_allclose(found, heights_of(genes)[:, 40:121:2, 40:281:2], atol=1e-6)


def test_a_space_of_one_spacing_gives_means_of_its_nodes():
    genes = COURSE.hard_random(3, 0)
    found, nodes = corridor_heights(torch.from_numpy(genes), COURSE).numpy(), heights_of(genes, COURSE)
    assert found.shape == (3, 41, 121)
    for row, col in ((0, 0), (20, 57), (40, 120), (7, 71)):
        y, x = 40 + 2 * row, 40 + 2 * col
        around = nodes[:, y - 1 : y + 2, x - 1 : x + 2].mean(axis=(1, 2))
        np.testing.assert_allclose(found[:, row, col], around, atol=1e-6)


@pytest.mark.parametrize("name", ["super_gaussian+friction+softness", "course+softness"])
def test_ground_around_the_way(name):
    space = get_space(name)
    genes = space.uniform_random(3, 2)
    found = corridor_ground(torch.from_numpy(genes), space).numpy()
    assert found.shape == (3, len(space.ground), *SHAPE)
    _, ground = terrains_of(genes, space)
    maps = {"friction": 1.0 - ground.friction, "softness": ground.time_constant_s / 0.06}
    rows, cols = PATCHES
    for row, col in ((0, 0), (20, 57), (40, 120), (7, 70), (19, 71)):
        patch = int((2.0 + 0.1 * row) * rows / 8.0 + 1e-6), int((2.0 + 0.1 * col) * cols / 16.0 + 1e-6)
        for place, kind in enumerate(space.ground):
            np.testing.assert_allclose(found[:, place, row, col], maps[kind][:, *patch], atol=1e-6)
    assert found.std() > 0.05


def test_plain_ground_has_no_maps():
    genes = SUPER_GAUSSIAN.hard_random(3, 0)
    assert corridor_ground(torch.from_numpy(genes), SUPER_GAUSSIAN).shape == (3, 0, *SHAPE)
