"""The state of a Quality-Diversity search: methods that ask for terrains, and the pyribs archive of the best ones.

An archive has one dimension, whose units are the reachable cells; a terrain's measure is the middle of its cell. It
holds unclipped solutions, for evolution strategies, and the clipped genes as data.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from ribs.archives import GridArchive

from qd.search.descriptors import Cells
from qd.search.fitness import FAILING_GOAL_RATE, FITNESS_FLOOR, Evaluation, FitnessCfg
from qd.search.methods import METHODS, Columns, Method, Setup
from qd.search.pool import Pool
from qd.search.presets import SchedulerCfg
from sim.terrains.spaces.base import TerrainSpace, clipped
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

_INVALID_VALUE = -1e3  # an invalid terrain ranks below any other that was not accepted
_STATISTICS = ("ratios", "penalty_mean", "penalty_std")
_RATES = ("collision_rate", "goal_rate", "fallen_rate")
_COUNTS = ("invalid_episodes", "episodes", "iteration")
_FIELDS = ("genes", *_STATISTICS, *_RATES, *_COUNTS, "end_position")  # beside solution, objective and measures


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


class Scheduler:
    """The state of a search, which a checkpoint holds: ask for genes, tell what became of them; methods take turns."""

    def __init__(
        self, cfg: SchedulerCfg, *, cells: Cells, fitness: FitnessCfg, seed: int, space: TerrainSpace = SUPER_GAUSSIAN
    ) -> None:
        self._num_genes, self._num_emitters = space.num_genes, cfg.emitters
        self._terrains_per_emitter = cfg.batch_size + cfg.again
        make_archive = partial(_make_archive, space.num_genes, cells)
        # Not learning_rate=1 with a threshold: told two terrains of a cell at once, that keeps the better one but sets
        # the threshold to their mean, and a later, worse one may replace it.
        self._archive = make_archive(np.random.SeedSequence(seed, spawn_key=(1,)))
        self.methods: list[Method] = []  # those that have emitters
        for first, name in enumerate(cfg.methods[: cfg.emitters]):
            numbers = tuple(range(first, cfg.emitters, len(cfg.methods)))
            setup = Setup(space, cells, self._archive, make_archive, seed, numbers, fitness)
            self.methods.append(METHODS[name](cfg, setup))
        self._pool = Pool(space.num_genes, cells, fitness) if cfg.again else None
        self._asked: list[Asked | None] = [None] * cfg.num_groups

    def compute_on(self, device: str) -> None:
        """Moves what methods compute to a Warp device."""
        for method in self.methods:
            method.compute_on(device)

    def _group_emitters(self, group: int) -> range:
        """Numbers of a group's emitters; the sizes of groups differ by at most 1."""
        count, num_groups = self._num_emitters, len(self._asked)
        return range(group * count // num_groups, (group + 1) * count // num_groups)

    def group_rows(self, group: int) -> slice:
        """Rows of a group's terrains among those of an iteration."""
        emitters = self._group_emitters(group)
        return slice(emitters.start * self._terrains_per_emitter, emitters.stop * self._terrains_per_emitter)

    def ask(self, group: int = 0, *, new: bool = True) -> NDArray[np.float32]:
        """Clipped genes, (T, num_genes), of a group's next terrains; the same ones until it is told their results.

        Behind the emitters' come those that are crossed again; without ``new`` ones all are crossed again.
        """
        asked = self._asked[group]
        if asked is None:
            solutions: list[NDArray[np.float32]] = []
            if new or not self._pool:
                emitters = self._group_emitters(group)
                no_genes = np.zeros((0, self._num_genes), np.float32)
                pending = np.concatenate([no_genes, *(clipped(asked.new) for asked in self._asked if asked)])
                batches: dict[int, NDArray[np.float32]] = {}
                for method in self.methods:
                    if chosen := [emitter for emitter in emitters if emitter in method.emitters]:
                        batches |= zip(chosen, np.split(method.ask(chosen, pending), len(chosen)), strict=True)
                solutions = [batches[emitter] for emitter in emitters]
            number = np.full(sum(map(len, solutions)), -1)
            if self._pool is not None:
                rows = self.group_rows(group)
                again = self._pool.least_known(rows.stop - rows.start - len(number), self._pending_numbers())
                solutions.append(self._pool.solutions[np.searchsorted(self._pool.number, again)])
                number = np.append(number, again)
            asked = self._asked[group] = Asked(np.concatenate(solutions), number)
        return clipped(asked.solutions)

    def _pending_numbers(self) -> NDArray[np.int64]:
        """Numbers of the terrains that robots are to cross again already."""
        numbers = np.concatenate([np.zeros(0, np.int64), *(asked.number for asked in self._asked if asked)])
        return numbers[numbers >= 0]

    def tell(self, evaluation: Evaluation, iteration: int, group: int = 0) -> int:
        """Tells a group of emitters what became of the terrains that it last asked for; returns how many were new."""
        asked = self._asked[group]
        assert asked is not None
        self._asked[group] = None
        if self._pool is not None:
            evaluation = self._pool.tell(*asked, evaluation, iteration)
        rows = _archive_rows(asked.solutions, evaluation, iteration)
        accepted = evaluation.valid & (evaluation.fitness > FITNESS_FLOOR)
        added = {"status": np.zeros(len(accepted), np.int32), "value": np.full(len(accepted), _INVALID_VALUE)}
        if accepted.any():
            for name, values in self._archive.add(**{name: column[accepted] for name, column in rows.items()}).items():
                added[name][accepted] = values
        if (pool := self._pool) is not None and pool.terrains is not None:
            if (surrogate := self._surrogate) is not None:
                genes = clipped(pool.solutions)
                pool.share = surrogate.find_share(genes, surrogate.find_chance(genes, pool.terrains.goal_rate))
            held = pool.settle(self._pending_numbers())  # the archive is made anew, of those that hold the cells
            self._archive.clear()
            if len(held):
                rows_held = _archive_rows(pool.solutions[held], pool.terrains.rows(held), pool.iteration[held])
                self._archive.add(**rows_held)
        num_new = len(asked.new)
        emitters = self._group_emitters(group) if num_new else range(0)
        size = num_new // max(1, len(emitters))
        batches = {emitter: slice(k * size, (k + 1) * size) for k, emitter in enumerate(emitters)}
        for method in self.methods:
            method.tell(evaluation, rows, added, batches)
        return num_new

    @property
    def _surrogate(self) -> Any:
        """The surrogate that knows what earns less than its fitness; None where nothing does."""
        fitness = self._pool.fitness if self._pool is not None else None
        return getattr(self.methods[0], "surrogate", None) if fitness and (fitness.crossed or fitness.likely) else None

    def ask_crossed(
        self, most: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]]:
        """Failing elites that nobody has tried to cross, at most so many, drawn at random.

        Rows for :meth:`tell_crossed`, (T,), clipped genes, (T, num_genes), and goal rates, (T,).
        """
        assert self._pool is not None and self._pool.terrains is not None
        pool, terrains = self._pool, self._pool.terrains
        failing = terrains.valid & (terrains.goal_rate < FAILING_GOAL_RATE)
        rows = np.sort(rng.permutation(np.flatnonzero(failing & pool.holds & ~pool.labelled))[:most])
        return rows, clipped(pool.solutions[rows]), terrains.goal_rate[rows]

    def tell_crossed(self, rows: NDArray[np.int64], crossed: NDArray[np.bool_]) -> None:
        """Tells whether anybody crosses terrains of :meth:`ask_crossed`, which are not asked again, shape (T,)."""
        assert self._pool is not None and self._pool.terrains is not None
        self._pool.labelled[rows] = True
        if len(rows):
            self._surrogate.learn(self._pool.solutions[rows], self._pool.terrains.rows(rows), crossed)

    def elites(self) -> Columns:
        """The elites in order of descending fitness, as the arrays of an :class:`qd.search.archive.Archive`."""
        data: Any = self._archive.data()
        order = np.lexsort((data["index"], -data["objective"]))
        elites = {name: data[name][order] for name in _FIELDS}
        return elites | {"fitness": data["objective"][order], "cell": data["index"][order].astype(np.int64)}


def _make_archive(num_genes: int, cells: Cells, stream: np.random.SeedSequence, **learning: Any) -> GridArchive:
    extra_fields: dict[str, Any] = {"genes": ((num_genes,), np.float32), "end_position": ((2,), np.float32)}
    extra_fields |= dict.fromkeys(_STATISTICS, ((cells.num_ratios,), np.float64))
    extra_fields |= dict.fromkeys(_RATES, ((), np.float64)) | dict.fromkeys(_COUNTS, ((), np.int64))
    fields: dict[str, Any] = {"solution_dtype": np.float32, "extra_fields": extra_fields}
    fields["seed"] = stream  # handed to NumPy's default_rng, which takes it
    count = cells.num_cells
    return GridArchive(solution_dim=num_genes, dims=[count], ranges=[(0, count)], **fields, **learning)


def _archive_rows(solutions: NDArray[np.float32], terrains: Evaluation, iteration: NDArray[np.int64] | int) -> Columns:
    """Terrains as an archive takes them, of unclipped genes (T, num_genes), with the iteration that found each."""
    columns = {name: getattr(terrains, name) for name in _FIELDS if name not in ("genes", "iteration")}
    return columns | {
        "solution": solutions,
        "objective": terrains.fitness,
        "measures": terrains.cell[:, None] + 0.5,
        "genes": clipped(solutions),
        "iteration": np.broadcast_to(iteration, len(solutions)),
    }
