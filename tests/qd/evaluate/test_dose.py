"""The dose: rates by value and controller, and where under half get over."""

import json
from pathlib import Path

import numpy as np
import pytest

from qd.evaluate.dose import dose_set, find_half, measure_dose, measure_rates, parse_doses
from tests.qd.robots import Robots
from tests.qd.stand_in import BAD, GOAL, HIT, LATE, compute_by, result_of

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
    assert (half["value"], half["beyond"], half["interval"]) == (None, "last", [None, None])


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
