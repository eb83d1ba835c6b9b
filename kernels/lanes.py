"""What kernels share in which a warp of a GPU does all of one world's work, in shared memory; on a CPU one thread does.

Their bodies are C++ (``.cu`` files), for a warp's shuffles and barriers, which Warp's language does not have.
"""

from pathlib import Path
from string import Template
from typing import Any

import warp as wp

_WARP = 32
_BLOCK_WORDS = 12 * 1024  # what a block may have without asking: 48 KiB
_MOST_WORLDS = 4  # of a block
_PROLOGUE = Path(__file__).with_suffix(".cu")


def fits(words: int) -> bool:
    """Whether a world that needs so many words of memory finds room in a block's shared memory."""
    return 0 < words <= _BLOCK_WORDS


def worlds_of_block(words: int) -> int:
    """How many worlds, each of words that :func:`fits`, share a block of threads."""
    return min(_MOST_WORLDS, _BLOCK_WORDS // words)


def snippet(body: Path, *, words: int, **values: Any) -> str:
    """The body of a native function of an int ``thread`` from a C++ file, after what lanes.cu declares.

    A world needs so many ``words`` of memory. ``values`` take the place of the ``$names`` in the file.
    """
    source = Template(_PROLOGUE.read_text() + body.read_text())
    return source.substitute(values, words=words, worlds=worlds_of_block(words), warp=_WARP)


def launch(kernel: Any, num_worlds: int, inputs: list[Any], *, words: int, device: Any) -> None:
    """Launches a kernel of a grid (num_worlds * lanes,) over worlds that each need so many words of memory."""
    lanes = 1 if device.is_cpu else _WARP
    wp.launch(kernel, num_worlds * lanes, inputs=inputs, block_dim=worlds_of_block(words) * _WARP, device=device)
