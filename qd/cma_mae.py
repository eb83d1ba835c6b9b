"""CMA-MAE over the reachable cells: emitters that ask for terrains, and the two archives that they are told into.

The cells are numbered, so a pyribs archive has one dimension with one unit a cell, and a terrain's measure is the
middle of its cell. The search is unbounded; archives hold the unclipped solutions for the emitters, and the clipped
genes as data.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter

from qd import space
from qd.fitness import FITNESS_FLOOR, Evaluation
from qd.settings import CmaMaeCfg


class CmaMae:
    """The state of a search: ask for genes, tell what became of them.

    ``archive`` is CMA-MAE's own, with thresholds that lag behind; ``result`` keeps the best terrain ever found in each
    cell and is what a search is run for.

    Args:
        cfg: Settings.
        num_cells: Number of reachable cells.
        num_ratios: Number of ratio descriptors.
        seed: Seed of emitters and archives.
    """

    def __init__(self, cfg: CmaMaeCfg, *, num_cells: int, num_ratios: int, seed: int) -> None:
        streams = np.random.SeedSequence(seed).spawn(cfg.emitters + 2)
        learning = {"learning_rate": cfg.learning_rate, "threshold_min": FITNESS_FLOOR}
        self.archive = _make_archive(num_cells, num_ratios, streams[0], learning)
        # Not learning_rate=1 with a threshold: told two terrains of a cell at once, that keeps the better one but sets
        # the threshold to their mean, and a later, worse one may replace it.
        self.result = _make_archive(num_cells, num_ratios, streams[1], {})
        restart_rule: Any = int(cfg.restart_rule) if cfg.restart_rule.isdecimal() else cfg.restart_rule
        self.emitters = [
            EvolutionStrategyEmitter(
                self.archive,
                x0=np.zeros(space.NUM_GENES),
                sigma0=cfg.sigma0,
                ranker="imp",
                es=cfg.es,
                selection_rule="mu",
                restart_rule=restart_rule,
                batch_size=cfg.batch_size,
                seed=stream,  # pyright: ignore[reportArgumentType] - pyribs takes a SeedSequence, its hint does not say so
            )
            for stream in streams[2:]
        ]
        self._asked: NDArray[np.float32] | None = None

    def ask(self) -> NDArray[np.float32]:
        """The next terrains to evaluate.

        Returns:
            Clipped genes, shape (emitters * batch_size, 64).
        """
        self._asked = np.concatenate([emitter.ask() for emitter in self.emitters])
        return space.clip(self._asked)

    def tell(self, evaluation: Evaluation, iteration: int) -> None:
        """What became of the terrains last asked for.

        Args:
            evaluation: One row a terrain, in the order asked.
            iteration: Number of the iteration, from 1.

        Raises:
            RuntimeError: If nothing was asked for.
            ValueError: If the number of rows differs.
        """
        if self._asked is None:
            raise RuntimeError("tell() must follow ask(), got no terrains asked for")
        if len(evaluation.fitness) != len(self._asked):
            raise ValueError(f"evaluation must have {len(self._asked)} rows, got {len(evaluation.fitness)}")
        told = _rows(self._asked, evaluation, iteration)
        self._asked = None
        added = self.archive.add(**told)
        accepted = evaluation.valid & (evaluation.fitness > FITNESS_FLOOR)
        if accepted.any():
            self.result.add(**{name: rows[accepted] for name, rows in told.items()})
        if self.archive.empty:
            return  # nothing valid yet: an emitter that restarts now would have no elite to start from
        first = 0
        for emitter in self.emitters:
            own = slice(first, first + emitter.batch_size)
            emitter.tell(
                **{name: rows[own] for name, rows in told.items()},
                add_info={name: rows[own] for name, rows in added.items()},
            )
            first = own.stop

    def elites(self) -> dict[str, NDArray[Any]]:
        """The elites in order of descending fitness, as the arrays of an :class:`qd.archive.Archive`."""
        data: Any = self.result.data()
        order = np.lexsort((data["index"], -data["objective"]))
        elites = {name: data[name][order] for name in _FIELDS}
        return elites | {"fitness": data["objective"][order], "cell": data["index"][order].astype(np.int64)}

    def state(self) -> dict[str, Any]:
        """Everything a resumed search needs, valid between ``tell`` and ``ask``."""
        return {"archive": self.archive, "result": self.result, "emitters": self.emitters}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "CmaMae":
        """A search that goes on where another stood.

        Raises:
            ValueError: If the state is none of a search.
        """
        archive, result, emitters = (state.get(name) for name in ("archive", "result", "emitters"))
        if not (
            isinstance(archive, GridArchive)
            and isinstance(result, GridArchive)
            and isinstance(emitters, list)
            and emitters
            and all(isinstance(emitter, EvolutionStrategyEmitter) for emitter in emitters)
        ):
            raise ValueError("a search has two archives and a list of emitters, got something else")
        search = cls.__new__(cls)
        search.archive, search.result, search.emitters = archive, result, emitters
        search._asked = None
        return search


_FIELDS = (
    "genes",
    "ratios",
    "penalty_mean",
    "penalty_std",
    "collision_rate",
    "goal_rate",
    "fallen_rate",
    "invalid_episodes",
    "episodes",
    "iteration",
)


def _make_archive(num_cells: int, num_ratios: int, stream: np.random.SeedSequence, learning: dict) -> GridArchive:
    per_ratio = ((num_ratios,), np.float64)
    rate, count = ((), np.float64), ((), np.int64)
    shapes = ((space.NUM_GENES,), np.float32), per_ratio, per_ratio, per_ratio, rate, rate, rate, count, count, count
    return GridArchive(
        solution_dim=space.NUM_GENES,
        dims=[num_cells],
        ranges=[(0, num_cells)],
        seed=stream,  # pyright: ignore[reportArgumentType] - handed to numpy's default_rng, which takes it
        solution_dtype=np.float32,
        objective_dtype=np.float64,
        measures_dtype=np.float64,
        extra_fields=dict(zip(_FIELDS, shapes, strict=True)),
        **learning,
    )


def _rows(solutions: NDArray[np.float32], evaluation: Evaluation, iteration: int) -> dict[str, NDArray[Any]]:
    """What both archives are told: one row a terrain."""
    taken = {name: getattr(evaluation, name) for name in _FIELDS if name not in ("genes", "iteration")}
    return taken | {
        "solution": solutions,
        "objective": evaluation.fitness,
        "measures": evaluation.cell[:, None] + 0.5,
        "genes": space.clip(solutions),
        "iteration": np.full(len(solutions), iteration),
    }
