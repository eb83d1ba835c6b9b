"""Terrain spaces of a user: code that the command line names, tried before any long work."""

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray

from kernels.ground import COLS, PATCH, ROWS, Ground
from sim.ground import GROUND_KINDS, check_friction, check_time_constant
from sim.policy.spec import ControllerSpec, controller_hash, find_named, in_one_line
from sim.spaces.base import DEFAULT_SIGMA0, Seed, TerrainSpace, clipped

_MOST_GENES = 10_000
_PAGE = "docs/own-space.md shows a whole one"
_TRIED = 2  # terrains


class OwnSpace(TerrainSpace):
    """A space of a user's own, with what it returns checked.

    Args:
        spec: What the command line calls it: ``file.py:Space`` or ``module:Space``.
        own: What is found there. It has ``num_genes`` and ``rasterise(genes, x, y)``, and may have ``hard_random(count,
            rng)``, ``describe(genes)``, ``parts(genes)`` with ``without(genes, parts)``, ``scaled(genes,
            scale)``, ``friction(genes, x, y)``, ``softness(genes, x, y)``, ``genes_per_part``, and ``sigma0``.

    Raises:
        ValueError: If it lacks something, or what it has is not as it must be.
    """

    def __init__(self, spec: str, own: Any) -> None:
        self._spec, self._own = spec, own
        self._sha256 = controller_hash(spec)
        number = getattr(own, "num_genes", None)
        if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= _MOST_GENES:
            raise self._wrong("num_genes", f"must be a whole number of 1 to {_MOST_GENES}, got {number!r}: {_PAGE}")
        self._num_genes: int = number
        missing = [name for name in ("rasterise",) if not callable(getattr(own, name, None))]
        missing += ["without"] * (hasattr(own, "parts") and not callable(getattr(own, "without", None)))
        if missing:
            raise self._wrong(missing[0], f"must be a method, got none: {_PAGE}")
        sigma0 = getattr(own, "sigma0", DEFAULT_SIGMA0)
        if not isinstance(sigma0, int | float) or not 0.0 < sigma0 < np.inf:
            raise self._wrong("sigma0", f"must be a positive number, got {sigma0!r}")
        self._sigma0 = float(sigma0)
        per_part = getattr(own, "genes_per_part", None)
        if per_part is not None and (
            isinstance(per_part, bool) or not isinstance(per_part, int) or per_part < 1 or number % per_part
        ):
            raise self._wrong("genes_per_part", f"must divide num_genes, {number}, got {per_part!r}")
        self._genes_per_part: int | None = per_part

    @property
    def name(self) -> str:
        """What the command line calls it."""
        return self._spec

    @property
    def num_genes(self) -> int:
        """Length of one row of genes."""
        return self._num_genes

    @property
    def sha256(self) -> str | None:
        """Hash of its file and its name there; None of a module without a file."""
        return self._sha256

    @property
    def sigma0(self) -> float:
        """First step size of a search whose command line names none."""
        return self._sigma0

    @property
    def genes_per_part(self) -> int | None:
        """Genes of a part that can be exchanged for that of another terrain; None if it names no number."""
        return self._genes_per_part

    @property
    def ground(self) -> tuple[str, ...]:
        """What it has methods for beside ``rasterise``."""
        return tuple(kind for kind in GROUND_KINDS if callable(getattr(self._own, kind, None)))

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into maps, as tensors on the device that the arrays are on.

        Raises:
            ValueError: If a method of the user's fails, or returns anything but a map in range.
        """
        rows, stream = self._on_device(genes)
        with torch.no_grad(), torch.cuda.stream(stream):  # pyright: ignore[reportArgumentType] - None: nothing to do
            middles = (PATCH * (torch.arange(count, device=rows.device) + 0.5) for count in (ROWS, COLS))
            y, x = torch.meshgrid(*middles, indexing="ij")
            for kind in self.ground:
                target, check = {
                    "friction": (ground_out.friction, check_friction),
                    "softness": (ground_out.time_constant, check_time_constant),
                }[kind]
                out = wp.to_torch(target)
                found = self._values(kind, self._call(kind, rows, x, y), tuple(out.shape), rows.device)
                try:
                    check(found.cpu().numpy())
                except ValueError as error:
                    raise self._wrong(kind, f"must return a map: {error}") from None
                out.copy_(found)

    def _on_device(self, genes: Any) -> tuple[torch.Tensor, Any]:
        """Clipped genes as a tensor, and the stream that the device works on; None on the CPU."""
        rows = wp.to_torch(genes).clamp(-1.0, 1.0)
        return rows, None if rows.device.type == "cpu" else wp.stream_to_torch(wp.get_stream(genes.device))

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights, as tensors on the device that the arrays are on.

        Raises:
            ValueError: If the user's method fails, or returns anything but finite heights of the right shape.
        """
        (rows, stream), out = self._on_device(genes), wp.to_torch(heights_out)
        with torch.no_grad(), torch.cuda.stream(stream):  # pyright: ignore[reportArgumentType] - None: nothing to do
            nodes = (spacing * torch.arange(count, device=rows.device) for count in out.shape[1:])
            y, x = torch.meshgrid(*nodes, indexing="ij")
            found = self._call("rasterise", rows, x, y)
            out.copy_(self._values("rasterise", found, tuple(out.shape), rows.device))

    def _values(self, method: str, found: Any, shape: tuple[int, ...], device: torch.device) -> torch.Tensor:
        what, unit, place = ("heights", " [m]", "node") if method == "rasterise" else (method, "", "patch")
        if isinstance(found, np.ndarray) and found.dtype.kind in "fiu":
            found = torch.from_numpy(np.ascontiguousarray(found, dtype=np.float32)).to(device)
        if not isinstance(found, torch.Tensor) or found.is_complex():
            kind = f"an array of {found.dtype}" if isinstance(found, np.ndarray) else type(found).__name__
            raise self._wrong(method, f"must return a tensor of {what}{unit}, got {kind}")
        if tuple(found.shape) != shape:
            raise self._wrong(
                method,
                f"must return {what} of shape {shape} (terrains, y, x), got {tuple(found.shape)}: make them of "
                f"genes[:, k, None, None] and of x and y, which have a value a {place}",
            )
        finite = torch.isfinite(found).reshape(len(found), -1).all(dim=1)
        if not bool(finite.all()):
            terrain = int(torch.argmin(finite.int()))
            raise self._wrong(
                method, f"must return finite {what}, got NaN or infinity in terrain {terrain} of {len(found)}"
            )
        return found.to(device=device, dtype=torch.float32)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """What the user's method draws, clipped; uniform genes if it has none.

        Raises:
            ValueError: If that fails, or is anything but finite genes of the right shape.
        """
        if count < 1 or not hasattr(self._own, "hard_random"):
            return self.uniform_random(count, seed)
        found = self._rows("hard_random", self._call("hard_random", count, np.random.default_rng(seed)))
        if len(found) != count:
            raise self._wrong("hard_random", f"must return {count} rows of genes, got {len(found)}")
        return found

    def describe(self, genes: ArrayLike) -> str:
        """What the user's method says of a terrain; its parts, or its genes as numbers, if it has none."""
        row = clipped(genes)
        if hasattr(self._own, "describe"):
            return str(self._call("describe", row))
        return super().describe(row) or f"genes {', '.join(f'{gene:.2f}' for gene in row)}"

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """The parts that the user's method names; none if it has none."""
        found = self._call("parts", clipped(genes)) if hasattr(self._own, "parts") else ()
        if isinstance(found, str) or not isinstance(found, Sequence):
            raise self._wrong("parts", f"must return a list of texts, got {type(found).__name__}")
        return tuple(map(str, found))

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes of the same terrains without some of their parts.

        Raises:
            ValueError: If the space has no parts, or the user's method does not return genes.
        """
        rows = self.validate(genes)
        if not len(parts):
            return rows
        if not hasattr(self._own, "parts"):
            raise self._wrong("parts", "is missing: terrains of this space have no parts to take away")
        return self._rows("without", self._call("without", clipped(rows), list(parts)))

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32] | None:
        """What the user's method makes of genes; None if there is none.

        Raises:
            ValueError: If it does not return genes.
        """
        if not hasattr(self._own, "scaled"):
            return None
        return self._rows("scaled", self._call("scaled", clipped(self.validate(genes)), scale))

    def _rows(self, method: str, found: Any) -> NDArray[np.float32]:
        try:
            return clipped(self.validate(found))
        except (TypeError, ValueError) as error:
            raise self._wrong(method, f"must return genes: {error}") from None

    def _call(self, method: str, *arguments: Any) -> Any:
        called = getattr(self._own, method)
        try:
            return called(*arguments)
        except Exception as error:  # a user's code can fail with anything
            raise ValueError(f"space '{self._spec}': {method} fails: {in_one_line(error, called)}; mend it") from error

    def _wrong(self, what: str, text: str) -> ValueError:
        return ValueError(f"space '{self._spec}': {what} {text}")


def load_own(spec: str) -> OwnSpace:
    """Runs the code of a space and tries it on terrains in the middle of its genes and on hard-random ones.

    Args:
        spec: ``file.py:Space`` or ``module:Space``; a class is called without arguments.

    Raises:
        ValueError: If it cannot be loaded or does not work.
    """
    from sim.bank import terrains_of  # it needs the spaces

    named = ControllerSpec.parse(spec)
    assert named.place is not None and named.name is not None
    try:
        own: Any = find_named(named.place, named.name)
        own = own() if inspect.isclass(own) else own
    except Exception as error:  # a user's code can fail with anything
        raise ValueError(f"space '{spec}' cannot be loaded: {in_one_line(error)}; {_PAGE}") from error
    space = OwnSpace(spec, own)
    hard = space.hard_random(_TRIED, 0)
    terrains_of(np.concatenate([np.zeros((1, space.num_genes), np.float32), hard]), space)
    space.without(hard, range(len(space.parts(hard[0]))))
    space.scaled(hard, 0.5)
    space.describe(hard[0])
    return space
