"""The dose: rates by value and controller, where under half get over, words, and what goes on after a kill."""

import json
from contextlib import contextmanager

import numpy as np
import pytest

from qd.evaluate.dose import MeasureDose, half_of, measure_dose, rows_of, set_of
from sim.spaces.dose import chosen_doses
from tests.train.results import BAD, GOAL, HIT, LATE, result_of

STRONG, WEAK = "tests.sim.policies:stand", "tests.sim.policies:stretch"
LIMITS = {STRONG: 0.27, WEAK: 0.12}


class Crossers:
    """Every robot of a controller gets over what is no higher than its limit, and over no slippery ground."""

    def __init__(self, die_after=1000):
        self.opened, self.crossed, self.die_after = [], [], die_after

    @contextmanager
    def open(self, cfg):
        self.opened.append(cfg)

        def evaluate(terrains, seeds, progress=None):
            if len(self.crossed) == self.die_after:
                raise KeyboardInterrupt
            self.crossed.append((cfg.policy, len(seeds)))
            flat = terrains.reshape(len(terrains), -1)
            over = flat.max(axis=1) <= LIMITS[cfg.policy] if terrains.ndim == 3 else flat[:, 64] > 0.0
            return result_of([[GOAL if ok else HIT] * cfg.num_replicas for ok in over])

        yield evaluate


def flags_of(tmp_path, **changes):
    values = {
        "policies": (f"base={WEAK} C-G={STRONG}",), "elements": ("step_up friction",), "device": "cpu", "terrains": 3,
        "values": ("step_up=0.1,0.2,0.25,0.3 friction=0.2,0.9",), "episodes": 4, "run_dir": tmp_path,
    }  # fmt: skip
    return MeasureDose(**values | changes)


def test_a_dose_from_end_to_end(tmp_path, capsys):
    crossers = Crossers()
    report = measure_dose(flags_of(tmp_path), open_evaluator=crossers.open)
    assert json.loads((tmp_path / "dose.json").read_text()) == json.loads(json.dumps(report))
    assert (tmp_path / "dose.png").stat().st_size > 10_000
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
    said = capsys.readouterr().out
    assert "kerb or step up: robots that reach the goal" in said
    assert "  C-G: half of the robots reach the goal at a height of 0.28 m (0.27 to 0.28 m)" in said
    # All values of an element are crossed together: two sets a controller, 3 terrains a value.
    assert crossers.crossed == [(WEAK, 12), (WEAK, 6), (STRONG, 12), (STRONG, 6)]
    assert not any(cfg.resolved for cfg in crossers.opened)


def test_the_same_command_goes_on(tmp_path, capsys):
    with pytest.raises(KeyboardInterrupt):
        measure_dose(flags_of(tmp_path), open_evaluator=Crossers(die_after=3).open)
    assert not (tmp_path / "dose.json").exists()
    again = Crossers()
    measure_dose(flags_of(tmp_path), open_evaluator=again.open)
    assert again.crossed == [(STRONG, 6)]
    assert "3 of 4 crossings of a set are kept" in capsys.readouterr().out
    more = Crossers()
    measure_dose(flags_of(tmp_path, values=("step_up=0.1",), elements=("step_up",)), open_evaluator=more.open)
    assert more.crossed == [(WEAK, 3), (STRONG, 3)]


def test_contact_resolved_has_files_of_its_own(tmp_path):
    crossers = Crossers()
    report = measure_dose(flags_of(tmp_path, resolved=True), open_evaluator=crossers.open)
    assert all(cfg.resolved for cfg in crossers.opened) and all(row["resolved"] for row in report["dose"])
    assert (tmp_path / "dose-resolved.json").exists() and not (tmp_path / "dose.json").exists()


def test_seeds_and_places_are_the_same_for_all_values_and_doses():
    doses = chosen_doses(["ditch", "sill"], {"ditch": [0.2, 0.4]}, {})
    ditch, sill = (set_of(name, doses[name], 3, 7) for name in ("ditch", "sill"))
    assert len({*ditch.seeds.tolist()}) == 3
    np.testing.assert_array_equal(ditch.seeds.reshape(3, 2), ditch.seeds[::2, None].repeat(2, axis=1))
    np.testing.assert_array_equal(ditch.seeds[::2], sill.seeds[:: len(doses["sill"].values)])
    assert (set_of("ditch", doses["ditch"], 3, 8).seeds != ditch.seeds).any()


def test_rows_are_by_value():
    dose = chosen_doses(["ditch"], {"ditch": [0.2, 0.4]}, {})["ditch"]
    # Two places of two values each, two episodes: the first value at both places comes first.
    result = result_of([[GOAL, GOAL], [HIT, LATE], [GOAL, BAD], [BAD, BAD]], fallen=[[0, 0], [1, 0], [0, 0], [0, 0]])
    first, second = rows_of("ditch", dose, "base", result)
    assert (first["value"], first["goal_rate"], first["episodes"], first["left_out"]) == (0.2, 1.0, 3, 1)
    # Half of the second's episodes are invalid, more than a quarter.
    assert (second["goal_rate"], second["interval"], second["episodes"]) == (None, None, 0)
    half = half_of(dose, [first, second])
    assert half["value"] is None
    assert half["words"] == "over half of the robots reach the goal at every width, up to 0.20 m"


def half_words(name, values, rates, limits):
    dose = chosen_doses([name], {name: values}, {})[name]
    rows = [
        {"element": name, "parameter": dose.parameter, "unit": dose.unit, "controller": "a", "value": value,
         "goal_rate": rate, "interval": [low, high]}
        for value, rate, (low, high) in zip(dose.values, rates, limits, strict=True)
    ]  # fmt: skip
    return half_of(dose, rows)


def test_where_under_half_begin_to_reach_the_goal():
    # From 0.9 at 0.2 m to 0.1 at 0.4 m: half at 0.3 m. The limits pass it from 0.8 to 0 and from 1 to 0.3.
    found = half_words("ditch", [0.2, 0.4], [0.9, 0.1], [(0.8, 1.0), (0.0, 0.3)])
    assert found["value"] == pytest.approx(0.3)
    assert found["interval"] == pytest.approx([0.2 + 0.2 * 0.3 / 0.8, 0.2 + 0.2 * 0.5 / 0.7])
    assert found["words"] == "half of the robots reach the goal at a width of 0.30 m (0.28 to 0.34 m)"
    open_end = half_words("ditch", [0.2, 0.4], [0.9, 0.1], [(0.8, 1.0), (0.0, 0.6)])
    assert open_end["interval"][1] is None and open_end["words"].endswith("0.30 m (0.28 m or more)")
    under = half_words("ditch", [0.2, 0.4], [0.4, 0.1], [(0.3, 0.6), (0.0, 0.3)])
    assert under["value"] is None
    assert under["words"] == "under half of the robots reach the goal even at a width of 0.20 m"


def test_what_gets_harder_as_it_falls():
    found = half_words("friction", [0.2, 0.4], [0.9, 0.1], [(0.8, 1.0), (0.0, 0.3)])
    assert found["value"] == pytest.approx(0.3) and found["interval"][0] < 0.3 < found["interval"][1]
    assert found["words"] == "half of the robots reach the goal at a friction of 0.30 (0.26 to 0.33)"
    over = half_words("friction", [0.2, 0.4], [0.9, 0.7], [(0.8, 1.0), (0.6, 0.8)])
    assert over["words"] == "over half of the robots reach the goal at every friction, down to 0.20"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"elements": ("stair",)}, "got stair"),
        ({"values": ("step_up=high",)}, "values must be ELEMENT=VALUE,VALUE,..., got 'step_up=high'"),
        ({"at": ("tread",)}, "at must be NAME=VALUE, got 'tread='"),
        ({"policies": ("a=nosuch.pt",)}, "no such file"),
        ({"terrains": 0}, "terrains must be at least 1"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_any_work(tmp_path, changes, message):
    crossers = Crossers()
    with pytest.raises(ValueError, match=message):
        measure_dose(flags_of(tmp_path, **changes), open_evaluator=crossers.open)
    assert not crossers.opened and not any(tmp_path.iterdir())
