"""Terrain spaces: draws, texts, refusals, terrains without some parts, code of a user; all entries of registries."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from kernels.course import GENES_PER_ELEMENT
from qd.commands import ArchiveCommand, DoseCommand
from qd.evaluate.dose import all_doses, parse_doses
from qd.faults.causes import find_effects
from sim.rollout import Rollout
from sim.terrains.bank import make_heights, make_terrains
from sim.terrains.conditions.kinds import CONDITIONS, condition_column, condition_texts, nominal_row
from sim.terrains.corridor import corridor_maps, num_maps
from sim.terrains.elements.kinds import ELEMENTS
from sim.terrains.spaces import registry
from sim.terrains.spaces.base import clipped
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.registry import SPACES, get_space, is_user_space, load_space, space_key
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.spaces.wider import varied_space
from sim.terrains.terrains import Terrains
from tests.kernels.oracle import course, element, mixture_height
from tests.sim.scenes import NODE_X, NODE_Y
from tests.sim.terrains.spaces.spaces import write_ridges


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
    expected = [mixture_height(row, NODE_X[None, :], NODE_Y[:, None]) for row in others]
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
@pytest.mark.slow
def test_a_lower_space_is_the_same_terrain_with_all_heights_scaled(name):
    space, lower = get_space(name), get_space(f"{name}@0.1")
    genes = space.hard_random(3, 0)
    np.testing.assert_allclose(make_heights(genes, lower), 0.4 * make_heights(genes, space), atol=1e-6)
    assert "of 0.10 m at" in lower.describe(genes[0]) or name == "course"
    assert lower.name == f"{name}@0.1" and get_space(f"{name}@0.1+friction").name == f"{name}@0.1+friction"
    with pytest.raises(ValueError, match=r"at most at 0\.25 m, got 0\.3"):
        get_space(f"{name}@0.3")


def test_a_course_in_words():
    kerb, stairs = element("kerb", size=0.15, turn=1), element("stairs", size=0.18, length=0.28, detail=3, turn=-1)
    genes = course(kerb, stairs, element("ditch", size=0.4, length=6))[0]
    words = "kerb 0.15 m up, 3 stairs of 0.18 x 0.28 m down, ditch 0.30 m wide and 0.40 m deep"
    assert COURSE.describe(genes) == words and COURSE.parts(genes)[0] == "kerb 0.15 m up"
    assert len(COURSE.parts(genes)) == 6 and COURSE.parts(genes)[3] == "nothing"


OVER = "over a ditch 1.20 m wide and 0.50 m deep"
TEXTS = {
    "flat ground": element("flat", length=20),
    "ramp of 1:4.0 up, 1.20 m long": element("ramp", size=0.25, length=24, turn=1),
    "cross slope of 1:5.0 right side up, 2.00 m long": element("cross_slope", size=0.2, length=40, turn=-1),
    "sill 0.100 m high and 0.10 m wide": element("sill", size=0.1, length=2),
    "rail 0.050 m high": element("rail", size=0.05, length=0),
    "rail 0.050 m high and 0.05 m wide": element("rail", size=0.05, length=1),
    "step 0.30 m down": element("step", size=0.3, turn=-1),
    "pallet 0.14 m high and 0.80 m long": element("pallet", size=0.144, length=16, detail=1),
    "2 pallets, 0.29 m high and 1.20 m long": element("pallet", size=0.144, length=24, detail=2),
    f"beam 0.40 m wide {OVER}, 0.20 m right of the way": element("bridge", size=0.5, length=24, detail=8, turn=-4),
    "stones of 0.25 m, 0.15 m apart, in a ditch 1.00 m wide and 0.30 m deep": element(
        "stones", size=0.3, length=20, detail=5, turn=3
    ),
    "rubble of blocks of 0.20 m up to 0.15 m high, 1.50 m long": element(
        "rubble", size=0.15, length=30, detail=4, turn=0
    ),
}


@pytest.mark.parametrize("text", TEXTS)
def test_every_kind_has_a_text(text):
    assert COURSE.describe(course(TEXTS[text])[0]) == text


def test_words_are_of_what_was_cut_to_fit():
    before = [element("flat", length=60)] * 2
    genes = course(*before, element("ramp", lead=16, size=0.25, length=48, turn=1))[0]
    assert COURSE.describe(genes) == "ramp of 1:4.0 up, 0.80 m long"  # 16 of 160 cells are left


def test_hard_random_courses_have_kinds_evenly_and_hard_ends():
    genes = COURSE.hard_random(500, 0)
    assert genes.dtype == np.float32 and np.abs(genes).max() <= 1.0
    rows = genes.reshape(-1, GENES_PER_ELEMENT)
    kinds = np.minimum((rows[:, 0] + 1) / 2 * 13, 12).astype(int)
    assert np.bincount(kinds).min() > 170 and np.bincount(kinds).max() < 300  # 3,000 / 13 = 231 +- 15
    steps = rows[kinds == COURSE.kinds.index("step")]
    assert set(steps[:, 2]) == {1.0} and set(steps[:, 5]) == {-1.0, 1.0}
    stairs = rows[kinds == COURSE.kinds.index("stairs")]
    assert set(stairs[:, 2]) == {1.0} and set(stairs[:, 3]) == {-1.0}  # high on short treads
    assert all(len(np.unique(rows[kinds == COURSE.kinds.index("rubble"), column])) > 100 for column in (1, 4, 5))
    np.testing.assert_array_equal(genes, COURSE.hard_random(500, 0))


def test_without_an_element_the_others_stay_where_they_are():
    genes = COURSE.hard_random(20, 3)
    before = COURSE.elements(genes)
    for part in range(6):
        after = COURSE.elements(COURSE.without(genes, [part]))
        np.testing.assert_array_equal(after["first"], before["first"])
        np.testing.assert_array_equal(after["cells"], before["cells"])
        assert (after["kind"][:, part] == 0).all()
        assert not after["rise"][:, part].any()
        others = [k for k in range(6) if k != part]
        np.testing.assert_array_equal(after["kind"][:, others], before["kind"][:, others])
    assert not make_heights(COURSE.without(genes, range(6)), COURSE).any()
    np.testing.assert_array_equal(COURSE.without(genes, []), genes)


def test_scaled_elements_are_lower_and_stay_in_their_ranges():
    genes = course(
        element("kerb", size=0.2, turn=1),
        element("flat", length=10),
        element("ditch", size=0.4, length=6),
        element("stairs", size=0.2, length=0.28, detail=3, turn=-1),
    )
    before, half = COURSE.elements(genes)[0], COURSE.elements(COURSE.scaled(genes, 0.5))[0]
    # Half of .2 m stairs is below the lowest stairs, .12 m.
    np.testing.assert_allclose(half["size"][:4], [0.1, 0.0, 0.2, ELEMENTS["stairs"].size.low], atol=1e-6)
    for name in ("kind", "first", "cells", "detail"):
        np.testing.assert_array_equal(half[name], before[name])
    np.testing.assert_allclose(COURSE.scaled(genes, 1.0), genes, atol=1e-6)
    np.testing.assert_allclose(make_heights(COURSE.scaled(genes, 0.9), COURSE).max(), 0.18, atol=1e-6)


BOTH = get_space("super_gaussian+friction+softness")


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
    assert space.describe(np.concatenate([course()[0], np.full(64, -1.0)])).splitlines()[0] == "flat ground"


def test_ground_is_named_by_the_space(tmp_path):
    assert load_space(None) is get_space("super_gaussian") is SUPER_GAUSSIAN and SUPER_GAUSSIAN.num_genes == 64
    assert all(space.name == name for name, space in SPACES.items())
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


LEAST = """
class Space:
    num_genes = 2

    def rasterise(self, genes, x, y):
        return genes[:, 0, None, None] * x
"""


def method(signature, returned):
    return f"    def {signature}:\n        return {returned}\n"


@pytest.fixture(autouse=True)
def none_named(monkeypatch):
    """As in a program that has just begun."""
    monkeypatch.setattr(registry, "LOADED", [])


@pytest.fixture
def ridges(tmp_path):
    return write_ridges(tmp_path / "mine")


@pytest.fixture
def write(tmp_path):
    """Writes a file; returns the name of the space in it."""

    def write_space(text):
        (tmp_path / "space.py").write_text(text)
        return f"{tmp_path / 'space.py'}:Space"

    return write_space


def test_a_space_from_a_file(ridges):
    space = load_space(ridges)
    assert (space.name, space.num_genes, space.sigma0) == (ridges, 3, 0.4)
    assert is_user_space(ridges) and not is_user_space("course")
    # Height .3 m, ridges 0.9 m apart, not turned: a crest at x = 8 m, the next at 8.9 m; a hollow half way is flat.
    heights = make_heights(np.array([[1.0, 0.0, 0.0]]), space)[0]
    assert heights[[0, 80, 160], 160] == pytest.approx(0.3) and heights[80, 178] == pytest.approx(0.3, abs=1e-6)
    assert heights[80, 169] == 0.0 and not heights[:, :80].any()
    assert make_heights(np.array([[5.0, 0.0, 0.0]]), space).max() == pytest.approx(0.3)  # genes are clipped
    assert (space.hard_random(4, 0)[:, 0] == 1).all()
    assert space.describe([0.0, 0.0, 0.0]) == "ridges of 0.15 m, 0.90 m apart"
    assert not make_heights(space.without(space.hard_random(2, 0), [0]), space).any()


def test_what_a_space_may_leave_out(write):
    space = load_space(write(LEAST))
    assert space.hard_random(3, 0).shape == (3, 2)
    assert space.describe([0.5, -1.0]) == "genes 0.50, -1.00" and space.parts([0.5, -1.0]) == ()
    assert space.sigma0 == 2.0
    with pytest.raises(ValueError, match="parts"):
        space.without(np.zeros((1, 2)), [0])


def test_numpy_will_do(write):
    name = write("import numpy as np\n" + LEAST.replace("return", "return np.ones((len(genes), *x.shape)) #"))
    assert (make_heights(np.zeros((2, 2)), load_space(name)) == 1.0).all()


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("num_genes = 2", "num_genes = 0", "num_genes"),
        ("    def", "    sigma0 = -1\n    def", "sigma0"),
        ("    def", "    genes_per_part = 3\n    def", "genes_per_part"),
        ("def rasterise", "def draw", "rasterise"),
        ("    def", "    def parts(self, genes):\n        return []\n    def", "without"),
        ("* x", "", "rasterise"),
        ("* x", "/ 0 * x", "rasterise"),
        ("return", "return None #", "rasterise"),
        ("genes[:, 0,", "genes[:, 7,", "IndexError.*line 6"),
        ("class", "1 / 0\nclass", "ZeroDivisionError"),
        ("class Space", "class Other", "Other"),
        ("    def", method("hard_random(self, count, rng)", "rng.random((count, 5))") + "    def", "hard_random"),
        ("    def", method("hard_random(self, count, rng)", "1 / 0") + "    def", "^(?!.*must).*hard_random fails"),
        ("    def", method("friction(self, genes, x, y)", "x.new_full((3, 4, 8), 2.0)") + "    def", "friction"),
        ("    def", method("friction(self, genes, x, y)", "x.new_ones(3, 8, 4)") + "    def", "friction"),
    ],
)
def test_a_space_that_does_not_work_says_so_before_any_work(write, old, new, field):
    assert old in LEAST
    name = write(LEAST.replace(old, new, 1))
    with pytest.raises(ValueError, match=field) as error:
        load_space(name)
    assert "space.py" in str(error.value)


def test_a_space_of_ones_own_may_have_ground(write):
    friction = method("friction(self, genes, x, y)", "(1.0 - 0.5 * (x > 8)).expand(len(genes), -1, -1)")
    softness = method("softness(self, genes, x, y)", "0.03 * (y < 4) * (genes[:, 1, None, None] > 0)")
    name = write(LEAST + friction + softness)
    space = load_space(name)
    ground = make_terrains(np.array([[0.0, 1.0], [0.0, -1.0]]), space)[1]
    assert (space.ground, space.num_genes) == (("friction", "softness"), 2)
    assert (ground.friction[:, :, 4:] == 0.5).all() and (ground.friction[:, :, :4] == 1.0).all()
    assert (ground.time_constant_s[0, :2] == np.float32(0.03)).all()
    assert not ground.time_constant_s[0, 2:].any() and not ground.time_constant_s[1].any()
    with pytest.raises(ValueError, match="ground"):
        load_space(f"{name}+friction")


def test_no_record_runs_code(ridges):
    with pytest.raises(ValueError, match="--space"):
        get_space(ridges, "0" * 64)
    load_space(ridges)
    with pytest.raises(ValueError, match="changed"):
        get_space(ridges, "0" * 64)


def test_a_space_is_known_by_the_hash_of_its_code(ridges, tmp_path):
    digest = load_space(ridges).sha256
    elsewhere = write_ridges(tmp_path / "elsewhere")
    moved = load_space(elsewhere)
    assert moved.sha256 == digest and get_space(ridges, digest) is moved  # the one named last
    file = Path(elsewhere.rpartition(":")[0])
    file.write_text(file.read_text().replace("0.9", "1.9"))
    changed = load_space(elsewhere)
    assert changed.sha256 != digest and get_space(elsewhere, changed.sha256) is changed
    assert get_space(elsewhere) is changed


@pytest.mark.parametrize(
    ("name", "problem"),
    [("nowhere", "unknown terrain space"), ("nowhere.py:Space", "no such file"), ("sys:maxsize", "num_genes")],
)
def test_what_is_no_space(name, problem):
    with pytest.raises(ValueError, match=f"{name}'.*{problem}|{problem} '{name}'"):
        load_space(name)


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_condition_appears_wherever_conditions_do(name):
    condition, space = CONDITIONS[name], load_space(f"super_gaussian+{name}")
    genes, part = space.hard_random(1, 0), len(SUPER_GAUSSIAN.parts(np.zeros(64)))
    assert space.num_genes == 64 + len(condition.genes) and space.conditions == (name,)
    (row,) = space.condition_rows(genes)
    (text,) = condition_texts(row, [name])
    assert space.parts(genes[0])[part] == text == space.condition_text(genes[0]) != ""
    without = space.without(genes, [part])
    np.testing.assert_array_equal(space.condition_rows(without), [[*nominal_row()[:-1], condition.asks]])
    assert space.parts(without[0])[part] == f"no {name}"
    assert find_effects(genes[0], [part], space).shape(0, 0.3).kind == condition.cause
    assert num_maps(space) == len(condition.genes) == corridor_maps(torch.as_tensor(genes), space).shape[1]
    assert f"+{name}" in ArchiveCommand.help_values()["conditions"]
    assert (name in varied_space(SUPER_GAUSSIAN).conditions) == (condition.varied is not None)
    if condition.dose:
        assert name in DoseCommand.help_values()["conditions"]
        dose = parse_doses([name], [])[name]
        rows = get_space(dose.space).condition_rows(dose.terrains(1, np.random.default_rng(0)))
        np.testing.assert_allclose(rows[:, condition_column(condition.dose.parameter)], dose.values, atol=1e-6)


@pytest.mark.parametrize("name", ELEMENTS)
def test_an_element_appears_wherever_elements_do(name):
    element = ELEMENTS[name]
    space = next(space for space in SPACES.values() if name in getattr(space, "kinds", ()))
    assert all(dose in DoseCommand.help_values()["obstacles"] for dose in element.doses)
    for dose in element.doses:
        grids = all_doses()[dose].terrains(1, np.random.default_rng(0))
        assert np.ptp(grids, axis=(1, 2)).min() > 0.0 and (grids[1:] != grids[:-1]).any(axis=(1, 2)).all()
    kind = space.kinds.index(name)
    genes = np.full((1, space.num_genes), 0.9, np.float32)
    genes[:, ::6] = (2 * kind + 1) / len(space.kinds) - 1
    records = space.elements(genes)[0]
    assert {list(ELEMENTS)[number] for number in records["kind"][:1]} == {name}
    assert space.parts(genes[0])[0] == element.text(records[0])
    assert make_heights(genes, space).any() == (name != "flat")


@pytest.mark.slow
def test_a_toy_condition_blows_the_robot_forward(anymal):
    space, robot = get_space("super_gaussian+wind"), dataclasses.replace(anymal, max_duration_s=0.4)
    genes = np.zeros((2, 65), np.float32)
    genes[1, 64] = 1.0
    rollout = Rollout(robot, anymal.policy_file, num_terrains=2, replicas=2, device="cpu", space=space)
    result = rollout.evaluate(Terrains(genes=genes, seeds=np.array([1, 1], np.uint32), space=space))
    # 5 m/s^2 for 0.4 s without friction would be 0.4 m.
    gain = result.final_position[1, :, 0] - result.final_position[0, :, 0]
    assert (gain > 0.05).all() and (gain < 0.5).all()


@pytest.mark.parametrize(
    "name", [*SPACES, "super_gaussian@0.1", "course+friction+softness+grip+push", "ridges", "ridges+wind"]
)
def test_a_terrain_without_all_of_its_parts_is_flat_and_nominal(name, tmp_path):
    space = load_space(name.replace("ridges", write_ridges(tmp_path)))
    genes = space.uniform_random(20, 1) * 1.5
    parts = space.parts(genes[0])
    heights, ground = make_terrains(space.without(genes, range(len(parts))), space)
    assert not heights.any() and make_heights(genes, space).any()
    if ground is not None:
        assert (ground.friction == 1.0).all() and not ground.time_constant_s.any()
        np.testing.assert_array_equal(ground.rows, np.tile(nominal_row(), (20, 1)))
