"""Doses: obstacles alone on flat ground, of any size, against courses and by numbers worked out by hand."""

import itertools

import numpy as np
import pytest

from qd.evaluate.dose import all_doses, parse_doses
from sim.terrains.bank import make_terrains
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.elements.kinds import FIRST_COL, NUM_STARTS
from sim.terrains.spaces.registry import get_space
from tests.kernels import course_oracle as oracle
from tests.kernels.course_oracle import course, element

IN_RANGE = {
    "stairs_up": (element("stairs", size=0.17, length=0.3, detail=5, turn=1), {"rise": 0.17}),
    "stairs_down": (element("stairs", size=0.2, length=0.3, detail=5, turn=-1), {"rise": 0.2}),
    "step_up": (element("step", size=0.3, turn=1), {"height": 0.3}),
    "step_down": (element("step", size=0.3, turn=-1), {"height": 0.3}),
    "sill": (element("sill", size=0.12, length=2), {"height": 0.12}),
    "rail": (element("rail", size=0.1, length=0), {"height": 0.1}),
    "pallet": (element("pallet", size=0.15, length=20, detail=1), {"height": 0.15}),
    "ramp_up": (element("ramp", size=0.3, length=40, turn=1), {"slope": 0.3}),
    "ramp_down": (element("ramp", size=0.2, length=40, turn=-1), {"slope": 0.2}),
    "ditch": (element("ditch", size=0.5, length=8), {"width": 0.4}),
    "beam": (element("bridge", size=0.5, length=30, detail=8, turn=0), {"width": 0.4}),
    "stones": (element("stones", size=0.4, length=40, detail=6, turn=4), {"gap": 0.2}),
}


def dose_of(name, *values, **others):
    at = [f"{parameter}={value}" for parameter, value in others.items()]
    return parse_doses([f"{name}={','.join(map(str, values))}"], at)[name]


@pytest.mark.parametrize("name", IN_RANGE)
def test_an_obstacle_is_the_element_of_a_course(name):
    genes, value = IN_RANGE[name]
    (heights,) = dose_of(name, *value.values()).terrains(1, np.random.default_rng(0))
    expected = oracle.heights(course([*genes[:1], *element("flat", lead=4)[1:2], *genes[2:]])[0])
    # There it begins behind 4 cells of flat ground, at column 84; here at column 100.
    np.testing.assert_allclose(heights[:, 16:], expected[:, : 321 - 16], atol=1e-5)
    assert not heights[:, :17].any()


def test_sizes_go_beyond_what_the_space_has():
    stairs = dose_of("stairs_up", 0.3, 0.15).terrains(1, np.random.default_rng(0))
    # The easier value first: five steps of 0.15 m and of 0.30 m, 6 cells apart, the first behind column 100.
    assert [grid.max() for grid in stairs] == pytest.approx([0.75, 1.5])
    assert np.flatnonzero(np.diff(stairs[1][80]) > 0).tolist() == [100, 106, 112, 118, 124]
    steep = dose_of("cross_slope", 1.0).terrains(2, np.random.default_rng(0))
    assert sorted(grid[160, 130] > 0 for grid in steep) == [False, True]  # one to each side
    assert np.abs(steep).max() == pytest.approx(2.0)  # 1 in 1 over 2 m
    first, second = dose_of("rubble", 0.3).terrains(2, np.random.default_rng(0))
    assert np.abs(first[:, 101:140] - second[:, 111:150]).max() > 0.05  # another at each place
    narrow = dose_of("beam", 0.1).terrains(1, np.random.default_rng(0))[0]
    assert np.flatnonzero(narrow[:, 110] == 0.0).tolist() == [79, 80, 81]


def test_places_are_spread_over_a_metre_and_the_same_for_all_values():
    dose = dose_of("ditch", 0.2, 0.4, 0.6)
    grids = dose.terrains(NUM_STARTS, np.random.default_rng(0)).reshape(NUM_STARTS, 3, 161, 321)
    begins = (grids[:, :, 80] < 0).argmax(axis=2) - 1
    assert (begins == begins[:, :1]).all()
    assert begins[:, 0].tolist() == list(range(FIRST_COL, FIRST_COL + NUM_STARTS))
    assert ((grids[:, :, 80] < 0).sum(axis=2) == [3, 7, 11]).all()  # nodes between the edges
    few = dose.terrains(4, np.random.default_rng(0)).reshape(4, 3, 161, 321)
    assert ((few[:, 0, 80] < 0).argmax(axis=1) - 1).tolist() == [100, 105, 110, 115]


@pytest.mark.parametrize(("name", "values"), [("friction", (1.0, 0.5, 0.15)), ("softness", (0.02, 0.06))])
def test_ground_is_level_and_the_same_everywhere(name, values):
    dose = dose_of(name, *values)
    heights, ground = make_terrains(dose.terrains(2, np.random.default_rng(0)), get_space(dose.space))
    assert not heights.any()
    maps = {"friction": ground.friction, "softness": ground.time_constant_s}
    np.testing.assert_allclose(maps.pop(name), np.tile(values, 2)[:, None, None] * np.ones((4, 8)), atol=1e-6)
    assert (next(iter(maps.values())) == (0.0 if name == "friction" else 1.0)).all()


def test_words():
    assert all_doses()["stairs_up"].describe() == "stairs up, tread 0.30 m, flight 5 steps"


def test_a_command_line_names_doses():
    assert list(parse_doses([], [])) == [name for name in all_doses() if name not in CONDITIONS]
    doses = parse_doses(["friction=0.2,0.9 stairs_up", "ditch"], ["tread=0.25"])
    assert list(doses) == ["stairs_up", "ditch", "friction"]  # in the order of all doses
    assert doses["friction"].values == (0.9, 0.2)  # the easier first
    assert doses["stairs_up"].others == {"tread": 0.25, "flight": 5.0}
    assert doses["ditch"] == all_doses()["ditch"]


@pytest.mark.parametrize(
    ("elements", "at", "field"),
    [
        ("stair", "", "stair"),
        ("ditch=0.12", "", "width"),  # no multiple of 5 cm
        ("lag=0.009", "", "lag"),  # nor of a control step
        ("stairs_up=0.9", "", "rise"),
        ("stairs_up=high", "", "stairs_up=high"),
        ("ditch=nan", "", "width"),
        ("stairs_up", "flight=2.5", "flight"),
        ("ditch", "tread=0.3", "tread"),
        ("ditch", "depth", "depth"),
    ],
)
def test_what_cannot_be_made_is_refused(elements, at, field):
    with pytest.raises(ValueError, match=field):
        parse_doses([elements], [at])


@pytest.mark.parametrize("name", IN_RANGE)
def test_every_value_of_an_obstacle_is_one(name):
    grids = all_doses()[name].terrains(1, np.random.default_rng(0))
    assert len(grids) == len(all_doses()[name].values) > 5
    assert all(np.ptp(grid) > 0.0 for grid in grids)  # level ground stops nobody, and says nothing of a size
    assert all(not np.array_equal(*pair) for pair in itertools.pairwise(grids))
