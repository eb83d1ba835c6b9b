"""Terrain spaces: random draws, what is refused, and terrains without some of their parts."""

import numpy as np
import pytest

from sim.terrains.bank import make_heights
from sim.terrains.spaces.base import clipped
from sim.terrains.spaces.registry import SPACES, get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.kernels import oracle
from tests.sim.scenes import NODE_X, NODE_Y


def test_a_space_is_found_by_its_name():
    assert get_space("super_gaussian") is SUPER_GAUSSIAN
    assert all(space.name == name for name, space in SPACES.items())
    assert SUPER_GAUSSIAN.num_genes == 64


def test_hard_random_genes_have_every_bump_at_full_height():
    genes = SUPER_GAUSSIAN.hard_random(200, 0)
    bumps = genes.reshape(200, 8, 8)
    assert genes.dtype == np.float32
    assert set(np.unique(bumps[..., 7])) == {-1.0, 1.0}
    assert abs(bumps[..., 7].mean()) < 0.1  # both signs equally often: standard error 1 / sqrt(1600) = 0.025
    np.testing.assert_array_equal(bumps[..., :7], SUPER_GAUSSIAN.uniform_random(200, 0).reshape(200, 8, 8)[..., :7])


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: SUPER_GAUSSIAN.uniform_random(-1, 0), "count"),
        (lambda: SUPER_GAUSSIAN.validate(np.zeros(64)), "genes"),
        (lambda: SUPER_GAUSSIAN.validate([[0.0] * 64, [np.nan] * 64]), "row 1"),
    ],
)
def test_what_are_no_genes_is_refused(call, field):
    with pytest.raises(ValueError, match=field):
        call()


def test_a_terrain_without_some_bumps_is_the_sum_of_the_others():
    genes = SUPER_GAUSSIAN.hard_random(2, 5)
    without = SUPER_GAUSSIAN.without(genes, [0, 3, 7])
    others = genes.reshape(2, 8, 8)[:, [1, 2, 4, 5, 6]].reshape(2, 40)
    expected = [oracle.mixture_height(row, NODE_X[None, :], NODE_Y[:, None]) for row in others]
    np.testing.assert_allclose(make_heights(without), expected, atol=1e-5)
    assert not make_heights(SUPER_GAUSSIAN.without(genes, range(8))).any()
    np.testing.assert_array_equal(SUPER_GAUSSIAN.without(genes, []), genes)


def test_a_bump_in_words():
    # Table I: mu_x 6 to 10 m, mu_y 2 to 6 m, sigma 0.5 to 3 m, theta -180 to 180 degrees, w -0.25 to 0.25 m.
    genes = np.tile([0.5, 0.0, -1.0, 1.0, 0.0, 0.0, 0.5, -1.0], 8)
    genes[8 + 6] = -1.0  # half a turn of the second changes nothing
    first, second, *others = SUPER_GAUSSIAN.describe(genes).splitlines()
    assert first == "hollow of 0.25 m at (9.0, 4.0) m, half widths 0.5 m and 3.0 m, turned by 90 degrees"
    assert second.endswith("turned by 0 degrees") and others == [first] * 6


def test_scaled_bumps_are_lower_everywhere():
    genes = 2 * SUPER_GAUSSIAN.hard_random(2, 5)  # beyond the limits, which are clipped
    np.testing.assert_allclose(make_heights(SUPER_GAUSSIAN.scaled(genes, 0.3)), 0.3 * make_heights(genes), atol=1e-6)
    np.testing.assert_array_equal(SUPER_GAUSSIAN.scaled(genes, 1.0), clipped(genes))


@pytest.mark.parametrize("name", ["super_gaussian", "course"])
def test_a_lower_space_is_the_same_terrain_with_all_heights_scaled(name):
    space, lower = get_space(name), get_space(f"{name}@0.1")
    genes = space.hard_random(3, 0)
    np.testing.assert_allclose(make_heights(genes, lower), 0.4 * make_heights(genes, space), atol=1e-6)
    assert lower.name == f"{name}@0.1" and get_space(f"{name}@0.1+friction").name == f"{name}@0.1+friction"
    with pytest.raises(ValueError, match=r"at most at 0\.25 m, got 0\.3"):
        get_space(f"{name}@0.3")


def test_words_of_a_lower_space_are_its_heights():
    genes = get_space("super_gaussian").hard_random(1, 0)[0]
    assert "of 0.10 m at" in get_space("super_gaussian@0.1").describe(genes)
