"""Which terrains a controller is fine-tuned on: half of one kind and half of another, exchanged every so often."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sim.robots.training import Draw
from sim.terrains.bank import terrains_of
from sim.terrains.ground import GroundMaps
from sim.terrains.hand_crafted import CROSSING_TYPES, NUM_COLS, NUM_ROWS, hand_crafted_crossings
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from train.task.curriculum import Tiles

_MIX_KEY = 20250607  # with the seed and the number of the exchange, the entropy of its terrains
_REMEMBERED = ("rows", "episodes", "crossed")
_LEAST_WEIGHT = 0.1  # of a terrain that is drawn least, beside 1 more for one that is drawn most


@dataclass(kw_only=True)
class Mix:
    """Draws the terrains of each exchange, and remembers how often each elite was crossed when it was last trained on.

    What is drawn follows from the seed, the number of the exchange and, for ``failing`` and ``learnable``, what was
    crossed before, all of which a checkpoint keeps: a resumed training goes on with the same terrains.
    """

    kind: Literal["generated", "hard-random", "hand-crafted"]
    """What half of the terrains are, the paper's C-G and C-HR, beside hand-crafted ones; or those alone, its C-HC."""
    num_terrains: int
    draw: Draw = "uniform"
    """How elites are drawn (:class:`train.cfg.RecipeCfg`)."""
    genes: tuple[NDArray[np.float32], ...]
    """Elites to train on, a part of each archive, shape (E, genes of its space); E sums up over the parts. None except
    with mix generated."""
    seed: int
    device: str
    spaces: tuple[TerrainSpace, ...] = (SUPER_GAUSSIAN,)
    """What the genes of each part mean; the first is that of hard-random terrains. Hand-crafted ones are as much lower
    than usual as the lowest of them."""
    goal_rate: NDArray[np.float64] | None = None
    """Goal rate of each elite as its archive has it, shape (E,), which stands in until it is trained on; None: 0."""
    swap: int = -1
    """Number of the present exchange, from 0."""
    rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Which elites are trained on, in the order of their terrains after the hand-crafted ones."""
    episodes: NDArray[np.int64] = field(init=False)
    """Valid episodes that ended on each elite when it was last trained on before the present exchange, shape (E,)."""
    crossed: NDArray[np.int64] = field(init=False)
    """How many of them reached the goal."""

    def __post_init__(self) -> None:
        self.num_elites = sum(map(len, self.genes))
        self.num_hand_crafted = self.num_terrains if self.kind == "hand-crafted" else self.num_terrains // 2
        self.episodes = np.zeros(self.num_elites, np.int64)
        self.crossed = np.zeros(self.num_elites, np.int64)
        self._before_resume = np.zeros((2, self.num_elites), np.int64)

    def next(self, counts: dict[str, NDArray[Any]] | None = None) -> Tiles:
        """The terrains of the next exchange.

        ``counts`` say what became of the present ones (:meth:`train.task.task.CommandTask.counts`). It replaces what
        was known of their elites: the controller was another then.
        """
        if counts is not None:
            episodes, crossed = self._present(counts)
            known = episodes > 0
            self.episodes[known], self.crossed[known] = episodes[known], crossed[known]
            self._before_resume[:] = 0
        self.swap += 1
        self.rows = self.draw_rows()
        return self.terrains()

    def terrains(self) -> Tiles:
        """The terrains of the present exchange: one level, a terrain a column, hand-crafted ones first."""
        rng = self._rng(0)
        heights, numbers, _ = hand_crafted_crossings(self.num_hand_crafted, rng)
        heights *= np.float32(min(space.height_share for space in self.spaces))
        types = tuple(CROSSING_TYPES[number] for number in numbers)
        if self.kind == "hand-crafted":
            return Tiles(heights=heights, type_of_column=types)
        count = self.num_terrains - self.num_hand_crafted
        if self.kind == "generated":
            others, ground = self._elites()
        else:
            others, ground = terrains_of(self.spaces[0].hard_random(count, rng), self.spaces[0], device=self.device)
        if ground is not None:
            ground = GroundMaps.plain(self.num_hand_crafted).joined(ground)
        heights = np.concatenate([heights, others])
        return Tiles(heights=heights, type_of_column=(*types, *(self.kind,) * count), ground=ground)

    def state(self, counts: dict[str, NDArray[Any]]) -> dict[str, Any]:
        """Plain values for a checkpoint, with what was counted on the present terrains so far."""
        present = self._present(counts)
        return {
            "swap": self.swap,
            "goal_rate": None if self.goal_rate is None else self.goal_rate.tolist(),
            **{name: getattr(self, name).tolist() for name in _REMEMBERED},
            "present_episodes": present[0].tolist(),
            "present_crossed": present[1].tolist(),
        }

    def restore(self, state: dict[str, Any]) -> Tiles:
        """Go on where a checkpoint was; returns its terrains."""
        if state["goal_rate"] is not None:
            self.goal_rate = np.asarray(state["goal_rate"], np.float64)
        self.swap = state["swap"]
        self.rows, self.episodes, self.crossed = (np.asarray(state[name], np.int64) for name in _REMEMBERED)
        self._before_resume = np.asarray([state["present_episodes"], state["present_crossed"]], np.int64)
        return self.terrains()

    def success(self) -> NDArray[np.float64]:
        """Share of the episodes on each elite that crossed it, shape (E,); without any what its archive says, or 0."""
        before = 0.0 if self.goal_rate is None else self.goal_rate
        return np.where(self.episodes > 0, self.crossed / np.maximum(self.episodes, 1), before)

    def _elites(self) -> tuple[NDArray[np.float32], GroundMaps | None]:
        """Heights of the present elites, shape (rows, NUM_ROWS, NUM_COLS), and their ground if any space has maps."""
        heights = np.empty((len(self.rows), NUM_ROWS, NUM_COLS), np.float32)
        ground = None
        if any(space.ground or space.conditions for space in self.spaces):
            ground = GroundMaps.plain(len(self.rows))
            if any(space.conditions for space in self.spaces):
                ground = replace(ground, conditions=ground.rows)
        first = 0
        for genes, space in zip(self.genes, self.spaces, strict=True):
            (places,) = np.nonzero((first <= self.rows) & (self.rows < first + len(genes)))
            if len(places):
                heights[places], maps = terrains_of(genes[self.rows[places] - first], space, device=self.device)
                if ground is not None and maps is not None:
                    ground.friction[places], ground.time_constant_s[places] = maps.friction, maps.time_constant_s
                    if ground.conditions is not None:
                        ground.conditions[places] = maps.rows
            first += len(genes)
        return heights, ground

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([_MIX_KEY, self.seed, self.swap, stream])

    def draw_rows(self) -> NDArray[np.int64]:
        """Elites of the next exchange: none twice, unless there are too few."""
        if self.kind != "generated":
            return np.zeros(0, np.int64)
        rng, count, wanted = self._rng(1), self.num_elites, self.num_terrains - self.num_hand_crafted
        whole = np.tile(np.arange(count), wanted // count)
        rate = self.success()
        preferred = {
            "uniform": np.ones(count),
            "failing": 1.0 - rate + _LEAST_WEIGHT,
            "learnable": 4.0 * rate * (1.0 - rate) + _LEAST_WEIGHT,
        }[self.draw]
        weights = self._in_equal_shares(preferred) if len(self.genes) > 1 else preferred
        rest = rng.choice(count, size=wanted - len(whole), replace=False, p=weights / weights.sum())
        return np.concatenate([whole, rest])

    def _in_equal_shares(self, preferred: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same with a sum of 1 in each part that has elites, shape (E,)."""
        parts = np.split(preferred, np.cumsum([len(part) for part in self.genes])[:-1])
        return np.concatenate([part / part.sum() if len(part) else part for part in parts])

    def _present(self, counts: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
        """Valid episodes on each elite since the last exchange, and those that crossed it, shape (2, E)."""
        present = self._before_resume.copy()
        if self.kind == "generated":
            num_envs = len(counts["episodes"])
            terrain = np.arange(num_envs) * self.num_terrains // num_envs  # as Tiles.columns_of deals them out
            on_elite = terrain >= self.num_hand_crafted
            rows = self.rows[terrain[on_elite] - self.num_hand_crafted]
            valid = counts["episodes"] - counts["invalid"]
            for sums, part in zip(present, (valid, counts["goal"]), strict=True):
                sums += np.bincount(rows, part[on_elite], self.num_elites).astype(np.int64)
        return present
