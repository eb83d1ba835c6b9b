import numpy as np
import pytest

from qd.search.checkpoint import load_checkpoint, save_checkpoint
from qd.search.descriptors import Cells
from qd.search.fitness import FITNESS_FLOOR, Evaluation, FitnessCfg, evaluate_rollout
from qd.search.methods import METHODS
from qd.search.presets import SchedulerCfg
from qd.search.scheduler import Scheduler
from qd.search.surrogate import surrogate
from tests.qd import stand_in

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
    cell = np.asarray(cell)
    rates = np.zeros(len(cell))
    columns = np.full((len(cell), 6), 1 / 6)
    return Evaluation(
        fitness=np.asarray(fitness, dtype=float), ratios=columns, cell=cell, penalty_mean=columns, penalty_std=columns,
        collision_rate=rates, goal_rate=rates, fallen_rate=rates, end_position=np.zeros((len(cell), 2), np.float32),
        invalid_episodes=np.zeros(len(cell), int) if invalid is None else np.asarray(invalid),
        episodes=np.full(len(cell), 4),
    )  # fmt: skip


def test_the_best_of_a_cell_is_kept_and_a_worse_one_never_replaces_it():
    search = make_search(method="cma_mae+map_elites", restart_rule=4)
    genes = search.ask()
    search.tell(evaluation_with([7, 7] + [9] * 10, [5.0, 1.0] + [0.0] * 10), 1)
    # A threshold of 3, the mean of 5 and 1, would let 4 in.
    search.ask()
    search.tell(evaluation_with([7] * 12, [4.0] * 12), 2)
    elites = search.elites()
    assert elites["cell"].tolist() == [7, 9]
    assert elites["fitness"].tolist() == [5.0, 0.0]
    assert elites["iteration"].tolist() == [1, 1]
    assert np.array_equal(elites["genes"][0], genes[0])


@pytest.mark.parametrize("again", [0, 5])
@pytest.mark.parametrize("method", [*METHODS, *JOINED, "cma_mae+map_elites", "cma_mae+map_elites+surrogate"])
def test_a_saved_search_goes_on_bit_for_bit(method, again, tmp_path):
    # 16 iterations: several eigendecompositions and restarts lie on both sides of the cut
    straight, cut = (make_search(restart_rule=5, method=method, again=again) for _ in range(2))
    advance(straight, 1, 16)
    advance(cut, 1, 7)
    save_checkpoint(tmp_path / "saved", {"scheduler": cut})
    cut = load_checkpoint(tmp_path / "saved")["scheduler"]
    advance(cut, 8, 16)
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
    assert {type(method): method.emitters for method in search.methods} == {
        METHODS["cma_me"]: (0, 3), METHODS["cma_mae"]: (1, 4), METHODS["uniform_random"]: (2,),
    }  # fmt: skip
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
