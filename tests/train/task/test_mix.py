"""Terrains of a fine-tuning: shares, exchanges, what is remembered of elites, and going on from a checkpoint."""

import numpy as np
import pytest

from sim.bank import TerrainBank, terrains_of
from sim.spaces.course import COURSE
from sim.spaces.registry import get_space
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import CROSSING_TYPES, TILE_TYPES
from train.task.mix import Mix

ELITES = SUPER_GAUSSIAN.hard_random(7, 0)


def make_mix(*, kind="generated", terrains=6, elites=ELITES, crosses=True, seed=0, **changes) -> Mix:
    genes = elites if kind == "generated" else np.zeros((0, 64), np.float32)
    return Mix(
        kind=kind, num_terrains=terrains, crosses=crosses, seed=seed, device="cpu", **{"genes": (genes,), **changes}
    )


def heights_of(genes):
    bank = TerrainBank(len(genes), device="cpu")
    bank.set_genes(genes)
    return bank.heights.numpy()


def counts(goals, episodes, time_outs=None, invalid=None):
    """What became of the episodes of 12 robots on 6 terrains, two on each."""
    return {
        "goal": np.repeat(np.float32(goals), 2),
        "time_out": np.repeat(np.float32(goals if time_outs is None else time_outs), 2),
        "episodes": np.repeat(np.float32(episodes), 2),
        "invalid": np.repeat(np.float32([0] * 6 if invalid is None else invalid), 2),
    }


def test_hard_random_terrains_are_of_the_space():
    mix = make_mix(kind="hard-random", genes=(), spaces=(COURSE,))
    own = mix.next().heights[3:]
    assert not own[:, :, :81].any() and np.abs(own).max() > 0.1  # flat up to x = 4 m
    assert (np.ptp(own[:, :, 240:], axis=(1, 2)) == 0).all()


def test_half_is_hand_crafted_and_half_are_elites():
    mix = make_mix()
    tiles = mix.next()
    assert (tiles.num_levels, tiles.num_columns) == (1, 6)
    assert tiles.type_of_column == (*CROSSING_TYPES[:3], *["generated"] * 3)
    np.testing.assert_array_equal(tiles.heights[3:], heights_of(ELITES[mix.rows]))
    assert len(set(mix.rows)) == 3
    # Robots begin a crossing at x = 2 on flat ground before the feature.
    assert (tiles.heights[:3, :, :80] == 0.0).all() and np.abs(tiles.heights[:3, :, 100:220]).max() > 0.0


def test_the_other_mixes():
    tiles = make_mix(kind="hand-crafted").next()
    assert tiles.type_of_column == CROSSING_TYPES
    mix = make_mix(kind="hard-random", terrains=5)
    first, second = mix.next(), mix.next()
    assert first.type_of_column == (*CROSSING_TYPES[:2], *["hard-random"] * 3)
    assert not any(np.array_equal(one, other) for one in first.heights[2:] for other in second.heights[2:])


def test_robots_told_velocities_get_tiles_of_the_training():
    tiles = make_mix(kind="hand-crafted", crosses=False, terrains=40).next()
    assert set(tiles.type_of_column) <= set(TILE_TYPES) and len(set(tiles.type_of_column)) > 2


def test_exchanges_differ_and_follow_from_the_seed():
    one, same, other = make_mix(), make_mix(), make_mix(seed=1)
    first, again, foreign = one.next(), same.next(), other.next()
    np.testing.assert_array_equal(first.heights, again.heights)
    assert not np.array_equal(first.heights, foreign.heights)
    second = one.next()
    assert not np.array_equal(first.heights[:3], second.heights[:3])
    np.testing.assert_array_equal(second.heights, same.next().heights)


def test_few_elites_come_more_than_once_but_none_is_left_out():
    mix = make_mix(terrains=40, elites=ELITES)
    mix.next()
    # 20 terrains of 7 elites: each twice, and 6 of them a third time.
    assert sorted(np.bincount(mix.rows, minlength=7)) == [2, 3, 3, 3, 3, 3, 3]


def test_what_is_remembered_of_an_elite_is_its_last_exchange():
    mix = make_mix(terrains=6)
    mix.next()
    first = mix.rows.copy()
    mix.next(counts([9, 9, 9, 4, 0, 2], [9, 9, 9, 4, 5, 4]))
    np.testing.assert_array_equal(mix.episodes[first], [8, 10, 8])  # of both robots
    np.testing.assert_array_equal(mix.crossed[first], [8, 0, 4])
    np.testing.assert_allclose(mix.success()[first], [1.0, 0.0, 0.5])
    assert mix.episodes.sum() == 26
    second = mix.rows.copy()
    mix.next(counts([0, 0, 0, 1, 1, 1], [0, 0, 0, 1, 0, 1]))  # no episode ended on the second of them
    assert mix.episodes[second[0]] == 2 and mix.crossed[second[0]] == 2
    assert mix.episodes[second[1]] == dict(zip(first, [8, 10, 8], strict=True)).get(second[1], 0)  # as before


def test_invalid_episodes_say_nothing_of_an_elite():
    mix = make_mix()
    mix.next()
    first = mix.rows.copy()
    mix.next(counts([0, 0, 0, 1, 0, 2], [4] * 6, invalid=[0, 0, 0, 3, 4, 0]))
    np.testing.assert_array_equal(mix.episodes[first], [2, 0, 8])
    np.testing.assert_allclose(mix.success()[first], [1.0, 0.0, 0.5])


def test_a_resume_between_exchanges_counts_what_was_before_it_too():
    straight, cut, again = make_mix(), make_mix(), make_mix()
    straight.next(), cut.next()
    again.restore(cut.state(counts([0, 0, 0, 3, 2, 1], [4] * 6)))
    again.next(counts([0, 0, 0, 1, 0, 0], [1] * 6))
    straight.next(counts([0, 0, 0, 4, 2, 1], [5] * 6))
    np.testing.assert_array_equal(again.episodes, straight.episodes)
    np.testing.assert_array_equal(again.crossed, straight.crossed)
    assert again.episodes.max() == 10 and again.crossed.max() == 8
    later = counts([1] * 6, [2] * 6)
    assert again.state(later) == straight.state(later)  # and nothing of it is left for the next


def test_without_a_goal_it_is_the_end_of_the_time_that_counts():
    mix = make_mix(crosses=False)
    mix.next()
    first = mix.rows.copy()
    mix.next(counts([0] * 6, [4] * 6, time_outs=[4] * 6))
    assert (mix.success()[first] == 1.0).all()


@pytest.mark.slow
def test_failing_elites_are_drawn_more_often():
    drawn = np.zeros(7)
    for seed in range(300):
        mix = make_mix(draw="failing", terrains=4, seed=seed)
        mix.next()
        mix.episodes[:], mix.crossed[:] = 10, [10, 10, 10, 10, 10, 0, 0]
        mix.rows = np.zeros(0, np.int64)
        drawn[mix._draw_rows()] += 1
    # Two of seven without replacement, weights .1 (five of them) and 1.1 (two): a failing one comes first with
    # 1.1/2.7, second with 5 * .1/2.7 * 1.1/2.6 after another kind and 1.1/2.7 * 1.1/1.6 after its like: .77 in all.
    assert drawn[5:].mean() / 300 == pytest.approx(0.77, abs=0.06)
    assert drawn[:5].mean() / 300 == pytest.approx((2 - 2 * 0.77) / 5, abs=0.05)


def test_learnable_elites_are_drawn_more_often_and_harder_ones_later():
    drawn = np.zeros((2, 7))
    for seed in range(300):
        mix = make_mix(draw="learnable", terrains=4, seed=seed)
        mix.goal_rate = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.5])
        mix.swap = 0
        drawn[0, mix._draw_rows()] += 1
        # trained on, the last two are always crossed and the third in half of the episodes
        mix.episodes[:], mix.crossed[:] = [0, 0, 10, 0, 0, 10, 10], [0, 0, 5, 0, 0, 10, 10]
        drawn[1, mix._draw_rows()] += 1
    # The weights of the test above: .1 and 4 * .5 * .5 + .1. Then one of seven has 1.1: it comes first with 1.1/1.7,
    # second with .6/1.7 * 1.1/1.6: .89 in all.
    assert drawn[0, 5:].mean() / 300 == pytest.approx(0.77, abs=0.06)
    assert drawn[1, 2] / 300 == pytest.approx(0.89, abs=0.06)
    assert drawn[1, [0, 1, 3, 4, 5, 6]].mean() / 300 == pytest.approx((2 - 0.89) / 6, abs=0.05)


def test_it_goes_on_from_its_state():
    straight, cut = make_mix(draw="failing"), make_mix(draw="failing")
    known = counts([1, 2, 3, 3, 0, 1], [4] * 6)
    straight.next(), cut.next()
    again = make_mix(draw="failing")
    tiles = again.restore(cut.state(known))
    np.testing.assert_array_equal(tiles.heights, cut.terrains().heights)
    np.testing.assert_array_equal(again.next(counts([0] * 6, [0] * 6)).heights, straight.next(known).heights)
    assert again.state(counts([0] * 6, [0] * 6)) == straight.state(counts([0] * 6, [0] * 6))


@pytest.mark.parametrize(
    "damage", [{"swap": "1"}, {"swap": -1}, {"rows": [0, 1]}, {"rows": [0, 1, 7]}, {"episodes": [1]}, {"crossed": None}]
)
def test_a_state_of_something_else_is_refused(damage):
    mix = make_mix()
    mix.next()
    state = {**mix.state(counts([0] * 6, [0] * 6)), **damage}
    with pytest.raises(ValueError, match="the terrains of the checkpoint"):
        make_mix().restore({key: value for key, value in state.items() if value is not None})


def test_it_needs_elites():
    with pytest.raises(ValueError, match="elites"):
        make_mix(elites=ELITES[:0])


def test_elites_bring_their_ground():
    space = get_space("super_gaussian+friction")
    genes = space.hard_random(4, 1)
    mix = make_mix(terrains=4, genes=(genes,), spaces=(space,))
    tiles = mix.next()
    assert tiles.ground is not None and (tiles.ground.friction[:2] == 1.0).all()
    np.testing.assert_array_equal(tiles.ground.friction[2:].reshape(2, 32) == 1.0, genes[mix.rows, 64:] == 1.0)
    assert make_mix().next().ground is None


def test_elites_of_several_spaces_are_drawn_together_each_with_its_own_ground():
    parts = {"super_gaussian+friction": 3, "course": 4, "course+softness": 2}
    spaces = tuple(map(get_space, parts))
    genes = tuple(space.hard_random(count, 1) for space, count in zip(spaces, parts.values(), strict=True))
    mix = make_mix(terrains=18, genes=genes, spaces=spaces)
    tiles = mix.next()
    assert mix.num_elites == 9 and sorted(mix.rows) == list(range(9)) and tiles.ground is not None
    whole = [terrains_of(part, space) for part, space in zip(genes, spaces, strict=True)]
    of_course = np.concatenate([heights for heights, _ in whole])[mix.rows]
    np.testing.assert_array_equal(tiles.heights[9:], of_course)
    slips, sinks = (tiles.ground.friction[9:] < 1).any((1, 2)), (tiles.ground.time_constant_s[9:] > 0).any((1, 2))
    np.testing.assert_array_equal(slips, mix.rows < 3)
    np.testing.assert_array_equal(sinks, mix.rows >= 7)
    np.testing.assert_array_equal(tiles.ground.friction[9:][slips], whole[0][1].friction[mix.rows[slips]])
    nothing = dict.fromkeys(("goal", "episodes", "invalid"), np.zeros(18, np.float32))
    rested = mix.restore(mix.state(nothing))
    np.testing.assert_array_equal(rested.heights, tiles.heights)
    assert rested.ground is not None


def test_parts_are_drawn_in_equal_shares_however_learnable_they_are():
    genes = SUPER_GAUSSIAN.hard_random(60, 0)
    rate = np.repeat([0.0, 0.5], [40, 20])
    mix = make_mix(
        terrains=12, draw="learnable", genes=(genes[:40], genes[40:]), spaces=(SUPER_GAUSSIAN,) * 2, goal_rate=rate
    )
    rows = []
    for mix.swap in range(300):
        rows.append(mix._draw_rows())
    assert 0.45 < (np.concatenate(rows) < 40).mean() < 0.58  # a quarter and less by how learnable they are


def test_goal_rates_of_the_archive_stay_those_that_a_training_began_with():
    def begun(rate):
        mix = make_mix(draw="learnable", terrains=4)
        mix.goal_rate = np.full(7, 0.0)
        mix.goal_rate[rate] = 0.5
        return mix

    there, here = begun(2), begun(5)
    there.next()
    here.restore(there.state(counts([0] * 6, [0] * 6)))
    assert here.goal_rate.tolist() == there.goal_rate.tolist()


def test_a_part_that_is_not_drawn_still_leaves_maps_of_the_ground():
    spaces = (SUPER_GAUSSIAN, get_space("course+friction"))
    mix = make_mix(terrains=4, genes=(ELITES, np.zeros((0, 68), np.float32)), spaces=spaces)
    ground = mix.next().ground
    assert ground is not None and (ground.friction == 1.0).all()
