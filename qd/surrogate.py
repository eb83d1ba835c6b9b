"""A surrogate of the simulation: networks that learn from all crossings what a terrain does to the robot.

The inner loop searches the archive that they predict, and lets robots cross what promises most (after DSAGE: Bhatt et
al. 2022, "Deep Surrogate Assisted Generation of Environments"). What a terrain promises is the mean over the networks
of the QD score that it would add by their word, so terrains count that only some of them hold for new.
"""

from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from qd.descriptors import Cells
from qd.fitness import FITNESS_FLOOR, Evaluation
from qd.networks import MEMBERS, Networks, Training
from qd.run.settings import SchedulerCfg
from qd.variation import iso_line, recombined
from sim.corridor import corridor_ground, corridor_heights
from sim.policy.loaders import prepare_torch
from sim.space import TerrainSpace, clipped, get_space

BATCH = 64
"""Terrains of a step of training, for each network."""
FEWEST = 64
"""Valid terrains that must be known before the networks are asked."""
MOST = 50_000
"""Terrains that are learned from, the newest ones."""
_AT_ONCE = {"cpu": 1024, "cuda": 8192}  # terrains that are judged at once
_HEIGHT_SCALE = 0.25  # m, of a bump at its limit
_LEAST_PENALTY = 0.01  # is added before the logarithm
_RATIO_WEIGHT = 10.0  # cross entropies of ratios differ by hundredths, the other losses by tenths
_NUM_RATES = 3  # goal rate, collision rate, whether any robot collided


class Prediction(NamedTuple):
    """What each of the networks says of N terrains."""

    ratios: NDArray[np.float64]
    """Shape (MEMBERS, N, P), each row summing to 1."""
    fitness: NDArray[np.float64]
    """Shape (MEMBERS, N)."""
    penalty_mean: NDArray[np.float64]
    """Shape (MEMBERS, N, P)."""
    penalty_std: NDArray[np.float64]
    """Shape (MEMBERS, N, P)."""
    goal_rate: NDArray[np.float64]
    """Shape (MEMBERS, N)."""
    collision_rate: NDArray[np.float64]
    """Shape (MEMBERS, N)."""
    collided: NDArray[np.bool_]
    """Whether at least one robot has a base collision, shape (MEMBERS, N)."""


class Surrogate:
    """Networks, what they have learned from, and the inner loop.

    Args:
        cfg: Settings of the search.
        cells: The archive's cells.
        space: What genes mean.
        stream: Seed of first weights, draws and proposals.
    """

    space_sha256: str | None = None

    def __init__(self, cfg: SchedulerCfg, cells: Cells, space: TerrainSpace, stream: np.random.SeedSequence) -> None:
        self.cfg, self.cells, self.device = cfg, cells, "cpu"
        self.space_name, self.space_sha256 = space.name, space.sha256  # a checkpoint holds no code
        self._rng = np.random.default_rng(stream)
        self._genes = np.zeros((0, space.num_genes), np.float32)
        self._targets = np.zeros((0, 3 * cells.num_ratios + 1 + _NUM_RATES), np.float32)
        self._scale = np.stack([np.zeros(self._regressed), np.ones(self._regressed)]).astype(np.float32)
        self._make_networks()
        for weights in self._networks.parameters():
            drawn = self._rng.normal(size=weights.shape) * np.sqrt(2.0 / max(1, weights[0].numel()))
            values = drawn if weights.ndim > 1 else np.zeros(weights.shape)
            weights.data.copy_(torch.from_numpy(values))

    @property
    def _regressed(self) -> int:
        """Numbers that are regressed: logarithms of the penalties' means and stds, and the fitness."""
        return 2 * self.cells.num_ratios + 1

    def _make_networks(self) -> None:
        with torch.random.fork_rng(devices=[]):  # torch draws weights first, which are replaced
            self._networks = Networks(1 + len(self.space.ground), self._targets.shape[1])
        self._training = Training(self._networks, self._loss, self.device)
        self._maps: Tensor | None = None  # of the genes

    @property
    def space(self) -> TerrainSpace:
        """What genes mean."""
        return get_space(self.space_name, self.space_sha256)

    def __len__(self) -> int:
        """Terrains that it learns from."""
        return len(self._genes)

    def compute_on(self, device: str) -> None:
        """Moves the work to a Warp device; to the CPU where torch does not see such a device."""
        self.device = device if device.startswith("cuda") and torch.cuda.is_available() else "cpu"
        prepare_torch(self.device)
        self._maps = None
        moments = self._training.moments
        self._training = Training(self._networks.to(self.device), self._loss, self.device, moments)

    def learn(self, genes: NDArray[np.float32], evaluation: Evaluation, fitness: NDArray[np.float64]) -> None:
        """Remembers terrains, and trains for their share of an iteration's steps; draws from all that it remembers.

        Args:
            genes: Of the terrains told, shape (N, num_genes).
            evaluation: What became of them; invalid ones are left out.
            fitness: What they are told with, shape (N,).
        """
        valid = evaluation.valid
        if valid.any():
            self._remember(clipped(genes[valid]), _targets_of(evaluation, fitness)[valid])
        if len(self) >= FEWEST:
            self._train(max(1, round(self.cfg.training_steps * len(genes) / self.cfg.num_terrains)))

    def _remember(self, genes: NDArray[np.float32], targets: NDArray[np.float32]) -> None:
        if self._maps is not None:
            self._maps = torch.cat([self._maps, self._mapped(genes)])[-MOST:]
        self._genes = np.concatenate([self._genes, genes])[-MOST:]
        self._targets = np.concatenate([self._targets, targets])[-MOST:]
        numbers = self._targets[:, self.cells.num_ratios :][:, : self._regressed]
        self._scale = np.stack([numbers.mean(axis=0), numbers.std(axis=0) + 1e-3])

    def _mapped(self, genes: NDArray[np.float32]) -> Tensor:
        """Heights over their scale and ground, in half precision since there are many, shape (N, num_maps, *SHAPE)."""
        parts = np.array_split(genes, max(1, -(-len(genes) // _AT_ONCE["cpu"])))
        return torch.cat([self._some_mapped(part).half() for part in parts])

    def _some_mapped(self, genes: NDArray[np.float32]) -> Tensor:
        heights = corridor_heights(genes, self.space, device=self.device) / _HEIGHT_SCALE
        return torch.cat([heights[:, None], corridor_ground(genes, self.space, device=self.device)], dim=1)

    def _train(self, steps: int) -> None:
        if self._maps is None:
            self._maps = self._mapped(self._genes)
        targets = self._scaled(torch.from_numpy(self._targets).to(self.device))
        shape = steps, BATCH, MEMBERS
        drawn = torch.from_numpy(self._rng.integers(len(self), size=shape)).to(self.device)
        turned = torch.from_numpy(self._rng.random(shape) < 0.5).to(self.device)  # terrain and robot are symmetric
        self._training.run(self._maps, targets, drawn, turned)

    def _scaled(self, targets: Tensor) -> Tensor:
        middle, spread = torch.from_numpy(self._scale).to(targets.device)
        ratios, numbers, rates = self._split(targets)
        return torch.cat([ratios, (numbers - middle) / spread, rates], dim=-1)

    def _split(self, columns: Any) -> tuple[Any, Any, Any]:
        """Columns of ratios, numbers and rates."""
        first, last = self.cells.num_ratios, self.cells.num_ratios + self._regressed
        return columns[..., :first], columns[..., first:last], columns[..., last:]

    def _loss(self, found: Tensor, wanted: Tensor) -> Tensor:
        """Of shape (batch, MEMBERS, columns) both: the sum over the networks, none of which learns from another."""
        (ratios, numbers, rates), (own_ratios, own_numbers, own_rates) = self._split(found), self._split(wanted)
        loss = -_RATIO_WEIGHT * (own_ratios * ratios.log_softmax(-1)).sum(-1)
        loss = loss + ((numbers - own_numbers) ** 2).mean(-1)
        loss = loss + nn.functional.binary_cross_entropy_with_logits(rates, own_rates, reduction="none").mean(-1)
        return loss.mean(0).sum()

    @torch.inference_mode()
    def predict(self, genes: NDArray[np.float32]) -> Prediction:
        """What each network says of terrains.

        Args:
            genes: Shape (N, num_genes).
        """
        found = []
        at_once = _AT_ONCE["cpu" if self.device == "cpu" else "cuda"]
        for first in range(0, len(genes), at_once):
            maps = self._some_mapped(clipped(genes[first : first + at_once]))
            found.append(self._networks.judge(maps).cpu().numpy())
        columns = np.moveaxis(np.concatenate(found).astype(np.float64), 1, 0)
        ratios, numbers, rates = self._split(columns)
        ratios = np.exp(ratios - ratios.max(axis=-1, keepdims=True))
        middle, spread = self._scale.astype(np.float64)
        numbers = np.clip(numbers, -10.0, 10.0) * spread + middle
        penalties = np.maximum(np.exp(numbers[..., :-1]) - _LEAST_PENALTY, 0.0)
        mean, std = np.split(penalties, 2, axis=-1)
        return Prediction(
            ratios=ratios / ratios.sum(axis=-1, keepdims=True),
            fitness=np.sinh(numbers[..., -1]),
            penalty_mean=mean,
            penalty_std=std,
            goal_rate=_sigmoid(rates[..., 0]),
            collision_rate=_sigmoid(rates[..., 1]),
            collided=rates[..., 2] > 0.0,
        )

    def propose(
        self,
        count: int,
        elites: NDArray[np.float32],
        cell: NDArray[np.int64],
        fitness: NDArray[np.float64],
        under_way: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Terrains for robots to cross: hard-random ones before there is an elite, varied elites before it has learned.

        Args:
            count: How many.
            elites: Genes of the elites, shape (E, num_genes).
            cell: Their cells, shape (E,).
            fitness: Their fitness, shape (E,).
            under_way: Genes of terrains that robots are to cross already, shape (U, num_genes).

        Returns:
            Genes in [-1, 1], shape (count, num_genes).
        """
        if not len(elites):
            return self.space.hard_random(count, self._rng)
        if len(self) < FEWEST:
            return self._varied(elites, count)
        explored = self._varied(elites, round(self.cfg.explore_share * count))
        best = np.full(self.cells.num_cells, FITNESS_FLOOR)
        np.maximum.at(best, cell, fitness)
        expected = np.concatenate([under_way, explored])
        if len(expected):
            found = self.predict(expected)
            np.maximum.at(best, self._cells(found.ratios.mean(0), _most(found.collided)), found.fitness.mean(0))
        return np.concatenate([explored, self._searched(count - len(explored), elites, best, count)])

    def _searched(
        self, wanted: int, elites: NDArray[np.float32], best: NDArray[np.float64], count: int
    ) -> NDArray[np.float32]:
        """The inner loop: what adds most to the predicted archive, and what the networks disagree about.

        Args:
            wanted: Terrains to return.
            elites: Genes of the elites, where it begins.
            best: Fitness in each cell, expected or found, shape (num_cells,).
            count: Terrains of which these are a part.
        """
        each = self.cfg.candidates * count
        genes = np.empty((self.cfg.generations * each, elites.shape[1]), np.float32)
        gain, spread, cells = np.empty(len(genes)), np.empty(len(genes)), np.empty(len(genes), np.int64)
        kept = np.zeros(0, np.int64)
        for first in range(0, len(genes), each):
            own = slice(first, first + each)
            genes[own] = self._varied(np.concatenate([elites, genes[kept]]), each)
            if turned := round(self.cfg.gradient_share * each):
                genes[first : first + turned] = self._stepped(genes[first : first + turned])
            found = self.predict(genes[own])
            gain[own], spread[own] = self._gain(found, best), found.ratios.std(axis=0).sum(axis=1)
            cells[own] = self._cells(found.ratios.mean(0), _most(found.collided))
            rows = np.concatenate([kept, np.arange(first, first + each)])
            kept = rows[_best_of_each(cells[rows], gain[rows])]
        chosen = kept[: wanted - min(wanted, round(self.cfg.disagree_share * count))]
        spread[chosen] = -np.inf
        disputed = np.argsort(-spread, kind="stable")[: wanted - len(chosen)]
        return genes[np.concatenate([chosen, disputed])]

    def _stepped(self, genes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Terrains a step along gradients of the networks' mean, if the space is the rasteriser's."""
        from qd.gradient import stepped

        def judge(heights: Tensor) -> tuple[Tensor, Tensor]:
            maps = (heights / _HEIGHT_SCALE)[:, None, None].expand(-1, MEMBERS, -1, -1, -1)
            ratios, numbers, _ = self._split(self._networks(maps))
            return 10.0 * ratios.softmax(-1).mean(1), numbers[..., -1].mean(1)  # both of the order of a cell

        networks = list(self._networks.parameters())
        for weights in networks:
            weights.requires_grad_(False)
        found = stepped(genes, judge, self.cells.num_ratios, self.cfg.gradient_sigma, self._rng, self.device)
        for weights in networks:
            weights.requires_grad_(True)
        return found

    def _gain(self, found: Prediction, best: NDArray[np.float64]) -> NDArray[np.float64]:
        """QD score that terrains would add, the mean over the networks, shape (N,)."""
        gains = [
            np.maximum(fitness - best[self._cells(ratios, collided)], 0.0)
            for ratios, fitness, collided in zip(found.ratios, found.fitness, found.collided, strict=True)
        ]
        return np.mean(gains, axis=0)

    def _cells(self, ratios: NDArray[np.float64], collided: NDArray[np.bool_]) -> NDArray[np.int64]:
        return self.cells.cell_of(ratios / ratios.sum(axis=1, keepdims=True), collided)

    def _varied(self, pool: NDArray[np.float32], count: int) -> NDArray[np.float32]:
        elites, others, further = pool[self._rng.integers(len(pool), size=(3, count))]
        children = iso_line(elites, others, self.cfg, self._rng)
        shares = self.cfg.crossover_share, self.cfg.mirror_share
        return recombined(children, further, *shares, self.space, self._rng)

    def __getstate__(self) -> dict[str, Any]:
        """Plain values and arrays; maps are made again."""
        parts = zip(self._networks.parameters(), self._training.moments, strict=True)
        learned = [{"weights": weights.detach(), **moments} for weights, moments in parts]
        return {
            "cfg": asdict(self.cfg),
            "cells": (self.cells.num_ratios, self.cells.intervals, self.cells.collision_bit),
            "space": (self.space_name, self.space_sha256),
            "rng": self._rng,
            "genes": self._genes,
            "targets": self._targets,
            "scale": self._scale,
            "learned": [{name: value.cpu().numpy() for name, value in one.items()} for one in learned],
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """On the CPU, until :meth:`compute_on` moves it."""
        num_ratios, intervals, collision_bit = state["cells"]
        self.cfg, self.device = SchedulerCfg(**state["cfg"]), "cpu"
        self.cells = Cells(num_ratios, intervals, collision_bit=collision_bit)
        self.space_name, self.space_sha256 = state["space"]
        self._rng, self._genes, self._targets, self._scale = (state[k] for k in ("rng", "genes", "targets", "scale"))
        self._make_networks()
        learned = [{name: torch.from_numpy(value).clone() for name, value in one.items()} for one in state["learned"]]
        values, weights = [one.pop("weights") for one in learned], list(self._networks.parameters())
        if [value.shape for value in values] != [own.shape for own in weights]:
            raise ValueError("its surrogate has networks of another shape, of another version")
        for own, value in zip(weights, values, strict=True):
            own.data.copy_(value)
        self._training = Training(self._networks, self._loss, self.device, learned)


def _targets_of(evaluation: Evaluation, fitness: NDArray[np.float64]) -> NDArray[np.float32]:
    """What is to be predicted of terrains, shape (N, 3 P + 4)."""
    columns = (
        evaluation.ratios,
        np.log(evaluation.penalty_mean + _LEAST_PENALTY),
        np.log(evaluation.penalty_std + _LEAST_PENALTY),
        np.arcsinh(fitness)[:, None],
        evaluation.goal_rate[:, None],
        evaluation.collision_rate[:, None],
        (evaluation.collision_rate > 0.0)[:, None],
    )
    return np.concatenate(columns, axis=1).astype(np.float32)


def _best_of_each(cells: NDArray[np.int64], gain: NDArray[np.float64]) -> NDArray[np.int64]:
    """Of each cell the row with the largest gain, if that is positive; by descending gain."""
    order = np.flatnonzero(gain > 0.0)
    order = order[np.argsort(-gain[order], kind="stable")]
    return order[np.sort(np.unique(cells[order], return_index=True)[1])]


def _most(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return flags.mean(axis=0) >= 0.5


def _sigmoid(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1.0 / (1.0 + np.exp(-np.clip(values, -30.0, 30.0)))
