"""Quality-Diversity over the reachable cells: emitters that ask for terrains, and the archives they are told into.

The cells are numbered, so a pyribs archive has one dimension with one unit a cell, and a terrain's measure is the
middle of its cell. Evolution strategies search unbounded; archives hold the unclipped solutions for them, and the
clipped genes as data.
"""

from collections.abc import Iterator
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter, IsoLineEmitter

from qd.search.descriptors import Cells
from qd.search.fitness import FITNESS_FLOOR, Evaluation, FitnessCfg, rows_of
from qd.search.pool import Pool
from qd.search.presets import SchedulerCfg
from qd.search.surrogate import Surrogate
from sim.terrains.spaces.base import TerrainSpace, clipped
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

_INVALID_VALUE = -1e3  # an invalid terrain ranks below any other that was not accepted


class RandomEmitter:
    """Asks for terrains drawn anew each time by ``uniform_random`` or ``hard_random``."""

    def __init__(self, space: TerrainSpace, method: str, batch_size: int, stream: np.random.SeedSequence) -> None:
        self.method, self.batch_size = method, batch_size
        self.space, self.space_sha256 = space.name, space.sha256  # a checkpoint holds no code
        self._rng = np.random.default_rng(stream)

    def ask(self) -> NDArray[np.float32]:
        """Genes, shape (batch_size, num_genes)."""
        space = get_space(self.space, self.space_sha256)
        draw = space.uniform_random if self.method == "uniform_random" else space.hard_random
        return draw(self.batch_size, self._rng)


class SurrogateEmitter:
    """Asks for what the surrogate proposes, of which a scheduler has one for all such emitters."""

    def __init__(self, batch_size: int) -> None:
        self.batch_size = batch_size


class Asked(NamedTuple):
    """Terrains that robots are to cross."""

    solutions: NDArray[np.float32]
    """Unclipped genes, shape (T, num_genes)."""
    number: NDArray[np.int64]
    """Numbers of those that are crossed again (:class:`qd.search.pool.Pool`); -1 of new ones, shape (T,)."""

    @property
    def new(self) -> NDArray[np.float32]:
        """Unclipped genes of the new ones."""
        return self.solutions[self.number < 0]


Emitter = EvolutionStrategyEmitter | IsoLineEmitter | RandomEmitter | SurrogateEmitter


class Scheduler:
    """The state of a search, which a checkpoint holds: ask for genes, tell what became of them.

    ``result`` keeps the best terrain ever found in each cell and is what a search is run for. ``archive`` is what
    CMA-MAE's emitters are judged by: their own, with thresholds that lag behind. All others go by ``result``, and where
    there are none of CMA-MAE's, ``archive`` is ``result``. Where terrains are crossed again, ``result`` has those that
    hold the cells of ``pool``.
    """

    def __init__(
        self, cfg: SchedulerCfg, *, cells: Cells, fitness: FitnessCfg, seed: int, space: TerrainSpace = SUPER_GAUSSIAN
    ) -> None:
        *streams, surrogate_stream = np.random.SeedSequence(seed).spawn(cfg.emitters + 3)
        methods = list(zip(cycle(cfg.methods), streams[2:], strict=False))
        names = {method for method, _ in methods}
        # Not learning_rate=1 with a threshold: told two terrains of a cell at once, that keeps the better one but sets
        # the threshold to their mean, and a later, worse one may replace it.
        self.result = self.archive = _make_archive(space.num_genes, cells, streams[1])
        if "cma_mae" in names:
            self.archive = _make_archive(
                space.num_genes, cells, streams[0], learning_rate=cfg.learning_rate, threshold_min=FITNESS_FLOOR
            )
        self.surrogate = Surrogate(cfg, cells, space, surrogate_stream) if "surrogate" in names else None
        self.emitters: list[Emitter] = [self._make_emitter(cfg, method, space, stream) for method, stream in methods]
        self.again, self.pool = cfg.again, Pool(space.num_genes, cells, fitness) if cfg.again else None
        self._asked: list[Asked | None] = [None] * cfg.num_groups

    def _make_emitter(self, cfg: SchedulerCfg, method: str, space: TerrainSpace, stream: Any) -> Emitter:
        if method.endswith("random"):
            return RandomEmitter(space, method, cfg.batch_size, stream)
        if method == "surrogate":
            return SurrogateEmitter(cfg.batch_size)
        if method == "map_elites":
            first, later = stream.spawn(2)
            return IsoLineEmitter(
                self.result,
                iso_sigma=cfg.iso_sigma,
                line_sigma=cfg.line_sigma,
                initial_solutions=space.hard_random(cfg.batch_size, np.random.default_rng(first)),
                bounds=[(-1.0, 1.0)] * space.num_genes,
                batch_size=cfg.batch_size,
                seed=later,
            )
        improves = method == "cma_me"  # ranks and selects by what is new in the archive, and restarts without it
        return EvolutionStrategyEmitter(
            self.result if improves else self.archive,
            x0=np.zeros(space.num_genes),
            sigma0=space.sigma0 if cfg.sigma0 is None else cfg.sigma0,
            ranker="2imp" if improves else "imp",
            selection_rule="filter" if improves else "mu",
            restart_rule="no_improvement" if improves else cfg.restart_rule,
            batch_size=cfg.batch_size,
            seed=stream,
        )

    def _emitters_of(self, group: int) -> slice:
        """Places of a group's emitters: groups are of the same size, as far as that goes."""
        count, num_groups = len(self.emitters), len(self._asked)
        return slice(group * count // num_groups, (group + 1) * count // num_groups)

    def places(self, group: int) -> slice:
        """Places of a group's terrains among those of an iteration."""
        emitters, each = self._emitters_of(group), int(self.emitters[0].batch_size) + self.again
        return slice(emitters.start * each, emitters.stop * each)

    def ask(self, group: int = 0, *, new: bool = True) -> NDArray[np.float32]:
        """The next terrains of a group of emitters; the same ones until the group is told their results.

        Behind the emitters' come those that are crossed again, as soon as there are any. Without ``new`` ones all are
        crossed again. Clipped genes, shape (at most emitters of the group * (batch_size + again), num_genes).
        """
        asked = self._asked[group]
        if asked is None:
            emitters = self.emitters[self._emitters_of(group)] if new or not self.pool else []
            proposals = self._propose([emitter for emitter in emitters if isinstance(emitter, SurrogateEmitter)])
            solutions = [
                next(proposals) if isinstance(emitter, SurrogateEmitter) else emitter.ask() for emitter in emitters
            ]
            number = np.full(sum(map(len, solutions)), -1)
            if self.pool is not None:
                places = self.places(group)
                again = self.pool.least_known(places.stop - places.start - len(number), self._under_way())
                solutions.append(self.pool.solutions_of(again))
                number = np.append(number, again)
            asked = self._asked[group] = Asked(np.concatenate(solutions), number)
        return clipped(asked.solutions)

    def _under_way(self) -> NDArray[np.int64]:
        """Numbers of the terrains that robots are to cross again already."""
        numbers = [asked.number[asked.number >= 0] for asked in self._asked if asked]
        return np.concatenate([np.zeros(0, np.int64), *numbers])

    def _propose(self, emitters: list[SurrogateEmitter]) -> Iterator[NDArray[np.float32]]:
        """What the surrogate proposes for some emitters: one search for all, so that no two ask for the same."""
        if self.surrogate is None or not emitters:
            return iter(())
        data: Any = self.result.data()
        under_way = [clipped(asked.new) for asked in self._asked if asked]
        sizes = [emitter.batch_size for emitter in emitters]
        genes = self.surrogate.propose(
            sum(sizes), data["genes"], data["index"], data["objective"], np.concatenate([data["genes"][:0], *under_way])
        )
        return iter(np.split(genes, np.cumsum(sizes)[:-1]))

    def tell(self, evaluation: Evaluation, iteration: int, group: int = 0) -> int:
        """Tells a group of emitters what became of the terrains that it last asked for, one row each in that order.

        Iterations are numbered from 1. Returns how many of the terrains were new.
        """
        asked = self._asked[group]
        assert asked is not None
        self._asked[group] = None
        if self.pool is not None:
            evaluation = self.pool.tell(*asked, evaluation, iteration)
        if self.surrogate is not None:
            self.surrogate.learn(asked.solutions, evaluation)
        rows = _rows_of(asked.solutions, evaluation, iteration)
        added_to_result = self._add_to_result(rows, evaluation.valid & (evaluation.fitness > FITNESS_FLOOR))
        added = added_to_result if self.archive is self.result else self.archive.add(**rows)
        if self.pool is not None:
            self._make_result(self.pool)
        emitters = self.emitters[self._emitters_of(group)]
        if self.archive.empty or not len(asked.new):
            emitters = []  # without a valid terrain yet, one that restarts now would have no elite to start from
        first = 0
        for emitter in emitters:
            batch = slice(first, first + int(emitter.batch_size))
            first = batch.stop
            if isinstance(emitter, EvolutionStrategyEmitter):  # no other learns by itself
                add_info = added_to_result if emitter.archive is self.result else added
                emitter.tell(
                    **{name: values[batch] for name, values in rows.items()},
                    add_info={name: values[batch] for name, values in add_info.items()},
                )
        return len(asked.new)

    def _make_result(self, pool: Pool) -> None:
        """Makes ``result`` anew, of the terrains that hold the cells."""
        rows = pool.settle(self._under_way())
        self.result.clear()
        if len(rows):
            assert pool.terrains is not None
            self.result.add(**_rows_of(pool.solutions[rows], rows_of(pool.terrains, rows), pool.iteration[rows]))

    def _add_to_result(self, rows: dict[str, NDArray[Any]], accepted: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        """Fills ``result``; status and value of each terrain as pyribs gives them to its emitters."""
        added = {"status": np.zeros(len(accepted), np.int32), "value": np.full(len(accepted), _INVALID_VALUE)}
        if accepted.any():
            for name, values in self.result.add(**{name: column[accepted] for name, column in rows.items()}).items():
                added[name][accepted] = values
        return added

    def elites(self) -> dict[str, NDArray[Any]]:
        """The elites in order of descending fitness, as the arrays of an :class:`qd.search.archive.Archive`."""
        data: Any = self.result.data()
        order = np.lexsort((data["index"], -data["objective"]))
        elites = {name: data[name][order] for name in _FIELDS}
        return elites | {"fitness": data["objective"][order], "cell": data["index"][order].astype(np.int64)}


_RATES = ("collision_rate", "goal_rate", "fallen_rate")
_COUNTS = ("invalid_episodes", "episodes", "iteration")
_BY_RATIO = ("ratios", "penalty_mean", "penalty_std")
_FIELDS = ("genes", *_BY_RATIO, *_RATES, *_COUNTS, "end_position")


def _rows_of(
    solutions: NDArray[np.float32], terrains: Evaluation, iteration: NDArray[np.int64] | int
) -> dict[str, NDArray[Any]]:
    """Terrains as a pyribs archive takes them, of unclipped genes (T, num_genes), with when each was found."""
    columns = {name: getattr(terrains, name) for name in _FIELDS if name not in ("genes", "iteration")}
    return columns | {
        "solution": solutions,
        "objective": terrains.fitness,
        "measures": terrains.cell[:, None] + 0.5,
        "genes": clipped(solutions),
        "iteration": np.broadcast_to(iteration, len(solutions)),
    }


def _make_archive(num_genes: int, cells: Cells, stream: np.random.SeedSequence, **learning: Any) -> GridArchive:
    extra_fields: dict[str, Any] = {
        "genes": ((num_genes,), np.float32),
        **dict.fromkeys(_BY_RATIO, ((cells.num_ratios,), np.float64)),
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
