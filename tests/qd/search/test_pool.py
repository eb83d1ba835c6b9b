import numpy as np
import pytest

from qd.search.descriptors import Cells
from qd.search.fitness import Evaluation, FitnessCfg, evaluate_rollout, join_evaluations
from qd.search.pool import DEPTH, Pool, chance_to_stay, expected_score
from tests.qd.stand_in import make_result

CELLS = Cells(3)
CFG = FitnessCfg(penalties=("yaw_rate", "vel_x", "vel_y"), scales=(1.0, 1.0, 1.0))
SOLUTION = np.zeros((1, 2), np.float32)


def crossed(ratios, *, episodes=3, total=8.0, collides=0, cells=CELLS) -> Evaluation:
    """A terrain whose episodes are all alike: their penalties sum to ``total`` in these ratios."""
    penalties = np.broadcast_to(np.asarray(ratios) * total, (1, episodes, 3))
    result = make_result(penalties, base_collision=[np.arange(episodes) < collides], names=CFG.penalties)
    return evaluate_rollout(result, cells, CFG)


def tell(pool: Pool, evaluation: Evaluation, number: int = -1, iteration: int = 1, solution=SOLUTION) -> Evaluation:
    return pool.tell(solution, np.array([number]), evaluation, iteration)


def holders(pool: Pool) -> dict[int, int]:
    """The numbers of the terrains that hold a cell, by their cells."""
    rows = pool.settle(np.zeros(0, np.int64))
    return dict(zip(pool.terrains.cell[rows].tolist(), pool.number[rows].tolist(), strict=True))


def find_cell(*ratios: float) -> int:
    return int(CELLS.find_cells([ratios])[0])


@pytest.mark.parametrize(
    ("ratios", "episodes"),
    [((0.25, 0.35, 0.4), 3), ((0.26, 0.34, 0.4), 40), ((0.02, 0.04, 0.94), 10), ((0.21, 0.39, 0.4), 10)],
)
def test_the_chance_to_stay_is_that_of_normal_ratios(ratios, episodes):
    """By drawing true ratios about what episodes show, and the mean of 40 fresh ones about these."""
    terrain = crossed(ratios, episodes=episodes)
    r = np.array(ratios)
    spread = 0.22 * np.sqrt(r * (1 - r) + 1e-3)
    draws = r + spread * np.random.default_rng(0).normal(size=(200_000, 3)) * np.sqrt(1 / episodes + 1 / 40)
    low = CELLS.tuples[terrain.cell[0]] / 10
    stays = ((draws >= np.where(low > 0, low, -1)) & (draws < np.where(low < 0.85, low + 0.1, 2))).all(axis=1)
    assert chance_to_stay(terrain, CELLS)[0] == pytest.approx(stays.mean(), abs=0.005)


@pytest.mark.parametrize(("collides", "certain"), [(0, False), (1, False), (3, True)])
def test_a_collision_bit_must_stay_too(collides, certain):
    cells = Cells(3, collision_bit=True)
    ratios = (0.25, 0.35, 0.4)
    chance = chance_to_stay(crossed(ratios, collides=collides, cells=cells), cells)[0]
    without_bit = chance_to_stay(crossed(ratios), CELLS)[0]
    # Without a collision in 3 episodes, none in 20 more; with one, any.
    expected = {0: (1 - 0.5 / 4) ** 20, 1: 1 - (1 - 1.5 / 4) ** 20, 3: 1 - (1 - 3.5 / 4) ** 20}[collides]
    assert chance == pytest.approx(expected * without_bit)
    assert (expected > 0.9999) == (certain or collides == 1)


def test_a_fit_terrain_of_few_episodes_adds_less_than_one_that_is_known():
    few, many = crossed((0.25, 0.35, 0.4), total=9.0), crossed((0.25, 0.35, 0.4), episodes=40)
    assert few.fitness > many.fitness
    assert expected_score(few, CELLS, CFG) < expected_score(many, CELLS, CFG)


def test_a_terrain_moves_to_the_cell_of_all_of_its_episodes_and_the_next_best_holds_the_one_it_leaves():
    pool = Pool(2, CELLS, CFG)
    tell(pool, crossed((0.25, 0.35, 0.4)))
    tell(pool, crossed((0.22, 0.38, 0.4)), iteration=2)  # nearer to the edge
    first, elsewhere = find_cell(0.25, 0.35, 0.4), find_cell(0.45, 0.15, 0.4)
    assert holders(pool) == {first: 0}
    known = tell(pool, crossed((0.55, 0.05, 0.4), episodes=6), number=0, iteration=3)
    assert known.ratios[0] == pytest.approx([0.45, 0.15, 0.4])
    assert known.episodes.tolist() == [9]
    assert holders(pool) == {elsewhere: 0, first: 1}
    assert pool.iteration.tolist() == [1, 2]


def test_a_cell_has_a_few_terrains_and_those_under_way():
    pool = Pool(2, CELLS, CFG)
    for k in range(DEPTH + 2):
        tell(pool, crossed((0.25, 0.35, 0.4), total=8.0 - k))
    pool.settle(np.array([DEPTH + 1]))
    assert pool.number.tolist() == [*range(DEPTH), DEPTH + 1]
    tell(pool, crossed((0.25, 0.35, 0.4), total=1.0), number=DEPTH + 1)
    pool.settle(pool.number[:0])
    assert len(pool) == DEPTH


def test_an_invalid_terrain_holds_no_cell_and_is_forgotten():
    result = make_result(np.full((1, 3, 3), np.nan), invalid=np.ones((1, 3), bool), names=CFG.penalties)
    pool = Pool(2, CELLS, CFG)
    tell(pool, evaluate_rollout(result, CELLS, CFG))
    assert holders(pool) == {} and len(pool) == 0
    assert len(pool.least_known(4, pool.number)) == 0


def test_the_least_known_are_crossed_again_first():
    pool = Pool(2, CELLS, CFG)
    for ratios in ((0.25, 0.35, 0.4), (0.35, 0.25, 0.4), (0.15, 0.45, 0.4)):
        tell(pool, crossed(ratios))
    pool.settle(pool.number[:0])
    tell(pool, crossed((0.25, 0.35, 0.4)), number=0)
    none = pool.number[:0]
    assert sorted(pool.least_known(2, none).tolist()) == [1, 2]
    assert pool.least_known(1, np.array([1])).tolist() == [2]
    # Seven crossings bring all to as many as there can be: 2 + 2, 1 + 3 and 1 + 2 or the other way round.
    counts = np.bincount(pool.least_known(7, none))
    assert counts[0] == 2 and sorted(counts[1:].tolist()) == [2, 3]


def test_a_terrain_that_was_crossed_again_several_times_at_once_has_all_episodes():
    pool = Pool(2, CELLS, CFG)
    tell(pool, crossed((0.25, 0.35, 0.4)))
    pool.settle(np.zeros(1, np.int64))
    again = [crossed((0.25, 0.35, 0.4), total=total) for total in (2.0, 5.0)]
    told = Evaluation(**{name: np.concatenate([vars(part)[name] for part in again]) for name in vars(again[0])})
    pool.tell(np.zeros((2, 2), np.float32), np.zeros(2, np.int64), told, 2)
    assert pool.terrains.episodes.tolist() == [9]
    assert pool.terrains.penalty_mean.sum() == pytest.approx((8.0 + 2.0 + 5.0) / 3)
    assert told.rows([0]).penalty_mean.sum() == pytest.approx(2.0)  # what it was told stays as it was


@pytest.mark.parametrize("seed", range(8))
def test_a_pool_keeps_its_promises_through_any_crossings(seed):
    """Numbers ascend, all episodes of a terrain count, no cell has two holders, and pending terrains stay."""
    rng = np.random.default_rng(seed)
    pool = Pool(2, CELLS, CFG)
    episodes: dict[int, int] = {}
    for iteration in range(1, 13):
        again = rng.choice(pool.number, rng.integers(0, 5)) if len(pool) else pool.number
        number = rng.permutation(np.append(again, np.full(rng.integers(1, 5), -1)))
        crossed_in = [crossed(rng.dirichlet(np.full(3, 4.0)), episodes=int(rng.integers(1, 6))) for _ in number]
        first_new = max(episodes, default=-1) + 1
        pool.tell(rng.normal(size=(len(number), 2)).astype(np.float32), number, join_evaluations(crossed_in), iteration)
        new = iter(range(first_new, first_new + int((number < 0).sum())))
        for name, evaluation in zip(number.tolist(), crossed_in, strict=True):
            name = next(new) if name < 0 else name
            episodes[name] = episodes.get(name, 0) + int(evaluation.episodes[0])
        pending = rng.choice(pool.number, 3)
        rows = pool.settle(pending)
        assert (np.diff(pool.number) > 0).all() and np.isin(pending, pool.number).all()
        assert pool.terrains.episodes.tolist() == [episodes[name] for name in pool.number.tolist()]
        assert len({*pool.terrains.cell[rows].tolist()}) == len(rows) > 0
        kept_unasked = ~np.isin(pool.number, pending)
        assert np.bincount(pool.terrains.cell[kept_unasked]).max(initial=0) <= DEPTH
        asked = pool.least_known(7, pending)
        assert len(asked) == 7 and np.isin(asked, pool.number).all()
