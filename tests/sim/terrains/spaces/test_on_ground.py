"""Friction and softness as genes beside those of any space."""

import numpy as np
import pytest

from sim.terrains.bank import make_heights, make_terrains
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.registry import get_space, load_space, space_key
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.kernels.course_oracle import course, element
from tests.sim.terrains.spaces.spaces import write_ridges

BOTH = get_space("super_gaussian+friction+softness")
WET = """
import torch


class Wet:
    num_genes = 2

    def rasterise(self, genes, x, y):
        return 0.0 * x + 0.0 * genes[:, :1, None]

    def friction(self, genes, x, y):
        {friction}
"""


def test_genes_of_the_ground_come_behind_those_of_the_space():
    genes = BOTH.hard_random(3, 5)
    assert (BOTH.num_genes, genes.shape, BOTH.ground) == (128, (3, 128), ("friction", "softness"))
    heights, ground = make_terrains(genes, BOTH)
    np.testing.assert_array_equal(heights, make_heights(genes[:, :64]))
    # Hard-random ground is as it always is, or as slippery or soft as can be.
    assert sorted(np.unique(ground.friction).round(6)) == [0.15, 1.0]
    assert sorted(np.unique(ground.time_constant_s).round(6)) == [0.0, 0.06]
    np.testing.assert_array_equal(ground.friction.reshape(3, 32) == 1.0, genes[:, 64:96] == 1.0)
    np.testing.assert_array_equal(ground.time_constant_s.reshape(3, 32) == 0.0, genes[:, 96:] == -1.0)
    only = get_space("course+softness")
    assert (only.num_genes, only.sigma0, only.genes_per_part) == (36 + 32, COURSE.sigma0, None)
    assert BOTH.genes_per_part == 8
    assert make_terrains(genes[:, :64], SUPER_GAUSSIAN)[1] is None


def test_a_patch_is_a_part_that_is_absent_where_it_changes_nothing():
    genes = BOTH.uniform_random(2, 1)
    words = BOTH.parts(genes[0])
    assert len(words) == 8 + 32 + 32
    assert words[8 + 10].startswith("friction 0.") and words[8 + 10].endswith("at x = 4 to 6 m, y = 2 to 4 m")
    assert words[8 + 32].startswith("soft ground of 0.0")
    without = BOTH.without(genes, [0, 8 + 10, 8 + 32 + 31])
    heights, ground = make_terrains(without, BOTH)
    np.testing.assert_array_equal(heights, make_heights(SUPER_GAUSSIAN.without(genes[:, :64], [0])))
    assert (ground.friction[:, 1, 2] == 1.0).all() and (ground.friction < 1.0).sum() == 2 * 31
    assert (ground.time_constant_s[:, 3, 7] == 0.0).all() and (ground.time_constant_s > 0.0).sum() == 2 * 31
    assert (without != genes).sum() == 2 * 3
    scaled = BOTH.scaled(genes, 0.5)
    np.testing.assert_array_equal(scaled[:, :64], SUPER_GAUSSIAN.scaled(genes[:, :64], 0.5))
    np.testing.assert_array_equal(scaled[:, 64:], genes[:, 64:])


def test_words_say_what_lies_beside_the_way():
    genes = np.zeros(128)
    genes[64:] = np.repeat([1.0, -1.0, 0.0, 1.0, -1.0, 1.0, -1.0, -1.0], 8)
    lines = BOTH.describe(genes).splitlines()[-2:]
    right, left = " ".join(["0.15"] * 8), " ".join(["0.57"] * 8)
    assert lines[0] == f"friction every 2 m along the way: left of the way {left}, right of it {right}"
    assert "left of the way 0.00 0.00" in lines[1] and "right of it 0.06 0.06" in lines[1]


def test_an_element_of_a_course_has_its_ground_behind_it():
    # A kerb at x = 4.2 m, a ditch of 0.4 m from x = 4.45 m on, and from x = 5.65 m stairs that end at x = 6.2 m.
    space = get_space("course+friction+softness")
    elements = [
        element("kerb", size=0.15, turn=1),
        element("ditch", lead=4, size=0.4, length=8),
        element("stairs", lead=16, size=0.18, length=0.25, detail=3, turn=-1),
    ]
    genes = np.concatenate([course(*elements)[0], np.full(32, 1.0), np.full(32, -1.0)])
    friction, softness = (genes[at : at + 32].reshape(4, 8) for at in (36, 68))
    assert space.describe(genes).splitlines()[0] == COURSE.describe(genes[:36])
    friction[[0, 3]] = -1.0  # far beside the way
    assert space.describe(genes).splitlines()[0] == COURSE.describe(genes[:36])
    friction[1, 2] = -1.0 + 2 * 0.1 / 0.85  # x = 4 m to 6 m, on the right: 0.25
    softness[2, 3] = 1.0  # x = 6 m to 8 m, on the left
    assert space.describe(genes).splitlines()[0] == (
        "kerb 0.15 m up (friction 0.25), ditch 0.40 m wide and 0.40 m deep (friction 0.25), "
        "3 stairs of 0.18 x 0.25 m down (friction 0.25, soft, 0.060 s)"
    )
    flat = np.concatenate([course()[0], np.full(64, -1.0)])
    assert space.describe(flat).splitlines()[0] == "flat ground"


def test_ground_is_named_by_the_space(tmp_path):
    assert load_space(None).name == "super_gaussian" and load_space("course").name == "course"
    assert load_space("super_gaussian+softness+friction").name == BOTH.name
    with pytest.raises(ValueError, match="ice"):
        load_space("course+ice")
    ridges = write_ridges(tmp_path / "a+b")
    space = load_space(f"{ridges}+friction")
    assert (space.num_genes, space.name) == (3 + 32, f"{ridges}+friction")
    assert get_space(space.name, space.sha256).num_genes == 35
    for name in (space.name, "x.py:X+friction"):
        assert space_key(name, space.sha256) == f"{space.sha256}+friction"
    assert space_key("course+friction", None) == "course+friction"


@pytest.mark.parametrize(
    "returned",
    [
        "return torch.full((len(genes), 4, 8), 2.0)",
        "return torch.ones(len(genes), 8, 4)",
    ],
)
def test_maps_of_a_space_of_ones_own_are_checked(tmp_path, returned):
    (tmp_path / "wet.py").write_text(WET.replace("{friction}", returned))
    with pytest.raises(ValueError, match="friction"):
        load_space(f"{tmp_path / 'wet.py'}:Wet")


def test_a_space_of_ones_own_may_have_ground(tmp_path):
    file = tmp_path / "wet.py"
    file.write_text(
        WET.replace("{friction}", "return torch.where(x > 8, 0.5, 1.0).expand(len(genes), -1, -1) * 1.0")
        + "\n    def softness(self, genes, x, y):\n        return 0.03 * (y < 4) * (genes[:, 1, None, None] > 0)\n"
    )
    space = load_space(f"{file}:Wet")
    ground = make_terrains(np.array([[0.0, 1.0], [0.0, -1.0]]), space)[1]
    assert (space.ground, space.num_genes) == (("friction", "softness"), 2)
    assert (ground.friction[:, :, 4:] == 0.5).all() and (ground.friction[:, :, :4] == 1.0).all()
    assert (ground.time_constant_s[0, :2] == np.float32(0.03)).all()
    assert not ground.time_constant_s[0, 2:].any() and not ground.time_constant_s[1].any()
    with pytest.raises(ValueError, match="ground"):
        load_space(f"{file}:Wet+friction")
