"""Any terrain space with more genes: of its ground, 32 for friction and 32 for softness, and of conditions."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels.episode import Kind
from kernels.ground import COLS, NUM_PATCHES, PATCH, ROWS, Ground, decode_friction, decode_softness
from sim.terrains.conditions.kinds import (
    CONDITIONS,
    TASKS,
    condition_column,
    condition_genes,
    condition_texts,
    split_row,
)
from sim.terrains.spaces.base import Seed, TerrainSpace, clipped
from sim.terrains.terrains import GROUND_KINDS, MAX_TIME_CONSTANT_S, MIN_FRICTION, MIN_TIME_CONSTANT_S, patch_index

_ABSENT = {"friction": 1.0, "softness": -1.0}  # the gene of ground that changes nothing
_TITLES = {
    "friction": "friction every 2 m along the way",
    "softness": "time constant of the ground [s] every 2 m along the way, 0 where it is firm",
}
_ROWS_OF_THE_WAY = slice(ROWS // 2 - 1, ROWS // 2 + 1)  # rows of patches, the right one first
_MAX_SLIPPERY = 0.995  # rounded, what is above is 1.00


class WiderSpace(TerrainSpace):
    """The terrains of another space, ``inner``, on ground whose patches differ, and crossed under conditions.

    The genes of the inner space come first, then those of each map, patch after patch (:mod:`kernels.ground`), then
    those of each condition. A patch is a part, and so is a condition; one that changes nothing counts as absent.
    """

    def __init__(self, inner: TerrainSpace, kinds: tuple[str, ...]) -> None:
        """``kinds`` are some of the ground's, of conditions and of tasks, in the order of their tables."""
        self.inner, self.kinds, self.name = inner, kinds, "+".join((inner.name, *kinds))
        for name in ("sha256", "sigma0", "any_spacing", "height_share", "genes_per_part"):
            setattr(self, name, getattr(inner, name))
        self.maps = tuple(kind for kind in kinds if kind in GROUND_KINDS)
        self.ground = self.maps or inner.ground
        self.conditions = tuple(kind for kind in kinds if kind in CONDITIONS)
        asked = {TASKS[kind] for kind in kinds if kind in TASKS}
        asked |= {CONDITIONS[kind].asks for kind in self.conditions} - {Kind.CROSS}
        if len(asked) > 1:
            raise ValueError(f"robots must be asked for one thing, got {self.name}: leave +stand or +command out")
        self.asks = next(iter(asked), Kind.CROSS)
        if self.maps and inner.genes_per_part and NUM_PATCHES % inner.genes_per_part:
            self.genes_per_part = None  # maps must divide by the parts of the space, too
        self._absent = [np.array([_ABSENT[kind]]) for kind in self.maps for _ in range(NUM_PATCHES)]
        self._absent += [CONDITIONS[name].to_genes({}) for name in self.conditions]
        ends = inner.num_genes + np.cumsum([0, *map(len, self._absent)])
        self._columns = [slice(*pair) for pair in pairwise(ends.tolist())]  # of each part
        self.num_genes = int(ends[-1])

    def _map_columns(self, kind: str) -> slice:
        first = self.inner.num_genes + NUM_PATCHES * self.maps.index(kind)
        return slice(first, first + NUM_PATCHES)

    def rasterise(self, genes: Any, spacing: float, heights_out: Any, *origin: float) -> None:
        """Turns genes into heights on the device, by the inner space."""
        self.inner.rasterise(genes[:, : self.inner.num_genes].contiguous(), spacing, heights_out, *origin)

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into maps on the device (:mod:`kernels.ground`)."""
        self.inner.lay_ground(genes[:, : self.inner.num_genes].contiguous(), ground_out)
        if "friction" in self.maps:
            decode_friction(genes[:, self._map_columns("friction")].contiguous(), ground_out.friction)
        if "softness" in self.maps:
            decode_softness(genes[:, self._map_columns("softness")].contiguous(), ground_out.time_constant)

    def condition_rows(self, genes: ArrayLike) -> NDArray[np.float32]:
        """Rows of conditions, shape (num_terrains, number of values)."""
        kinds = condition_genes(self.conditions)
        columns = clipped(genes)[:, self.num_genes - len(kinds) :].T
        rows = super().condition_rows(genes)
        for gene, values in zip(kinds, columns, strict=True):
            rows[:, condition_column(gene.name)] = gene.to_value(values)
        rows[:, -1] = self.asks
        return rows

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Hard-random terrains of the inner space, every patch as it always is or as slippery or soft as can be.

        Each condition is at one of its limits; pushes come at any time.
        """
        rng = np.random.default_rng(seed)
        heights = self.inner.hard_random(count, rng)
        maps = rng.choice([-1.0, 1.0], (count, NUM_PATCHES * len(self.maps)))
        hard = [gene.hard_at_limits for gene in condition_genes(self.conditions)]
        limits = rng.choice([-1.0, 1.0], (count, len(hard)))
        conditions = np.where(hard, limits, rng.uniform(-1.0, 1.0, limits.shape))
        return np.concatenate([heights, maps.astype(np.float32), conditions.astype(np.float32)], axis=1)

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Those of the inner space, then each patch of each map, then each condition."""
        row = clipped(genes)
        texts = [*self.inner.parts(row[: self.inner.num_genes])]
        for kind in self.maps:
            for (y, x), value in zip(np.ndindex(ROWS, COLS), self._patch_values(row, kind), strict=True):
                soft = f"soft ground of {value:.3f} s" if value else "firm ground"
                text = f"friction {value:.2f}" if kind == "friction" else soft
                limits = PATCH * np.array([x, x + 1, y, y + 1])
                texts.append("{} at x = {:.0f} to {:.0f} m, y = {:.0f} to {:.0f} m".format(text, *limits))
        conditions = zip(self.conditions, self._condition_texts(row), strict=True)
        return (*texts, *(text or f"no {name}" for name, text in conditions))

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes without some parts: those of the inner space come first, the others change nothing."""
        changed = self.validate(genes).copy()
        first = self.inner.num_genes
        if len(changed):
            count = len(self.inner.parts(changed[0, :first]))
            changed[:, :first] = self.inner.without(changed[:, :first], [part for part in parts if part < count])
            for part in parts:
                if part >= count:
                    changed[:, self._columns[part - count]] = self._absent[part - count]
        return changed

    def moments(self, genes: ArrayLike) -> dict[int, tuple[float, float]]:
        """When conditions come that come at some time, and the latest that they can [s]; absent ones do not."""
        row = clipped(genes)
        texts = self._condition_texts(row)
        first = len(self.parts(row)) - len(texts)
        values = self.condition_rows(row[None])[0]
        return {
            first + k: (float(values[condition_column(gene.name)]), gene.high)
            for k, name in enumerate(self.conditions)
            for gene in CONDITIONS[name].genes
            if gene.name == CONDITIONS[name].moment and texts[k]
        }

    def time_line(self, genes: ArrayLike, duration_s: float) -> list[tuple[str, float, float]]:
        """The conditions that are not nominal."""
        row = self.condition_rows(np.asarray(genes)[None])[0]
        acting = [(c, values) for c, values in split_row(row) if c.name in self.conditions and c.text(values)]
        return [(condition.text(values), *condition.span(values, duration_s)) for condition, values in acting]

    def at_moments(self, genes: ArrayLike, moments: Mapping[int, float]) -> NDArray[np.float32]:
        """Genes whose conditions of these parts come at other moments [s]."""
        changed = self.validate(genes).copy()
        first = len(self.parts(changed[0])) - len(self.conditions)
        for part, time_s in moments.items():
            condition = CONDITIONS[self.conditions[part - first]]
            names = [gene.name for gene in condition.genes]
            column = names.index(str(condition.moment))
            columns = self._columns[NUM_PATCHES * len(self.maps) + part - first]
            changed[:, columns.start + column] = condition.genes[column].to_gene(time_s)
        return changed

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32] | None:
        """Genes with heights scaled by the inner space; the others stay as they are."""
        rows, first = clipped(self.validate(genes)), self.inner.num_genes
        heights = self.inner.scaled(rows[:, :first], scale)
        return None if heights is None else np.concatenate([heights, rows[:, first:]], axis=1)

    def describe(self, genes: ArrayLike) -> str:
        """The terrain of the inner space, of each map the patches on both sides of the way, and the conditions.

        Each has a line. What lies across the way has its ground behind it: ``kerb 0.15 m up (friction 0.25)``.
        """
        row = clipped(genes)
        heights = row[: self.inner.num_genes]
        maps = {kind: self._patch_values(row, kind).reshape(ROWS, COLS)[_ROWS_OF_THE_WAY] for kind in self.maps}
        spans = []
        for text, *ends in self.inner.spans(heights) if maps else ():
            first, last = patch_index(ends, PATCH * COLS, COLS)
            worst = []
            for kind, values in maps.items():
                below = values[:, first : last + 1]
                if kind == "friction" and below.min() < _MAX_SLIPPERY:
                    worst.append(f"friction {below.min():.2f}")
                if kind == "softness" and below.max() > 0.0:
                    worst.append(f"soft, {below.max():.3f} s")
            spans.append(f"{text} ({', '.join(worst)})" if worst else text)
        lines = [", ".join(spans) or self.inner.describe(heights)]
        for kind, values in maps.items():
            right, left = (" ".join(f"{value:.2f}" for value in side) for side in values)
            lines.append(f"{_TITLES[kind]}: left of the way {left}, right of it {right}")
        return "\n".join(lines + [self.condition_text(row)] * bool(self.conditions))

    def condition_text(self, genes: ArrayLike) -> str:
        """The conditions that are not nominal; empty of a space without any."""
        nominal = "nominal conditions" if self.conditions else ""
        return ", ".join(filter(None, self._condition_texts(genes))) or nominal

    def _condition_texts(self, genes: ArrayLike) -> list[str]:
        return condition_texts(self.condition_rows(np.asarray(genes)[None])[0], self.conditions)

    def _patch_values(self, row: NDArray[np.float32], kind: str) -> NDArray[np.float64]:
        """Frictions, or time constants [s], of one terrain, shape (32,)."""
        share = (row[self._map_columns(kind)].astype(np.float64) + 1.0) / 2.0
        if kind == "friction":
            return 1.0 - (1.0 - share) * (1.0 - MIN_FRICTION)
        tau = MIN_TIME_CONSTANT_S * (MAX_TIME_CONSTANT_S / MIN_TIME_CONSTANT_S) ** share
        return np.where(share > 0.0, tau, 0.0)


def ground_genes(values: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Genes of maps of one ``friction``, or of one ``softness`` [s] above the least; shape (num_values, 32)."""
    if "friction" in values:
        genes = 1.0 - 2.0 * (1.0 - values["friction"]) / (1.0 - MIN_FRICTION)
    else:
        share = np.log(values["softness"] / MIN_TIME_CONSTANT_S)
        genes = 2.0 * share / np.log(MAX_TIME_CONSTANT_S / MIN_TIME_CONSTANT_S) - 1.0
    return np.repeat(genes[:, None], NUM_PATCHES, axis=1)


def varied_space(space: TerrainSpace) -> TerrainSpace:
    """The space whose terrains are those of another one under varied conditions."""
    inner, maps = (space.inner, space.maps) if isinstance(space, WiderSpace) else (space, ())
    varied = (name for name in CONDITIONS if name in space.conditions or CONDITIONS[name].varied)
    tasks = (name for name, kind in TASKS.items() if kind == space.asks)
    return WiderSpace(inner, (*maps, *varied, *tasks))


def varied_genes(space: TerrainSpace, genes: NDArray[np.float32], seeds: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Genes of a terrain, (num_genes,), under conditions drawn by each seed, for :func:`varied_space`.

    The first value of a condition is drawn uniformly from its ``varied`` limits, what controllers are usually trained
    for; others are nominal. Conditions that the space has genes of stay as they are. Shape (number of seeds, its
    num_genes).
    """
    added = [condition for name, condition in CONDITIONS.items() if condition.varied and name not in space.conditions]
    low, high = np.array([condition.varied for condition in added]).reshape(-1, 2).T
    drawn = np.stack([np.random.default_rng(seed).uniform(low, high) for seed in seeds.tolist()], axis=1)
    columns = {c.name: c.to_genes({c.genes[0].name: values}) for c, values in zip(added, drawn, strict=True)}
    lengths = [len(CONDITIONS[name].genes) for name in space.conditions]
    cuts = space.num_genes - sum(lengths) + np.cumsum([0, *lengths])[:-1]
    terrain, *kept = np.split(np.tile(genes, (len(seeds), 1)), cuts, axis=1)
    columns |= dict(zip(space.conditions, kept, strict=True))
    ordered = [columns[name] for name in varied_space(space).conditions]
    return np.concatenate([terrain, *ordered], axis=1).astype(np.float32)
