from dataclasses import replace

import numpy as np
import pytest

from qd.search.checkpoint import load_checkpoint, save_checkpoint
from qd.search.descriptors import Cells
from qd.search.fitness import FITNESS_FLOOR, Evaluation, FitnessCfg, evaluate_rollout, join_evaluations
from qd.search.methods import METHODS
from qd.search.pool import DEPTH, Pool, chance_to_stay, expected_score
from qd.search.presets import SchedulerCfg
from qd.search.scheduler import Scheduler
from qd.search.surrogate import surrogate
from tests.qd import stand_in
from tests.qd.stand_in import make_result

CELLS = Cells(6)
FITNESS = FitnessCfg(penalties=stand_in.PENALTIES, scales=stand_in.SCALES)
JOINED = ("cma_me+cma_mae", "map_elites+hard_random", "surrogate+cma_mae")
BRIEF = {"training_steps": 2, "candidates": 2, "generations": 2}  # networks learn little in it


@pytest.fixture(autouse=True)
def small_steps(monkeypatch):
    """Training of a surrogate that takes next to no time."""
    monkeypatch.setattr(surrogate, "BATCH", 2)


def make_search(**settings) -> Scheduler:
    cfg = {"emitters": 2, "batch_size": 6, **BRIEF, **settings}
    return Scheduler(SchedulerCfg(**cfg), cells=CELLS, fitness=FITNESS, seed=0)


def advance(search: Scheduler, first: int, last: int) -> None:
    for iteration in range(first, last + 1):
        genes = search.ask()
        seeds = np.random.SeedSequence([0, iteration]).generate_state(len(genes))
        search.tell(evaluate_rollout(stand_in.evaluate(genes, seeds), CELLS, FITNESS), iteration)


def evaluation_with(cell, fitness, invalid=None) -> Evaluation:
    """An evaluation of terrains with the given cells and fitness."""
    evaluation = evaluate_rollout(stand_in.make_result(np.ones((len(cell), 4, 6))), CELLS, FITNESS)
    invalid = np.zeros(len(cell), int) if invalid is None else np.array(invalid)
    return replace(evaluation, cell=np.array(cell), fitness=np.array(fitness, float), invalid_episodes=invalid)


def test_the_best_of_a_cell_is_kept_and_a_worse_one_never_replaces_it():
    search = make_search(method="cma_mae+map_elites", restart_rule=4)
    genes = search.ask()
    search.tell(evaluation_with([7, 7] + [9] * 10, [5.0, 1.0] + [0.0] * 10), 1)
    # A threshold of 3, the mean of 5 and 1, would let 4 in.
    search.ask()
    search.tell(evaluation_with([7] * 12, [4.0] * 12), 2)
    elites = search.elites()
    assert [elites[name].tolist() for name in ("cell", "fitness", "iteration")] == [[7, 9], [5.0, 0.0], [1, 1]]
    assert np.array_equal(elites["genes"][0], genes[0])


@pytest.mark.parametrize("again", [pytest.param(0, marks=pytest.mark.slow), 5])
@pytest.mark.parametrize("method", [*METHODS, *JOINED, "cma_mae+map_elites", "cma_mae+map_elites+surrogate"])
def test_a_saved_search_goes_on_bit_for_bit(method, again, tmp_path):
    # Several eigendecompositions and restarts of strategies lie on both sides of the cut.
    middle, last = (3, 8) if "surrogate" in method else (7, 16)
    straight, cut = (make_search(restart_rule=5, method=method, again=again) for _ in range(2))
    advance(straight, 1, last)
    advance(cut, 1, middle)
    save_checkpoint(tmp_path / "saved", {"scheduler": cut})
    cut = load_checkpoint(tmp_path / "saved")["scheduler"]
    advance(cut, middle + 1, last)
    for name, rows in straight.elites().items():
        assert np.array_equal(rows, cut.elites()[name]), name
    assert np.array_equal(straight.ask(), cut.ask())


@pytest.mark.parametrize("method", [*METHODS, *JOINED])
def test_every_method_asks_within_the_limits_and_survives_iterations_without_a_valid_terrain(method):
    search = make_search(restart_rule=1, method=method)
    for iteration in (1, 2):
        genes = search.ask()
        assert genes.shape == (12, 64)
        assert np.abs(genes).max() <= 1.0
        assert len(np.unique(genes, axis=0)) == 12
        search.tell(evaluation_with([0] * 12, [FITNESS_FLOOR] * 12, invalid=[4] * 12), iteration)
    assert len(search.elites()["fitness"]) == 0
    advance(search, 3, 6)
    assert len(search.elites()["fitness"]) > 0


def test_random_terrains_are_new_each_time_and_hard_ones_have_their_heights_at_the_limits():
    hard, uniform = (make_search(batch_size=20, method=f"{kind}_random") for kind in ("hard", "uniform"))
    first = hard.ask()
    assert (np.abs(first[:, 7::8]) == 1.0).all()
    assert not (np.abs(uniform.ask()[:, 7::8]) == 1.0).any()
    hard.tell(evaluation_with([0] * 40, [1.0] * 40), 1)
    assert not np.isin(hard.ask(), first).all(axis=1).any()


def test_emitters_take_joined_methods_in_turn():
    search = make_search(emitters=5, batch_size=2, method="cma_me+cma_mae+uniform_random")
    emitters = {type(method): method.emitters for method in search.methods}
    assert [emitters[METHODS[name]] for name in ("cma_me", "cma_mae", "uniform_random")] == [(0, 3), (1, 4), (2,)]
    genes = search.ask()
    clips = (np.abs(genes) == 1.0).any(axis=1)  # evolution strategies begin wide, with steps of 2
    assert clips.tolist() == [True] * 4 + [False] * 2 + [True] * 4


def test_terrains_are_crossed_again_behind_new_ones_and_alone_where_nothing_new_is_wanted():
    search = make_search(method="hard_random", again=3)
    assert search.group_rows(0) == slice(0, 2 * (6 + 3))
    first = search.ask()
    assert len(first) == 12  # there is nothing to cross again yet
    advance(search, 1, 1)
    known = search.elites()["genes"]
    second = search.ask()
    assert len(second) == 18
    assert not np.isin(second[:12], first).all(axis=1).any()
    assert all((genes == first).all(axis=1).any() for genes in second[12:])
    advance(search, 2, 2)
    settling = search.ask(new=False)
    assert len(settling) == 18
    assert all((genes == np.concatenate([first, second])).all(axis=1).any() for genes in settling)
    assert len(known) and search.elites()["episodes"].max() == 8
    evaluation = evaluate_rollout(stand_in.evaluate(settling, np.arange(18)), CELLS, FITNESS)
    assert search.tell(evaluation, 3) == 0


def test_a_group_crosses_nothing_again_that_another_one_crosses_already_while_there_is_something_else():
    search = make_search(method="hard_random", emitters=2, again=3, groups=2)
    for group in (0, 1):
        genes = search.ask(group)
        search.tell(evaluate_rollout(stand_in.evaluate(genes, np.arange(len(genes))), CELLS, FITNESS), 1, group)
    again = [search.ask(group)[6:] for group in (0, 1)]
    assert len(np.unique(np.concatenate(again), axis=0)) == 6


THREE = Cells(3)
WEIGHTS = FitnessCfg(penalties=("yaw_rate", "vel_x", "vel_y"), scales=(1.0, 1.0, 1.0))
SOLUTION = np.zeros((1, 2), np.float32)


def crossed(ratios, *, episodes=3, total=8.0, collides=0, cells=THREE) -> Evaluation:
    """A terrain whose episodes are all alike: their penalties sum to ``total`` in these ratios."""
    penalties = np.broadcast_to(np.asarray(ratios) * total, (1, episodes, 3))
    result = make_result(penalties, base_collision=[np.arange(episodes) < collides], names=WEIGHTS.penalties)
    return evaluate_rollout(result, cells, WEIGHTS)


def tell(pool: Pool, evaluation: Evaluation, number: int = -1, iteration: int = 1, solution=SOLUTION) -> Evaluation:
    return pool.tell(solution, np.array([number]), evaluation, iteration)


def holders(pool: Pool) -> dict[int, int]:
    """The numbers of the terrains that hold a cell, by their cells."""
    rows = pool.settle(np.zeros(0, np.int64))
    return dict(zip(pool.terrains.cell[rows].tolist(), pool.number[rows].tolist(), strict=True))


def find_cell(*ratios: float) -> int:
    return int(THREE.find_cells([ratios])[0])


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
    low = THREE.tuples[terrain.cell[0]] / 10
    stays = ((draws >= np.where(low > 0, low, -1)) & (draws < np.where(low < 0.85, low + 0.1, 2))).all(axis=1)
    assert chance_to_stay(terrain, THREE)[0] == pytest.approx(stays.mean(), abs=0.005)


# Without a collision in 3 episodes, none in 20 more; with one, any.
@pytest.mark.parametrize(
    ("collides", "expected"), [(0, (1 - 0.5 / 4) ** 20), (1, 1 - (1 - 1.5 / 4) ** 20), (3, 1 - (1 - 3.5 / 4) ** 20)]
)
def test_a_collision_bit_must_stay_too(collides, expected):
    cells, ratios = Cells(3, collision_bit=True), (0.25, 0.35, 0.4)
    chance = chance_to_stay(crossed(ratios, collides=collides, cells=cells), cells)[0]
    assert chance == pytest.approx(expected * chance_to_stay(crossed(ratios), THREE)[0])


def test_a_fit_terrain_of_few_episodes_adds_less_than_one_that_is_known():
    few, many = crossed((0.25, 0.35, 0.4), total=9.0), crossed((0.25, 0.35, 0.4), episodes=40)
    assert few.fitness > many.fitness
    assert expected_score(few, THREE, WEIGHTS) < expected_score(many, THREE, WEIGHTS)


def test_a_terrain_moves_to_the_cell_of_all_of_its_episodes_and_the_next_best_holds_the_one_it_leaves():
    pool = Pool(2, THREE, WEIGHTS)
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
    pool = Pool(2, THREE, WEIGHTS)
    for k in range(DEPTH + 2):
        tell(pool, crossed((0.25, 0.35, 0.4), total=8.0 - k))
    pool.settle(np.array([DEPTH + 1]))
    assert pool.number.tolist() == [*range(DEPTH), DEPTH + 1]
    tell(pool, crossed((0.25, 0.35, 0.4), total=1.0), number=DEPTH + 1)
    pool.settle(pool.number[:0])
    assert len(pool) == DEPTH


def test_a_cell_is_held_by_what_keeps_most_of_its_worth():
    both = join_evaluations([crossed((0.25, 0.35, 0.4), total=8.1), crossed((0.25, 0.35, 0.4))])
    pool = Pool(2, THREE, WEIGHTS)
    pool.tell(np.zeros((2, 2), np.float32), np.full(2, -1), both, 1)
    for share, holder in (([1.0, 1.0], 0), ([0.5, 1.0], 1)):  # the first is a little fitter, and nobody crosses it
        pool.share = np.array(share)
        assert holders(pool) == {find_cell(0.25, 0.35, 0.4): holder}
        assert pool.holds.tolist() == [holder == 0, holder == 1] and pool.share.tolist() == share


def test_an_invalid_terrain_holds_no_cell_and_is_forgotten():
    result = make_result(np.full((1, 3, 3), np.nan), invalid=np.ones((1, 3), bool), names=WEIGHTS.penalties)
    pool = Pool(2, THREE, WEIGHTS)
    tell(pool, evaluate_rollout(result, THREE, WEIGHTS))
    assert holders(pool) == {} and len(pool) == 0
    assert len(pool.least_known(4, pool.number)) == 0


def test_the_least_known_are_crossed_again_first():
    pool = Pool(2, THREE, WEIGHTS)
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
    pool = Pool(2, THREE, WEIGHTS)
    tell(pool, crossed((0.25, 0.35, 0.4)))
    pool.settle(np.zeros(1, np.int64))
    again = join_evaluations([crossed((0.25, 0.35, 0.4), total=total) for total in (2.0, 5.0)])
    pool.tell(np.zeros((2, 2), np.float32), np.zeros(2, np.int64), again, 2)
    assert pool.terrains.episodes.tolist() == [9]
    assert pool.terrains.penalty_mean.sum() == pytest.approx((8.0 + 2.0 + 5.0) / 3)
    assert again.penalty_mean.sum(axis=1) == pytest.approx([2.0, 5.0])  # what it takes in stays as it was


@pytest.mark.parametrize("seed", range(8))
def test_a_pool_keeps_its_promises_through_any_crossings(seed):
    """Numbers ascend, all episodes of a terrain count, no cell has two holders, and pending terrains stay."""
    rng = np.random.default_rng(seed)
    pool = Pool(2, THREE, WEIGHTS)
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
