"""The dose: obstacles of any size against courses, rates by value and controller, and where under half get over."""

import json
from pathlib import Path

import numpy as np
import pytest

from qd.evaluate.dose import all_doses, dose_set, find_half, measure_dose, measure_rates, parse_doses
from sim.robots.find import get_robot
from sim.terrains.bank import make_terrains
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.elements.kinds import FIRST_COL, NUM_STARTS
from sim.terrains.spaces.registry import get_space
from tests.kernels.oracle import course, course_heights, element
from tests.qd.robots import Robots
from tests.qd.stand_in import BAD, GOAL, HIT, LATE, compute_by, result_of
from tests.sim.dogs import write_toml

STRONG, WEAK = "tests.sim.policies:stand", "tests.sim.policies:stretch"
LIMITS = {STRONG: 0.27, WEAK: 0.12}


def fails(cfg, terrains, seeds):
    """Robots get over what is no higher than their limit, and over no slippery ground, whose genes end with a -1."""
    if terrains.ndim == 3:
        return terrains.max(axis=(1, 2)) > LIMITS[cfg.policy]
    return terrains[:, 64] <= 0.0


def test_a_dose_from_end_to_end(anymal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robots, controllers = Robots(fails), {"base": WEAK, "C-G": STRONG}
    doses = parse_doses(["step_up=0.1,0.2,0.25,0.3 friction=0.2,0.9"], [])
    given = {"compute": compute_by(robots), "terrains": 3, "episodes": 4}
    report = measure_dose(anymal, controllers, doses, **given)
    assert json.loads(Path("runs/anymal-dose/dose.json").read_text()) == json.loads(json.dumps(report))
    assert Path("runs/anymal-dose/dose.png").stat().st_size > 10_000
    rates = {(row["element"], row["controller"], row["value"]): row["goal_rate"] for row in report["dose"]}
    assert [rates["step_up", "base", value] for value in (0.1, 0.2, 0.25, 0.3)] == [1.0, 0.0, 0.0, 0.0]
    assert [rates["step_up", "C-G", value] for value in (0.1, 0.2, 0.25, 0.3)] == [1.0, 1.0, 1.0, 0.0]
    assert [rates["friction", "C-G", value] for value in (0.9, 0.2)] == [1.0, 0.0]
    first = report["dose"][0]
    assert (first["parameter"], first["unit"], first["episodes"], first["left_out"]) == ("height", "m", 12, 0)
    # Wilson: 12 of 12 at 95 %: 1 / (1 + 1.96^2 / 12) = 0.757.
    assert first["interval"] == pytest.approx([0.757, 1.0], abs=1e-3) and first["resolved"] is False
    half = {(row["element"], row["controller"]): row["value"] for row in report["half"]}
    assert half["step_up", "base"] == pytest.approx(0.15) and half["step_up", "C-G"] == pytest.approx(0.275)
    assert not any(cfg.engine == "resolved" for cfg in robots.opened)
    resolved = measure_dose(anymal, controllers, doses, resolved=True, **given)
    assert robots.opened[-1].engine == "resolved" and all(row["resolved"] for row in resolved["dose"])
    assert Path("runs/anymal-dose/dose-resolved.json").exists()


def test_seeds_and_places_are_the_same_for_all_values_and_doses():
    doses = parse_doses(["ditch=0.2,0.4 sill"], [])
    ditch, sill = (dose_set(doses[name], 3, 0) for name in ("ditch", "sill"))
    np.testing.assert_array_equal(ditch.terrains.seeds, np.uint32([2133650207, 3412581510, 3220273462]).repeat(2))
    np.testing.assert_array_equal(ditch.terrains.seeds[::2], sill.terrains.seeds[:: len(doses["sill"].values)])


def test_rows_are_by_value():
    dose = parse_doses(["ditch=0.2,0.4"], [])["ditch"]
    # Two places of two values each, two episodes: the first value at both places comes first.
    result = result_of([[GOAL, GOAL], [HIT, LATE], [GOAL, BAD], [BAD, BAD]], fallen=[[0, 0], [1, 0], [0, 0], [0, 0]])
    first, second = measure_rates("ditch", dose, "base", result)
    assert (first["value"], first["goal_rate"], first["episodes"], first["left_out"]) == (0.2, 1.0, 3, 1)
    assert (first["success_rate"], first["fallen_rate"]) == (1.0, 0.0)
    # Half of the second's episodes are invalid, more than a quarter.
    assert (second["goal_rate"], second["interval"], second["episodes"]) == (None, None, 0)
    half = find_half(dose, [first, second], result)
    assert (half["value"], half["beyond"], half["interval"]) == (None, "invalid", [None, None])


@pytest.mark.parametrize(
    ("hits", "value", "beyond"),
    [
        ([4, 4, 1, None], 0.4 + 0.2 * 2 / 3, None),  # all arrive at .4, a quarter at .6
        ([4, None, 0, 0], None, "invalid"),  # somewhere between .2 and .6
        ([4, 4, 4, None], None, "invalid"),
        ([None, 0, 0, 0], None, "invalid"),
        ([None, 4, 4, 4], None, "last"),
    ],
)
def test_values_whose_episodes_are_all_invalid_say_nothing(hits, value, beyond):
    dose = parse_doses(["ditch=0.2,0.4,0.6,0.8"], [])["ditch"]
    result = result_of([[BAD] * 4 if hit is None else [GOAL] * hit + [HIT] * (4 - hit) for hit in hits])
    half = find_half(dose, measure_rates("ditch", dose, "a", result), result)
    assert (half["value"], half["beyond"]) == (value and pytest.approx(value), beyond)


@pytest.mark.parametrize(
    ("name", "hits", "value", "beyond", "interval"),
    [
        # Of four places all arrive at the first value and one at the second: 1 and .25, and a half between them.
        ("ditch", [(2, 0), (2, 2), (2, 0), (2, 0)], 0.2 + 0.2 * 0.5 / 0.75, None, (0.3, None)),
        # Friction gets harder as it falls, from .4 to .2.
        ("friction", [(2, 0), (2, 2), (2, 0), (2, 0)], 0.4 - 0.2 * 0.5 / 0.75, None, (None, 0.3)),
        ("friction", [(2, 2), (2, 2), (2, 2), (2, 2)], None, "last", (None, None)),
        ("ditch", [(0, 0), (0, 2), (0, 0), (0, 0)], None, "first", (None, None)),
        ("ditch", [(2, 0), (2, 0), (2, 0), (2, 0)], 0.3, None, (0.3, 0.3)),  # no place differs from another
    ],
)
def test_where_under_half_begin_to_reach_the_goal(name, hits, value, beyond, interval):
    dose = parse_doses([f"{name}=0.2,0.4"], [])[name]
    result = result_of([[GOAL] * hit + [HIT] * (2 - hit) for place in hits for hit in place])
    half = find_half(dose, measure_rates(name, dose, "a", result), result)
    assert half["value"] == (None if value is None else pytest.approx(value)) and half["beyond"] == beyond
    assert half["interval"] == [None if limit is None else pytest.approx(limit) for limit in interval]


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
    expected = course_heights(course([*genes[:1], *element("flat", lead=4)[1:2], *genes[2:]])[0])
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


def test_a_command_line_names_doses():
    assert all_doses()["stairs_up"].describe() == "stairs up, tread 0.30 m, flight 5 steps"
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


SEEN = {"estimate": ('{term = "gravity"}', "lin_vel"), "map_late": ('{term = "lin_vel"}', "scan")}
"""What a controller sees, and what it would have to see for the condition to disturb it."""


@pytest.mark.parametrize("elements", SEEN)
def test_what_a_controller_does_not_see_is_refused_before_any_work(anymal, tmp_path, elements):
    sees, lacks = SEEN[elements]
    file = tmp_path / "controller.toml"
    file.write_text(f'policy = "net.pt"\nobservation = [{{term = "ang_vel"}}, {sees}]\naction_scale = 0.5\n')
    doses, given = parse_doses([f"sill=0.1 {elements}"], []), {"compute": compute_by(None), "out": tmp_path / "a.json"}
    with pytest.raises(ValueError, match=rf"{lacks}.*\+{elements}"):
        measure_dose(anymal, {"base": str(file)}, doses, **given)
    robot = get_robot(str(write_toml(tmp_path / "a")))  # which was never measured under routes
    with pytest.raises(ValueError, match="stray_m"):
        measure_dose(robot, {"base": STRONG}, parse_doses(["sill=0.1 segment_2"], []), **given)
