"""Kernels in which some threads of a GPU's warp work on one world together; on a CPU one thread does.

The threads share the world's memory and leave out parked worlds. Kernel bodies are C++ (``.cu`` files), for shuffles
and barriers, which Warp's language does not have. A block is one warp, so that a world that is done early frees its
multiprocessor.
"""

from pathlib import Path
from string import Template
from typing import Any

import warp as wp

_WARP = 32
_BLOCK_FLOATS = 12 * 1024  # 48 KiB: what a block may have without asking
_PROLOGUE = Path(__file__).with_suffix(".cu")


def fits_block(num_floats: int, lanes: int) -> bool:
    """Whether a block has shared memory for its worlds, of ``lanes`` threads and ``num_floats`` floats each."""
    return 0 < num_floats * (_WARP // lanes) <= _BLOCK_FLOATS


def snippet(body: Path, *, num_floats: int, lanes: int, **values: Any) -> str:
    """The body of a native function of ``robots`` and an int ``thread``: lanes.cu, then the C++ file ``body``.

    On a GPU a world has ``lanes`` threads, a power of 2 up to 32, and ``num_floats`` floats of memory. ``values``
    replace the ``$names`` in the file.
    """
    source = Template(_PROLOGUE.read_text() + body.read_text())
    return source.substitute(values, num_floats=num_floats, lanes=lanes, worlds=_WARP // lanes)


def launch(kernel: Any, num_worlds: int, inputs: list[Any], *, lanes: int, device: Any) -> None:
    """Launch a kernel of grid (num_worlds * lanes,), with one thread a world on a CPU."""
    wp.launch(kernel, num_worlds * (1 if device.is_cpu else lanes), inputs=inputs, block_dim=_WARP, device=device)
