"""pyribs archives over the reachable cells, and terrains as rows of them.

The cells are numbered, so an archive has one dimension with one unit a cell, and a terrain's measure is the middle of
its cell. It holds unclipped solutions, for evolution strategies, and the clipped genes as data.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from ribs.archives import GridArchive

from qd.search.descriptors import Cells
from qd.search.fitness import Evaluation
from sim.terrains.spaces.base import clipped

_STATISTICS = ("ratios", "penalty_mean", "penalty_std")
_RATES = ("collision_rate", "goal_rate", "fallen_rate")
_COUNTS = ("invalid_episodes", "episodes", "iteration")
FIELDS = ("genes", *_STATISTICS, *_RATES, *_COUNTS, "end_position")
"""What an archive has of a terrain beside solution, objective and cell."""


def make_grid(num_genes: int, cells: Cells, stream: np.random.SeedSequence, **learning: Any) -> GridArchive:
    """An empty archive; ``learning`` are pyribs' ``learning_rate`` and ``threshold_min``."""
    extra_fields: dict[str, Any] = {
        "genes": ((num_genes,), np.float32),
        **dict.fromkeys(_STATISTICS, ((cells.num_ratios,), np.float64)),
        **dict.fromkeys(_RATES, ((), np.float64)),
        **dict.fromkeys(_COUNTS, ((), np.int64)),
        "end_position": ((2,), np.float32),
    }
    return GridArchive(
        solution_dim=num_genes,
        dims=[cells.num_cells],
        ranges=[(0, cells.num_cells)],
        seed=stream,  # pyright: ignore[reportArgumentType] - handed to numpy's default_rng, which takes it
        solution_dtype=np.float32,
        objective_dtype=np.float64,
        measures_dtype=np.float64,
        extra_fields=extra_fields,
        **learning,
    )


def grid_rows(
    solutions: NDArray[np.float32], terrains: Evaluation, iteration: NDArray[np.int64] | int
) -> dict[str, NDArray[Any]]:
    """Terrains as an archive takes them, of unclipped genes (T, num_genes), with the iteration that found each."""
    columns = {name: getattr(terrains, name) for name in FIELDS if name not in ("genes", "iteration")}
    return columns | {
        "solution": solutions,
        "objective": terrains.fitness,
        "measures": terrains.cell[:, None] + 0.5,
        "genes": clipped(solutions),
        "iteration": np.broadcast_to(iteration, len(solutions)),
    }
