"""Minimal terrains by a rule of failing that is known: subsets, refutation, scales, and what is crossed for them."""

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.judge import Search
from qd.minimal import SCALE_STEPS, Case, Trial, find_minimal, take_apart
from qd.workers.cross import Crossings
from qd.workers.evaluator import Compute
from sim.robots.find import get_robot
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values, small_archive
from tests.qd.searches import CFG
from tests.qd.stand_in import Stub, make_result

PASSES, FAILS, INVALID = np.array([20, 0, 0, 0]), np.array([0, 20, 0, 0]), np.array([0, 9, 0, 11])
ROBOT = get_robot("anymal")


def case(how="exhaustive", parts=range(8), scalable=True):
    whole = tuple(parts)
    return Case(parts=whole, how=how, scalable=scalable, counts={Trial(tuple(sorted(whole)), fresh=True): 2 * FAILS})


def solve(case, rule, crossed=None):
    """The minimal terrain where ``rule(trial)`` says how many of 20 robots arrive; notes what is crossed, in steps."""
    steps = find_minimal(case)
    while True:
        try:
            wanted = next(steps)
        except StopIteration as end:
            return end.value
        (crossed if crossed is not None else []).append(wanted)
        for trial in wanted:
            assert trial not in case.counts
            case.counts[trial] = (2 if trial.fresh else 1) * np.array([rule(trial), 20 - rule(trial), 0, 0])


def two_and_five(trial):
    """Two parts are needed, at over .6 of their heights."""
    return 3 if {2, 5} <= set(trial.parts) and trial.scale > 0.6 else 18


@pytest.mark.parametrize("how", ["exhaustive", "greedy"])
def test_the_parts_that_are_needed_are_found_and_scaled(how):
    found = solve(case(how), two_and_five)
    assert found.parts == (2, 5)
    assert found.counts.tolist() == [6, 34, 0, 0]
    assert {part: counts.tolist() for part, counts in found.without.items()} == {2: [18, 2, 0, 0], 5: [18, 2, 0, 0]}
    # .5 passes, .75 fails, .625 fails, .5625 and .59375 pass
    assert (found.scale, found.passing_scale) == (0.625, 0.59375)
    assert sorted(found.scales) == [0.5, 0.5625, 0.59375, 0.625, 0.75] and len(found.scales) == SCALE_STEPS
    assert found.cause({2: 0.1, 5: 0.2}) == 5 and found.cause({2: 0.3, 5: 0.2}) == 2


def test_subsets_are_crossed_from_the_smallest_on_all_of_a_size_at_once():
    crossed = []
    assert solve(case(), two_and_five, crossed).subsets == 37
    # none, one of eight, two of eight; fresh episodes and scales one by one
    assert [len(wanted) for wanted in crossed] == [1, 8, 28, 1, 1, 1, 1, 1, 1]
    assert [{len(trial.parts) for trial in wanted} for wanted in crossed[:3]] == [{0}, {1}, {2}]
    assert crossed[3] == [Trial((2, 5), fresh=True)] and crossed[4] == [Trial((2, 5), scale=0.5)]


def test_greedy_crosses_each_part_once_and_what_is_left_once_more():
    crossed = []
    solve(case("greedy", parts=(7, 0, 5, 1, 2, 6, 3, 4)), two_and_five, crossed)
    subsets = [trial.parts for (trial,) in crossed if trial.scale == 1.0 and not trial.fresh]
    assert subsets[0] == tuple(range(7))  # without 7, which comes first
    # Eight, and 5 and 2 again without what was taken away after them.
    assert len(subsets) == len(set(subsets)) == 10
    assert set(subsets[-2:]) == {(2,), (5,)}


@pytest.mark.parametrize("seed", range(20))
def test_greedy_and_exhaustive_agree_where_parts_only_add(seed):
    """A terrain fails if it has all parts of one kernel: whatever greedy leaves is as small as can be."""
    rng = np.random.default_rng(seed)
    kernel = set(rng.choice(8, rng.integers(1, 5), replace=False).tolist())
    order = rng.permutation(8).tolist()
    rule = lambda trial: 0 if kernel <= set(trial.parts) and trial.scale > 0.3 else 20  # noqa: E731
    one, other = solve(case(), rule), solve(case("greedy", parts=order), rule)
    assert one.parts == other.parts == tuple(sorted(kernel))
    assert (one.scale, one.passing_scale) == (other.scale, other.passing_scale)


@pytest.mark.parametrize("how", ["exhaustive", "greedy"])
def test_what_greedy_leaves_has_no_part_to_spare_where_parts_hide_each_other(how):
    """Part 0 alone fails unless part 1 is there; parts 1 to 3 together fail."""

    def rule(trial):
        parts = set(trial.parts)
        return 0 if (0 in parts and 1 not in parts) or {1, 2, 3} <= parts else 20

    found = solve(case(how, parts=range(4)), rule)
    assert found.parts == ((0,) if how == "exhaustive" else (1, 2, 3))
    assert all(counts.tolist() == PASSES.tolist() for counts in found.without.values())


@pytest.mark.parametrize("how", ["exhaustive", "greedy"])
def test_fresh_episodes_refute(how):
    """Part 3 alone looks failing in its 20 episodes and is not in its 40; 3 and 4 together fail."""

    def rule(trial):
        if trial.parts == (3,):
            return 12 if trial.fresh else 8
        return 2 if {3, 4} <= set(trial.parts) else 20

    crossed = []
    found = solve(case(how, scalable=False), rule, crossed)
    assert found.parts == (3, 4)
    assert [Trial((3,), fresh=True)] in crossed
    assert found.without[4].tolist() == [24, 16, 0, 0]  # the fresh ones, which are not selected
    assert found.without[3].tolist() == [20, 0, 0, 0]
    assert found.cause({3: 0.1, 4: 0.1}) == 3
    assert (found.scale, found.scales) == (None, {})


def test_of_equally_many_parts_the_lowest_goal_rate_is_taken_and_if_refuted_the_next():
    rates = {(1,): 6, (2,): 4, (3,): 9}

    def rule(trial, refuted=()):
        return 20 if trial.fresh and trial.parts in refuted else rates.get(trial.parts, 20)

    assert solve(case(scalable=False), rule).parts == (2,)
    assert solve(case(scalable=False), lambda trial: rule(trial, [(2,)])).parts == (1,)
    assert solve(case(scalable=False), lambda trial: rule(trial, [(1,), (2,), (3,)])).parts == tuple(range(8))


def test_the_whole_terrain_is_the_last_and_a_terrain_without_parts_the_first():
    for how in ("exhaustive", "greedy"):
        every = solve(
            case(how, parts=range(3)), lambda trial: 0 if len(trial.parts) == 3 and trial.scale == 1.0 else 20
        )
        assert every.parts == (0, 1, 2) and every.counts.tolist() == (2 * FAILS).tolist()
        assert (every.scale, every.passing_scale) == (1.0, 0.96875)
        flat = solve(case(how, parts=range(3)), lambda trial: 0)
        assert (flat.parts, flat.without, flat.scale, flat.cause({})) == ((), {}, None, None)
    always = solve(case(parts=range(3)), lambda trial: 20 if not trial.parts else 0)
    assert (always.parts, always.scale, always.passing_scale) == ((0,), 1 / 32, None)


def test_too_many_invalid_episodes_say_nothing():
    known = case(parts=range(2), scalable=False)
    known.counts.update({Trial(()): PASSES, Trial((0,)): INVALID, Trial((1,)): PASSES})
    minimal = solve(known, lambda trial: 20)
    assert minimal.parts == (0, 1)
    assert minimal.cause({0: 0.1, 1: 0.3}) == 0  # without 1 nothing is known


def test_where_flat_parts_alone_are_left_nothing_is_scaled():
    crossed = []
    slippery = replace(case(parts=range(3)), flat=(1,))
    minimal = solve(slippery, lambda trial: 0 if 1 in trial.parts else 20, crossed)
    assert (minimal.parts, minimal.scale, minimal.scales) == ((1,), None, {})
    assert {trial.scale for wanted in crossed for trial in wanted} == {1.0}


@pytest.fixture
def failing():
    """Three elites that fail."""
    archive = small_archive(3)
    return replace(archive, fresh=replace(fresh_values(archive), goal_rate=np.full(3, 0.1)))


class Robots:
    """Fail where bumps 2 and 5 are there, higher than .6 of what the elite has; note seeds and genes; then Ctrl-C."""

    def __init__(self, archive, stop_after=None):
        self.archive, self.stop_after, self.rows, self.opened = archive, stop_after, [], []

    @contextmanager
    def __call__(self, cfg):
        self.opened.append(cfg)

        def evaluate(genes, seeds, progress=None):
            if self.stop_after is not None and len(self.rows) >= self.stop_after:
                raise KeyboardInterrupt
            self.rows += zip(seeds.tolist(), map(tuple, genes.tolist()), strict=True)
            full = self.archive.genes
            whose = [min(range(len(full)), key=lambda number: np.abs(full[number] - row).sum()) for row in genes]
            needed = (np.abs(genes[:, 7::8]) > 0.6 * np.abs(full[whose][:, 7::8]))[:, [2, 5]].all(axis=1)
            fails = np.repeat(needed[:, None], cfg.num_replicas, axis=1)
            return make_result(np.ones((*fails.shape, 6)), base_collision=fails)

        yield Stub(evaluate)


def apart(archive, cases, robots, cache=None):
    search = Search(
        run=Path("run"), cfg=CFG, robot=ROBOT, policy=str(ROBOT.policy_file), space="super_gaussian"
    )  # fmt: skip
    with Crossings(ROBOT, Compute(workers="1"), cache=cache, open_evaluator=robots) as crossings:
        return take_apart(archive, cases, SUPER_GAUSSIAN, search, crossings)


@pytest.mark.parametrize("how", ["exhaustive", "greedy"])
def test_elites_are_taken_apart_together(failing, how):
    cases, robots = {number: case(how) for number in (2, 0)}, Robots(failing)
    minima = apart(failing, cases, robots)
    assert len(robots.opened) == 1 and robots.opened[0].num_replicas == 5
    assert {number: minimal.parts for number, minimal in minima.items()} == {0: (2, 5), 2: (2, 5)}
    assert all(minimal.scale == 0.625 for minimal in minima.values())
    # An elite's 20 episodes are of four seeds, its 40 fresh ones of eight others.
    assert len({seed for seed, _ in robots.rows}) == 2 * (4 + 8)
    assert sum(counts.sum() for one in cases.values() for counts in one.counts.values()) - 80 == 5 * len(robots.rows)


def test_an_elite_has_its_own_episodes_whatever_is_crossed_beside_it(failing):
    together, alone = Robots(failing), Robots(failing)
    both = apart(failing, {0: case("greedy"), 2: case("greedy")}, together)
    one = apart(failing, {2: case("greedy")}, alone)
    assert set(alone.rows) < set(together.rows)
    assert both[2].counts.tolist() == one[2].counts.tolist() and both[2].parts == one[2].parts


def test_stopped_it_goes_on_with_what_was_crossed(failing, tmp_path):
    stopped, rest, every = Robots(failing, stop_after=20), Robots(failing), Robots(failing)
    with pytest.raises(KeyboardInterrupt):
        apart(failing, {0: case("greedy")}, stopped, tmp_path / "crossings")
    minima = apart(failing, {0: case("greedy")}, rest, tmp_path / "crossings")
    whole = apart(failing, {0: case("greedy")}, every)
    assert sorted(stopped.rows + rest.rows) == sorted(every.rows) and 0 < len(rest.rows) < len(every.rows)
    assert minima[0].parts == whole[0].parts
