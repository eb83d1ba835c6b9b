"""Terrains of trainings: a grid of tiles, harder level by level, or a mix of two kinds, exchanged at intervals."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.terrains import hand_crafted
from sim.terrains.bank import make_terrains
from sim.terrains.hand_crafted import NUM_COLS, NUM_LEVELS, NUM_ROWS
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.terrains import GroundMaps
from train.cfg import CurriculumCfg, FinetuneCfg

_MIX_KEY = 20250607  # with the seed and the number of the exchange, the entropy of its terrains
_SAVED = ("rows", "episodes", "crossed")
_MIN_WEIGHT = 0.1  # added to weights from 0 to 1, so that every elite can be drawn


@dataclass(frozen=True, kw_only=True)
class Tiles:
    """Training terrains; the tile of a level and a column is number ``level * num_columns + column``."""

    heights: np.ndarray
    """Heights [m] float32, shape (num_levels * num_columns, NUM_ROWS, NUM_COLS); the robot starts at (8, 4)."""
    type_of_column: tuple[str, ...]
    ground: GroundMaps | None = None
    """Friction and softness of each terrain; None where no terrain has any."""

    @property
    def num_columns(self) -> int:
        """Columns of the grid."""
        return len(self.type_of_column)

    @property
    def num_levels(self) -> int:
        """Levels of the grid."""
        return len(self.heights) // self.num_columns

    def assign_columns(self, num_envs: int) -> np.ndarray:
        """Column of each environment, int32 of shape (num_envs,): in order, equally many each."""
        return (np.arange(num_envs) * self.num_columns // num_envs).astype(np.int32)


def make_tiles(cfg: CurriculumCfg, seed: int) -> Tiles:
    """Generate the tiles of a training run."""
    if cfg.num_columns + cfg.noise_columns < 1:
        raise ValueError("the curriculum needs at least one column, got num_columns 0 and noise_columns 0")
    tile_rng, noise_rng = np.random.default_rng(seed).spawn(2)
    grid = np.empty((NUM_LEVELS, cfg.num_columns + cfg.noise_columns, NUM_ROWS, NUM_COLS), np.float32)
    tiles, type_index = hand_crafted.training_tiles(cfg.num_columns, tile_rng)
    grid[:, : cfg.num_columns] = tiles.reshape(NUM_LEVELS, cfg.num_columns, NUM_ROWS, NUM_COLS)
    for level, column in np.ndindex(NUM_LEVELS, cfg.noise_columns):
        grid[level, cfg.num_columns + column] = hand_crafted.crossing_terrain("noise", level, noise_rng)
    types = (*(hand_crafted.TILE_TYPES[k] for k in type_index), *("noise",) * cfg.noise_columns)
    return Tiles(heights=grid.reshape(-1, NUM_ROWS, NUM_COLS), type_of_column=types)


@dataclass(frozen=True, kw_only=True)
class TrainingElites:
    """E elites to train on, by archive."""

    genes: tuple[NDArray[np.float32], ...]
    """Genes from each archive, shape (elites of the archive, genes of its space)."""
    spaces: tuple[TerrainSpace, ...]
    """Space of each archive; without elites, that of hard-random terrains."""
    goal_rate: NDArray[np.float64] | None = None
    """Goal rate of each elite in its archive, shape (E,)."""
    archives: list[dict[str, Any]] = field(default_factory=list)
    """Sizes and hash of each archive, for the record."""


class Mix:
    """Draws the terrains of each exchange, and counts how often each elite was crossed when it was last trained on.

    A checkpoint has all that a draw depends on, so a resumed training goes on with the same terrains.

    Attributes:
        goal_rate: Goal rate of each elite, shape (E,), until the elite is trained on; None: 0.
        swap: Number of the present exchange, from 0.
        rows: Present elites, in the order of their terrains after the hand-crafted ones.
        episodes: Valid episodes on each elite when it was last trained on before the present exchange, shape (E,).
        crossed: How many of them reached the goal.
    """

    def __init__(self, cfg: FinetuneCfg, elites: TrainingElites, device: str) -> None:
        self.cfg, self.elites, self.device = cfg, elites, device
        self.num_elites = sum(map(len, elites.genes))
        self.num_hand_crafted = cfg.terrains if cfg.mix == "hand-crafted" else cfg.terrains // 2
        self.goal_rate = elites.goal_rate if cfg.recipe.draw == "learnable" else None
        self.swap, self.rows = -1, np.zeros(0, np.int64)
        self.episodes, self.crossed = np.zeros((2, self.num_elites), np.int64)
        self._before_resume = np.zeros((2, self.num_elites), np.int64)

    def next(self, counts: dict[str, NDArray[Any]] | None = None) -> Tiles:
        """The next terrains; ``counts`` of the present ones replace those that their elites had before."""
        if counts is not None:
            episodes, crossed = self._count_present(counts)
            self.episodes = np.where(episodes > 0, episodes, self.episodes)
            self.crossed = np.where(episodes > 0, crossed, self.crossed)
            self._before_resume[:] = 0
        self.swap += 1
        self.rows = self.draw_rows()
        return self.terrains()

    def terrains(self) -> Tiles:
        """The terrains of the present exchange: one level, a terrain a column, hand-crafted ones first."""
        rng, spaces = self._rng(0), self.elites.spaces
        first = self.num_hand_crafted
        heights, numbers, _ = hand_crafted.hand_crafted_crossings(first, rng)
        heights *= np.float32(min(space.height_share for space in spaces))
        types = tuple(hand_crafted.CROSSING_TYPES[number] for number in numbers)
        if self.cfg.mix == "hand-crafted":
            return Tiles(heights=heights, type_of_column=types)
        count = self.cfg.terrains - first
        rows, genes = self.rows, self.elites.genes
        if self.cfg.mix == "hard-random":
            rows, genes = np.arange(count), (spaces[0].hard_random(count, rng),)
        heights = np.concatenate([heights, np.empty((count, NUM_ROWS, NUM_COLS), np.float32)])
        ground = GroundMaps.plain(first)
        if any(space.has_conditions for space in spaces):
            ground = replace(ground, conditions=ground.rows)
        order = [np.arange(first)]
        start = 0
        for elites, space in zip(genes, spaces, strict=True):
            (drawn,) = np.nonzero((start <= rows) & (rows < start + len(elites)))
            if len(drawn):
                heights[first + drawn], maps = make_terrains(elites[rows[drawn] - start], space, device=self.device)
                ground = ground.joined(maps or GroundMaps.plain(len(drawn)))
                order.append(first + drawn)
            start += len(elites)
        is_plain = not any(space.ground or space.has_conditions for space in spaces)
        ground = None if is_plain else ground[np.argsort(np.concatenate(order))]
        return Tiles(heights=heights, type_of_column=(*types, *(self.cfg.mix,) * count), ground=ground)

    def state(self, counts: dict[str, NDArray[Any]]) -> dict[str, Any]:
        """Plain values for a checkpoint, with the counts on the present terrains so far."""
        present = zip(("present_episodes", "present_crossed"), self._count_present(counts).tolist(), strict=True)
        goal_rate = None if self.goal_rate is None else self.goal_rate.tolist()
        saved = {name: getattr(self, name).tolist() for name in _SAVED}
        return {"swap": self.swap, "goal_rate": goal_rate, **saved, **dict(present)}

    def restore(self, state: dict[str, Any]) -> Tiles:
        """Restore the state of a checkpoint; returns its terrains."""
        if state["goal_rate"] is not None:
            self.goal_rate = np.asarray(state["goal_rate"], np.float64)
        self.swap = state["swap"]
        self.rows, self.episodes, self.crossed = (np.asarray(state[name], np.int64) for name in _SAVED)
        self._before_resume = np.asarray([state["present_episodes"], state["present_crossed"]], np.int64)
        return self.terrains()

    def success(self) -> NDArray[np.float64]:
        """Rate at which each elite was crossed, shape (E,); its archive's goal rate, or 0, before any episode."""
        initial = 0.0 if self.goal_rate is None else self.goal_rate
        return np.where(self.episodes > 0, self.crossed / np.maximum(self.episodes, 1), initial)

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([_MIX_KEY, self.cfg.seed, self.swap, stream])

    def draw_rows(self) -> NDArray[np.int64]:
        """Elites of the next exchange: none twice, unless there are too few."""
        if self.cfg.mix != "generated":
            return np.zeros(0, np.int64)
        rng, count = self._rng(1), self.num_elites
        num_drawn = self.cfg.terrains - self.num_hand_crafted
        all_elites = np.tile(np.arange(count), num_drawn // count)
        rate = self.success()
        weights = {
            "uniform": np.ones(count),
            "failing": 1.0 - rate + _MIN_WEIGHT,
            "learnable": 4.0 * rate * (1.0 - rate) + _MIN_WEIGHT,
        }[self.cfg.recipe.draw]
        if len(self.elites.genes) > 1:  # each archive gets an equal share
            by_archive = np.split(weights, np.cumsum([len(genes) for genes in self.elites.genes])[:-1])
            weights = np.concatenate([values / values.sum() if len(values) else values for values in by_archive])
        rest = rng.choice(count, size=num_drawn - len(all_elites), replace=False, p=weights / weights.sum())
        return np.concatenate([all_elites, rest])

    def _count_present(self, counts: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
        """Valid episodes on each elite since the last exchange, and those that crossed it, shape (2, E)."""
        present = self._before_resume.copy()
        if self.cfg.mix == "generated":
            num_envs = len(counts["episodes"])
            terrain = np.arange(num_envs) * self.cfg.terrains // num_envs  # as Tiles.assign_columns does
            on_elite = terrain >= self.num_hand_crafted
            rows = self.rows[terrain[on_elite] - self.num_hand_crafted]
            valid = counts["episodes"] - counts["invalid"]
            for sums, values in zip(present, (valid, counts["goal"]), strict=True):
                sums += np.bincount(rows, values[on_elite], self.num_elites).astype(np.int64)
        return present
