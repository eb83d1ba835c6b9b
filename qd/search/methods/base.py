"""What a method of search has: settings, a line of help, ``ask`` and ``tell``.

Settings are shown by ``--help``, so these files load nothing heavy before a method is made.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from sim.files.settings import PositiveInt, check_settings

if TYPE_CHECKING:
    from ribs.archives import GridArchive

    from qd.search.descriptors import Cells
    from qd.search.fitness import Evaluation
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


@dataclass(frozen=True, kw_only=True)
class IsoLineCfg(MethodCfg):
    """Settings of iso+line variation (Vassiliades and Mouret 2018)."""

    iso_sigma: Sigma = 0.02
    """Iso+line: standard deviation of each gene's own change (published: .01 of the genes' range)."""
    line_sigma: Sigma = 0.2
    """Iso+line: standard deviation of the step along the line to another elite, in its length (published: .2)."""


@dataclass(frozen=True)
class Setup:
    """The search that a method is made for."""

    space: "TerrainSpace"
    cells: "Cells"
    archive: "GridArchive"
    """The elites of the search."""
    seed: int
    emitters: tuple[int, ...]
    """Numbers of the method's emitters among those of the search, ascending."""

    def stream(self, index: int) -> np.random.SeedSequence:
        """A stream of the search's seed: 0 and 1 are those of archives, 2 and up of emitters, then the surrogate's."""
        return np.random.SeedSequence(self.seed, spawn_key=(index,))


class Method:
    """A source of new terrains for some of a search's emitters; a checkpoint holds it as it is.

    Attributes:
        Cfg: Its settings. They are fields of :class:`qd.search.presets.SchedulerCfg`, and flags of the command.
        text: What it is, for ``--help``.
        emitters: Numbers of its emitters, ascending.
        sources: What asks for each emitter, by its number, as pyribs' emitters do.
    """

    Cfg: ClassVar[type[MethodCfg]] = MethodCfg
    text: ClassVar[str]

    def __init__(self, cfg: Any, setup: Setup) -> None:
        """``cfg`` has all settings of the search, those of :attr:`Cfg` among them."""
        self.batch_size, self.emitters = int(cfg.batch_size), setup.emitters
        self._space = setup.space.name, setup.space.sha256  # a checkpoint holds no code
        self.sources = {number: self._make_source(cfg, setup, setup.stream(2 + number)) for number in setup.emitters}

    def _make_source(self, cfg: Any, setup: Setup, stream: np.random.SeedSequence) -> Any:
        """What asks for one emitter; None if the method asks for all of them itself."""

    @property
    def space(self) -> "TerrainSpace":
        """The terrain space of the genes."""
        from sim.terrains.spaces.registry import get_space

        return get_space(*self._space)

    def ask(self, emitters: Sequence[int], pending: NDArray[np.float32]) -> NDArray[Any]:
        """New terrains of some of its emitters, in their order.

        ``pending`` are clipped genes of new terrains that were asked for and not told yet, shape (U, num_genes).
        Returns unclipped genes, shape (len(emitters) * batch_size, num_genes).
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
