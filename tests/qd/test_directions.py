import numpy as np
import pytest
from ribs.archives import GridArchive

from qd.directions import DirectionEmitter

RATIOS = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.3, 0.3, 0.4]])


def make_emitter(restart_every: int = 100, seed: int = 0, **changes) -> DirectionEmitter:
    archive = GridArchive(
        solution_dim=64, dims=[5], ranges=[(0, 5)], extra_fields={"ratios": ((3,), np.float64)},
        solution_dtype=np.float32,
    )  # fmt: skip
    elites = np.repeat(np.float32([[0], [1], [2]]), 64, axis=1)
    archive.add(elites, np.zeros(3), [[0.5], [1.5], [2.5]], ratios=RATIOS)
    settings = {"num_ratios": 3, "es": "cma_es", "sigma0": 0.5, "batch_size": 10}
    return DirectionEmitter(
        archive, restart_every=restart_every, stream=np.random.SeedSequence(seed), **{**settings, **changes}
    )


def tell(emitter, ratios, objective=0.0):
    emitter.tell(ratios=ratios, objective=np.full(len(ratios), objective), status=np.zeros(len(ratios)))


def ratios_of(genes):
    """Three ratios, of which a terrain's first three genes say how large they are."""
    weights = np.exp(np.clip(genes[:, :3], -3.0, 3.0).astype(float))
    return weights / weights.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("es", ["cma_es", "sep_cma_es"])
def test_it_moves_the_ratios_along_its_direction(es):
    emitter = make_emitter(es=es)
    assert emitter.direction.sum() == pytest.approx(0.0)  # ratios sum to 1: nothing moves along (1, 1, 1)
    assert np.linalg.norm(emitter.direction) == pytest.approx(1.0)
    along = []
    for _ in range(40):
        ratios = ratios_of(emitter.ask())
        along.append((ratios @ emitter.direction).mean())
        tell(emitter, ratios)
    # The best that three ratios of sum 1 allow is all in one.
    assert along[0] < 0.5 * emitter.direction.max()
    assert along[-1] > 0.7 * emitter.direction.max()


def test_it_restarts_at_an_elite_far_along_a_new_direction(monkeypatch):
    starts = []
    emitter = make_emitter(restart_every=2)
    reset = emitter._strategy.reset
    monkeypatch.setattr(emitter._strategy, "reset", lambda x0: (starts.append(x0), reset(x0)))
    directions = [emitter.direction]
    for step in range(1, 41):
        tell(emitter, ratios_of(emitter.ask()))
        assert emitter.restarts == step // 2
        if step % 2 == 0:
            directions.append(emitter.direction)
    assert len(np.unique(np.round(directions, 6), axis=0)) == 21
    furthest = [int(np.argmax(RATIOS @ direction)) for direction in directions[1:]]
    begun = [int(start[0]) for start in starts]
    # Of 8 contenders drawn from 3 elites the furthest is missing with probability (2/3)^8 = 4 %.
    assert np.mean(np.equal(furthest, begun)) > 0.8
    assert len(set(begun)) > 1


def test_a_rare_ratio_counts_as_much_as_a_common_one():
    ratios = np.array([[0.50, 0.20, 0.30], [0.20, 0.21, 0.59], [0.35, 0.19, 0.46]])
    emitter = make_emitter(restart_every=1)
    emitter.archive.clear()
    emitter.archive.add(np.zeros((3, 64)), np.zeros(3), [[0.5], [1.5], [2.5]], ratios=ratios)
    spread = []
    for _ in range(200):
        tell(emitter, ratios_of(emitter.ask()))
        spread.append(np.abs(emitter.direction))
    assert np.mean(spread, axis=0)[1] > 0.7  # the second hardly varies among the elites, so directions lean on it


def test_one_elite_alone_gives_no_direction_and_does_no_harm():
    emitter = make_emitter(restart_every=1)
    emitter.archive.clear()
    emitter.archive.add(np.ones((1, 64)), [0.0], [[0.5]], ratios=RATIOS[:1])
    for _ in range(3):
        tell(emitter, ratios_of(emitter.ask()))
    assert np.isfinite(emitter.ask()).all()


def test_a_ratio_that_varies_by_rounding_alone_is_no_direction():
    ratios = np.array([[0.6, 0.1, 0.3], [0.2, 0.1 + 1e-16, 0.7], [0.35, 0.1 - 1e-16, 0.55]])
    assert ratios[:, 1].std() > 0.0
    emitter = make_emitter(restart_every=1)
    emitter.archive.clear()
    emitter.archive.add(np.zeros((3, 64)), np.zeros(3), [[0.5], [1.5], [2.5]], ratios=ratios)
    sizes = []
    for _ in range(50):
        tell(emitter, ratios_of(emitter.ask()))
        sizes.append(np.abs(emitter.direction))
    # Of (a, 0, b) without its mean the middle one is (a + b) / 3: .82 of the length where a is b, 0 where it is -b.
    # Divided by a spread of 1e-16 the middle one alone would count, and be .82 always.
    assert np.mean(sizes, axis=0)[1] < 0.6


def test_terrains_that_are_no_elites_rank_last(monkeypatch):
    emitter, seen = make_emitter(), []
    monkeypatch.setattr(emitter._strategy, "tell", lambda order, values, parents: seen.append((order, values)))
    emitter.ask()
    # The last two are invalid: of fitness -20 and equal ratios, further along than the worst of the others.
    ratios = np.vstack([np.tile(np.eye(3), (3, 1))[:8], np.full((2, 3), 1 / 3)])
    emitter.tell(ratios=ratios, objective=np.array([1.0] * 8 + [-20.0] * 2))
    (order, values), = seen
    assert (ratios[:8] @ emitter.direction).min() < 0.0
    assert sorted(order[8:].tolist()) == [8, 9]
    assert (np.diff(values[order]) <= 0.0).all() and values[8:].max() < values[:8].min()
