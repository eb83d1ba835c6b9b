"""Quality-Diversity over the reachable cells: emitters that ask for terrains, and the archives they are told into.

The cells are numbered, so a pyribs archive has one dimension with one unit a cell, and a terrain's measure is the
middle of its cell. Evolution strategies search unbounded; archives hold the unclipped solutions for them, and the
clipped genes as data.
"""

from collections.abc import Iterator
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter, IsoLineEmitter

from qd.descriptors import Cells
from qd.fitness import FITNESS_FLOOR, Evaluation
from qd.run.settings import SchedulerCfg
from sim.spaces.base import TerrainSpace, clipped
from sim.spaces.registry import get_space
from sim.spaces.super_gaussian import SUPER_GAUSSIAN

if TYPE_CHECKING:
    from qd.surrogate import Surrogate

_INVALID_VALUE = -1e3  # an invalid terrain ranks below any other that was not accepted


class RandomEmitter:
    """Asks for terrains drawn anew each time, whatever it is told.

    Args:
        archive: The elites, of which it learns nothing.
        space: What genes mean.
        method: ``uniform_random`` or ``hard_random``.
        batch_size: Terrains asked for at once.
        stream: Seed.
    """

    space_sha256: str | None = None  # a checkpoint of a shipped space may lack it

    def __init__(
        self, archive: GridArchive, space: TerrainSpace, method: str, batch_size: int, stream: np.random.SeedSequence
    ) -> None:
        self.archive, self.method, self.batch_size = archive, method, batch_size
        self.space, self.space_sha256 = space.name, space.sha256  # a checkpoint holds no code
        self._rng = np.random.default_rng(stream)

    def ask(self) -> NDArray[np.float32]:
        """Genes, shape (batch_size, num_genes)."""
        space = get_space(self.space, self.space_sha256)
        draw = space.uniform_random if self.method == "uniform_random" else space.hard_random
        return draw(self.batch_size, self._rng)

    def tell(self, **told: Any) -> None:
        """Learns nothing."""


class SurrogateEmitter:
    """Asks for what a surrogate proposes, which all such emitters of a search share.

    Args:
        archive: The elites.
        surrogate: Proposes terrains, for all emitters of a group at once.
        batch_size: Terrains asked for at once.
    """

    def __init__(self, archive: GridArchive, surrogate: "Surrogate", batch_size: int) -> None:
        self.archive, self.surrogate, self.batch_size = archive, surrogate, batch_size

    def tell(self, **told: Any) -> None:
        """Learns nothing by itself: the surrogate learns from the terrains of all emitters."""


Emitter = EvolutionStrategyEmitter | IsoLineEmitter | RandomEmitter | SurrogateEmitter


class Scheduler:
    """The state of a search: ask for genes, tell what became of them.

    ``result`` keeps the best terrain ever found in each cell and is what a search is run for. ``archive`` is what
    CMA-MAE's emitters are judged by: their own, with thresholds that lag behind. All others go by ``result``, and where
    there are none of CMA-MAE's, ``archive`` is ``result``.

    Args:
        cfg: Settings.
        space: What genes mean.
        cells: The reachable cells.
        seed: Seed of emitters and archives.
    """

    def __init__(
        self,
        cfg: SchedulerCfg,
        *,
        cells: Cells,
        seed: int,
        space: TerrainSpace = SUPER_GAUSSIAN,
    ) -> None:
        *streams, shared = np.random.SeedSequence(seed).spawn(cfg.emitters + 3)
        learning = {"learning_rate": cfg.learning_rate, "threshold_min": FITNESS_FLOOR}
        # Not learning_rate=1 with a threshold: told two terrains of a cell at once, that keeps the better one but sets
        # the threshold to their mean, and a later, worse one may replace it.
        shapes = space.num_genes, cells.num_cells, cells.num_ratios
        self.result = _make_archive(*shapes, streams[1], {})
        in_turn = list(zip(cycle(cfg.methods), streams[2:], strict=False))
        learns = any(name == "cma_mae" for name, _ in in_turn)
        self.archive = self.result
        if learns:
            self.archive = _make_archive(*shapes, streams[0], learning)
        self.surrogate: Surrogate | None = None
        if any(name == "surrogate" for name, _ in in_turn):
            from qd import surrogate  # with torch

            self.surrogate = surrogate.Surrogate(cfg, cells, space, shared)
        self.emitters: list[Emitter] = [self._emitter(cfg, name, space, stream) for name, stream in in_turn]
        self._asked: list[NDArray[np.float32] | None] = [None] * cfg.groups

    def _emitter(self, cfg: SchedulerCfg, method: str, space: TerrainSpace, stream: Any) -> Emitter:
        if method.endswith("random"):
            return RandomEmitter(self.result, space, method, cfg.batch_size, stream)
        if method == "surrogate":
            assert self.surrogate is not None
            return SurrogateEmitter(self.result, self.surrogate, cfg.batch_size)
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
        restart_rule: Any = int(cfg.restart_rule) if cfg.restart_rule.isdecimal() else cfg.restart_rule
        improves = method == "cma_me"  # ranks and selects by what is new in the archive, and restarts without it
        return EvolutionStrategyEmitter(
            self.result if improves else self.archive,
            x0=np.zeros(space.num_genes),
            sigma0=cfg.sigma0,
            ranker="2imp" if improves else "imp",
            es=cfg.es,
            selection_rule="filter" if improves else "mu",
            restart_rule="no_improvement" if improves else restart_rule,
            batch_size=cfg.batch_size,
            seed=stream,
        )

    def _part(self, group: int, whole: int) -> slice:
        """A group's part of a number of things: equal parts, as far as that goes."""
        emitters = len(self.emitters)
        return slice(*(whole // emitters * (k * emitters // len(self._asked)) for k in (group, group + 1)))

    def _group(self, group: int) -> list[Emitter]:
        """The emitters of a group."""
        return self.emitters[self._part(group, len(self.emitters))]

    def places(self, group: int) -> slice:
        """Places of a group's terrains among those of an iteration."""
        return self._part(group, len(self.emitters) * int(self.emitters[0].batch_size))

    def ask(self, group: int = 0) -> NDArray[np.float32]:
        """The next terrains of a group of emitters; the same ones until the group is told their results.

        Args:
            group: Number of the group.

        Returns:
            Clipped genes, shape (emitters of the group * batch_size, num_genes).
        """
        asked = self._asked[group]
        if asked is None:
            emitters = self._group(group)
            proposed = self._proposed([emitter for emitter in emitters if isinstance(emitter, SurrogateEmitter)])
            asked = self._asked[group] = np.concatenate(
                [next(proposed) if isinstance(emitter, SurrogateEmitter) else emitter.ask() for emitter in emitters]
            )
        return clipped(asked)

    def _proposed(self, emitters: list[SurrogateEmitter]) -> Iterator[NDArray[np.float32]]:
        """What the surrogate proposes for some emitters: one search for all, so that no two ask for the same."""
        if self.surrogate is None or not emitters:
            return iter(())
        data: Any = self.result.data()
        under_way = [clipped(genes) for genes in self._asked if genes is not None]
        sizes = [emitter.batch_size for emitter in emitters]
        genes = self.surrogate.propose(
            sum(sizes), data["genes"], data["index"], data["objective"], np.concatenate([data["genes"][:0], *under_way])
        )
        return iter(np.split(genes, np.cumsum(sizes)[:-1]))

    def compute_on(self, device: str) -> None:
        """Lets a surrogate work on a Warp device; all else works on the host."""
        if self.surrogate is not None:
            self.surrogate.compute_on(device)

    def tell(self, evaluation: Evaluation, iteration: int, group: int = 0) -> None:
        """What became of the terrains that a group last asked for.

        Args:
            evaluation: One row a terrain, in the order asked.
            iteration: Number of the iteration, from 1.
            group: Number of the group.

        Raises:
            RuntimeError: If it asked for nothing.
            ValueError: If the number of rows differs.
        """
        asked = self._asked[group]
        if asked is None:
            raise RuntimeError("tell() must follow ask(), got no terrains asked for")
        if len(evaluation.fitness) != len(asked):
            raise ValueError(f"evaluation must have {len(asked)} rows, got {len(evaluation.fitness)}")
        told = _rows(asked, evaluation, iteration)
        self._asked[group] = None
        if self.surrogate is not None:
            self.surrogate.learn(asked, evaluation, told["objective"])
        accepted = evaluation.valid & (evaluation.fitness > FITNESS_FLOOR)
        plain = self._add(told, accepted)
        learned = plain if self.archive is self.result else self.archive.add(**told)
        if self.archive.empty:
            return  # nothing valid yet: an emitter that restarts now would have no elite to start from
        first = 0
        for emitter in self._group(group):
            own = slice(first, first + int(emitter.batch_size))
            added = plain if emitter.archive is self.result else learned
            emitter.tell(
                **{name: rows[own] for name, rows in told.items()},
                add_info={name: rows[own] for name, rows in added.items()},
            )
            first = own.stop

    def _add(self, told: dict[str, NDArray[Any]], accepted: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        """Fills ``result``; status and value of each terrain as pyribs gives them to its emitters."""
        kept = {name: rows[accepted] for name, rows in told.items()}
        added = {"status": np.zeros(len(accepted), np.int32), "value": np.full(len(accepted), _INVALID_VALUE)}
        if accepted.any():
            for name, rows in self.result.add(**kept).items():
                added[name][accepted] = rows
        return added

    def elites(self) -> dict[str, NDArray[Any]]:
        """The elites in order of descending fitness, as the arrays of an :class:`qd.archive.Archive`."""
        data: Any = self.result.data()
        order = np.lexsort((data["index"], -data["objective"]))
        elites = {name: data[name][order] for name in _FIELDS}
        return elites | {"fitness": data["objective"][order], "cell": data["index"][order].astype(np.int64)}

    def state(self) -> dict[str, Any]:
        """Everything a resumed search needs; what was asked for and not told stays asked for."""
        return {"archive": self.archive, "result": self.result, "emitters": self.emitters, "asked": self._asked}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Scheduler":
        """A search that goes on where another stood.

        Raises:
            ValueError: If the state is none of a search.
        """
        state = {"asked": [None], **state}  # one of before there were groups was saved when all were told
        archive, result, emitters, asked = (state.get(name) for name in ("archive", "result", "emitters", "asked"))
        if not (
            isinstance(archive, GridArchive)
            and isinstance(result, GridArchive)
            and isinstance(emitters, list)
            and emitters
            and all(isinstance(emitter, Emitter) for emitter in emitters)
            and isinstance(asked, list)
            and 1 <= len(asked) <= len(emitters)
            and all(isinstance(genes, np.ndarray | None) for genes in asked)
        ):
            raise ValueError("a search has two archives, emitters, and what they asked for, got something else")
        search = cls.__new__(cls)
        search.archive, search.result, search.emitters, search._asked = archive, result, emitters, asked
        shared = [emitter.surrogate for emitter in emitters if isinstance(emitter, SurrogateEmitter)]
        search.surrogate = shared[0] if shared else None
        return search


_FIELDS = (
    "genes", "ratios", "penalty_mean", "penalty_std", "collision_rate", "goal_rate", "fallen_rate", "invalid_episodes",
    "episodes", "iteration",
)  # fmt: skip


def _make_archive(
    num_genes: int,
    num_cells: int,
    num_ratios: int,
    stream: np.random.SeedSequence,
    learning: dict[str, Any],
) -> GridArchive:
    per_ratio = ((num_ratios,), np.float64)
    rate, count = ((), np.float64), ((), np.int64)
    shapes = ((num_genes,), np.float32), per_ratio, per_ratio, per_ratio, rate, rate, rate, count, count, count
    own: dict[str, Any] = dict(zip(_FIELDS, shapes, strict=True))
    return GridArchive(
        solution_dim=num_genes,
        dims=[num_cells],
        ranges=[(0, num_cells)],
        seed=stream,  # pyright: ignore[reportArgumentType] - handed to numpy's default_rng, which takes it
        solution_dtype=np.float32,
        objective_dtype=np.float64,
        measures_dtype=np.float64,
        extra_fields=own,
        **learning,
    )


def _rows(solutions: NDArray[np.float32], evaluation: Evaluation, iteration: int) -> dict[str, NDArray[Any]]:
    """What both archives are told: one row a terrain."""
    taken = {name: getattr(evaluation, name) for name in _FIELDS if name not in ("genes", "iteration")}
    return taken | {
        "solution": solutions,
        "objective": evaluation.fitness,
        "measures": evaluation.cell[:, None] + 0.5,
        "genes": clipped(solutions),
        "iteration": np.full(len(solutions), iteration),
    }
