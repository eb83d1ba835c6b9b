"""A surrogate of the simulation: networks that learn from all crossings what a terrain does to the robot.

The inner loop searches the archive that they predict, and lets robots cross what should add most to the QD score (after
DSAGE: Bhatt et al. 2022), where ratios may be as far from the predicted ones as those of earlier terrains were.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from qd.search.descriptors import Cells
from qd.search.fitness import FITNESS_FLOOR, Evaluation, FitnessCfg, find_worth
from qd.search.surrogate.networks import MEMBERS, Moments, Networks, Trainer
from sim.controllers.loaders import on_stream, prepare_torch
from sim.terrains.conditions.likely import find_log_likelihood
from sim.terrains.corridor import SHAPE, corridor_heights, corridor_maps, num_maps
from sim.terrains.spaces.base import TerrainSpace, clipped
from sim.terrains.spaces.registry import get_space

BATCH = 64  # terrains of a step of training, for each network, or as many as an iteration has if those are fewer
MIN_TERRAINS = 64  # valid ones that must be known before the networks are asked
MAX_TERRAINS = 200_000  # that are learned from, the newest ones; fewer where their maps would take more memory
MAX_MAP_BYTES = 8 << 30
_CHUNK = {"cpu": 1024, "cuda": 8192}  # terrains that are judged in one pass
_GENE_UNITS = 32767  # genes are remembered as whole numbers of 16 bits, which keep a course's kinds apart
_HEIGHT_SCALE = 0.25  # m, of a bump at its limit
_MIN_PENALTY = 0.01  # is added before the logarithm
_RATIO_WEIGHT = 10.0  # cross entropies of ratios differ by hundredths, the other losses by tenths
_NUM_RATES = 3  # goal rate, collision rate, collision bit
_DRAWS = 4  # of the ratios of a terrain, for each network's fitness and collision
_LABELLED_SHARE = 0.25  # of each batch, drawn among the terrains of which is known whether anybody crosses them
_STORED = (
    "cfg", "cells", "fitness", "space_name", "space_sha256", "squared_error", "knows_both", "_rng", "_genes",
    "_targets", "_scale",
)  # fmt: skip
_ERROR_STEP = 0.1  # of the known error of ratios toward that of the latest terrains


class Prediction(NamedTuple):
    """Predictions of each of the networks for N terrains, on their device, shape (MEMBERS, N, columns)."""

    ratios: Tensor
    """Each row sums to 1."""
    numbers: Tensor
    """Logarithms of the penalties' means and standard deviations, and the fitness' area hyperbolic sine."""
    rates: Tensor
    """Logits of goal rate, collision rate and collision bit."""
    chance: Tensor
    """That somebody crosses a terrain, shape (MEMBERS, N); 1 where the networks have not learned that."""

    @property
    def fitness(self) -> Tensor:
        """Shape (MEMBERS, N)."""
        return self.numbers[..., -1].sinh()

    @property
    def collided(self) -> Tensor:
        """The collision bit, shape (MEMBERS, N)."""
        return self.rates[..., 2] > 0.0


class Surrogate:
    """Networks, what they have learned from, and the inner loop; ``stream`` seeds weights, draws and proposals.

    With ``crossed`` in the ``fitness``, networks also learn whether anybody crosses a terrain.
    """

    def __init__(
        self, cfg: Any, cells: Cells, space: TerrainSpace, stream: np.random.SeedSequence, *, fitness: FitnessCfg
    ) -> None:
        self.cfg, self.cells, self.fitness = cfg, cells, fitness
        self.space_name, self.space_sha256 = space.name, space.sha256  # a checkpoint holds no code
        self._rng = np.random.default_rng(stream)
        self._genes = np.zeros((0, space.num_genes), np.int16)
        num_numbers = 2 * cells.num_ratios + 1
        num_targets = cells.num_ratios + num_numbers + _NUM_RATES + (fitness.crossed > 0.0)
        self._targets = np.zeros((0, num_targets), np.float16)
        self._scale = np.stack([np.zeros(num_numbers), np.ones(num_numbers)]).astype(np.float32)
        self.squared_error: NDArray[np.float32] | None = None
        """Of predicted ratios, their episodes' noise included, shape (P,); None before the networks are asked."""
        self.knows_both = False
        """Whether it was told of terrains that somebody crosses, and of others that nobody does."""
        self._networks = Networks(1 + num_maps(space), self._targets.shape[1])
        for weights in self._networks.parameters():
            drawn = self._rng.normal(size=weights.shape) * np.sqrt(2.0 / max(1, weights[0].numel()))
            if weights.ndim > 1:  # biases stay zero
                weights.data.copy_(torch.from_numpy(drawn))
        self._work_on("cpu")

    @property
    def space(self) -> TerrainSpace:
        """What genes mean."""
        return get_space(self.space_name, self.space_sha256)

    @property
    def _capacity(self) -> int:
        """Terrains that it learns from at most."""
        return min(MAX_TERRAINS, MAX_MAP_BYTES // (self._maps.element_size() * self._maps.shape[1:].numel()))

    def __len__(self) -> int:
        """Terrains that it learns from."""
        return len(self._genes)

    def compute_on(self, device: str) -> None:
        """Moves the work to a Warp device; to the CPU where torch does not see such a device."""
        device = device if device.startswith("cuda") and torch.cuda.is_available() else "cpu"
        prepare_torch(device)
        self._work_on(device, self._trainer.moments)

    def _work_on(self, device: str, moments: Moments | None = None) -> None:
        self.device = device
        # Its many small kernels go before the large ones that let robots walk, which fill what is left of the device;
        # the other way round each small one would wait for a large one to end.
        self._stream = torch.cuda.Stream(device, priority=-1) if device.startswith("cuda") else None
        # A ring of the newest terrains' maps, in half precision since there are many; it grows by doubling.
        self._maps = torch.empty((0, *SHAPE, 1 + num_maps(self.space)), dtype=torch.half, device=device)
        self._num_mapped, self._num_unmapped = 0, len(self)  # terrains that the ring has taken, and has still to take
        self._codes: Tensor | None = None  # of the cells
        with on_stream(self._stream):
            self._trainer = Trainer(self._networks.to(device), self._loss, device, moments)

    @property
    def _labelled(self) -> NDArray[np.int64]:
        """Rows of the terrains of which is known whether anybody crosses them."""
        return np.flatnonzero(~np.isnan(self._targets[:, -1])) if self.fitness.crossed else np.zeros(0, np.int64)

    def learn(
        self, genes: NDArray[np.float32], evaluation: Evaluation, crossed: NDArray[np.bool_] | None = None
    ) -> None:
        """Remembers the valid ones of terrains, (N, num_genes), and trains for their share of an iteration's steps.

        ``crossed`` says whether anybody crosses each, shape (N,), if that is known; then it trains for all the steps.
        """
        share = 1.0 if crossed is not None else len(genes) / self.cfg.num_terrains
        steps = max(1, round(self.cfg.training_steps * share))
        valid = evaluation.valid
        genes = clipped(genes[valid])
        with on_stream(self._stream):
            if len(genes) and len(self) >= MIN_TERRAINS and crossed is None:  # else it knows them already
                predicted = self.predict(torch.from_numpy(genes).to(self.device)).ratios.mean(0).cpu().numpy()
                squared_error = ((predicted - evaluation.ratios[valid]) ** 2).mean(axis=0).astype(np.float32)
                before = squared_error if self.squared_error is None else self.squared_error
                self.squared_error = before + np.float32(_ERROR_STEP) * (squared_error - before)
            if len(genes):
                units = np.rint(genes * _GENE_UNITS).astype(np.int16)
                logarithms = (np.log(values + _MIN_PENALTY) for values in (evaluation.penalty_mean, evaluation.spread))
                rates = evaluation.goal_rate, evaluation.collision_rate, evaluation.collides
                columns = [*logarithms, np.arcsinh(evaluation.fitness), *rates]
                if self.fitness.crossed:
                    columns.append(np.full(len(valid), np.nan) if crossed is None else crossed.astype(np.float64))
                targets = np.column_stack([evaluation.ratios, *columns])
                targets = targets[valid].astype(np.float32).astype(np.float16)
                # Labels are few: their terrains come anew before they are the oldest ones, which are forgotten.
                labelled = self._labelled
                again = labelled[labelled < len(self) + len(units) + len(labelled) - self._capacity]
                units = np.concatenate([self._genes[again], units])
                targets = np.concatenate([self._targets[again], targets])
                self._targets[again, -1] = np.nan
                self._genes = np.concatenate([self._genes, units])[-self._capacity :]
                self._targets = np.concatenate([self._targets, targets])[-self._capacity :]
                self._num_unmapped = min(self._num_unmapped + len(units), len(self))
                self.knows_both = len({*self._targets[self._labelled, -1].tolist()}) == 2
                numbers = self._split(self._targets)[1].astype(np.float32)
                self._scale = np.stack([numbers.mean(axis=0), numbers.std(axis=0) + 1e-3])
            if len(self) >= MIN_TERRAINS:
                self._train(steps)

    def _map_genes(self, genes: Tensor) -> Tensor:
        """Heights over their scale, ground and conditions, shape (N, *SHAPE, num_maps)."""
        heights = corridor_heights(genes, self.space) / _HEIGHT_SCALE
        return torch.cat([heights[..., None], corridor_maps(genes, self.space).movedim(1, -1)], dim=-1)

    def _train(self, steps: int) -> None:
        """Adds the maps of new terrains to the ring, and takes steps on all."""
        self._num_mapped += self._num_unmapped
        size = len(self._maps)
        while size < min(self._num_mapped, self._capacity):
            size = min(max(MIN_TERRAINS, 2 * size), self._capacity)
        if size > len(self._maps):  # nothing was overwritten yet, so that maps stay in their rows
            self._maps = torch.cat([self._maps, self._maps.new_empty(size - len(self._maps), *self._maps.shape[1:])])
        rows = torch.arange(self._num_mapped - len(self), self._num_mapped, device=self.device) % len(self._maps)
        new = slice(len(self) - self._num_unmapped, None)
        units = torch.from_numpy(self._genes[new]).to(self.device)
        for chunk, chunk_rows in zip(units.split(_CHUNK["cpu"]), rows[new].split(_CHUNK["cpu"]), strict=True):
            self._maps[chunk_rows] = self._map_genes(chunk / _GENE_UNITS).half()
        self._num_unmapped = 0
        middle, spread = torch.from_numpy(self._scale).to(self.device)
        ratios, numbers, *others = self._split(torch.from_numpy(self._targets).to(self.device).float())
        targets = torch.cat([ratios, (numbers - middle) / spread, *others], dim=-1)
        shape = steps, min(BATCH, self.cfg.num_terrains), MEMBERS
        terrains = self._rng.integers(len(self), size=shape)
        if len(labelled := self._labelled):
            size = steps, round(_LABELLED_SHARE * shape[1]), MEMBERS
            terrains[:, : size[1]] = labelled[self._rng.integers(len(labelled), size=size)]
        drawn = torch.from_numpy(terrains).to(self.device)
        turned = torch.from_numpy(self._rng.random(shape) < 0.5).to(self.device)  # terrain and robot are symmetric
        ordered = targets.new_empty(len(self._maps), targets.shape[1])
        ordered[rows] = targets
        self._trainer.run(self._maps, ordered, rows[drawn], turned)

    def _split(self, columns: Any) -> tuple[Any, Any, Any, Any]:
        """Columns of ratios, numbers and rates, and the one of whether anybody crosses, if there is one."""
        first = self.cells.num_ratios
        last = 3 * first + 1
        rates_end = last + _NUM_RATES
        return columns[..., :first], columns[..., first:last], columns[..., last:rates_end], columns[..., rates_end:]

    def _loss(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Sum over the networks, none of which learns from another; both of shape (batch, MEMBERS, columns)."""
        ratios, numbers, rates, crossed = self._split(outputs)
        true_ratios, true_numbers, true_rates, true_crossed = self._split(targets)
        loss = -_RATIO_WEIGHT * (true_ratios * ratios.log_softmax(-1)).sum(-1)
        loss = loss + ((numbers - true_numbers) ** 2).mean(-1)
        loss = loss + nn.functional.binary_cross_entropy_with_logits(rates, true_rates, reduction="none").mean(-1)
        loss = loss.mean(0).sum()
        return loss + label_loss(crossed, true_crossed) if self.fitness.crossed else loss

    @torch.inference_mode()
    def predict(self, genes: Tensor) -> Prediction:
        """Predictions of each network, of genes in [-1, 1] on the surrogate's device, shape (N, num_genes)."""
        if self._stream is not None:  # for what was learned, if another one asks
            torch.cuda.current_stream(self.device).wait_stream(self._stream)
        chunks = genes.split(_CHUNK[genes.device.type])
        columns = torch.cat([self._networks.judge(self._map_genes(chunk)) for chunk in chunks])
        ratios, numbers, rates, crossed = self._split(columns.transpose(0, 1))
        middle, spread = torch.from_numpy(self._scale).to(self.device)
        chance = crossed[..., 0].sigmoid() if self.knows_both else torch.ones_like(rates[..., 0])
        return Prediction(ratios.softmax(-1), numbers.clamp(-10.0, 10.0) * spread + middle, rates, chance)

    def find_chance(self, genes: NDArray[np.float32], goal_rate: NDArray[np.float64]) -> NDArray[np.float64]:
        """Chance that somebody crosses terrains, (N, num_genes), shape (N,): 1 where the goal was reached before."""
        chance = np.ones(len(genes))
        rows = np.flatnonzero(goal_rate == 0.0)
        if self.knows_both and len(rows):
            with on_stream(self._stream):
                predicted = self.predict(torch.from_numpy(genes[rows]).to(self.device))
                chance[rows] = predicted.chance.mean(0).cpu().numpy()
        return chance

    def find_share(self, genes: Any, chance: Any) -> Any:
        """Share of their worth that terrains keep: less, the less anybody crosses them, and the less likely they are.

        Genes, (N, num_genes), the ``chance`` that somebody crosses each, and the share, (..., N), are arrays or
        tensors; None if all keep all.
        """
        cfg = self.fitness
        share = 1.0 - cfg.crossed * (1.0 - chance) if cfg.crossed else None
        if not cfg.likely:
            return share
        rows = self.space.condition_rows(torch.as_tensor(genes).cpu().numpy())
        likely = np.exp(cfg.likely * find_log_likelihood(rows, cfg.disturbances))
        likely = torch.from_numpy(likely).to(chance) if isinstance(chance, Tensor) else likely
        return likely if share is None else share * likely

    def _find_worth(self, prediction: Prediction, genes: Tensor) -> Tensor:
        """What terrains are worth in the search, shape (MEMBERS, N)."""
        return find_worth(prediction.fitness, self.find_share(genes, prediction.chance))

    @torch.inference_mode()
    def propose(
        self,
        count: int,
        elites: NDArray[np.float32],
        cell: NDArray[np.int64],
        worth: NDArray[np.float64],
        pending: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Terrains for robots to cross: hard-random ones before there is an elite, varied elites before it has learned.

        Genes of ``elites`` are (E, num_genes), of ``pending`` terrains, which robots are to cross already, (U,
        num_genes), of proposals (count, num_genes), in [-1, 1]. What elites are ``worth`` is their fitness, or less.
        """
        if not len(elites):
            return self.space.hard_random(count, self._rng)
        with on_stream(self._stream):
            draw = torch.Generator(self.device).manual_seed(int(self._rng.integers(2**62)))
            parents = torch.from_numpy(np.ascontiguousarray(elites, np.float32)).to(self.device)
            if len(self) < MIN_TERRAINS:
                return self._vary(parents, count, draw).cpu().numpy()
            explored = self._vary(parents, round(self.cfg.explore_share * count), draw)
            fittest = np.full(self.cells.num_cells, FITNESS_FLOOR, np.float32)
            np.maximum.at(fittest, cell, worth.astype(np.float32))
            best = torch.from_numpy(fittest).to(self.device)
            expected = torch.cat([torch.from_numpy(pending).to(self.device), explored])
            if len(expected):  # what robots are to cross already
                prediction = self.predict(expected)
                cells = self._expected_cells(prediction)
                inside = cells >= 0
                predicted = self._find_worth(prediction, expected).mean(0)
                best = best.scatter_reduce(0, cells[inside], predicted[inside], "amax")
            searched = self._search(count - len(explored), parents, best, count, draw)
            return torch.cat([explored, searched]).cpu().numpy()

    def _search(self, num_proposals: int, elites: Tensor, best: Tensor, count: int, draw: torch.Generator) -> Tensor:
        """The inner loop: what adds most to the predicted archive, and what the networks disagree about."""
        num_children = self.cfg.candidates * count
        genes = elites.new_empty(self.cfg.generations * num_children, elites.shape[1])
        gain, spread = elites.new_empty(2, len(genes))
        cells = torch.empty(len(genes), dtype=torch.int64, device=genes.device)
        survivors = cells[:0]
        for first in range(0, len(genes), num_children):
            children = slice(first, first + num_children)
            genes[children] = self._vary(torch.cat([elites, genes[survivors]]), num_children, draw)
            prediction = self.predict(genes[children])
            ratios = prediction.ratios.mean(0)
            drawn = ratios.expand(1, MEMBERS, -1, -1)
            if self.squared_error is not None:
                error = torch.from_numpy(self.squared_error).to(self.device).sqrt()
                noise = torch.randn((_DRAWS, MEMBERS, *ratios.shape), generator=draw, device=self.device)
                drawn = (ratios + error * noise).clamp_min(1e-6)
                drawn = drawn / drawn.sum(-1, keepdim=True)
            reached = self.find_cells(drawn, prediction.collided)
            worth = self._find_worth(prediction, genes[children])
            added = torch.where(reached >= 0, (worth - best[reached]).clamp_min(0.0), 0.0)
            gain[children] = added.mean((0, 1))  # to the QD score
            spread[children] = prediction.ratios.std(0, correction=0).sum(1)
            cells[children] = self._expected_cells(prediction)
            rows = torch.cat([survivors, torch.arange(first, first + num_children, device=genes.device)])
            survivors = rows[_best_of_each(cells[rows], gain[rows], self.cells.num_cells)]
        chosen = survivors[: num_proposals - min(num_proposals, round(self.cfg.disagree_share * count))]
        spread[chosen] = -torch.inf
        disputed = spread.argsort(descending=True, stable=True)[: num_proposals - len(chosen)]
        return genes[torch.cat([chosen, disputed])]

    def _expected_cells(self, prediction: Prediction) -> Tensor:
        """Cell of each terrain by the networks' mean, and by most of them whether robots collide, shape (N,)."""
        return self.find_cells(prediction.ratios.mean(0), prediction.collided.float().mean(0) >= 0.5)

    def find_cells(self, ratios: Tensor, collided: Tensor) -> Tensor:
        """Cell of each row of ratios, as :meth:`Cells.find_cells` has it; -1 where it would be moved to a neighbour."""
        if self._codes is None:
            self._codes = torch.from_numpy(self.cells.codes).to(self.device)
        intervals = self.cells.intervals
        digits = (ratios * intervals).long().clamp_max(intervals - 1)
        powers = intervals ** torch.arange(ratios.shape[-1] - 1, -1, -1, device=ratios.device)
        codes = (digits * powers).sum(-1)
        cells = torch.searchsorted(self._codes, codes).clamp_max(len(self._codes) - 1)
        reached = self._codes[cells] == codes
        if self.cells.collision_bit:
            cells = cells + len(self._codes) * collided
        return torch.where(reached, cells, -1)

    def _vary(self, pool: Tensor, count: int, draw: torch.Generator) -> Tensor:
        return vary_elites(pool, count, self.cfg, self.space.genes_per_part, draw)

    def __getstate__(self) -> dict[str, Any]:
        """Plain values and arrays; maps are made again."""
        with on_stream(self._stream):  # another one would wait for crossings
            learned = [
                {name: value.detach().cpu().numpy() for name, value in {"weights": weights, **moments}.items()}
                for weights, moments in zip(self._networks.parameters(), self._trainer.moments, strict=True)
            ]
        return {name: getattr(self, name) for name in _STORED} | {"learned": learned}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """On the CPU, until :meth:`compute_on` moves it."""
        moments = [{name: torch.from_numpy(array) for name, array in arrays.items()} for arrays in state.pop("learned")]
        vars(self).update(state)
        self._networks = Networks(1 + num_maps(self.space), self._targets.shape[1])
        for weights, tensors in zip(self._networks.parameters(), moments, strict=True):
            weights.data.copy_(tensors.pop("weights"))
        self._work_on("cpu", moments)


def label_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Sum over networks of the mean cross entropy of those labels that are not NaN, shape (batch, MEMBERS, columns)."""
    known = ~labels.isnan()
    weights, labels = known.to(logits.dtype), labels.nan_to_num()
    entropy = nn.functional.binary_cross_entropy_with_logits(logits, labels, weights, reduction="none")
    return (entropy.sum(0) / known.sum(0).clamp_min(1)).sum()


def vary_elites(pool: Tensor, count: int, cfg: Any, genes_per_part: int | None, draw: torch.Generator) -> Tensor:
    """Children, (count, num_genes), of elites by iso+line; a share of them takes parts from a third elite."""
    options = {"generator": draw, "device": pool.device}
    first, second, third = pool[torch.randint(len(pool), (3, count), **options)]
    noise = cfg.iso_sigma * torch.randn(first.shape, **options)
    step = cfg.line_sigma * torch.randn((count, 1), **options)
    children = first + noise + step * (second - first)
    if cfg.crossover_share and genes_per_part:
        crossed = torch.rand((count, 1), **options) < cfg.crossover_share
        swapped = (torch.rand((count, pool.shape[1] // genes_per_part), **options) < 0.5) & crossed
        swapped = swapped.repeat_interleave(genes_per_part, dim=1)
        width = swapped.shape[1]
        children[:, :width] = torch.where(swapped, third[:, :width], children[:, :width])
    return children.clamp(-1.0, 1.0)


def _best_of_each(cells: Tensor, gain: Tensor, num_cells: int) -> Tensor:
    """The row with the largest gain of each cell, if that is positive; by descending gain."""
    order = gain.argsort(descending=True, stable=True)
    order = order[(gain[order] > 0.0) & (cells[order] >= 0)]
    ranks = torch.arange(len(order), device=order.device)
    first = ranks.new_full((num_cells,), len(order)).scatter_reduce(0, cells[order], ranks, "amin")
    return order[first[cells[order]] == ranks]
