"""What kernels share in which some threads of a GPU's warp do all of one world's work; on a CPU one thread does.

They share its memory, and leave out worlds that are parked. Their bodies are C++ (``.cu`` files), for shuffles and
barriers, which Warp's language does not have. A block is one warp, so that a world whose work ends soon holds no place
on a multiprocessor.
"""

from pathlib import Path
from string import Template
from typing import Any

import warp as wp

_WARP = 32
_BLOCK_WORDS = 12 * 1024  # what a block may have without asking: 48 KiB
_PROLOGUE = Path(__file__).with_suffix(".cu")


def fits(words: int, lanes: int) -> bool:
    """Whether worlds of so many ``lanes`` that need so many words of memory each find room in a block's."""
    return 0 < words * (_WARP // lanes) <= _BLOCK_WORDS


def snippet(body: Path, *, words: int, lanes: int, **values: Any) -> str:
    """The body of a native function of ``robots`` and an int ``thread`` from a C++ file, after what lanes.cu declares.

    On a GPU a world has so many ``lanes``, a power of 2 up to 32, and ``words`` of memory. ``values`` take the place of
    the ``$names`` in the file.
    """
    source = Template(_PROLOGUE.read_text() + body.read_text())
    return source.substitute(values, words=words, lanes=lanes, worlds=_WARP // lanes)


def launch(kernel: Any, num_worlds: int, inputs: list[Any], *, lanes: int, device: Any) -> None:
    """Launches a kernel of a grid (num_worlds * lanes,) over worlds that have so many on a GPU."""
    wp.launch(kernel, num_worlds * (1 if device.is_cpu else lanes), inputs=inputs, block_dim=_WARP, device=device)
