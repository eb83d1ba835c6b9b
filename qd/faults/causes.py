"""The shape of a part of a terrain, as a robot that walks straight to the goal meets it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.ground import FIRM
from sim.crossing import CrossingCfg
from sim.terrains.bank import make_heights, make_terrains
from sim.terrains.conditions.kinds import CONDITIONS, condition_texts
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.wider import WiderSpace
from sim.terrains.terrains import PATCHES, patch_index

_LEAST_HEIGHT = 0.03  # a part that is lower and less deep everywhere under the robot lies beside its way [m]
_GENTLE = 10.0  # slopes below are gentle [degrees]
_HEAD_ON = 30.0  # a slope that rises or falls at a smaller angle to the way is met head on [degrees]
_SIDEWAYS = 60.0  # a slope at a larger angle to the way is met from the side [degrees]
_SHORT = 1.0  # a part that keeps half of its height over no more of the way is a ridge or a ditch [m]
_NARROW = 0.5  # a part that falls to half of its height within this distance of the way ends there [m]

SLIPPERY = "slippery ground"
SOFT = "soft ground"
OFF_THE_WAY = "beside the way"
UNCLEAR = "unclear"  # the cause where no part of the terrain lies where robots end
_STRAIGHT = {"rise": "high", "drop": "deep", "ridge": "high", "ditch": "deep"}
SHAPES: dict[str, str | None] = {
    **_STRAIGHT,
    **{f"oblique {kind}": size for kind, size in _STRAIGHT.items()},
    **dict.fromkeys(("ridge end", "knob", "gentle hill"), "high"),
    **dict.fromkeys(("ditch end", "hole", "gentle hollow"), "deep"),
    **dict.fromkeys(("side slope", OFF_THE_WAY)),
}
"""Causes that are shapes, by what their height is called; None where its sign says whether it is high or deep."""

_BEHIND = 1.25  # how far before the place where robots end something may have stopped them [m]
_AHEAD = 0.75
_BESIDE = 0.4
_COARSE = 2  # nodes; parts are compared at 0.1 m
_NEAR = 1.0  # an oblique ridge goes on before and behind the place where it is highest under the robot [m]
_CENTRE = round(CrossingCfg.start[1] / SPACING)  # the row of the straight way
_FIRST_MET = 0.9  # share of the steepest slope; the first place that is as steep counts


@dataclass(frozen=True, kw_only=True)
class Shape:
    """How a robot meets a part that lies alone on flat ground. Slopes are those of its steepest place."""

    kind: str  # one of SHAPES, SLIPPERY, SOFT, or the cause of a condition; docs/faults.md has limits
    height_m: float = 0.0  # height under the robot where it is largest, negative of a hollow [m]
    slope_deg: float = 0.0  # steepest slope under the robot [degrees]
    along_deg: float = 0.0  # slope along the way, negative where the ground falls [degrees]
    across_deg: float = 0.0  # slope across the way [degrees]
    oblique_deg: float = 0.0  # angle between the way and the steepest rise or fall, 0 to 90 [degrees]
    length_m: float = 0.0  # length of the way over which it has at least half of that height, through that place [m]
    left_m: float = 0.0  # how far left of the way it has that height, within 1 m along the way of that place [m]
    right_m: float = 0.0  # how far right of the way [m]; negative where it lies to the left alone


@dataclass(frozen=True, kw_only=True)
class Effects:
    """What each of some parts of a terrain does."""

    heights: NDArray[np.float32]  # heights that it adds to the others [m], shape (num_parts, nrow, ncol)
    slippery: NDArray[np.bool_]  # patches that it makes slippery, shape (num_parts, rows, cols) of its map
    soft: NDArray[np.bool_]  # patches that it makes soft, of the same shape
    conditions: tuple[str, ...]  # the kind of condition that each part sets; empty where it sets none

    @property
    def patches(self) -> NDArray[np.bool_]:
        """Patches whose ground it changes."""
        return self.slippery | self.soft

    def changes(self, least: float) -> NDArray[np.bool_]:
        """Whether a part sets a condition, or changes the ground, or heights by over ``least`` [m]; (num_parts,)."""
        sets = np.array([kind != "" for kind in self.conditions], bool)
        return sets | (np.abs(self.heights).max(axis=(1, 2)) > least) | self.patches.any(axis=(1, 2))

    def way(self, part: int, half_width: float) -> tuple[float, bool]:
        """Largest height or depth [m] of a part under a robot on its way, and whether it changes the ground there."""
        patches = self.patches[part]
        x, y = CrossingCfg.start
        first_row, last_row = patch_index((y - half_width, y + half_width), SPACING * (NUM_ROWS - 1), patches.shape[0])
        first, last = patch_index((x, CrossingCfg.goal[0]), SPACING * (NUM_COLS - 1), patches.shape[1])
        changed = patches[first_row : last_row + 1, first : last + 1].any()
        return float(np.abs(_under(self.heights[part], half_width)).max()), bool(changed)

    def shape(self, part: int, half_width: float) -> Shape:
        """The shape of a part. A condition has only a kind, and so has a part that changes the ground alone."""
        name = self.conditions[part]
        kind = CONDITIONS[name].cause if name else None
        if kind is None and self.patches[part].any() and self.way(part, half_width)[0] < _LEAST_HEIGHT:
            kind = SLIPPERY if self.slippery[part].any() else SOFT
        return Shape(kind=kind) if kind else measure_shape(self.heights[part], half_width)


def describe_cause(cause: Mapping[str, Any] | None) -> str:
    """A cause with the values of its :class:`Shape`: ``ridge, 0.25 m high, 53 degrees steep``."""
    if cause is None:
        return UNCLEAR
    kind, height = cause["kind"], cause.get("height_m")
    if not height:
        return kind
    size = SHAPES[kind] or ("high" if height > 0.0 else "deep")
    steep = f", {cause['slope_deg']:.0f} degrees steep" if "slope_deg" in cause else ""
    return f"{kind}, {abs(height):.2f} m {size}{steep}"


def describe_commonest(kind: str) -> str:
    """That most terrains stop the robot by a cause: ``ridges are the commonest cause``."""
    if kind not in SHAPES or kind == OFF_THE_WAY:
        return f"{kind} is the commonest cause"
    return f"{kind}{'es' if kind.endswith('ch') else 's'} are the commonest cause"


def find_effects(genes: NDArray[np.float32], parts: Sequence[int], space: TerrainSpace) -> Effects:
    """What some parts of a terrain, of genes of shape (num_genes,), do, each beside all others."""
    rows = [genes[None], *(space.without(genes[None], [part]) for part in parts)]
    heights, ground = make_terrains(np.concatenate(rows), space)
    nothing = np.zeros((len(parts), *PATCHES), bool)
    texts = condition_texts(space.condition_rows(genes[None])[0], space.conditions)
    first = len(space.parts(genes)) - len(texts)
    conditions = {first + k: name for k, name in enumerate(space.conditions) if texts[k]}
    return Effects(
        heights=heights[0] - heights[1:],
        slippery=nothing if ground is None else ground.friction[0] != ground.friction[1:],
        soft=nothing if ground is None else ground.time_constant_s[0] != ground.time_constant_s[1:],
        conditions=tuple(conditions.get(part, "") for part in parts),
    )


def find_causes(
    genes: NDArray[np.float32], ends: NDArray[np.floating], space: TerrainSpace, half_width: float
) -> list[str]:
    """What stops robots that end at a place of each terrain: the kind of a :class:`Shape`, or :data:`UNCLEAR`.

    It is the part which, alone on flat ground, has the largest difference of heights near that place; where that is
    under 3 cm, slippery or soft ground. How near was chosen on half of the elites in results/ with minimal terrains. Of
    the others it names the cause's kind in six of ten, in seven if oblique counts as straight; a random part in three.
    Genes have shape (N, num_genes), ``ends`` are world-local x and y [m], (N, 2), NaN where they are not known.
    """
    return [_find_cause(*terrain, space, half_width) for terrain in zip(genes, ends, strict=True)]


def _find_cause(genes: NDArray[np.float32], end: NDArray[np.floating], space: TerrainSpace, half_width: float) -> str:
    if not np.isfinite(end).all():
        return UNCLEAR
    raised = space
    while isinstance(raised, WiderSpace):
        raised = raised.inner
    row = genes[None, : raised.num_genes]
    parts = range(len(raised.parts(row[0])))
    alone = [raised.without(row, [other for other in parts if other != part]) for part in parts] or [row]
    every = _COARSE if space.any_spacing else 1
    maps = make_heights(np.concatenate(alone), raised, every=every)
    x, y = end.tolist()
    limits = np.array([[y - _BESIDE, y + _BESIDE], [x - _BEHIND, x + _AHEAD]]) / (every * SPACING)
    nodes = np.clip(np.rint(limits), 0, np.array(maps.shape[1:])[:, None] - 1).astype(int)
    rows, columns = (slice(first, last + 1) for first, last in nodes.tolist())  # near the end, or nearest to it
    differences = np.ptp(maps[:, rows, columns], axis=(1, 2))
    part = int(np.argmax(differences))
    if differences[part] < _LEAST_HEIGHT:
        _, ground = make_terrains(genes[None], space) if space.ground else (None, None)
        if ground is None:
            return UNCLEAR
        patch_row = patch_index(y, SPACING * (NUM_ROWS - 1), PATCHES[0])
        patch_column = patch_index(x, SPACING * (NUM_COLS - 1), PATCHES[1])
        if ground.friction[0, patch_row, patch_column] < 1.0:
            return SLIPPERY
        return SOFT if ground.time_constant_s[0, patch_row, patch_column] != FIRM else UNCLEAR
    heights = maps[part] if every == 1 else make_heights(alone[part], raised)[0]
    at_end = np.roll(heights, round((CrossingCfg.start[1] - float(end[1])) / SPACING), axis=0)
    kinds = (measure_shape(field, half_width).kind for field in (heights, at_end))  # robots may leave the straight way
    return next((kind for kind in kinds if kind != OFF_THE_WAY), UNCLEAR)


def measure_shape(field: NDArray[np.float32], half_width: float) -> Shape:
    """The shape of a part that adds heights [m], (nrow, ncol), under a robot of ``half_width`` [m] on its way."""
    heights = field.astype(np.float64)
    by_y, by_x = (np.gradient(heights, SPACING, axis=axis) for axis in (0, 1))
    ground, along, across = (_under(np.asarray(values), half_width) for values in (heights, by_x, by_y))
    column, row = np.unravel_index(np.abs(ground).argmax(), ground.shape)
    height = float(ground[column, row])
    steepness = np.hypot(along, across)
    met = np.argwhere(steepness >= _FIRST_MET * steepness.max())
    met = met[met[:, 0] == met[0, 0]]
    steepest = (int(met[0, 0]), int(met[np.argmax(steepness[*met.T]), 1]))
    # How far it has half of its height to either side of the way, near where it is highest.
    middle = _CENTRE - round(half_width / SPACING) + int(row)
    first = round(CrossingCfg.start[0] / SPACING) + int(column)
    near = round(_NEAR / SPACING)
    window = heights[:, max(first - near, 0) : first + near + 1]
    low = (window * np.sign(height) < abs(height) / 2).all(axis=1)
    low = np.pad(low, 1, constant_values=True)  # the grid's edge ends it
    slopes = {"slope_deg": steepness, "along_deg": along, "across_deg": across}
    numbers = {
        "height_m": height,
        **{name: float(np.rad2deg(np.arctan(float(values[steepest])))) for name, values in slopes.items()},
        "oblique_deg": float(np.rad2deg(np.arctan2(abs(across[steepest]), abs(along[steepest])))),
        "length_m": SPACING * int((np.abs(ground[:, row]) >= abs(height) / 2).sum()) if height else 0.0,
        "left_m": SPACING * (middle + int(low[middle + 1 :].argmax()) - _CENTRE),
        "right_m": SPACING * (_CENTRE - middle + int(low[middle + 1 :: -1].argmax())),
    }
    return Shape(kind=_classify(numbers), **{name: round(value, 3) for name, value in numbers.items()})


def _classify(shape: dict[str, float]) -> str:
    """The kind of a shape by the limits above; docs/faults.md has them as a table."""
    raised = shape["height_m"] > 0.0
    if abs(shape["height_m"]) < _LEAST_HEIGHT:
        return OFF_THE_WAY
    if shape["slope_deg"] < _GENTLE:
        return "gentle hill" if raised else "gentle hollow"
    if shape["length_m"] <= _SHORT:
        name = "ridge" if raised else "ditch"
        ends = sum(shape[side] < _NARROW for side in ("left_m", "right_m"))
        if ends:
            return f"{name} end" if ends == 1 else "knob" if raised else "hole"
    elif shape["oblique_deg"] > _SIDEWAYS:
        return "side slope"
    else:
        name = "rise" if shape["along_deg"] > 0.0 else "drop"
    return name if shape["oblique_deg"] <= _HEAD_ON else f"oblique {name}"


def _under(values: NDArray[Any], half_width: float) -> NDArray[Any]:
    """Values of the nodes under the robot, shape (along the way, across it)."""
    first, last = (round(x / SPACING) for x, _ in (CrossingCfg.start, CrossingCfg.goal))
    reach = round(half_width / SPACING)
    return values[_CENTRE - reach : _CENTRE + reach + 1, first : last + 1].T
