"""What every terrain space has."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels.episode import Kind
from kernels.ground import Ground
from sim.terrains.conditions.kinds import nominal_row
from sim.terrains.hand_crafted import Seed

MAX_HEIGHT = 0.25
"""Heights of the shipped spaces are for robots half a metre high: Table I's w [m]."""


class TerrainSpace:
    """What a search needs of its terrains. Attributes and methods below are the defaults of a space."""

    name: str
    """What files and command lines call the space."""
    num_genes: int
    """Length of one row of genes."""
    sha256: str | None = None
    """Hash of the code of a user's space, which records hold beside its name; None of a shipped space."""
    sigma0: float = 2.0
    """First step size of a search whose command line names none. So wide a start asks for terrains at the genes'
    limits, which are the hard ones of most spaces."""
    any_spacing: bool = False
    """Whether it can be rasterised on nodes of any distance and number, and not only on those of a simulation."""
    genes_per_part: int | None = None
    """Genes of a part that can be exchanged for that of another terrain; None if it has no such parts."""
    ground: tuple[str, ...] = ()
    """Maps that its terrains have beside heights, some of :data:`sim.terrains.terrains.GROUND_KINDS`."""
    conditions: tuple[str, ...] = ()
    """Conditions that it has genes of, some of :data:`sim.terrains.conditions.kinds.CONDITIONS`."""
    asks: Kind = Kind.CROSS
    """What its robots are asked for."""
    height_share: float = 1.0
    """Its highest terrain over that of the shipped heights; 1 of a user's space."""

    @property
    def has_conditions(self) -> bool:
        """Whether its terrains are crossed under conditions, or robots are asked for something else there."""
        return bool(self.conditions) or self.asks != Kind.CROSS

    def rasterise(self, genes: Any, spacing: float, heights_out: Any, *origin: float) -> None:
        """Turns genes, floats of shape (num_terrains, num_genes), clipped to [-1, 1], into heights on the device.

        Heights [m] have shape (num_terrains, nrow, ncol), row along y, column along x, at nodes ``spacing`` [m] apart.
        ``origin`` is x and y of the first node [m] where they are not 0, in spaces of any spacing alone.
        """

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into the maps that :attr:`ground` names, on the device; others stay as they are."""

    def condition_rows(self, genes: ArrayLike) -> NDArray[np.float32]:
        """Rows of conditions (:mod:`sim.terrains.conditions`), shape (num_terrains, number of values)."""
        return np.tile(nominal_row(), (len(np.asarray(genes)), 1))

    def condition_text(self, genes: ArrayLike) -> str:
        """The conditions of one row of genes (num_genes,) as text; empty of a space without any."""
        return ""

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Genes of random terrains that are as hard as the space allows, shape (count, num_genes)."""
        raise NotImplementedError

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Texts of the parts of a terrain that can be taken away, of one row of genes (num_genes,)."""
        raise NotImplementedError

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes (num_terrains, num_genes) of the same terrains without the parts of these indices in :meth:`parts`."""
        raise NotImplementedError

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32] | None:
        """Genes of the same terrains with all heights times ``scale``, which is in (0, 1]; None where none can be."""
        return None

    def moments(self, genes: ArrayLike) -> dict[int, tuple[float, float]]:
        """When parts come, and the latest that they can [s], of one row of genes (num_genes,), by part. Few do."""
        return {}

    def at_moments(self, genes: ArrayLike, moments: Mapping[int, float]) -> NDArray[np.float32]:
        """Genes (num_terrains, num_genes) of the same terrains, where parts come at other moments [s]."""
        return self.validate(genes)

    def time_line(self, genes: ArrayLike, duration_s: float) -> list[tuple[str, float, float]]:
        """What acts on a robot in an episode of this length, from when to when [s], of genes (num_genes,)."""
        return []

    def describe(self, genes: ArrayLike) -> str:
        """A terrain as text, one part a line, of one row of genes (num_genes,)."""
        return "\n".join(self.parts(genes))

    def spans(self, genes: ArrayLike) -> tuple[tuple[str, float, float], ...]:
        """What lies across the whole way: text, and x at which it begins and ends [m]. Most spaces have none."""
        return ()

    def uniform_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Genes drawn uniformly from [-1, 1], shape (count, num_genes)."""
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, self.num_genes)).astype(np.float32)

    def validate(self, genes: ArrayLike) -> NDArray[np.float32]:
        """Genes as float32, shape (num_terrains, num_genes), not clipped."""
        array = np.asarray(genes, dtype=np.float32)
        if array.ndim != 2 or array.shape[1] != self.num_genes:
            expected = f"(num_terrains, {self.num_genes})"
            raise ValueError(f"genes must have shape {expected}, got {array.shape}: the space is {self.name}")
        finite = np.isfinite(array).all(axis=1)
        if not finite.all():
            raise ValueError(f"genes must be finite, got NaN or infinity in row {int(np.argmin(finite))}")
        return array


@dataclass(frozen=True, kw_only=True)
class ShippedSpace(TerrainSpace):
    """A space with heights for robots half a metre high, which can be lowered for smaller ones."""

    base_name: ClassVar[str]
    """Its name at its usual height."""
    height: float = MAX_HEIGHT
    """Largest height [m]: a smaller one lowers all terrains alike."""

    @property
    def name(self) -> str:
        """``course``, with another height ``course@0.06``."""
        return self.base_name if self.height == MAX_HEIGHT else f"{self.base_name}@{self.height:g}"

    @property
    def height_share(self) -> float:
        """Heights over the usual ones."""
        return self.height / MAX_HEIGHT


def clipped(genes: ArrayLike) -> NDArray[np.float32]:
    """Genes as every space has them: a copy clipped to [-1, 1]; the search itself is unbounded."""
    return np.clip(np.asarray(genes, dtype=np.float32), -1.0, 1.0)
