"""Terrains as height grids: hand-crafted crossings, and the tiles of the training curriculum.

Every grid is 16 m x 8 m at 0.05 m: heights [m] of shape ``(NUM_ROWS, NUM_COLS)``, row along y (0..8 m), column along x
(0..16 m). A feature fills the 8 m x 8 m square 4 <= x <= 12 in the middle. A crossing starts at (2, 4) on flat ground
before it; a training tile starts at (8, 4), in the tile's centre.

Level l in 0..9 sets the difficulty d = l / 10 (after Rudin et al. 2022, the paper's reference for its hand-crafted
terrains): gradient 0.4 d, step height 0.05 + 0.18 d m (tread 0.31 m), obstacle height 0.05 + 0.2 d m, roughness
+-0.05 m; crossings add noise of +-(0.02 + 0.08 d) m. Heights are sampled at the nodes: a riser is one cell wide.

Every random terrain has its own generator, spawned from the seed: terrain i does not depend on how many are drawn.
"""

import numpy as np

Seed = int | np.random.Generator
"""What the generators draw from. A Generator gives other terrains on each call, an int the same ones."""

SPACING = 0.05
"""Distance of neighbouring nodes [m]."""
NUM_ROWS = 161
NUM_COLS = 321
NUM_LEVELS = 10

CROSSING_TYPES = ("slope", "rough_slope", "stairs_up_down", "stairs_down_up", "boxes", "noise")
TILE_TYPES = ("slope", "rough_slope", "stairs_up", "stairs_down", "obstacles")

_SIDE = NUM_ROWS  # nodes along one side of the feature square
_FIRST_COL = (NUM_COLS - _SIDE) // 2  # column at x = 4 m
TILE_SHARES_PERCENT = np.array([10, 10, 35, 25, 20])
"""How often legged_gym's curriculum has each of :data:`TILE_TYPES`."""

# Centimetres as integers: 0.31 m treads fall on nodes exactly, with no rounding at a riser.
_NODES_CM = 5 * np.arange(_SIDE)
_EDGE_DISTANCE_CM = np.minimum(_NODES_CM, _NODES_CM[-1] - _NODES_CM)
_INSET_CROSSING_CM = np.broadcast_to(_EDGE_DISTANCE_CM, (_SIDE, _SIDE))  # the feature is the same at every y
_INSET_TILE_CM = np.minimum(_EDGE_DISTANCE_CM[:, None], _EDGE_DISTANCE_CM)  # a pyramid
_FLANK_CM = 250  # from the edge to the 3 m platform
_TREAD_CM = 31

_PATCH_NODES = 4  # 0.2 m: roughness is drawn at this distance and interpolated; noise is drawn a patch
_ROUGHNESS = 0.05
_NUM_BOXES = 20
_BOX_CELLS = (20, 40)  # 1 m to 2 m


def _roughness(rng: np.random.Generator) -> np.ndarray:
    """Uniform heights of +-0.05 m drawn every 0.2 m, bilinearly interpolated; 0 at x = 4 and x = 12."""
    coarse = np.arange(0, _SIDE, _PATCH_NODES)
    drawn = rng.uniform(-_ROUGHNESS, _ROUGHNESS, (len(coarse), len(coarse)))
    drawn[:, [0, -1]] = 0.0
    weights = np.maximum(0.0, 1.0 - np.abs(np.arange(_SIDE)[:, None] - coarse) / _PATCH_NODES)
    return weights @ drawn @ weights.T


def _noise(rng: np.random.Generator, amplitude: float) -> np.ndarray:
    """Uniform heights of +-``amplitude`` [m], constant on patches of 0.2 m."""
    patches = -(-_SIDE // _PATCH_NODES)
    return np.kron(rng.uniform(-amplitude, amplitude, (patches, patches)), np.ones((_PATCH_NODES,) * 2))[:_SIDE, :_SIDE]


def _boxes(rng: np.random.Generator, height: float) -> np.ndarray:
    """20 boxes of 1-2 m sides, each ``height`` or half of it [m] above or below the ground; a later one overwrites."""
    heights = np.zeros((_SIDE, _SIDE))
    for _ in range(_NUM_BOXES):
        size_y, size_x = rng.integers(*_BOX_CELLS, size=2, endpoint=True)
        # Not at the edge, whose heights continue beyond a tile: a box there would become a ridge.
        row, col = (rng.integers(1, _SIDE - 1 - size) for size in (size_y, size_x))
        heights[row : row + size_y + 1, col : col + size_x + 1] = height * rng.choice([-1.0, -0.5, 0.5, 1.0])
    return heights


def _feature(kind: str, level: int, inset_cm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Heights [m] of the square of a crossing or a tile, whose nodes lie ``inset_cm`` inside its edge."""
    d = level / NUM_LEVELS
    slope = 0.4 * d * 0.01 * np.minimum(inset_cm, _FLANK_CM)
    # The first riser stands one tread inside the edge.
    stairs = (0.05 + 0.18 * d) * np.minimum(inset_cm // _TREAD_CM, _FLANK_CM // _TREAD_CM)
    return {
        "slope": lambda: slope,
        "rough_slope": lambda: slope + _roughness(rng),
        "stairs_up_down": lambda: stairs,
        "stairs_down_up": lambda: -stairs,
        "stairs_up": lambda: -stairs,
        "stairs_down": lambda: stairs,
        "boxes": lambda: _boxes(rng, 0.05 + 0.2 * d),
        "obstacles": lambda: np.where(inset_cm < _FLANK_CM, _boxes(rng, 0.05 + 0.2 * d), 0.0),
        "noise": lambda: _noise(rng, 0.02 + 0.08 * d),
    }[kind]()


def crossing_terrain(kind: str, level: int, seed: Seed) -> np.ndarray:
    """One hand-crafted crossing of :data:`CROSSING_TYPES`: heights [m], float32, shape (NUM_ROWS, NUM_COLS).

    The feature has the full width; for x <= 4 and x >= 12 the ground is flat at height 0. Levels go from 0 (nearly
    flat) to 9.
    """
    heights = np.zeros((NUM_ROWS, NUM_COLS), np.float32)
    feature = _feature(kind, level, _INSET_CROSSING_CM, np.random.default_rng(seed))
    # The nodes at x = 4 and x = 12 belong to the run-in and run-out.
    heights[:, _FIRST_COL + 1 : _FIRST_COL + _SIDE - 1] = feature[:, 1:-1]
    return heights


def hand_crafted_crossings(count: int, seed: Seed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hand-crafted crossings: the types of :data:`CROSSING_TYPES` in turn (equal shares), levels uniform in 0..9.

    Heights [m] are float32 of shape (count, NUM_ROWS, NUM_COLS), types, indices into :data:`CROSSING_TYPES`, and levels
    int of shape (count,).
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    types = np.arange(count) % len(CROSSING_TYPES)
    levels = np.empty(count, int)
    heights = np.empty((count, NUM_ROWS, NUM_COLS), np.float32)
    for i, rng in enumerate(np.random.default_rng(seed).spawn(count)):
        levels[i] = rng.integers(NUM_LEVELS)
        heights[i] = crossing_terrain(CROSSING_TYPES[types[i]], levels[i], rng)
    return heights, types, levels


def training_tile(kind: str, level: int, seed: Seed, *, inverted: bool = False) -> np.ndarray:
    """One 8 m x 8 m tile of the training curriculum in the middle of the grid; beyond it the edge heights continue.

    The robot starts in the centre, on the platform: it walks down from a slope, up from ``stairs_up`` (a pit) and down
    from ``stairs_down``. ``kind`` is one of :data:`TILE_TYPES`; levels go from 0 (nearly flat) to 9. ``inverted`` turns
    a slope into a pit, and no other type. Heights [m], float32, shape (NUM_ROWS, NUM_COLS).
    """
    tile = _feature(kind, level, _INSET_TILE_CM, np.random.default_rng(seed))
    if inverted and kind == "slope":
        tile = -tile
    return np.pad(tile, ((0, 0), (_FIRST_COL, _FIRST_COL)), mode="edge").astype(np.float32)


def training_tiles(num_columns: int, seed: Seed) -> tuple[np.ndarray, np.ndarray]:
    """The tiles of the training curriculum: a row a level from 0 up, a column a type.

    Columns go to :data:`TILE_TYPES` in order, in shares .1, .1, .35, .25, .2, which 20 and its multiples give exactly;
    every other smooth slope is inverted. Heights [m] are float32 of shape (NUM_LEVELS * num_columns, NUM_ROWS,
    NUM_COLS), the tile of a level and a column at index level * num_columns + column; types are indices into
    :data:`TILE_TYPES`, int of shape (num_columns,).
    """
    ends = np.cumsum(TILE_SHARES_PERCENT) * num_columns
    types = np.searchsorted(ends, 100 * np.arange(num_columns), side="right")
    heights = np.empty((NUM_LEVELS * num_columns, NUM_ROWS, NUM_COLS), np.float32)
    for i, rng in enumerate(np.random.default_rng(seed).spawn(len(heights))):
        level, column = divmod(i, num_columns)
        heights[i] = training_tile(TILE_TYPES[types[column]], level, rng, inverted=column % 2 == 1)
    return heights, types
