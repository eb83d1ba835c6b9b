"""The terrain of each environment: a grid of tiles, harder level by level, one type a column."""

from dataclasses import dataclass

import numpy as np

from sim.terrains.ground import GroundMaps
from sim.terrains.hand_crafted import NUM_COLS, NUM_LEVELS, NUM_ROWS, TILE_TYPES, crossing_terrain, training_tiles
from train.task.cfg import CurriculumCfg


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
    types = ("noise",) * cfg.noise_columns
    if cfg.num_columns:
        tiles, type_index = training_tiles(cfg.num_columns, tile_rng)
        grid[:, : cfg.num_columns] = tiles.reshape(NUM_LEVELS, cfg.num_columns, NUM_ROWS, NUM_COLS)
        types = (*(TILE_TYPES[k] for k in type_index), *types)
    for level, column in np.ndindex(NUM_LEVELS, cfg.noise_columns):
        grid[level, cfg.num_columns + column] = crossing_terrain("noise", level, noise_rng)
    return Tiles(heights=grid.reshape(-1, NUM_ROWS, NUM_COLS), type_of_column=types)
