"""The space of courses: terrains in words, hard-random ones, and terrains without some of their elements."""

import numpy as np

from kernels.course import GENES_PER_ELEMENT
from sim.terrains.bank import make_heights
from sim.terrains.elements.kinds import ELEMENTS
from sim.terrains.spaces.course import COURSE
from tests.kernels.course_oracle import course, element


def test_a_course_in_words():
    genes = course(
        element("kerb", size=0.15, turn=1),
        element("stairs", size=0.18, length=0.28, detail=3, turn=-1),
        element("ditch", size=0.4, length=6),
    )[0]
    assert COURSE.describe(genes) == (
        "kerb 0.15 m up, 3 stairs of 0.18 x 0.28 m down, ditch 0.30 m wide and 0.40 m deep"
    )
    assert COURSE.parts(genes)[0] == "kerb 0.15 m up"
    assert len(COURSE.parts(genes)) == 6 and COURSE.parts(genes)[3] == "nothing"


def test_every_kind_in_words():
    def words(kind, **values):
        return COURSE.describe(course(element(kind, **values))[0])

    assert words("flat", length=20) == "flat ground"
    assert words("ramp", size=0.25, length=24, turn=1) == "ramp of 1:4.0 up, 1.20 m long"
    assert words("cross_slope", size=0.2, length=40, turn=-1) == "cross slope of 1:5.0 right side up, 2.00 m long"
    assert words("sill", size=0.1, length=2) == "sill 0.100 m high and 0.10 m wide"
    assert words("rail", size=0.05, length=0) == "rail 0.050 m high"
    assert words("rail", size=0.05, length=1) == "rail 0.050 m high and 0.05 m wide"
    assert words("step", size=0.3, turn=-1) == "step 0.30 m down"
    assert words("pallet", size=0.144, length=16, detail=1) == "pallet 0.14 m high and 0.80 m long"
    assert words("pallet", size=0.144, length=24, detail=2) == "2 pallets, 0.29 m high and 1.20 m long"
    assert words("bridge", size=0.5, length=24, detail=8, turn=-4) == (
        "beam 0.40 m wide over a ditch 1.20 m wide and 0.50 m deep, 0.20 m right of the way"
    )
    assert words("stones", size=0.3, length=20, detail=5, turn=3) == (
        "stones of 0.25 m, 0.15 m apart, in a ditch 1.00 m wide and 0.30 m deep"
    )
    assert words("rubble", size=0.15, length=30, detail=4, turn=0) == (
        "rubble of blocks of 0.20 m up to 0.15 m high, 1.50 m long"
    )


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
