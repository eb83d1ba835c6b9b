"""Tiles of the curriculum; mixes: shares, exchanges, what is remembered of elites, going on from a checkpoint."""

import numpy as np
import pytest

from sim.terrains.bank import make_terrains
from sim.terrains.hand_crafted import CROSSING_TYPES, NUM_COLS, NUM_LEVELS, NUM_ROWS, training_tiles
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from train.cfg import CurriculumCfg, FinetuneCfg, RecipeCfg
from train.task.tiles import Mix, TrainingElites, make_tiles

ELITES = SUPER_GAUSSIAN.hard_random(7, 0)


def make_mix(*, kind="generated", terrains=6, elites=ELITES, seed=0, draw="uniform", **changes) -> Mix:
    given = {"genes": (elites if kind == "generated" else ELITES[:0],), "spaces": (SUPER_GAUSSIAN,), **changes}
    cfg = FinetuneCfg(mix=kind, terrains=terrains, seed=seed, recipe=RecipeCfg(draw=draw))
    return Mix(cfg=cfg, elites=TrainingElites(**given), device="cpu")


def counts(goals, episodes, invalid=None):
    """What became of the episodes of 12 robots on 6 terrains, two on each."""
    return {
        "goal": np.repeat(np.float32(goals), 2),
        "episodes": np.repeat(np.float32(episodes), 2),
        "invalid": np.repeat(np.float32([0] * 6 if invalid is None else invalid), 2),
    }


def test_half_is_hand_crafted_and_half_are_elites():
    mix = make_mix()
    tiles = mix.next()
    assert (tiles.num_levels, tiles.num_columns, tiles.ground) == (1, 6, None)
    assert tiles.type_of_column == (*CROSSING_TYPES[:3], *["generated"] * 3)
    np.testing.assert_array_equal(tiles.heights[3:], make_terrains(ELITES[mix.rows], SUPER_GAUSSIAN)[0])
    assert len(set(mix.rows)) == 3
    # Robots begin a crossing at x = 2 on flat ground before the feature.
    assert (tiles.heights[:3, :, :80] == 0.0).all() and np.abs(tiles.heights[:3, :, 100:220]).max() > 0.0


def test_the_other_mixes():
    assert make_mix(kind="hand-crafted").next().type_of_column == CROSSING_TYPES
    mix = make_mix(kind="hard-random", terrains=5, genes=(), spaces=(COURSE,))
    first, second = mix.next(), mix.next()
    assert first.type_of_column == (*CROSSING_TYPES[:2], *["hard-random"] * 3)
    assert not first.heights[2:, :, :81].any() and np.abs(first.heights[2:]).max() > 0.1  # flat up to x = 4 m
    assert not any(np.array_equal(before, after) for before in first.heights[2:] for after in second.heights[2:])


def test_hand_crafted_terrains_are_as_low_as_the_space():
    spaces = map(get_space, ("super_gaussian@0.05", "super_gaussian"))
    low, usual = (make_mix(kind="hand-crafted", spaces=(space,)).next().heights for space in spaces)
    np.testing.assert_allclose(low, usual / 5, rtol=1e-5)


def test_exchanges_differ_and_follow_from_the_seed():
    mix, same, other = make_mix(), make_mix(), make_mix(seed=1)
    first = mix.next().heights
    np.testing.assert_array_equal(first, same.next().heights)
    assert not np.array_equal(first, other.next().heights)
    second = mix.next().heights
    assert not np.array_equal(first[:3], second[:3])
    np.testing.assert_array_equal(second, same.next().heights)


def test_few_elites_come_more_than_once_but_none_is_left_out():
    # 20 terrains of 7 elites: each twice, and 6 of them a third time.
    mix = make_mix(terrains=40)
    mix.next()
    assert sorted(np.bincount(mix.rows, minlength=7)) == [2, 3, 3, 3, 3, 3, 3]


def test_what_is_remembered_of_an_elite_is_its_last_exchange():
    mix = make_mix()
    mix.next()
    first = mix.rows.copy()
    mix.next(counts([9, 9, 9, 4, 0, 2], [9, 9, 9, 4, 9, 4], invalid=[0, 0, 0, 0, 4, 0]))
    np.testing.assert_array_equal(mix.episodes[first], [8, 10, 8])  # of both robots, but for the invalid ones
    np.testing.assert_array_equal(mix.crossed[first], [8, 0, 4])
    np.testing.assert_allclose(mix.success()[first], [1.0, 0.0, 0.5])
    assert mix.episodes.sum() == 26
    second = mix.rows.copy()
    mix.next(counts([0, 0, 0, 1, 1, 1], [0, 0, 0, 1, 0, 1]))  # no episode ended on the second of them
    assert mix.episodes[second[0]] == 2 and mix.crossed[second[0]] == 2
    assert mix.episodes[second[1]] == dict(zip(first, [8, 10, 8], strict=True)).get(second[1], 0)  # as before


def test_a_resume_between_exchanges_counts_what_was_before_it_too():
    rate = np.linspace(0.0, 1.0, 7)
    straight, cut = (make_mix(draw="learnable", goal_rate=rate.copy()) for _ in range(2))
    straight.next(), cut.next()
    again = make_mix(draw="learnable", goal_rate=np.zeros(7))  # what the archive says by now is another thing
    tiles = again.restore(cut.state(counts([0, 0, 0, 3, 2, 1], [4] * 6)))
    np.testing.assert_array_equal(tiles.heights, cut.terrains().heights)
    exchanged = again.next(counts([0, 0, 0, 1, 0, 0], [1] * 6))
    np.testing.assert_array_equal(exchanged.heights, straight.next(counts([0, 0, 0, 4, 2, 1], [5] * 6)).heights)
    assert again.episodes.max() == 10 and again.crossed.max() == 8
    later = counts([1] * 6, [2] * 6)
    assert again.state(later) == straight.state(later)  # and nothing of it is left for the next


@pytest.mark.parametrize(
    ("draw", "crossed", "likely", "share"),
    [
        # Two of seven without replacement, weights .1 (five of them) and 1.1 (two): a likely one comes first with
        # 1.1/2.7, second with 5 * .1/2.7 * 1.1/2.6 after another kind and 1.1/2.7 * 1.1/1.6 after its like: .77.
        ("failing", [10, 10, 10, 10, 10, 0, 0], [5, 6], 0.77),
        ("learnable", [0, 0, 0, 0, 0, 5, 5], [5, 6], 0.77),
        # One has 1.1 and six .1: it comes first with 1.1/1.7, second with .6/1.7 * 1.1/1.6: .89 in all.
        ("learnable", [0, 0, 5, 0, 0, 10, 10], [2], 0.89),
    ],
)
def test_elites_are_drawn_by_how_often_they_were_crossed(draw, crossed, likely, share):
    drawn = np.zeros(7)
    for seed in range(300):
        mix = make_mix(draw=draw, terrains=4, seed=seed)
        mix.swap = 0
        mix.episodes[:], mix.crossed[:] = 10, crossed
        drawn[mix.draw_rows()] += 1
    assert drawn[likely].mean() / 300 == pytest.approx(share, abs=0.06)
    others = np.delete(drawn, likely)
    assert others.mean() / 300 == pytest.approx((2 - share * len(likely)) / len(others), abs=0.05)


def test_parts_are_drawn_in_equal_shares_however_learnable_they_are():
    genes, rate = SUPER_GAUSSIAN.hard_random(60, 0), np.repeat([0.0, 0.5], [40, 20])
    parts = {"genes": (genes[:40], genes[40:]), "spaces": (SUPER_GAUSSIAN,) * 2}
    mix = make_mix(terrains=12, draw="learnable", goal_rate=rate, **parts)
    rows = [mix.draw_rows() for mix.swap in range(300)]
    assert 0.45 < (np.concatenate(rows) < 40).mean() < 0.58  # a quarter and less by how learnable they are


def test_elites_of_several_spaces_are_drawn_together_each_with_its_own_ground():
    numbers = {"super_gaussian+friction": 3, "course": 4, "course+softness": 2}
    spaces = (*map(get_space, numbers), SUPER_GAUSSIAN)
    genes = [space.hard_random(count, 1) for space, count in zip(spaces, numbers.values(), strict=False)]
    genes.append(ELITES[:0])  # an archive of which all is held out
    mix = make_mix(terrains=18, genes=tuple(genes), spaces=spaces)
    tiles = mix.next()
    assert mix.num_elites == 9 and sorted(mix.rows) == list(range(9)) and tiles.ground is not None
    whole = [make_terrains(part, space) for part, space in zip(genes[:3], spaces, strict=False)]
    np.testing.assert_array_equal(tiles.heights[9:], np.concatenate([heights for heights, _ in whole])[mix.rows])
    assert (tiles.ground.friction[:9] == 1.0).all()  # hand-crafted ones
    slips, sinks = (tiles.ground.friction[9:] < 1).any((1, 2)), (tiles.ground.time_constant_s[9:] > 0).any((1, 2))
    np.testing.assert_array_equal(slips, mix.rows < 3)
    np.testing.assert_array_equal(sinks, mix.rows >= 7)
    np.testing.assert_array_equal(tiles.ground.friction[9:][slips], whole[0][1].friction[mix.rows[slips]])


def test_elites_that_fail_under_conditions_are_trained_on_under_them():
    spaces = get_space("super_gaussian+payload+push"), COURSE
    genes = spaces[0].hard_random(3, 1), COURSE.hard_random(2, 1)
    tiles = make_mix(terrains=10, genes=genes, spaces=spaces).next()
    expected = np.concatenate([spaces[0].condition_rows(genes[0]), COURSE.condition_rows(genes[1])])
    mix = make_mix(terrains=10, genes=genes, spaces=spaces)
    mix.next()
    np.testing.assert_array_equal(tiles.ground.rows[5:], expected[mix.rows])
    np.testing.assert_array_equal(
        tiles.ground.rows[:5], COURSE.condition_rows(np.zeros((5, 36)))
    )  # hand-crafted: nominal


@pytest.fixture(scope="module")
def tiles():
    return make_tiles(CurriculumCfg(num_columns=5, noise_columns=2), seed=3)


def test_grid_order(tiles):
    assert tiles.heights.shape == (NUM_LEVELS * 7, NUM_ROWS, NUM_COLS)
    assert (tiles.num_levels, tiles.num_columns) == (NUM_LEVELS, 7)
    assert tiles.type_of_column[-2:] == ("noise", "noise")
    without_noise = tiles.heights.reshape(NUM_LEVELS, 7, NUM_ROWS, NUM_COLS)[:, :5].reshape(-1, NUM_ROWS, NUM_COLS)
    rng = np.random.default_rng(3).spawn(2)[0]
    np.testing.assert_array_equal(without_noise, training_tiles(5, rng)[0])


def test_noise_grows_with_the_level(tiles):
    for level in range(NUM_LEVELS):
        tile = tiles.heights[level * 7 + 6]
        bound = 0.02 + 0.08 * level / 10
        assert 0.9 * bound < np.abs(tile).max() <= bound
    assert (tiles.heights[5] != tiles.heights[6]).any()


def test_every_column_gets_its_share(tiles):
    counts = np.bincount(tiles.assign_columns(700))
    assert counts.tolist() == [100] * 7
    assert set(np.bincount(tiles.assign_columns(703))) == {100, 101}
    assert tiles.assign_columns(3).max() < 7


def test_columns_of_noise_alone_and_none_at_all():
    assert make_tiles(CurriculumCfg(num_columns=0, noise_columns=1), seed=0).type_of_column == ("noise",)
    with pytest.raises(ValueError, match="num_columns"):
        make_tiles(CurriculumCfg(num_columns=0, noise_columns=0), seed=0)
