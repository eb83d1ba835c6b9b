"""The surrogate over a stand-in whose penalties follow from heights, as a robot's do."""

import dataclasses
import pickle

import numpy as np
import pytest
import torch

from qd.search.descriptors import Cells
from qd.search.fitness import Evaluation, FitnessCfg, evaluate_rollout
from qd.search.presets import SchedulerCfg
from qd.search.surrogate import surrogate as module
from qd.search.surrogate.networks import MEMBERS, Networks, Trainer, _block_diagonal, _slide_over
from qd.search.surrogate.surrogate import Prediction, Surrogate, label_loss, vary_elites
from sim.terrains.conditions.likely import choose_likely, find_log_likelihood
from sim.terrains.corridor import SHAPE, corridor_heights
from sim.terrains.spaces.base import clipped
from sim.terrains.spaces.registry import get_space, load_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import bump
from tests.qd import stand_in
from tests.sim.terrains.spaces.spaces import write_ridges

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
    return evaluate_rollout(result, CELLS, FITNESS)


@pytest.fixture(autouse=True, scope="module")
def small_steps():
    """Steps of training that take a quarter of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BATCH", 16)
        yield


def predicted(search: Surrogate, genes) -> dict[str, np.ndarray]:
    """What each network says, on the host in double precision."""
    prediction = search.predict(torch.from_numpy(genes).to(search.device))
    return {name: getattr(prediction, name).cpu().numpy().astype(float) for name in ("ratios", "fitness", "collided")}


def make_surrogate(space=SUPER_GAUSSIAN, cells=CELLS, weight=0.0, worth=None, **settings) -> Surrogate:
    return Surrogate(
        dataclasses.replace(CFG, **settings),
        cells,
        space,
        np.random.SeedSequence(0),
        fitness=dataclasses.replace(FITNESS, crossed=weight, **worth or {}),
    )


@pytest.fixture(scope="module")
def learned() -> Surrogate:
    """A surrogate that knows 400 random terrains."""
    surrogate = make_surrogate(training_steps=6)
    for seed in range(4):
        genes = SUPER_GAUSSIAN.hard_random(100, seed)
        surrogate.learn(genes, crossed(genes, seed))
    return surrogate


@pytest.mark.slow
def test_what_it_learned_holds_for_other_terrains(learned):
    genes = SUPER_GAUSSIAN.hard_random(150, 100)
    truth = crossed(genes, 100)
    prediction = predicted(learned, genes)
    assert len(learned) == 400
    mean = prediction["ratios"].mean(axis=0)
    np.testing.assert_allclose(mean.sum(axis=1), 1.0, atol=1e-6)
    # Against the mean ratios of all, which is what it would say that has learned nothing of heights.
    error, spread = ((mean - truth.ratios) ** 2).sum(), ((truth.ratios - truth.ratios.mean(axis=0)) ** 2).sum()
    assert error < 0.7 * spread
    assert np.corrcoef(np.arcsinh(prediction["fitness"]).mean(axis=0), np.arcsinh(truth.fitness))[0, 1] > 0.6
    assert prediction["collided"].mean() < 0.1  # none of the stand-in's robots collides


@pytest.mark.slow
def test_it_learns_from_a_payload_alone():
    """On one terrain for all, penalties follow from the payload."""
    space = get_space("super_gaussian+payload")
    search = make_surrogate(space)

    def loaded(count, seed):
        genes = np.tile(space.hard_random(1, 0), (count, 1))
        genes[:, 64] = np.random.default_rng(seed).uniform(-1.0, 1.0, count)
        shares = np.full((count, 4, 6), 1.0)
        shares[..., 0] += 4.0 * (1.0 + genes[:, 64, None])
        return genes, evaluate_rollout(stand_in.make_result(shares * stand_in.SCALES), CELLS, FITNESS)

    for seed in range(2):
        search.learn(*loaded(64, seed))
    genes, truth = loaded(100, 9)
    ratios = predicted(search, genes)["ratios"].mean(axis=0)[:, 0]
    assert np.corrcoef(ratios, truth.ratios[:, 0])[0, 1] > 0.9


def test_of_terrains_alike_it_proposes_the_likeliest_where_these_are_worth_more(monkeypatch):
    space, alike = get_space("super_gaussian+payload"), torch.ones(MEMBERS, 1, 6)
    elites, entries = space.uniform_random(80, 0), choose_likely(space)
    same = Prediction(alike / 6.0, 5.0 * alike, -alike[..., :3], alike[..., 0])
    monkeypatch.setattr(module, "MIN_TERRAINS", 0)
    wide = lambda genes: Prediction(*(values.expand(-1, len(genes), *values.shape[2:]) for values in same))  # noqa: E731
    monkeypatch.setattr(Surrogate, "predict", lambda self, genes: wide(genes))

    def propose(**worth):
        search = make_surrogate(space, worth=worth, candidates=40)
        return search.propose(1, elites, np.zeros(80, int), np.full(80, -19.0), elites[:0])

    usual, likely = propose(), propose(likely=0.5, disturbances=entries)
    assert (propose(disturbances=entries) == usual).all()  # bit for bit
    before, after = (find_log_likelihood(space.condition_rows(genes), entries)[0] for genes in (usual, likely))
    assert before < after and after > -0.2
    likely_too = {"likely": 0.5, "disturbances": entries}
    for weight, chance, lost in ((0.0, 0.25, 0.0), (0.8, 0.25, 0.8 * 0.75)):
        share = make_surrogate(space, weight=weight, worth=likely_too).find_share(usual, np.array([chance]))
        np.testing.assert_allclose(share, (1.0 - lost) * np.exp(0.5 * before))
    assert make_surrogate(space, weight=0.8).find_share(usual, np.array([0.25])) == pytest.approx([0.4])
    assert make_surrogate(space).find_share(usual, np.array([0.25])) is None


def trained(maps: torch.Tensor, turned: bool) -> list[torch.Tensor]:
    """Weights of networks after a step on given maps, all or none of them mirrored."""
    torch.manual_seed(0)
    networks = Networks(1, 5)
    for weights in networks.parameters():
        torch.nn.init.normal_(weights, std=0.1)
    targets = torch.rand(len(maps), 5)
    drawn = torch.arange(16 * MEMBERS).reshape(1, 16, MEMBERS) % len(maps)
    trainer = Trainer(networks, lambda outputs, targets: ((outputs - targets) ** 2).sum(), "cpu")
    trainer.run(maps, targets, drawn, torch.full_like(drawn, turned, dtype=torch.bool))
    return list(networks.parameters())


def test_mirrored_terrains_are_seen_as_if_they_lay_so():
    maps = torch.randn(20, *SHAPE, 1).half()
    plain, mirrored, laid_so = trained(maps, False), trained(maps, True), trained(maps.flip(1), False)
    assert all(torch.equal(weights, expected) for weights, expected in zip(mirrored, laid_so, strict=True))
    assert not torch.equal(mirrored[0], plain[0])


@pytest.mark.slow
def test_training_is_the_same_on_every_device_and_after_a_pickle(device, monkeypatch):
    """On CUDA: steps before the capture, its repetition, and what was saved after it; back on the CPU at last.

    Rounding grows with every step, so there are few, in single precision, and on the same maps.
    """
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    same = lambda genes, space: corridor_heights(genes.cpu(), space).to(genes.device)  # noqa: E731
    monkeypatch.setattr(module, "corridor_heights", same)
    straight, moved = (make_surrogate(training_steps=2) for _ in range(2))
    moved.compute_on(device)
    for seed in range(3):
        genes = SUPER_GAUSSIAN.hard_random(100, seed)
        for search in (straight, moved):
            search.learn(genes, crossed(genes, seed))
        moved = pickle.loads(pickle.dumps(moved))  # on the CPU
        moved.compute_on("cpu" if seed == 1 else device)
    genes = SUPER_GAUSSIAN.hard_random(50, 9)
    expected, values = predicted(straight, genes), predicted(moved, genes)
    tolerance = 0.005 if moved.device.startswith("cuda") else 0.0
    np.testing.assert_allclose(values["ratios"], expected["ratios"], rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("num_maps", [1, 3])
@pytest.mark.parametrize("same", [True, False])
def test_the_first_layer_of_a_gpu_is_a_convolution(num_maps, same):
    draw = torch.Generator().manual_seed(0)
    sets = 1 if same else MEMBERS
    rows = torch.randn((3, sets * num_maps, *SHAPE), generator=draw)
    weight = torch.randn((MEMBERS, 12, num_maps, 5, 5), generator=draw, requires_grad=True)
    bias = torch.randn((MEMBERS, 12), generator=draw, requires_grad=True)
    joined = weight.flatten(0, 1) if same else _block_diagonal(weight)
    expected = torch.nn.functional.conv2d(rows, joined, bias.flatten(), (3, 3), 2).relu()
    found = _slide_over(rows, weight, bias, (3, 3))
    assert found.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-5)
    learned = (torch.autograd.grad((values**2).sum(), (weight, bias)) for values in (found, expected))
    torch.testing.assert_close(*learned, atol=0.1, rtol=1e-4)


@pytest.mark.parametrize("name", ["super_gaussian", "course+friction", "{own}+softness+push+delay"])
def test_it_learns_and_proposes_on_every_device(device, name, tmp_path):
    space = load_space(name.format(own=write_ridges(tmp_path)))
    search = make_surrogate(space, training_steps=2)
    search.compute_on(device)
    elites = space.hard_random(80, 0)
    evaluation = crossed(elites, 0, space)
    search.learn(elites, evaluation)
    genes = search.propose(16, elites, evaluation.cell, evaluation.fitness, elites[:4])
    assert genes.shape == (16, space.num_genes) and genes.dtype == np.float32 and np.abs(genes).max() <= 1.0
    assert len(np.unique(genes, axis=0)) == 16
    copied = pickle.loads(pickle.dumps(search))  # on the CPU
    apart = np.abs(predicted(search, genes)["ratios"] - predicted(copied, genes)["ratios"]).max(axis=(0, 2))
    assert np.median(apart) < 0.005  # devices may round an element of a course to another node


def archive_cells(ratios: np.ndarray) -> np.ndarray:
    """By the archive's own rule, in double precision."""
    return CELLS.find_cells(ratios / ratios.sum(axis=-1, keepdims=True))


def test_what_it_proposes_is_new_by_its_own_word_one_a_cell(learned):
    learned.cfg = dataclasses.replace(CFG, explore_share=0.0, disagree_share=0.0, candidates=20)
    elites = SUPER_GAUSSIAN.hard_random(60, 0)
    evaluation = crossed(elites, 0)
    under_way = SUPER_GAUSSIAN.hard_random(8, 9)
    genes = learned.propose(6, elites, evaluation.cell, evaluation.fitness, under_way)
    assert genes.shape == (6, 64) and np.abs(genes).max() <= 1.0

    def predict(genes):
        """Mean ratios and fitness."""
        prediction = predicted(learned, genes)
        return prediction["ratios"].mean(axis=0), prediction["fitness"].mean(axis=0)

    def gains(genes):
        """The fitness above the best of the cell where a terrain may fall; the mean over 50 draws of ratios."""
        ratios, fitness = predict(genes)
        noise = np.sqrt(learned.squared_error) * np.random.default_rng(0).normal(size=(50, len(genes), 6))
        cells = map(archive_cells, np.maximum(ratios + noise, 1e-6))
        return np.mean([np.maximum(fitness - best[cell], 0.0) for cell in cells], axis=0)

    assert len(set(archive_cells(predict(genes)[0]))) == 6
    best = np.full(CELLS.num_cells, -20.0, np.float32)
    np.maximum.at(best, evaluation.cell, evaluation.fitness.astype(np.float32))
    ratios, fitness = predict(under_way)
    np.maximum.at(best, archive_cells(ratios), fitness.astype(np.float32))
    assert (gains(genes) > 0.0).all()
    chance = vary_elites(torch.from_numpy(elites), 60, learned.cfg, 8, torch.Generator().manual_seed(0))
    assert gains(genes).mean() > gains(chance.numpy()).mean()


def test_it_knows_how_far_its_ratios_are_off(learned):
    search = pickle.loads(pickle.dumps(learned))
    genes = SUPER_GAUSSIAN.hard_random(50, 7)
    evaluation = crossed(genes, 7)
    off = ((predicted(search, genes)["ratios"].mean(axis=0) - evaluation.ratios) ** 2).mean(axis=0)
    search.learn(genes, evaluation)  # by what it said before it learned
    assert learned.squared_error is not None
    np.testing.assert_allclose(search.squared_error, 0.9 * learned.squared_error + 0.1 * off, rtol=1e-4)


@pytest.mark.parametrize("cells", [Cells(6, 10), Cells(5, 10, collision_bit=True)])
def test_cells_are_the_archives(cells):
    search = make_surrogate(cells=cells)
    rng = np.random.default_rng(1)
    ratios, collided = rng.dirichlet(np.full(cells.num_ratios, 0.5), 3000), rng.random(3000) < 0.5
    numbers = search.find_cells(torch.from_numpy(ratios), torch.from_numpy(collided)).numpy()
    assert np.array_equal(numbers, cells.find_cells(ratios, collided))
    edge = torch.zeros(1, cells.num_ratios)
    edge[0, :2] = 0.5  # 5 + 5 intervals leave nothing for the others: a single point, in no cell
    assert search.find_cells(edge, torch.tensor([False])).tolist() == [-1]


def test_before_it_knows_enough_it_draws_and_varies():
    search = make_surrogate()
    none = np.zeros((0, 64), np.float32)
    first = search.propose(8, none, np.zeros(0, int), np.zeros(0), none)
    assert (np.abs(first[:, 7::8]) == 1.0).all()  # hard-random
    evaluation = crossed(first, 0)
    search.learn(first, evaluation)
    later = search.propose(8, first[:1], evaluation.cell[:1], evaluation.fitness[:1], none)
    assert 0.0 < np.abs(later - first[0]).max() < 0.2  # one elite, varied by .02


@pytest.mark.parametrize(("name", "value"), [("MAX_TERRAINS", 70), ("MAX_MAP_BYTES", 70 * 41 * 121 * 2 + 1)])
def test_invalid_terrains_are_not_learned_and_the_newest_stay(monkeypatch, name, value):
    monkeypatch.setattr(module, name, value)
    search = make_surrogate(training_steps=1)
    for seed, length in ((0, 38), (1, 70)):
        genes = SUPER_GAUSSIAN.hard_random(40, seed)
        invalid = np.zeros((40, 4), bool)
        invalid[1:3] = True
        result = stand_in.make_result(np.ones((40, 4, 6)), invalid=invalid)
        search.learn(genes, evaluate_rollout(result, CELLS, FITNESS))
        assert len(search) == length


def test_maps_take_no_more_room_than_terrains_need_and_each_stays_its_terrains(monkeypatch):
    """By what training is given: 60 terrains at a time up to 300, and then in place of the oldest."""
    monkeypatch.setattr(module, "MAX_TERRAINS", 300)
    given = []
    run = lambda self, maps, targets, drawn, turned: given.append((maps.clone(), targets, drawn))  # noqa: E731
    monkeypatch.setattr(Trainer, "run", run)
    search = make_surrogate(training_steps=60)
    genes = SUPER_GAUSSIAN.hard_random(420, 0)
    evaluation = crossed(genes, 0)
    ratios = torch.from_numpy(evaluation.ratios)
    heights = (corridor_heights(torch.from_numpy(genes), SUPER_GAUSSIAN) / 0.25).flatten(1)
    for first in range(0, 420, 60):
        part = slice(first, first + 60)
        search.learn(genes[part], evaluation.rows(part))
    assert [len(maps) for maps, _, _ in given] == [128, 256, 256, 300, 300, 300]
    for count, (maps, targets, drawn) in zip(range(120, 421, 60), given, strict=True):
        rows = drawn.unique()
        terrain = torch.cdist(maps[rows].float().flatten(1), heights).argmin(1)  # genes of 16 bits move maps a little
        assert sorted(terrain.tolist()) == [*range(max(0, count - 300), count)]
        torch.testing.assert_close(targets[rows, :6].double(), ratios[terrain], rtol=0.0, atol=1e-3)


def test_labels_that_nobody_knows_cost_nothing_by_hand():
    unknown = float("nan")
    logits = torch.tensor([[0.0, 9.0], [1.0, -2.0], [5.0, 9.0]])[..., None].requires_grad_()
    labels = torch.tensor([[1.0, unknown], [0.0, 1.0], [unknown, unknown]])[..., None]
    # Of the first network (ln 2 + ln(1 + e)) / 2, of the second ln(1 + e^2) of its only label.
    loss = label_loss(logits, labels)
    assert loss.item() == pytest.approx((np.log(2.0) + np.log(1.0 + np.e)) / 2.0 + np.log(1.0 + np.e**2.0), rel=1e-6)
    loss.backward()
    assert (logits.grad[..., 0] != 0.0).tolist() == [[True, False], [True, True], [False, False]]
    assert label_loss(logits, torch.full_like(labels, unknown)).item() == 0.0


@pytest.mark.slow
def test_it_learns_who_crosses_from_a_few_labels_and_keeps_these(monkeypatch):
    """Nobody crosses where a wall of .25 m lies in the middle; the newest 200 terrains are learned from."""
    monkeypatch.setattr(module, "MAX_TERRAINS", 200)

    def terrains(count, seed):
        genes = SUPER_GAUSSIAN.hard_random(count, seed)
        walls = np.random.default_rng(seed).random(count) < 0.5
        genes[walls, :8] = bump(x=8.0, sigma_x=0.5, height=0.25)
        return genes, ~walls

    search = make_surrogate(weight=0.8, training_steps=150, batch_size=400)
    genes, passes = terrains(60, 0)
    others, others_pass = terrains(100, 1)
    search.learn(others, crossed(others, 1))
    search.learn(genes[passes], crossed(genes[passes], 0), passes[passes])
    assert (search.find_chance(others, np.zeros(100)) == 1.0).all()  # labels of one kind say nothing
    search.learn(genes[~passes], crossed(genes[~passes], 0), passes[~passes])
    for seed in (2, 3):  # 300 more, without labels
        more, _ = terrains(150, seed)
        search.learn(more, crossed(more, seed))
        search = pickle.loads(pickle.dumps(search))
    assert len(search) == 200
    chance = search.find_chance(others, np.zeros(100))
    better = chance[others_pass, None] > chance[~others_pass]  # any two of them
    assert better.mean() > 0.9 and chance[others_pass].mean() > chance[~others_pass].mean() + 0.2
    assert (search.find_chance(others, np.full(100, 0.25)) == 1.0).all()  # by the episodes of its own


def test_what_nobody_crosses_is_not_proposed_where_it_is_worth_nothing(learned, monkeypatch):
    """By the first bump: nobody crosses a hollow. Half of the elites have one."""
    search = pickle.loads(pickle.dumps(learned))
    search.cfg = dataclasses.replace(CFG, explore_share=0.0, disagree_share=0.0)
    by_bump = lambda genes: learned.predict(genes)._replace(chance=(genes[:, 7] > 0.0).float().expand(MEMBERS, -1))  # noqa: E731
    monkeypatch.setattr(search, "predict", by_bump)
    elites = SUPER_GAUSSIAN.hard_random(60, 0)
    evaluation = crossed(elites, 0)
    hollows = []
    for weight in (0.0, 1.0):
        search.fitness = dataclasses.replace(search.fitness, crossed=weight)
        genes = search.propose(6, elites, evaluation.cell, np.full(60, -20.0), elites[:0])
        hollows.append(int((genes[:, 7] <= 0.0).sum()))
    assert hollows[0] > 0 == hollows[1]


PAIR = torch.from_numpy(0.5 * SUPER_GAUSSIAN.uniform_random(2, 0))
LINE = (PAIR[1] - PAIR[0]).numpy()


def children(pool: torch.Tensor, genes_per_part: int | None = 8, **steps: float) -> np.ndarray:
    cfg = SchedulerCfg(**{"iso_sigma": 0.0, "line_sigma": 0.0, "crossover_share": 0.0, **steps})
    return vary_elites(pool, 400, cfg, genes_per_part, torch.Generator().manual_seed(0)).numpy()


def test_of_a_share_of_the_children_half_of_the_bumps_are_another_elites():
    varied = children(PAIR, crossover_share=0.4).reshape(-1, 8, 8)
    first, second = ((varied == elite.reshape(8, 8).numpy()).all(axis=2) for elite in PAIR)
    assert (first ^ second).all()
    mixed = first.any(axis=1) & second.any(axis=1)
    # 0.4 are crossed, half of them with the other of the two, which takes 1 to 7 bumps in 254 of 256 cases.
    assert mixed.mean() == pytest.approx(0.4 * 0.5 * 254 / 256, abs=0.06)
    assert 0.4 < first[mixed].mean() < 0.6
    without_parts = children(PAIR, crossover_share=1.0, genes_per_part=None)
    assert all((row == PAIR.numpy()).all(axis=1).any() for row in without_parts)
    assert np.abs(children(PAIR, iso_sigma=5.0)).max() == 1.0  # clipped
    # Genes behind the last whole part, such as of conditions, stay with those of the first elite.
    longer = children(torch.cat([PAIR, PAIR[:, :3]], dim=1), crossover_share=1.0)
    ends = (longer[:, None, 64:] == PAIR[:, :3].numpy()).all(axis=2)
    assert (ends.sum(axis=1) == 1).all() and (longer[:, :8] != PAIR[0, :8].numpy()).any(axis=1).mean() > 0.4


def test_steps_along_lines_stay_on_them():
    varied = children(PAIR, line_sigma=0.1)
    steps = np.stack([varied - elite.numpy() for elite in PAIR])
    nearest = np.abs(steps).sum(axis=2).argmin(axis=0)
    step = steps[nearest, np.arange(len(varied))]
    share = (step @ LINE) / (LINE @ LINE)
    np.testing.assert_allclose(step, share[:, None] * LINE, atol=1e-6)
    moved = share[np.abs(share) > 1e-6]
    assert 0.4 < len(moved) / len(varied) < 0.6  # half of them meet the other elite
    assert moved.std() == pytest.approx(0.1, rel=0.2)
