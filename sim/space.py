"""Terrain spaces: what a row of genes in [-1, 1] means. Another one is one more class and its place in ``SPACES``."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels import super_gaussian
from kernels.super_gaussian import GENES_PER_BUMP, LOWER, PARAMETERS, UPPER
from sim.ground import check_kinds, joined_name, split_name
from sim.policy.spec import ControllerSpec, controller_hash
from sim.spaces.base import Seed as Seed
from sim.spaces.base import TerrainSpace as TerrainSpace
from sim.spaces.base import clipped as clipped
from sim.spaces.course import COURSE
from sim.spaces.ground import OnGround

_HEIGHT = PARAMETERS.index("w")


@dataclass(frozen=True, kw_only=True)
class SuperGaussian(TerrainSpace):
    """The paper's terrains: sums of rotated Super-Gaussian bumps (eq. 1; genes rescaled by Table I)."""

    num_bumps: int = 8

    def __post_init__(self) -> None:
        if self.num_bumps < 1:
            raise ValueError(f"num_bumps must be at least 1, got {self.num_bumps}")

    @property
    def name(self) -> str:
        """What files and command lines call the space."""
        return "super_gaussian"

    @property
    def num_genes(self) -> int:
        """Eight genes a bump, in the order of :data:`kernels.super_gaussian.PARAMETERS`, bump after bump."""
        return self.num_bumps * GENES_PER_BUMP

    @property
    def any_spacing(self) -> bool:
        """A bump has a height everywhere."""
        return True

    @property
    def genes_per_part(self) -> int:
        """A part is a bump."""
        return GENES_PER_BUMP

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights on the device (:func:`kernels.super_gaussian.rasterise`)."""
        super_gaussian.rasterise(genes, spacing, heights_out)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Uniform genes, but every bump at its lowest or highest height: the paper's hard-random terrains."""
        genes = self.uniform_random(count, seed)
        heights = genes[:, _HEIGHT::GENES_PER_BUMP]
        heights[:] = np.where(heights < 0.0, -1.0, 1.0)
        return genes

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Each bump in words."""
        bumps = clipped(genes).reshape(self.num_bumps, GENES_PER_BUMP)
        return tuple(map(_in_words, LOWER + (bumps + 1.0) / 2.0 * (UPPER - LOWER)))

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes with the heights of some bumps at zero."""
        found = self.validate(genes).copy()
        found[:, np.asarray(parts, dtype=int) * GENES_PER_BUMP + _HEIGHT] = 0.0  # the middle of -0.25 m to 0.25 m
        return found

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32]:
        """Genes with the height of every bump times ``scale``."""
        found = clipped(self.validate(genes))
        found[:, _HEIGHT::GENES_PER_BUMP] *= scale  # 0 is the height in the middle of its range
        return found


def _in_words(bump: NDArray[np.float64]) -> str:
    x, y, sigma_x, sigma_y, _, _, theta, height = bump
    kind = "bump" if height >= 0.0 else "hollow"
    return (
        f"{kind} of {abs(height):.2f} m at ({x:.1f}, {y:.1f}) m, half widths {sigma_x:.1f} m and {sigma_y:.1f} m, "
        f"turned by {np.rad2deg(theta):.0f} degrees"
    )


SUPER_GAUSSIAN = SuperGaussian()
SPACES: dict[str, TerrainSpace] = {space.name: space for space in (SUPER_GAUSSIAN, COURSE)}
"""Every shipped space by its name."""
_named: list[TerrainSpace] = []
"""Spaces of a user's own that this process was told to run."""


def is_own(name: str) -> bool:
    """Whether a space is code of a user's own."""
    base, _ = split_name(name)
    return base not in SPACES and ControllerSpec.parse(base).runs_code


def to_be_named(name: str) -> str | None:
    """What commands have to name (--space) for a space: it, if it is a user's own code; else nothing."""
    return name if is_own(name) else None


def space_identity(name: str) -> str:
    """What the terrains of a space depend on: its name, or the hash of its code where it has one, and its ground."""
    base, _ = split_name(name)
    return recorded_identity(name, controller_hash(base) if is_own(name) else None)


def recorded_identity(name: str, sha256: str | None) -> str:
    """:func:`space_identity` of a space that a record names, with the hash of its code there."""
    base, kinds = split_name(name)
    return joined_name(sha256 or base, kinds)


def on_ground(named: str | None, kinds: Sequence[str] | None) -> str | None:
    """The name of a space with the ground that a command line asks for; None if it names neither.

    Args:
        named: As of :func:`load_space`; the paper's if None.
        kinds: As of :func:`sim.ground.check_kinds`; those of the name if None.

    Raises:
        ValueError: If a kind is unknown, or the name has another ground already.
    """
    if kinds is None:
        return named
    (base, there), wanted = split_name(named or SUPER_GAUSSIAN.name), check_kinds(kinds)
    if there and there != wanted:
        raise ValueError(
            f"the space {named} has ground of its own, {' and '.join(there)}, got --ground {' '.join(wanted)}: leave "
            "one of them out"
        )
    return joined_name(base, wanted)


def load_space(named: str) -> TerrainSpace:
    """A space that the command line names; one of a user's own is run, and :func:`get_space` finds it from then on.

    Args:
        named: A shipped space's name, ``file.py:Space`` or ``module:Space``, and behind it the maps of its ground, as
            in ``course+friction+softness``.

    Raises:
        ValueError: If there is no such space, or it does not work.
    """
    base, kinds = split_name(named)
    if not is_own(base):
        return get_space(named)
    from sim.spaces.own import load_own  # with torch

    digest = controller_hash(base)
    for space in _named:
        if space.name == base and space.sha256 == digest and digest is not None:
            return _with_ground(space, kinds)
    space = load_own(base)
    _named.insert(0, space)
    return _with_ground(space, kinds)


def _with_ground(space: TerrainSpace, kinds: tuple[str, ...]) -> TerrainSpace:
    if kinds and space.ground:
        raise ValueError(
            f"the space {space.name} has {' and '.join(space.ground)} of its own, got --ground {' '.join(kinds)}: "
            "leave --ground out"
        )
    return OnGround(inner=space, kinds=kinds) if kinds else space


def get_space(name: str, sha256: str | None = None, *, file: Path | None = None) -> TerrainSpace:
    """A space that a record names; no code runs that :func:`load_space` did not run.

    Args:
        name: What the record calls it.
        sha256: Hash of its code that the record names, by which one that has moved is known.
        file: The record, for errors.

    Raises:
        ValueError: If there is no such space, the command line did not name it, or it has changed since.
    """
    base, kinds = split_name(name)
    return _with_ground(_get_base(base, sha256, file), kinds)


def _get_base(name: str, sha256: str | None, file: Path | None) -> TerrainSpace:
    """:func:`get_space` without ground."""
    if name in SPACES:
        return SPACES[name]
    where = "" if file is None else f"{file}: "
    if not is_own(name):
        raise ValueError(
            f"{where}unknown terrain space '{name}': expected one of {', '.join(SPACES)}, or file.py:CLASS "
            "(docs/own-space.md)"
        )
    for space in _named:
        if space.name == name if sha256 is None else space.sha256 == sha256:
            return space
    for space in _named:
        if space.name == name:
            raise ValueError(
                f"{where}terrains are of the space {name} as it was: its code has changed since (expected SHA-256 "
                f"{_short(sha256)}, got {_short(space.sha256)}): put back what was there then, or search anew"
            )
    raise ValueError(
        f"{where}terrains are of the space {name}, which is code: name it again (--space {shlex.quote(name)}), since "
        "no code runs that the command line does not name"
    )


def recorded_space(name: str, sha256: str | None, *, named: str | None, file: Path | None) -> TerrainSpace:
    """A space that a record names, once the one that the command line names, if any, is loaded.

    Args:
        name: What the record calls it.
        sha256: Hash of its code that the record names.
        named: What the command line names.
        file: The record, for errors.

    Raises:
        ValueError: As of :func:`load_space` and :func:`get_space`.
    """
    if named is not None:
        load_space(named)
    return get_space(name, sha256, file=file)


def _short(digest: str | None) -> str:
    return str(digest)[:12]


def read_pool(path: Path) -> tuple[NDArray[np.float32], TerrainSpace]:
    """Genes of a pool, shape (num_terrains, num_genes), and the space that its file names, the paper's if none.

    Raises:
        ValueError: If the file holds no genes of a known space.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            genes = content["genes"]
            name = str(content["space"]) if "space" in content else SUPER_GAUSSIAN.name
            digest = str(content["space_sha256"]) if "space_sha256" in content else None
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(f"--genes {path}: expected an .npz file with an array 'genes', got: {error}") from error
    space = get_space(name, digest, file=path)
    try:
        if not len(genes) or genes.dtype.kind != "f":
            raise ValueError(f"they must be floats, one row a terrain, got {genes.dtype} of shape {genes.shape}")
        with np.errstate(over="ignore"):
            return space.validate(genes.astype(np.float32)), space
    except (ValueError, TypeError) as error:
        raise ValueError(f"--genes {path}: 'genes': {error}") from None
