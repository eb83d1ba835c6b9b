"""How kernels are launched: over the entries of an array, or with some threads of a GPU's warp for each world.

Threads of a warp share the world's memory and leave out parked worlds; on a CPU one thread does their work. Bodies of
such kernels are C++ (``.cu`` files), for shuffles and barriers, which Warp's language does not have. A block is one
warp, so that a world that is done early frees its multiprocessor.
"""

from collections.abc import Callable, Sequence
from inspect import signature
from operator import attrgetter
from pathlib import Path
from string import Template
from types import SimpleNamespace
from typing import Any

import warp as wp

_WARP = 32
_BLOCK = 64  # threads of a block of a grid: few, so that a small grid reaches all multiprocessors
_BLOCK_FLOATS = 12 * 1024  # 48 KiB: what a block may have without asking
_LEAST = """
#if defined(__CUDA_ARCH__)
const unsigned others = ((1u << lanes) - 1u) << (threadIdx.x % 32 / lanes * lanes);
for (int k = lanes / 2; k > 0; k /= 2) x = wp::min(x, __shfl_xor_sync(others, x, k));
#endif
return x;
"""
_PROLOGUE = Path(__file__).with_name("lanes.cu")


def launch_grid(kernel: Any, size: tuple[int, ...], inputs: Sequence[Any], device: Any) -> None:
    """Launch a kernel of so many threads; all kernels of a module by this function, or it is compiled twice."""
    wp.launch(kernel, size, inputs=inputs, device=device, block_dim=_BLOCK)


@wp.func_native(_LEAST)
def least_of_lanes(x: int, lanes: int) -> int:
    """Least x of ``lanes`` threads beside each other, all of which call it: a power of 2 up to 16, 1 on a CPU."""
    ...


@wp.func_native(_LEAST)
def least_float_of_lanes(x: float, lanes: int) -> float:
    """The same of floats."""
    ...


def kernel_over(array: str, **options: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a Warp kernel of a function, and of its name a function that launches it on arguments in the same order.

    The grid is the shape of one ``array``: an argument, or a field of one ("episodes_out.outcome"). ``options`` are
    those of ``warp.kernel``.
    """

    def make_launcher(function: Callable[..., None]) -> Callable[..., None]:
        kernel = wp.kernel(function, **options)
        names = signature(function).parameters

        def launch_kernel(*arguments: Any) -> None:
            over = attrgetter(array)(SimpleNamespace(**dict(zip(names, arguments, strict=True))))
            launch_grid(kernel, over.shape, arguments, over.device)

        launch_kernel.__doc__ = function.__doc__
        return launch_kernel

    return make_launcher


def make_struct(struct: Any, *sources: Any, **values: Any) -> Any:
    """A kernel argument with these values, and with what ``sources`` have under the names of other fields."""
    named = {name: getattr(source, name) for source in sources for name in struct.vars if hasattr(source, name)}
    made = struct()
    for name, value in (named | values).items():
        setattr(made, name, value)
    return made


def make_zeros(struct: Any, device: str | None, **shapes: int | tuple[int, ...]) -> Any:
    """A kernel argument whose arrays have these shapes, with zeros of the types that its struct names."""
    types = {name: struct.vars[name].type.dtype for name in shapes}
    return make_struct(struct, **{name: wp.zeros(shapes[name], dtype=types[name], device=device) for name in shapes})


def fits_block(num_floats: int, lanes: int) -> bool:
    """Whether a block has shared memory for its worlds, of ``lanes`` threads and ``num_floats`` floats each."""
    return 0 < num_floats * (_WARP // lanes) <= _BLOCK_FLOATS


def fill_snippet(body: Path, *, num_floats: int, lanes: int, **values: Any) -> str:
    """The body of a native function of ``robots`` and an int ``thread``: lanes.cu, then the C++ file ``body``.

    On a GPU a world has ``lanes`` threads, a power of 2 up to 32, and ``num_floats`` floats of memory. ``values``
    replace the ``$names`` in the file.
    """
    source = Template(_PROLOGUE.read_text() + body.read_text())
    return source.substitute(values, num_floats=num_floats, lanes=lanes, worlds=_WARP // lanes)


def launch_lanes(kernel: Any, num_worlds: int, inputs: list[Any], *, lanes: int, device: Any) -> None:
    """Launch a kernel of grid (num_worlds * lanes,), with one thread a world on a CPU."""
    wp.launch(kernel, num_worlds * (1 if device.is_cpu else lanes), inputs=inputs, block_dim=_WARP, device=device)
