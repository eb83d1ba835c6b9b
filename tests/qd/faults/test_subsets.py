"""Minimal terrains by a rule of failing that is known: subsets, refutation, scales, and what is crossed for them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.faults.causes import find_effects
from qd.faults.searches import Search
from qd.faults.stages import Judging
from qd.faults.subsets import Case, Trial, find_minimal, open_case, take_apart
from qd.workers.crosser import Crosser
from sim.robots.find import get_robot
from sim.terrains.conditions.kinds import condition_column
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values, small_archive
from tests.qd.robots import Robots
from tests.qd.searches import CFG
from tests.qd.stand_in import compute_by

PASSES, FAILS, INVALID = np.array([20, 0, 0, 0]), np.array([0, 20, 0, 0]), np.array([0, 9, 0, 11])
ROBOT = get_robot("anymal")
BOTH = pytest.mark.parametrize("how", ["exhaustive", "greedy"])


def case(how="exhaustive", parts=range(8), scalable=True):
    counts = {Trial(tuple(sorted(parts)), fresh=True): 2 * FAILS}
    return Case(parts=tuple(parts), how=how, scalable=scalable, counts=counts)


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
    assert (case.parts, case.how, case.scalable, case.flat) == ((1, 6, 4), how, True, ())
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
