"""Methods of search, each a class with settings, a line of help, ``ask`` and ``tell``, and a line in :data:`METHODS`.

Settings are shown by ``--help``, so this file loads nothing heavy before a method is made.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from sim.files.settings import PositiveInt, Share, check_settings

if TYPE_CHECKING:
    from ribs.archives import GridArchive

    from qd.search.descriptors import Cells
    from qd.search.fitness import Evaluation, FitnessCfg
    from sim.terrains.spaces.base import TerrainSpace

Columns = dict[str, NDArray[Any]]
"""Arrays with one row a terrain."""
Sigma = Annotated[float, Meta(ge=0, le=1e3)]
"""A standard deviation of changes of genes."""


@dataclass(frozen=True, kw_only=True)
class MethodCfg:
    """Settings of every method."""

    emitters: PositiveInt = 10
    """Emitters that ask, each with an evolution strategy or a stream of its own."""
    batch_size: Annotated[int, Meta(ge=2)] = 20
    """Terrains an emitter asks for in an iteration."""
    again: Annotated[int, Meta(ge=0, le=10_000)] = 0
    """Terrains that are crossed again beside those of an emitter, the least known ones. All episodes of a terrain then
    count, and it holds its cell by what it is expected to add to the QD score of fresh ones. With 0 a terrain is
    crossed once, and the fittest of a cell holds it, as in the paper."""

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def num_terrains(self) -> int:
        """Terrains of one iteration."""
        return self.emitters * (self.batch_size + self.again)


@dataclass(frozen=True)
class Setup:
    """The search that a method is made for."""

    space: "TerrainSpace"
    cells: "Cells"
    archive: "GridArchive"
    """The elites of the search."""
    make_archive: Callable[..., "GridArchive"]
    """Makes an empty archive alike, of the stream of its seed and pyribs' ``learning_rate`` and ``threshold_min``."""
    seed: int
    emitters: tuple[int, ...]
    """Numbers of the method's emitters among those of the search, ascending."""
    fitness: "FitnessCfg"

    def stream(self, index: int) -> np.random.SeedSequence:
        """A stream of the search's seed: 0 and 1 are those of archives, 2 and up of emitters, then the surrogate's."""
        return np.random.SeedSequence(self.seed, spawn_key=(index,))

    @property
    def streams(self) -> dict[int, Any]:
        """The stream of each of the emitters by its number; pyribs hands it to NumPy's ``default_rng``."""
        return {number: self.stream(2 + number) for number in self.emitters}


class Method:
    """A source of new terrains for some of a search's emitters; a checkpoint holds it as it is."""

    Cfg: ClassVar[type[MethodCfg]] = MethodCfg
    """Its settings. They are fields of :class:`qd.search.presets.SchedulerCfg`, and flags of the command."""
    text: ClassVar[str]
    """What it is, for ``--help``."""

    def __init__(self, cfg: Any, setup: Setup) -> None:
        """``cfg`` has all settings of the search, those of :attr:`Cfg` among them."""
        self.batch_size, self.emitters = int(cfg.batch_size), setup.emitters
        self.sources: dict[int, Any] = {}  # pyribs' emitters by their numbers, if it asks by such

    def ask(self, emitters: Sequence[int], pending: NDArray[np.float32]) -> NDArray[Any]:
        """Unclipped genes of new terrains of some of its emitters in turn, (len(emitters) * batch_size, num_genes).

        ``pending`` are clipped genes of new terrains that were asked for and not told yet, shape (U, num_genes).
        """
        return np.concatenate([self.sources[emitter].ask() for emitter in emitters])

    def tell(self, evaluation: "Evaluation", rows: Columns, added: Columns, batches: dict[int, slice]) -> None:
        """Learns from T terrains that robots have crossed for a group of emitters, whichever method asked for them.

        Args:
            evaluation: What is known of them.
            rows: The same as a pyribs archive takes it; ``solution`` has unclipped genes, shape (T, num_genes).
            added: Status and value of each by the search's archive, as pyribs gives them to its emitters, shape (T,).
            batches: Rows of the new terrains of each emitter by its number; none where all were crossed again.
        """

    def compute_on(self, device: str) -> None:
        """Moves what it computes to a Warp device."""


class UniformRandom(Method):
    """Genes drawn uniformly from [-1, 1], anew each time: what other methods are compared with."""

    text = "genes drawn uniformly, which learns nothing"

    def __init__(self, cfg: Any, setup: Setup) -> None:
        super().__init__(cfg, setup)
        self._space = setup.space.name, setup.space.sha256  # a checkpoint holds no code
        self.sources = {number: np.random.default_rng(stream) for number, stream in setup.streams.items()}

    def ask(self, emitters: Sequence[int], pending: NDArray[np.float32]) -> NDArray[Any]:
        """Random genes."""
        from sim.terrains.spaces.registry import get_space

        draw = self._draw(get_space(*self._space))
        return np.concatenate([draw(self.batch_size, self.sources[emitter]) for emitter in emitters])

    def _draw(self, space: "TerrainSpace") -> Callable[..., NDArray[np.float32]]:
        return space.uniform_random


class HardRandom(UniformRandom):
    """Terrains drawn anew each time, as hard as the space allows: the paper's baseline."""

    text = "the paper's random terrains, every height at its limit, which learn nothing"

    def _draw(self, space: "TerrainSpace") -> Callable[..., NDArray[np.float32]]:
        return space.hard_random


@dataclass(frozen=True, kw_only=True)
class IsoLineCfg(MethodCfg):
    """Settings of iso+line variation (Vassiliades and Mouret 2018)."""

    iso_sigma: Sigma = 0.02
    """Iso+line: standard deviation of each gene's own change (published: .01 of the genes' range)."""
    line_sigma: Sigma = 0.2
    """Iso+line: standard deviation of the step along the line to another elite, in its length (published: .2)."""


class MapElites(Method):
    """Elites varied by iso+line; hard-random terrains before there is an elite."""

    Cfg = IsoLineCfg
    text = "elites varied by iso+line (Vassiliades and Mouret 2018)"

    def __init__(self, cfg: Any, setup: Setup) -> None:
        from ribs.emitters import IsoLineEmitter

        super().__init__(cfg, setup)
        settings = {name: getattr(cfg, name) for name in ("iso_sigma", "line_sigma", "batch_size")}
        settings["bounds"] = [(-1.0, 1.0)] * setup.space.num_genes
        for number, stream in setup.streams.items():
            first, later = stream.spawn(2)
            hard = setup.space.hard_random(cfg.batch_size, np.random.default_rng(first))
            self.sources[number] = IsoLineEmitter(setup.archive, **settings, initial_solutions=hard, seed=later)


@dataclass(frozen=True, kw_only=True)
class CmaMeCfg(MethodCfg):
    """Settings of evolution strategies."""

    sigma0: Annotated[float, Meta(ge=1e-6, le=1e3)] | None = None
    """First step size of an evolution strategy; genes live in [-1, 1]. The terrain space's own if None."""


class CmaMe(Method):
    """Evolution strategies that rank and select by what is new in the archive, and restart where nothing is."""

    Cfg: ClassVar[type[MethodCfg]] = CmaMeCfg
    text = "evolution strategies that follow what improves the archive (Fontaine et al. 2020)"

    def __init__(self, cfg: Any, setup: Setup, archive: "GridArchive | None" = None, **rules: Any) -> None:
        """``archive`` judges the strategies, the search's if None; ``rules`` say how they rank, select and restart."""
        from ribs.emitters import EvolutionStrategyEmitter

        super().__init__(cfg, setup)
        self.archive = setup.archive if archive is None else archive
        rules = rules or {"ranker": "2imp", "selection_rule": "filter", "restart_rule": "no_improvement"}
        x0 = np.zeros(setup.space.num_genes)
        sigma0 = setup.space.sigma0 if cfg.sigma0 is None else cfg.sigma0
        for number, stream in setup.streams.items():
            self.sources[number] = EvolutionStrategyEmitter(
                self.archive, x0=x0, sigma0=sigma0, batch_size=cfg.batch_size, seed=stream, **rules
            )

    def tell(self, evaluation: Any, rows: Columns, added: Columns, batches: dict[int, slice]) -> None:
        """Tells each strategy what became of its own terrains."""
        if self.archive.empty:  # a strategy that restarts now would have no elite to start from
            return
        for emitter, batch in batches.items():
            if emitter in self.sources:
                crossed, add_info = ({name: column[batch] for name, column in table.items()} for table in (rows, added))
                self.sources[emitter].tell(**crossed, add_info=add_info)


@dataclass(frozen=True, kw_only=True)
class CmaMaeCfg(CmaMeCfg):
    """Settings of evolution strategies and of their thresholds."""

    learning_rate: Share = 0.09
    """Step of a cell's acceptance threshold toward the fitness found there; 1 is elitist, 0 pure optimisation."""
    restart_rule: PositiveInt = 50
    """Iterations after which an evolution strategy restarts at an elite."""


class CmaMae(CmaMe):
    """Evolution strategies that are judged by an archive of their own, whose thresholds lag behind."""

    Cfg = CmaMaeCfg
    text = "evolution strategies on thresholds that lag behind the archive (Fontaine and Nikolaidis 2023), the paper's"

    def __init__(self, cfg: Any, setup: Setup) -> None:
        from qd.search.fitness import FITNESS_FLOOR

        archive = setup.make_archive(setup.stream(0), learning_rate=cfg.learning_rate, threshold_min=FITNESS_FLOOR)
        super().__init__(cfg, setup, archive, ranker="imp", selection_rule="mu", restart_rule=cfg.restart_rule)

    def tell(self, evaluation: Any, rows: Columns, added: Columns, batches: dict[int, slice]) -> None:
        """Tells each strategy what became of its own terrains in their archive."""
        super().tell(evaluation, rows, self.archive.add(**rows), batches)


@dataclass(frozen=True, kw_only=True)
class SurrogateCfg(IsoLineCfg):
    """Settings of the surrogate: of its networks, and of the search that they judge."""

    crossover_share: Share = 0.3
    """Surrogate: share of the varied elites that take each of their parts, such as bumps, from a further elite with a
    chance of a half; of no effect where a space has no parts."""
    candidates: Annotated[int, Meta(ge=1, le=10_000)] = 20
    """Surrogate: terrains that the networks judge in each generation for one that robots cross."""
    generations: Annotated[int, Meta(ge=1, le=1_000)] = 10
    """Surrogate: generations that the networks judge before robots cross the best."""
    explore_share: Share = 0.25
    """Surrogate: share of its terrains that are elites varied once, whatever the networks say."""
    disagree_share: Share = 0.1
    """Surrogate: share of its terrains that the networks disagree most about."""
    training_steps: Annotated[int, Meta(ge=1, le=100_000)] = 100
    """Surrogate: steps of training an iteration, each on 64 terrains a network, or as many as an iteration has."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.explore_share + self.disagree_share > 1.0:
            given = f"{self.explore_share} and {self.disagree_share}"
            raise ValueError(f"explore_share and disagree_share must be at most 1 together, got {given}")


class SurrogateSearch(Method):
    """One surrogate for all of its emitters, which learns from the terrains of all methods."""

    Cfg = SurrogateCfg
    text = "elites varied for some generations that networks judge (after DSAGE, Bhatt et al. 2022)"

    def __init__(self, cfg: Any, setup: Setup) -> None:
        from qd.search.surrogate.surrogate import Surrogate

        super().__init__(cfg, setup)
        self.archive = setup.archive
        stream = setup.stream(2 + cfg.emitters)
        self.surrogate = Surrogate(cfg, setup.cells, setup.space, stream, fitness=setup.fitness)

    def ask(self, emitters: Sequence[int], pending: NDArray[np.float32]) -> NDArray[Any]:
        """What one search by the networks proposes for all of these emitters: no two ask for the same."""
        from qd.search.fitness import find_worth

        elites: Any = self.archive.data()
        count = len(emitters) * self.batch_size
        chance = self.surrogate.find_chance(elites["genes"], elites["goal_rate"])
        worth = find_worth(elites["objective"], self.surrogate.find_share(elites["genes"], chance))
        return self.surrogate.propose(count, elites["genes"], elites["index"], worth, pending)

    def tell(self, evaluation: Any, rows: Columns, added: Columns, batches: dict[int, slice]) -> None:
        """Trains the networks on what became of all terrains."""
        self.surrogate.learn(rows["solution"], evaluation)

    def compute_on(self, device: str) -> None:
        """Moves the networks to a Warp device."""
        self.surrogate.compute_on(device)


METHODS: dict[str, type[Method]] = {
    "surrogate": SurrogateSearch,
    "cma_mae": CmaMae,
    "cma_me": CmaMe,
    "map_elites": MapElites,
    "hard_random": HardRandom,
    "uniform_random": UniformRandom,
}
"""By the names of ``--method`` and files; a new one comes before the import of :mod:`qd.search.presets`."""
