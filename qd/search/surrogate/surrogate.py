"""A surrogate of the simulation: networks that learn from all crossings what a terrain does to the robot.

The inner loop searches the archive that they predict, and lets robots cross what promises most (after DSAGE: Bhatt et
al. 2022, "Deep Surrogate Assisted Generation of Environments"). What a terrain promises is the QD score that it is
expected to add, where its ratios may be as far from the predicted ones as those of earlier terrains were.
"""

from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from qd.search.descriptors import Cells
from qd.search.fitness import FITNESS_FLOOR, Evaluation
from qd.search.presets import SchedulerCfg
from qd.search.surrogate.networks import MEMBERS, Moments, Networks, Training
from sim.controllers.loaders import on_stream, prepare_torch
from sim.terrains.corridor import SHAPE, corridor_heights, corridor_maps, num_maps
from sim.terrains.spaces.base import TerrainSpace, clipped
from sim.terrains.spaces.registry import get_space

BATCH = 64
"""Terrains of a step of training, for each network, or as many as an iteration has if those are fewer."""
FEWEST = 64
"""Valid terrains that must be known before the networks are asked."""
MOST = 200_000
"""Terrains that are learned from, the newest ones; fewer where their maps would take more than 8 GB."""
MOST_BYTES = 8 << 30
"""Of the maps of these."""
_AT_ONCE = {"cpu": 1024, "cuda": 8192}  # terrains that are judged at once
_GENE_UNITS = 32767  # genes are remembered as whole numbers of 16 bits, which keep a course's kinds apart
_HEIGHT_SCALE = 0.25  # m, of a bump at its limit
_LEAST_PENALTY = 0.01  # is added before the logarithm
_RATIO_WEIGHT = 10.0  # cross entropies of ratios differ by hundredths, the other losses by tenths
_NUM_RATES = 3  # goal rate, collision rate, collision bit
_DRAWS = 4  # of the ratios of a terrain, for each network's word on its fitness and collision
_ERROR_STEP = 0.1  # of the known error of ratios toward that of the terrains told last


class Prediction(NamedTuple):
    """What each of the networks says of N terrains, on their device."""

    ratios: Tensor
    """Shape (MEMBERS, N, P), each row summing to 1."""
    numbers: Tensor
    """Logarithms of the penalties' means and standard deviations, and the fitness' area hyperbolic sine, shape
    (MEMBERS, N, 2 P + 1)."""
    rates: Tensor
    """Logits of goal rate, collision rate and collision bit, shape (MEMBERS, N, 3)."""

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

    Attributes:
        squared_error: Of predicted ratios, by the terrains told so far, the noise of their episodes included, shape
            (P,); None before the networks are asked.
    """

    def __init__(self, cfg: SchedulerCfg, cells: Cells, space: TerrainSpace, stream: np.random.SeedSequence) -> None:
        self.cfg, self.cells = cfg, cells
        self.space_name, self.space_sha256 = space.name, space.sha256  # a checkpoint holds no code
        self._rng = np.random.default_rng(stream)
        self._genes = np.zeros((0, space.num_genes), np.int16)
        self._targets = np.zeros((0, 3 * cells.num_ratios + 1 + _NUM_RATES), np.float16)
        self._scale = np.stack([np.zeros(self._regressed), np.ones(self._regressed)]).astype(np.float32)
        self.squared_error: NDArray[np.float32] | None = None
        self._networks = Networks(1 + num_maps(space), self._targets.shape[1])
        for weights in self._networks.parameters():
            drawn = self._rng.normal(size=weights.shape) * np.sqrt(2.0 / max(1, weights[0].numel()))
            values = drawn if weights.ndim > 1 else np.zeros(weights.shape)
            weights.data.copy_(torch.from_numpy(values))
        self._work_on("cpu")

    @property
    def _regressed(self) -> int:
        """Numbers that are regressed: logarithms of the penalties' means and stds, and the fitness."""
        return 2 * self.cells.num_ratios + 1

    @property
    def space(self) -> TerrainSpace:
        """What genes mean."""
        return get_space(self.space_name, self.space_sha256)

    @property
    def _most(self) -> int:
        """Terrains that it learns from at most."""
        return min(MOST, MOST_BYTES // (self._maps.element_size() * self._maps.shape[1:].numel()))

    def __len__(self) -> int:
        """Terrains that it learns from."""
        return len(self._genes)

    def compute_on(self, device: str) -> None:
        """Moves the work to a Warp device; to the CPU where torch does not see such a device."""
        device = device if device.startswith("cuda") and torch.cuda.is_available() else "cpu"
        prepare_torch(device)
        self._work_on(device, self._training.moments)

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
            self._training = Training(self._networks.to(device), self._loss, device, moments)

    def learn(self, genes: NDArray[np.float32], evaluation: Evaluation) -> None:
        """Remembers terrains, of genes (N, num_genes), and trains for their share of an iteration's steps.

        Invalid ones are left out; each step draws from all that it remembers.
        """
        valid = evaluation.valid
        if valid.any():
            self._compare(clipped(genes[valid]), evaluation.ratios[valid])
            self._remember(clipped(genes[valid]), _targets_of(evaluation)[valid])
        if len(self) >= FEWEST:
            with on_stream(self._stream):
                self._train(max(1, round(self.cfg.training_steps * len(genes) / self.cfg.num_terrains)))

    def _compare(self, genes: NDArray[np.float32], ratios: NDArray[np.float64]) -> None:
        """Notes how far predicted ratios are from those that are told now, the noise of a few episodes included."""
        if len(self) < FEWEST:
            return
        with on_stream(self._stream):
            predicted = self.predict(torch.from_numpy(genes).to(self.device)).ratios.mean(0).cpu().numpy()
        squared_error = ((predicted - ratios) ** 2).mean(axis=0).astype(np.float32)
        before = squared_error if self.squared_error is None else self.squared_error
        self.squared_error = before + np.float32(_ERROR_STEP) * (squared_error - before)

    def _remember(self, genes: NDArray[np.float32], targets: NDArray[np.float32]) -> None:
        units = np.rint(genes * _GENE_UNITS).astype(np.int16)
        self._genes = np.concatenate([self._genes, units])[-self._most :]
        self._targets = np.concatenate([self._targets, targets.astype(np.float16)])[-self._most :]
        self._num_unmapped = min(self._num_unmapped + len(units), len(self))
        numbers = self._targets[:, self.cells.num_ratios :][:, : self._regressed].astype(np.float32)
        self._scale = np.stack([numbers.mean(axis=0), numbers.std(axis=0) + 1e-3])

    def _map_genes(self, genes: Tensor) -> Tensor:
        """Heights over their scale, ground and conditions, shape (N, *SHAPE, num_maps)."""
        heights = corridor_heights(genes, self.space) / _HEIGHT_SCALE
        return torch.cat([heights[..., None], corridor_maps(genes, self.space).movedim(1, -1)], dim=-1)

    def _map_new(self) -> tuple[Tensor, Tensor]:
        """The ring of maps, once it has those of all terrains, and the place of each terrain in it."""
        self._num_mapped += self._num_unmapped
        size = len(self._maps)
        while size < min(self._num_mapped, self._most):
            size = min(max(FEWEST, 2 * size), self._most)
        if size > len(self._maps):  # nothing was overwritten yet, so that maps stay in their places
            grown = self._maps.new_empty(size, *self._maps.shape[1:])
            grown[: len(self._maps)] = self._maps
            self._maps = grown
        places = torch.arange(self._num_mapped - len(self), self._num_mapped, device=self.device) % len(self._maps)
        new = slice(len(self) - self._num_unmapped, None)
        units = torch.from_numpy(self._genes[new]).to(self.device)
        for part, rows in zip(units.split(_AT_ONCE["cpu"]), places[new].split(_AT_ONCE["cpu"]), strict=True):
            self._maps[rows] = self._map_genes(part / _GENE_UNITS).half()
        self._num_unmapped = 0
        return self._maps, places

    def _train(self, steps: int) -> None:
        maps, places = self._map_new()
        middle, spread = torch.from_numpy(self._scale).to(self.device)
        ratios, numbers, rates = self._split(torch.from_numpy(self._targets).to(self.device).float())
        targets = torch.cat([ratios, (numbers - middle) / spread, rates], dim=-1)
        shape = steps, min(BATCH, self.cfg.num_terrains), MEMBERS
        drawn = torch.from_numpy(self._rng.integers(len(self), size=shape)).to(self.device)
        turned = torch.from_numpy(self._rng.random(shape) < 0.5).to(self.device)  # terrain and robot are symmetric
        ordered = targets.new_empty(len(maps), targets.shape[1])
        ordered[places] = targets
        self._training.run(maps, ordered, places[drawn], turned)

    def _split(self, columns: Any) -> tuple[Any, Any, Any]:
        """Columns of ratios, numbers and rates."""
        first, last = self.cells.num_ratios, self.cells.num_ratios + self._regressed
        return columns[..., :first], columns[..., first:last], columns[..., last:]

    def _loss(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Sum over the networks, none of which learns from another; both of shape (batch, MEMBERS, columns)."""
        ratios, numbers, rates = self._split(outputs)
        true_ratios, true_numbers, true_rates = self._split(targets)
        loss = -_RATIO_WEIGHT * (true_ratios * ratios.log_softmax(-1)).sum(-1)
        loss = loss + ((numbers - true_numbers) ** 2).mean(-1)
        loss = loss + nn.functional.binary_cross_entropy_with_logits(rates, true_rates, reduction="none").mean(-1)
        return loss.mean(0).sum()

    @torch.inference_mode()
    def predict(self, genes: Tensor) -> Prediction:
        """What each network says of terrains, of genes in [-1, 1] on the surrogate's device, (N, num_genes)."""
        if self._stream is not None:  # for what was learned, if another one asks
            torch.cuda.current_stream(self.device).wait_stream(self._stream)
        parts = genes.split(_AT_ONCE[genes.device.type])
        columns = torch.cat([self._networks.judge(self._map_genes(part)) for part in parts])
        ratios, numbers, rates = self._split(columns.transpose(0, 1))
        middle, spread = torch.from_numpy(self._scale).to(self.device)
        return Prediction(ratios.softmax(-1), numbers.clamp(-10.0, 10.0) * spread + middle, rates)

    @torch.inference_mode()
    def propose(
        self,
        count: int,
        elites: NDArray[np.float32],
        cell: NDArray[np.int64],
        fitness: NDArray[np.float64],
        under_way: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Terrains for robots to cross: hard-random ones before there is an elite, varied elites before it has learned.

        Genes of the ``elites`` have shape (E, num_genes), their cells and fitness (E,). ``under_way`` are genes of
        terrains that robots are to cross already, (U, num_genes). Those proposed are in [-1, 1], (count, num_genes).
        """
        if not len(elites):
            return self.space.hard_random(count, self._rng)
        with on_stream(self._stream):
            draw = torch.Generator(self.device).manual_seed(int(self._rng.integers(2**62)))
            parents = torch.from_numpy(np.ascontiguousarray(elites, np.float32)).to(self.device)
            if len(self) < FEWEST:
                return self._vary(parents, count, draw).cpu().numpy()
            explored = self._vary(parents, round(self.cfg.explore_share * count), draw)
            best = np.full(self.cells.num_cells, FITNESS_FLOOR, np.float32)
            np.maximum.at(best, cell, fitness.astype(np.float32))
            expected = torch.cat([torch.from_numpy(under_way).to(self.device), explored])
            best_expected = self._add_expected(torch.from_numpy(best).to(self.device), expected)
            searched = self._search(count - len(explored), parents, best_expected, count, draw)
            return torch.cat([explored, searched]).cpu().numpy()

    def _add_expected(self, best: Tensor, expected: Tensor) -> Tensor:
        """Fitness in each cell once robots have crossed what they are to cross already, shape (num_cells,)."""
        if not len(expected):
            return best
        prediction = self.predict(expected)
        cells = self._expected_cells(prediction)
        inside = cells >= 0
        return best.scatter_reduce(0, cells[inside], prediction.fitness.mean(0)[inside], "amax")

    def _search(self, num_proposals: int, elites: Tensor, best: Tensor, count: int, draw: torch.Generator) -> Tensor:
        """The inner loop: what adds most to the predicted archive, and what the networks disagree about."""
        each = self.cfg.candidates * count
        genes = elites.new_empty(self.cfg.generations * each, elites.shape[1])
        gain, spread = elites.new_empty(2, len(genes))
        cells = torch.empty(len(genes), dtype=torch.int64, device=genes.device)
        survivors = cells[:0]
        for first in range(0, len(genes), each):
            children = slice(first, first + each)
            genes[children] = self._vary(torch.cat([elites, genes[survivors]]), each, draw)
            prediction = self.predict(genes[children])
            gain[children] = self._expected_gain(prediction, best, draw)
            spread[children] = prediction.ratios.std(0, correction=0).sum(1)
            cells[children] = self._expected_cells(prediction)
            rows = torch.cat([survivors, torch.arange(first, first + each, device=genes.device)])
            survivors = rows[_best_of_each(cells[rows], gain[rows], self.cells.num_cells)]
        chosen = survivors[: num_proposals - min(num_proposals, round(self.cfg.disagree_share * count))]
        spread[chosen] = -torch.inf
        disputed = spread.argsort(descending=True, stable=True)[: num_proposals - len(chosen)]
        return genes[torch.cat([chosen, disputed])]

    def _expected_gain(self, prediction: Prediction, best: Tensor, draw: torch.Generator) -> Tensor:
        """What terrains are expected to add to the QD score, shape (N,), given the best fitness in each cell."""
        ratios = prediction.ratios.mean(0)
        if self.squared_error is None:
            drawn = ratios.expand(1, MEMBERS, -1, -1)
        else:
            error = torch.from_numpy(self.squared_error).to(self.device).sqrt()
            noise = torch.randn((_DRAWS, MEMBERS, *ratios.shape), generator=draw, device=self.device)
            drawn = (ratios + error * noise).clamp_min(1e-6)
            drawn = drawn / drawn.sum(-1, keepdim=True)
        cells = self.cells_of(drawn, prediction.collided)
        return torch.where(cells >= 0, (prediction.fitness - best[cells]).clamp_min(0.0), 0.0).mean((0, 1))

    def _expected_cells(self, prediction: Prediction) -> Tensor:
        """Cell of each terrain by the networks' mean, and by most of them whether robots collide, shape (N,)."""
        return self.cells_of(prediction.ratios.mean(0), prediction.collided.float().mean(0) >= 0.5)

    def cells_of(self, ratios: Tensor, collided: Tensor) -> Tensor:
        """Cell of each row of ratios, as :meth:`Cells.cell_of` has it; -1 of one on the edge of what can be reached."""
        if self._codes is None:
            self._codes = torch.from_numpy(self.cells.codes).to(self.device)
        intervals = self.cells.intervals
        digits = (ratios * intervals).long().clamp_max(intervals - 1)
        places = intervals ** torch.arange(ratios.shape[-1] - 1, -1, -1, device=ratios.device)
        codes = (digits * places).sum(-1)
        cells = torch.searchsorted(self._codes, codes).clamp_max(len(self._codes) - 1)
        reached = self._codes[cells] == codes
        if self.cells.collision_bit:
            cells = cells + len(self._codes) * collided
        return torch.where(reached, cells, -1)

    def _vary(self, pool: Tensor, count: int, draw: torch.Generator) -> Tensor:
        return vary_elites(pool, count, self.cfg, self.space.genes_per_part, draw)

    def __getstate__(self) -> dict[str, Any]:
        """Plain values and arrays; maps are made again."""
        parts = zip(self._networks.parameters(), self._training.moments, strict=True)
        with on_stream(self._stream):  # another one would wait for crossings
            learned = [
                {name: value.detach().cpu().numpy() for name, value in {"weights": weights, **moments}.items()}
                for weights, moments in parts
            ]
        return {
            "cfg": asdict(self.cfg),
            "cells": (self.cells.num_ratios, self.cells.intervals, self.cells.collision_bit),
            "space": (self.space_name, self.space_sha256),
            "rng": self._rng,
            "genes": self._genes,
            "targets": self._targets,
            "scale": self._scale,
            "squared_error": self.squared_error,
            "learned": learned,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """On the CPU, until :meth:`compute_on` moves it."""
        num_ratios, intervals, collision_bit = state["cells"]
        self.cfg = SchedulerCfg(**state["cfg"])
        self.cells = Cells(num_ratios, intervals, collision_bit=collision_bit)
        self.space_name, self.space_sha256 = state["space"]
        self._rng, self._genes, self._targets = state["rng"], state["genes"], state["targets"]
        self._scale, self.squared_error = state["scale"], state["squared_error"]
        self._networks = Networks(1 + num_maps(self.space), self._targets.shape[1])
        moments = [{name: torch.from_numpy(array) for name, array in arrays.items()} for arrays in state["learned"]]
        for weights, tensors in zip(self._networks.parameters(), moments, strict=True):
            weights.data.copy_(tensors.pop("weights"))
        self._work_on("cpu", moments)


def vary_elites(
    pool: Tensor, count: int, cfg: SchedulerCfg, genes_per_part: int | None, draw: torch.Generator
) -> Tensor:
    """Children beside the lines between elites (iso+line, Vassiliades and Mouret 2018), clipped.

    A share of them takes each of its parts, such as bumps, from a further elite with a chance of a half, where the
    space has parts (:attr:`sim.terrains.spaces.base.TerrainSpace.genes_per_part`). Elites' genes have shape (E,
    num_genes), children's (count, num_genes), in [-1, 1]; ``draw`` is on their device.
    """
    on = {"generator": draw, "device": pool.device}
    elites, others, further = pool[torch.randint(len(pool), (3, count), **on)]
    noise = cfg.iso_sigma * torch.randn(elites.shape, **on)
    along = cfg.line_sigma * torch.randn((count, 1), **on)
    children = elites + noise + along * (others - elites)
    if cfg.crossover_share and genes_per_part:
        crossed = torch.rand((count, 1), **on) < cfg.crossover_share
        swapped = (torch.rand((count, pool.shape[1] // genes_per_part), **on) < 0.5) & crossed
        swapped = swapped.repeat_interleave(genes_per_part, dim=1)
        children[:, : swapped.shape[1]] = torch.where(
            swapped, further[:, : swapped.shape[1]], children[:, : swapped.shape[1]]
        )
    return children.clamp(-1.0, 1.0)


def _targets_of(evaluation: Evaluation) -> NDArray[np.float32]:
    """What is to be predicted of terrains, shape (N, 3 P + 4)."""
    columns = (
        evaluation.ratios,
        np.log(evaluation.penalty_mean + _LEAST_PENALTY),
        np.log(evaluation.spread + _LEAST_PENALTY),
        np.arcsinh(evaluation.fitness)[:, None],
        evaluation.goal_rate[:, None],
        evaluation.collision_rate[:, None],
        evaluation.collides[:, None],
    )
    return np.concatenate(columns, axis=1).astype(np.float32)


def _best_of_each(cells: Tensor, gain: Tensor, num_cells: int) -> Tensor:
    """Of each cell the row with the largest gain, if that is positive; by descending gain."""
    order = gain.argsort(descending=True, stable=True)
    order = order[(gain[order] > 0.0) & (cells[order] >= 0)]
    ranks = torch.arange(len(order), device=order.device)
    first = ranks.new_full((num_cells,), len(order)).scatter_reduce(0, cells[order], ranks, "amin")
    return order[first[cells[order]] == ranks]
