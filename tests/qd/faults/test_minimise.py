"""Minimal terrains by a rule of failing that is known, and those of a run of the stand-in with its files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.faults.causes import find_effects
from qd.faults.judge import Judging
from qd.faults.minimise import Case, Trial, cut_genes, find_minimal, minimise, open_case, take_apart
from qd.faults.numbers import read_minimal
from qd.faults.searches import Search
from qd.search.archive import read_archive
from qd.workers.crosser import Crosser
from sim.controllers.spec import controller_hash
from sim.robots.find import get_robot
from sim.terrains.conditions.kinds import condition_column
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values, small_archive
from tests.qd.robots import OTHER, Robots, bump_stops
from tests.qd.searches import CFG
from tests.qd.stand_in import compute_by

PASSES, FAILS, INVALID = np.array([20, 0, 0, 0]), np.array([0, 20, 0, 0]), np.array([0, 9, 0, 11])
ROBOT = get_robot("anymal")
SPACE = "sim.terrains.spaces.super_gaussian.SuperGaussian"
BOTH = pytest.mark.parametrize("how", ["exhaustive", "greedy"])


def case(how="exhaustive", parts=range(8), scalable=True):
    counts = {Trial(tuple(sorted(parts)), fresh=True): 2 * FAILS}
    return Case(parts=tuple(parts), how=how, flat=() if scalable else tuple(parts), counts=counts)


def solve(case, rule, crossed=None):
    """The case taken apart; ``rule(trial)`` says how many of 20 robots arrive. Notes what is crossed, in steps."""
    for wanted in find_minimal(case):
        (crossed if crossed is not None else []).append(wanted)
        for trial in wanted:
            assert trial not in case.counts
            case.counts[trial] = (2 if trial.fresh else 1) * np.array([rule(trial), 20 - rule(trial), 0, 0])
    return case


def scales(case):
    return [trial.scale for trial in case.counts if trial.scale != 1.0]


def two_and_five(trial):
    """Two parts are needed, at over .6 of their heights."""
    return 3 if {2, 5} <= set(trial.parts) and trial.scale > 0.6 else 18


@BOTH
def test_the_parts_that_are_needed_are_found_and_scaled(how):
    crossed = []
    minimal = solve(case(how, parts=(7, 0, 5, 1, 2, 6, 3, 4)), two_and_five, crossed)
    assert minimal.minimal == (2, 5) and minimal.fresh.tolist() == [6, 34, 0, 0]
    assert {part: counts.tolist() for part, counts in minimal.without.items()} == {2: [18, 2, 0, 0], 5: [18, 2, 0, 0]}
    assert minimal.cause({2: 0.1, 5: 0.2}) == 5 and minimal.cause({2: 0.3, 5: 0.2}) == 2
    # .5 passes, .75 fails, .625 fails, .5625 and .59375 pass
    assert (minimal.scale, minimal.passing_scale) == (0.625, 0.59375)
    assert scales(minimal) == [0.5, 0.75, 0.625, 0.5625, 0.59375]
    if how == "exhaustive":  # all of a size at once: none, one of eight, two of eight; the rest one by one
        assert [len(wanted) for wanted in crossed] == [1, 8, 28, 1, 1, 1, 1, 1, 1]
        assert crossed[3] == [Trial((2, 5), fresh=True)] and crossed[4] == [Trial((2, 5), scale=0.5)]
        return
    subsets = [trial.parts for (trial,) in crossed if trial.scale == 1.0 and not trial.fresh]
    assert subsets[0] == tuple(range(7))  # without 7, which comes first
    # Eight, and 5 and 2 again without what was taken away after them.
    assert len(subsets) == len(set(subsets)) == 10 and set(subsets[-2:]) == {(2,), (5,)}


@BOTH
def test_what_is_left_has_no_part_to_spare_where_parts_hide_each_other(how):
    """Part 0 alone fails unless part 1 is there; parts 1 to 3 together fail."""

    def rule(trial):
        parts = set(trial.parts)
        return 0 if (0 in parts and 1 not in parts) or {1, 2, 3} <= parts else 20

    minimal = solve(case(how, parts=range(4)), rule)
    assert minimal.minimal == ((0,) if how == "exhaustive" else (1, 2, 3))
    assert all(counts.tolist() == PASSES.tolist() for counts in minimal.without.values())


@BOTH
def test_fresh_episodes_refute(how):
    """Part 3 alone looks failing in its 20 episodes and is not in its 40; 3 and 4 together fail."""

    def rule(trial):
        if trial.parts == (3,):
            return 12 if trial.fresh else 8
        return 2 if {3, 4} <= set(trial.parts) else 20

    minimal = solve(case(how, scalable=False), rule)
    assert minimal.minimal == (3, 4)
    assert minimal.without[4].tolist() == [24, 16, 0, 0]  # the fresh ones, which are not selected
    assert minimal.without[3].tolist() == [20, 0, 0, 0]
    assert minimal.cause({3: 0.1, 4: 0.1}) == 3
    assert minimal.scale is None and not scales(minimal)


def test_of_equally_many_parts_the_lowest_goal_rate_is_taken_and_if_refuted_the_next():
    rates = {(1,): 6, (2,): 4, (3,): 9}

    def rule(trial, refuted=()):
        return 20 if trial.fresh and trial.parts in refuted else rates.get(trial.parts, 20)

    assert solve(case(scalable=False), rule).minimal == (2,)
    assert solve(case(scalable=False), lambda trial: rule(trial, [(2,)])).minimal == (1,)
    assert solve(case(scalable=False), lambda trial: rule(trial, [(1,), (2,), (3,)])).minimal == tuple(range(8))


@BOTH
def test_the_whole_terrain_is_the_last_and_a_terrain_without_parts_the_first(how):
    every = solve(case(how, parts=range(3)), lambda trial: 0 if len(trial.parts) == 3 and trial.scale == 1.0 else 20)
    assert every.minimal == (0, 1, 2) and every.fresh.tolist() == (2 * FAILS).tolist()
    assert (every.scale, every.passing_scale) == (1.0, 0.96875)
    flat = solve(case(how, parts=range(3)), lambda trial: 0)
    assert (flat.minimal, flat.without, flat.scale, flat.cause({})) == ((), {}, None, None)
    always = solve(case("exhaustive", parts=range(3)), lambda trial: 20 if not trial.parts else 0)
    assert (always.minimal, always.scale, always.passing_scale) == ((0,), 1 / 32, None)


def test_too_many_invalid_episodes_say_nothing():
    known = case(parts=range(2), scalable=False)
    known.counts.update({Trial(()): PASSES, Trial((0,)): INVALID, Trial((1,)): PASSES})
    minimal = solve(known, lambda trial: 20)
    assert minimal.minimal == (0, 1)
    assert minimal.cause({0: 0.1, 1: 0.3}) == 0  # without 1 nothing is known


@pytest.mark.parametrize(("on_gpu", "how"), [(False, "greedy"), (True, "exhaustive")])
def test_parts_go_from_the_lowest_under_the_robot_on(on_gpu, how):
    archive = small_archive(1)
    archive = replace(archive, fresh=fresh_values(archive), genes=np.zeros((1, 64), np.float32))
    for bump, height in ((4, 0.96), (6, 0.7), (1, 0.4)):
        archive.genes[0, 8 * bump : 8 * bump + 8] = (0.0, 0.0, -0.5, 1.0, 1.0, 1.0, 0.0, height)  # across the way
    case = open_case(archive, 0, SUPER_GAUSSIAN, 0.3, None, on_gpu=on_gpu)
    assert (case.parts, case.how, case.flat) == ((1, 6, 4), how, ())
    assert [(trial, counts.sum()) for trial, counts in case.counts.items()] == [(Trial((1, 4, 6), fresh=True), 40)]


def take_all_apart(archive, cases, robots, space=SUPER_GAUSSIAN):
    search = Search(run=Path("run"), cfg=CFG, robot=ROBOT, policy=str(ROBOT.policy_file), space=space)
    with Crosser(ROBOT, compute_by(robots)) as crosser:
        take_apart(archive, cases, Judging(search=search, certifiers={}, crosser=crosser))


@BOTH
def test_elites_are_taken_apart_together_each_with_its_own_episodes(how):
    archive = small_archive(3)
    archive = replace(archive, fresh=replace(fresh_values(archive), goal_rate=np.full(3, 0.1)))

    def fails(cfg, genes, seeds):
        """Where bumps 2 and 5 are there, higher than .6 of what the elite has."""
        whose = np.abs(archive.genes[:, None] - genes).sum(axis=2).argmin(axis=0)
        return (np.abs(genes[:, 7::8]) > 0.6 * np.abs(archive.genes[whose, 7::8]))[:, [2, 5]].all(axis=1)

    def apart(numbers, robots):
        cases = {number: case(how) for number in numbers}
        take_all_apart(archive, cases, robots)
        return cases

    together, alone = Robots(fails), Robots(fails)
    cases = apart((2, 0), together)
    assert len(together.opened) == 1 and together.crossed[0][0].replicas == 5
    assert [(case.minimal, case.scale) for case in cases.values()] == [((2, 5), 0.625)] * 2
    # An elite's 20 episodes are of four seeds, its 40 fresh ones of eight others.
    assert len(set(together.seeds)) == 2 * (4 + 8)
    counted = sum(counts.sum() for case in cases.values() for counts in case.counts.values())
    assert counted - 2 * 20 * 2 == 5 * len(together.crossed)  # all but the whole terrains, which are given
    single = apart((2,), alone)
    assert set(alone.seeds) < set(together.seeds) and single[2].fresh.tolist() == cases[2].fresh.tolist()


@BOTH
def test_conditions_are_parts_that_are_kept_where_the_robot_fails_by_them_alone(how):
    space, archive = get_space("super_gaussian+payload+motors+push"), small_archive(1)
    genes = space.without(np.ones((1, space.num_genes), np.float32), range(8 + 3))
    genes[0, 8 * 3 : 8 * 4] = (0.0, 0.0, -0.5, 1.0, 1.0, 1.0, 0.0, 0.7)  # a bump across the way
    genes[0, [64, 68, 69]] = 0.5, 0.4, 0.4  # a payload and a push; motors as they are
    fresh = replace(fresh_values(archive), goal_rate=np.full(1, 0.1))
    archive = replace(archive, fresh=fresh, genes=genes, space=space)

    def fails(cfg, genes, seeds):
        """With this payload, on the bump where it is higher than .6 of what the elite has."""
        return (space.condition_rows(genes)[:, condition_column("payload")] > 0.1) & (genes[:, 31] > 0.42)

    case = open_case(archive, 0, space, 0.3, how, on_gpu=True)
    assert sorted(case.parts) == [3, 8, 10] and sorted(case.flat) == [8, 10]
    take_all_apart(archive, {0: case}, Robots(fails), space)
    assert (case.minimal, case.scale) == ((3, 8), 0.625)
    effects = find_effects(genes[0], range(11), space)
    assert effects.conditions == ("",) * 8 + ("payload", "", "push")
    assert [effects.shape(part, 0.3).kind for part in (8, 10)] == ["payload", "push"]
    assert effects.shape(3, 0.3).height_m > 0.1


def test_a_push_comes_as_late_as_it_still_makes_the_robot_fail():
    space, archive = get_space("super_gaussian+payload+push"), small_archive(1)
    genes = space.without(np.zeros((1, space.num_genes), np.float32), range(8 + 2))
    genes[0, [67, 68, 69]] = 0.4, 0.4, -0.5  # a push after 3 s
    assert space.moments(genes[0]) == {9: (3.0, 12.0)} and space.moments(0.0 * genes[0]) == {}
    fresh = replace(fresh_values(archive), goal_rate=np.full(1, 0.1))
    archive = replace(archive, fresh=fresh, genes=genes, space=space)

    def pushed_by(latest):
        return lambda cfg, genes, seeds: (
            (genes[:, 67] > 0.3) & (space.condition_rows(genes)[:, condition_column("push_time")] < latest)
        )

    for latest, moments in ((7.6, ((9, 7.5),)), (4.0, ()), (99.0, ((9, 12.0),))):
        case = open_case(archive, 0, space, 0.3, "greedy", on_gpu=False)
        take_all_apart(archive, {0: case}, Robots(pushed_by(latest)), space)
        assert case.minimal == (9,) and case.moments == moments
        row = space.condition_rows(cut_genes(genes[0], Trial((9,), moments=moments), space)[None])[0]
        assert row[condition_column("push_time")] == pytest.approx(moments[0][1] if moments else 3.0)


@pytest.fixture(autouse=True)
def minimal_undrawn(request, monkeypatch):
    """The figure takes longer to draw than the rest; one test draws it."""
    if "end_to_end" not in request.node.name:
        monkeypatch.setattr("qd.faults.minimise.draw_minimal", lambda *_: None)
        monkeypatch.setattr("qd.faults.minimise.save_figure", lambda *_: None)


def minimised(path, elites, robots=None, **changes):
    elite = " ".join(map(str, elites)) if elites else None
    return minimise(path, compute=compute_by(robots or Robots(bump_stops)), elite=elite, **changes)


def test_minimal_terrains_from_end_to_end(path, elites, capsys):
    minima = minimised(path, elites)
    assert f"Elite {elites[0]}: 1 of 8 parts" in capsys.readouterr().out
    numbers = json.loads((path / "minimal.json").read_text())
    assert numbers == minima.numbers
    assert numbers["seed"] == 3 and numbers["robot"] == "anymal" and numbers["space"] == "super_gaussian"
    assert (numbers["minimal"], numbers["bumps_histogram"], numbers["bumps_median"]) == (2, {"1": 2}, 1.0)
    first = numbers["elites"][0]
    assert first["elite"] == elites[0] and first["bumps"] == [4]
    assert (first["goal_rate"], first["valid_episodes"], first["without"]) == (0.0, 40, {"4": 1.0})
    assert first["of"] == 8 and first["how"] == "greedy" and "0.24 m at (8.0, 4.0) m" in first["words"][0]
    # .96 * .4375 = .42 fails, .96 * .40625 = .39 does not; the highest point moves by .24 m * (1 - .4375).
    assert (first["scale"], first["passing_scale"], first["margin_m"]) == (0.4375, 0.40625, 0.135)
    assert first["height_m"] == 0.24 and numbers["margin_m_median"] == 0.135
    # Half widths of .5 m + .25 * 2.5 m = 1.125 m along the way: the bump's half is longer than 1 m.
    assert first["cause"]["bump"] == 4 and first["cause"]["kind"] == "rise" and first["cause"]["height_m"] == 0.24
    assert numbers["causes"] == {"rise": 2} and first["verdict"] == "failing" and first["resolved"] is None
    assert numbers["confirmed"] is numbers["faults"] is None
    genes = minima.genes[elites[0]]
    assert not np.delete(genes[7::8], 4).any() and genes[39] == pytest.approx(0.96)
    assert (path / "minimal.png").read_bytes().startswith(b"\x89PNG")
    stored = read_minimal(path, read_archive(path))
    assert list(stored.genes) == elites and np.array_equal(stored.genes[elites[0]], genes)
    assert all(part in stored.describe(elites[0]) for part in ("1 of 8 parts", "0% (0 to 9%)", "rise", "13.5 cm"))


def test_stopped_it_goes_on_and_results_of_several_calls_add_up(path, elites):
    stopped, rest = Robots(bump_stops, stop_after=9), Robots(bump_stops)
    with pytest.raises(KeyboardInterrupt):
        minimised(path, elites[1:], stopped, how="exhaustive")
    minimised(path, elites[1:], rest, how="exhaustive")
    # 1 + 8 subsets of four rows, eight rows of fresh episodes, five scales of four rows
    assert len(stopped.seeds) + len(rest.seeds) == 9 * 4 + 8 + 5 * 4 and rest.seeds
    minimised(path, elites[1:], Robots(bump_stops, stop_after=0), how="exhaustive")  # nothing is left to be crossed
    minima = minimised(path, elites[:1])
    hows = [(entry["elite"], entry["how"]) for entry in minima.numbers["elites"]]
    assert hows == [(elites[0], "greedy"), (elites[1], "exhaustive")] and sorted(minima.genes) == elites
    again = minimised(path, elites[:1], how="exhaustive")
    assert [entry["how"] for entry in again.numbers["elites"]] == ["exhaustive"] * 2


def test_minimal_terrains_are_judged_like_elites(path, elites, capsys):
    numbers = minimised(path, elites, judged=True, certifiers=OTHER).numbers
    assert "; fault." in capsys.readouterr().out
    assert (numbers["confirmed"], numbers["certified"], numbers["faults"]) == (2, 2, 2)
    assert numbers["certifiers"] == ["C-G"]
    first = numbers["elites"][0]
    assert first["verdict"] == "fault" and first["resolved"]["goal_rate"] == 0.0
    (certificate,) = first["certificates"]
    assert certificate["controller"] == "C-G" and certificate["searched"]["goal_rate"] == 1.0
    assert certificate["policy_sha256"] == controller_hash(OTHER["C-G"])
    assert not read_archive(path).is_judged  # the elites' own counts are another thing


def test_elites_that_are_not_named_are_some_that_fail_and_without_scales_there_is_no_margin(path, monkeypatch):
    monkeypatch.setattr(f"{SPACE}.scaled", lambda self, genes, scale: None)
    minima = minimised(path, [])
    assert list(minima.genes) == np.flatnonzero(read_archive(path).failing)[:3].tolist()
    first = minima.numbers["elites"][0]
    assert (first["scale"], first["margin_m"], first["scales"]) == (None, None, [])


def test_what_cannot_be_minimised_is_refused_before_anything_is_crossed(path, made, elites, monkeypatch):
    nobody, fine = Robots(bump_stops, stop_after=0), np.flatnonzero(~read_archive(path).failing)[:1].tolist()
    with pytest.raises(ValueError, match=f"judge --run {made / 'found'} --robot anymal"):
        minimised(made / "found", elites, nobody)
    for number in (*fine, 999):
        with pytest.raises(ValueError, match=f"elite .*{number}"):
            minimised(path, [number], nobody)
    with pytest.raises(ValueError, match="certifier same"):
        minimised(path, elites, nobody, judged=True, certifiers={"same": str(get_robot("anymal").policy_file)})
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="how"):
        patch.setattr("qd.faults.minimise.MAX_PARTS", 7)
        minimised(path, elites, nobody, how="exhaustive")
    monkeypatch.setattr(f"{SPACE}.parts", lambda self, genes: ())
    with pytest.raises(ValueError, match="parts"):
        minimised(path, elites, nobody)
    assert not (path / "minimal.json").exists()


def test_terrains_of_elites_that_are_gone_and_damaged_files(path, elites):
    minimised(path, elites)
    archive = read_archive(path)
    gone = replace(archive, iteration=archive.iteration + (np.arange(len(archive)) == elites[0]))
    assert list(read_minimal(path, gone).genes) == elites[1:]
    (path / "minimal.npz").write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=str(path)):
        read_minimal(path, archive)
    (path / "minimal.json").unlink()
    assert read_minimal(path, archive) is None
