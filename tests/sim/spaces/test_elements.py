"""Courses whose elements have friction and softness of their own."""

import numpy as np
import pytest

from sim.bank import heights_of, terrains_of
from sim.space import COURSE, get_space, load_space, on_ground, space_identity
from sim.spaces.ground import gene_of
from tests.kernels.course_oracle import columns, course, element
from tests.sim.spaces.spaces import write_ridges

BOTH = get_space("course+element-friction+element-softness")
WET = get_space("course+element-friction")


def on(space, heights, *own):
    """Genes of courses, and genes of a map or two of their elements, one an element."""
    rows = np.reshape(heights, (-1, 6, 6))
    maps = [np.broadcast_to(np.float32(one), rows.shape[:2])[..., None] for one in own]
    return np.float32(np.concatenate([rows, *maps], axis=2)).reshape(len(rows), space.num_genes)


def friction_gene(value):
    return float(gene_of("friction", np.float64(value)))


def kerb_and_ditch():
    """A kerb, a ditch, and flat ground of 2 m."""
    return course(element("kerb", size=0.15, turn=1), element("ditch", size=0.4, length=8), element("flat", length=40))


def test_genes_of_an_element_lie_together():
    assert (BOTH.num_genes, BOTH.genes_per_part, BOTH.ground, BOTH.sigma0) == (48, 8, ("friction", "softness"), 0.5)
    assert (WET.num_genes, WET.genes_per_part, WET.ground) == (42, 7, ("friction",))
    heights = COURSE.uniform_random(8, 0)
    own = np.random.default_rng(1).uniform(-1.2, 1.2, (2, 8, 6))
    grid, ground = terrains_of(on(BOTH, heights, *own), BOTH)
    np.testing.assert_array_equal(grid, heights_of(heights, COURSE))
    assert ground.shape == (1, 320)
    for k, row in enumerate(heights):
        lies = columns(row, np.arange(1, 7)).astype(int)
        share = np.clip((own[:, k] + 1) / 2, 0, 1)
        friction = np.append(1.0, 0.15 + 0.85 * share[0])[lies]
        tau = np.append(0.0, np.where(share[1] > 0, 0.01 * 6 ** share[1], 0.0))[lies]
        np.testing.assert_allclose(ground.friction[k, 0], friction, rtol=1e-5)
        np.testing.assert_allclose(ground.time_constant_s[k, 0], tau, rtol=1e-5)
    assert (terrains_of(on(WET, heights, 0.0), WET)[1].time_constant_s == 0.0).all()


def test_elements_in_words_with_their_ground():
    # The last element has no cells, so no ground: nothing is said of it.
    genes = on(BOTH, kerb_and_ditch(), [friction_gene(0.25), 1, friction_gene(0.5), 1, 1, -1], [-1, 1, -1, -1, -1, 1])
    assert BOTH.describe(genes[0]) == (
        "kerb 0.15 m up (friction 0.25), ditch 0.40 m wide and 0.40 m deep (soft, 0.060 s), "
        "flat ground of 2.00 m (friction 0.50)"
    )
    assert BOTH.parts(genes[0])[0] == "kerb 0.15 m up (friction 0.25)"
    assert BOTH.parts(genes[0])[3:] == ("nothing",) * 3
    plain = on(BOTH, kerb_and_ditch(), 1, -1)
    assert BOTH.describe(plain[0]) == COURSE.describe(kerb_and_ditch()[0])
    assert BOTH.describe(on(BOTH, course(), 1, -1)[0]) == "flat ground"


def test_an_element_that_is_taken_away_takes_its_ground():
    genes = on(BOTH, kerb_and_ditch(), -1, 1)
    heights, ground = terrains_of(BOTH.without(genes, [0, 2]), BOTH)
    np.testing.assert_array_equal(heights, heights_of(COURSE.without(kerb_and_ditch(), [0, 2]), COURSE))
    other = columns(kerb_and_ditch()[0], [0, 1, 0, 0, 0, 0]) == 1
    assert ((ground.friction[0, 0] < 1) == other).all() and ((ground.time_constant_s[0, 0] > 0) == other).all()
    np.testing.assert_array_equal(BOTH.without(genes, []), np.clip(genes, -1, 1))


def test_scales_leave_the_ground():
    genes = BOTH.uniform_random(3, 2)
    (_, ground), (scaled, same) = terrains_of(genes, BOTH), terrains_of(BOTH.scaled(genes, 0.5), BOTH)
    heights = genes.reshape(3, 6, 8)[..., :6].reshape(3, 36)
    np.testing.assert_array_equal(scaled, heights_of(COURSE.scaled(heights, 0.5), COURSE))
    np.testing.assert_array_equal(same.friction, ground.friction)


def test_hard_random_ground_is_as_always_or_as_bad_as_can_be():
    genes = BOTH.hard_random(20, 3)
    own = genes.reshape(20, 6, 8)[..., 6:]
    assert (np.abs(own) == 1).all() and 0.3 < (own == 1).mean() < 0.7
    np.testing.assert_array_equal(genes, BOTH.hard_random(20, 3))
    ground = terrains_of(genes, BOTH)[1]
    assert np.unique(ground.friction).round(6).tolist() == pytest.approx([0.15, 1.0])
    assert np.unique(ground.time_constant_s).round(6).tolist() == pytest.approx([0.0, 0.06])


def test_the_name_says_it_and_only_courses_have_elements(tmp_path):
    assert on_ground("course", ["element-softness", "element-friction"]) == BOTH.name
    assert load_space(WET.name) == WET and space_identity(WET.name) == WET.name
    with pytest.raises(ValueError, match=r"super_gaussian has no elements.*--space course, or .*--ground friction"):
        load_space(on_ground(None, ["element-friction"]))
    with pytest.raises(ValueError, match="has no elements"):
        load_space(f"{write_ridges(tmp_path)}+element-softness")
    with pytest.raises(ValueError, match=r"of patches .* or of elements .* got friction and element-softness: leave"):
        on_ground("course", ["friction", "element-softness"])
