"""The surrogate over a stand-in whose penalties follow from heights, as a robot's do."""

import pickle

import numpy as np
import pytest
import torch

from qd import surrogate as module
from qd.descriptors import Cells
from qd.fitness import Evaluation, FitnessCfg, evaluation_of
from qd.run.presets import SchedulerCfg
from qd.surrogate import Surrogate
from sim.corridor import corridor_heights
from sim.spaces.base import clipped
from sim.spaces.registry import load_space
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd import stand_in
from tests.sim.spaces.spaces import write_ridges

CELLS = Cells(6, 5)
FITNESS = FitnessCfg(penalties=stand_in.PENALTIES, scales=stand_in.SCALES)
CFG = SchedulerCfg(emitters=2, batch_size=16, method="surrogate", training_steps=20, candidates=8, generations=2)


def crossed(genes, seed: int, space=SUPER_GAUSSIAN) -> Evaluation:
    """Six penalties that follow from slopes and heights of six parts of the way; the same mirrored."""
    heights = corridor_heights(torch.from_numpy(clipped(genes)), space).numpy().astype(float)
    parts = np.array_split(heights[:, 10:31, 30:91], 6, axis=2)
    steep = np.stack([np.abs(np.diff(part, axis=2)).mean(axis=(1, 2)) for part in parts], axis=1)
    high = np.stack([np.abs(part).mean(axis=(1, 2)) for part in parts], axis=1)
    noise = np.random.default_rng(seed).uniform(0.9, 1.1, (len(genes), 4, 6))
    result = stand_in.make_result((0.0005 + 0.1 * (30.0 * steep + 4.0 * high) ** 2)[:, None] * noise * stand_in.SCALES)
    return evaluation_of(result, CELLS, FITNESS)


@pytest.fixture(autouse=True, scope="module")
def small_steps():
    """Steps of training that take a quarter of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BATCH", 16)
        yield


def predicted(search: Surrogate, genes) -> dict[str, np.ndarray]:
    """What each network says, on the host in double precision."""
    found = search.predict(torch.from_numpy(genes).to(search.device))
    names = ("ratios", "fitness", "collided")
    return {name: getattr(found, name).cpu().numpy().astype(float) for name in names}


def mapped(search: Surrogate, genes) -> torch.Tensor:
    return search._map_genes(torch.from_numpy(genes))


def make_surrogate(cfg: SchedulerCfg = CFG, seed: int = 0) -> Surrogate:
    return Surrogate(cfg, CELLS, SUPER_GAUSSIAN, np.random.SeedSequence(seed))


@pytest.fixture(scope="module")
def learned() -> Surrogate:
    """A surrogate that knows 400 random terrains."""
    found = make_surrogate(SchedulerCfg(emitters=2, batch_size=16, training_steps=6))
    for seed in range(4):
        genes = SUPER_GAUSSIAN.hard_random(100, seed)
        evaluation = crossed(genes, seed)
        found.learn(genes, evaluation)
    return found


def test_what_it_learned_holds_for_other_terrains(learned):
    genes = SUPER_GAUSSIAN.hard_random(150, 100)
    truth = crossed(genes, 100)
    found = predicted(learned, genes)
    assert len(learned) == 400
    mean = found["ratios"].mean(axis=0)
    assert np.abs(mean.sum(axis=1) - 1.0).max() < 1e-6
    # Against the mean ratios of all, which is what it would say that has learned nothing of heights.
    error, spread = ((mean - truth.ratios) ** 2).sum(), ((truth.ratios - truth.ratios.mean(axis=0)) ** 2).sum()
    assert error < 0.7 * spread
    assert np.corrcoef(np.arcsinh(found["fitness"]).mean(axis=0), np.arcsinh(truth.fitness))[0, 1] > 0.6
    assert found["collided"].mean() < 0.1  # none of the stand-in's robots collides


def trained(maps: torch.Tensor, turned: bool) -> list[torch.Tensor]:
    """Weights of a surrogate after a step on given maps, all or none of them mirrored."""
    search = make_surrogate()
    targets = torch.rand(len(maps), search._targets.shape[1], generator=torch.Generator().manual_seed(0))
    drawn = torch.arange(16 * module.MEMBERS).reshape(1, 16, module.MEMBERS) % len(maps)
    search._training.run(maps, targets, drawn, torch.full_like(drawn, turned, dtype=torch.bool))
    return list(search._networks.parameters())


def test_mirrored_terrains_are_seen_as_if_they_lay_so(learned):
    maps = mapped(learned, SUPER_GAUSSIAN.hard_random(20, 7)).half()
    plain, mirrored, laid_so = trained(maps, False), trained(maps, True), trained(maps.flip(-2), False)
    assert all(torch.equal(one, other) for one, other in zip(mirrored, laid_so, strict=True))
    assert not torch.equal(mirrored[0], plain[0])


def learned_numbers(search: Surrogate) -> dict[str, np.ndarray]:
    """Weights and what Adam remembers, each in one row."""
    parts = search.__getstate__()["learned"]
    return {name: np.concatenate([one[name].ravel() for one in parts]) for name in parts[0]}


def test_training_is_the_same_on_every_device(device, monkeypatch):
    """On CUDA: steps before the capture, its repetition, and what was saved after it; back on the CPU at last.

    Rounding grows with every step, so there are few, in single precision, and on the same maps.
    """
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    same = lambda genes, space: corridor_heights(genes.cpu(), space).to(genes.device)  # noqa: E731
    monkeypatch.setattr(module, "corridor_heights", same)
    cfg = SchedulerCfg(emitters=2, batch_size=16, training_steps=2)
    here, there = make_surrogate(cfg), make_surrogate(cfg)
    begun = learned_numbers(here)["weights"]
    there.compute_on(device)
    for seed in range(3):
        genes = SUPER_GAUSSIAN.hard_random(100, seed)
        told = crossed(genes, seed)
        here.learn(genes, told)
        there.learn(genes, told)
        there = pickle.loads(pickle.dumps(there))  # on the CPU
        there.compute_on("cpu" if seed == 1 else device)
    found, wanted = learned_numbers(there), learned_numbers(here)
    assert np.array_equal(found["step"], wanted["step"]) and (wanted["step"] == 3 * 6).all()
    way = np.linalg.norm(wanted["weights"] - begun)
    assert np.linalg.norm(found["weights"] - wanted["weights"]) < 0.02 * way
    for name in ("exp_avg", "exp_avg_sq"):
        assert np.linalg.norm(found[name] - wanted[name]) < 0.05 * np.linalg.norm(wanted[name]), name
    there.compute_on(device)
    genes = SUPER_GAUSSIAN.hard_random(50, 9)
    np.testing.assert_allclose(predicted(there, genes)["ratios"], predicted(here, genes)["ratios"], atol=0.005)


@pytest.mark.parametrize("name", ["super_gaussian", "course+friction", "{own}+softness"])
def test_it_learns_and_proposes_on_every_device(device, name, tmp_path, monkeypatch):
    monkeypatch.setattr("sim.spaces.registry._loaded", [])
    space = load_space(name.format(own=write_ridges(tmp_path)))
    cfg = SchedulerCfg(emitters=2, batch_size=16, training_steps=2, candidates=8, generations=2)
    search = Surrogate(cfg, CELLS, space, np.random.SeedSequence(0))
    search.compute_on(device)
    elites = space.hard_random(80, 0)
    told = crossed(elites, 0, space)
    search.learn(elites, told)
    genes = search.propose(16, elites, told.cell, told.fitness, elites[:4])
    assert genes.shape == (16, space.num_genes) and genes.dtype == np.float32 and np.abs(genes).max() <= 1.0
    assert len(np.unique(genes, axis=0)) == 16
    here = pickle.loads(pickle.dumps(search))  # on the CPU
    apart = np.abs(predicted(search, genes)["ratios"] - predicted(here, genes)["ratios"]).max(axis=(0, 2))
    assert np.median(apart) < 0.005  # devices may round an element of a course to another node


def test_what_it_proposes_is_new_by_its_own_word_one_a_cell(learned):
    cfg = SchedulerCfg(emitters=2, batch_size=16, explore_share=0.0, disagree_share=0.0, candidates=20, generations=2)
    learned.cfg = cfg
    elites = SUPER_GAUSSIAN.hard_random(60, 0)
    told = crossed(elites, 0)
    under_way = SUPER_GAUSSIAN.hard_random(8, 9)
    genes = learned.propose(6, elites, told.cell, told.fitness, under_way)
    assert genes.shape == (6, 64) and np.abs(genes).max() <= 1.0

    def expected(genes):
        found = learned.predict(torch.from_numpy(genes))
        return found, found.fitness.numpy(), cells_of(found.ratios.mean(0))

    found, fitness, cells = expected(genes)
    assert len(set(cells)) == 6
    best = np.full(CELLS.num_cells, -20.0, np.float32)
    np.maximum.at(best, told.cell, told.fitness.astype(np.float32))
    _, there, at = expected(under_way)
    np.maximum.at(best, at, there.mean(axis=0))
    gain = learned._gain(found, torch.from_numpy(best)).numpy()
    assert (gain > 0.0).all()
    # By hand for the first: each network's fitness less that of the cell where it puts the terrain.
    own = [max(0.0, f - best[cells_of(r[None])[0]]) for f, r in zip(fitness[:, 0], found.ratios[:, 0], strict=True)]
    assert gain[0] == pytest.approx(np.mean(own), rel=1e-4)
    chance = learned._vary(torch.from_numpy(elites), 60, torch.Generator().manual_seed(0))
    assert gain.mean() > learned._gain(learned.predict(chance), torch.from_numpy(best)).mean()


def cells_of(ratios: torch.Tensor) -> np.ndarray:
    """By the archive's own rule, in double precision."""
    ratios = ratios.double().numpy()
    return CELLS.cell_of(ratios / ratios.sum(axis=-1, keepdims=True))


@pytest.mark.parametrize("cells", [Cells(6, 10), Cells(5, 10, collision_bit=True)])
def test_cells_are_the_archives(cells):
    search = Surrogate(CFG, cells, SUPER_GAUSSIAN, np.random.SeedSequence(0))
    rng = np.random.default_rng(1)
    ratios, collided = rng.dirichlet(np.full(cells.num_ratios, 0.5), 3000), rng.random(3000) < 0.5
    found = search._cells(torch.from_numpy(ratios), torch.from_numpy(collided)).numpy()
    assert np.array_equal(found, cells.cell_of(ratios, collided))
    edge = torch.zeros(1, cells.num_ratios)
    edge[0, :2] = 0.5  # 5 + 5 intervals leave nothing for the others: a single point, in no cell
    assert search._cells(edge, torch.tensor([False])).tolist() == [-1]


def test_before_it_knows_enough_it_draws_and_varies():
    search = make_surrogate()
    none = np.zeros((0, 64), np.float32)
    first = search.propose(8, none, np.zeros(0, int), np.zeros(0), none)
    assert (np.abs(first[:, 7::8]) == 1.0).all()  # hard-random
    told = crossed(first, 0)
    search.learn(first, told)
    later = search.propose(8, first[:1], told.cell[:1], told.fitness[:1], none)
    assert 0.0 < np.abs(later - first[0]).max() < 0.2  # one elite, varied by .02


def test_invalid_terrains_are_not_learned():
    search = make_surrogate()
    genes = SUPER_GAUSSIAN.hard_random(4, 0)
    penalties = np.ones((4, 4, 6))
    invalid = np.zeros((4, 4), bool)
    invalid[1:3] = True
    told = evaluation_of(stand_in.make_result(penalties, invalid=invalid), CELLS, FITNESS)
    search.learn(genes, told)
    assert len(search) == 2


def test_the_newest_are_kept(monkeypatch):
    monkeypatch.setattr(module, "MOST", 70)
    search = make_surrogate(SchedulerCfg(emitters=2, batch_size=16, training_steps=1))
    for seed in range(3):
        genes = SUPER_GAUSSIAN.hard_random(40, seed)
        told = crossed(genes, seed)
        search.learn(genes, told)
    assert len(search) == 70
