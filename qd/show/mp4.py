"""Films on disk."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.files.atomic import write_atomically


def write_film(
    path: Path, pictures: Iterator[NDArray[np.uint8]], fps: int, progress: Callable[[], object] | None = None
) -> int:
    """Encodes pictures as an MP4 (H.264) that plays everywhere, atomically.

    Args:
        path: File to write.
        pictures: RGB, all of one shape, with even sides.
        fps: Pictures a second.
        progress: Called after every picture.

    Returns:
        How many pictures there were.

    Raises:
        OSError: If the film cannot be encoded or written.
    """
    import imageio_ffmpeg  # found by nobody who asks for --help

    done = 0
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "film.mp4"
        writer: Any = None
        try:
            for picture in pictures:
                if writer is None:
                    size = (picture.shape[1], picture.shape[0])
                    writer = imageio_ffmpeg.write_frames(
                        str(draft), size, fps=fps, quality=7, macro_block_size=2, ffmpeg_log_level="error"
                    )
                    writer.send(None)
                writer.send(np.ascontiguousarray(picture))
                done += 1
                if progress is not None:
                    progress()
        finally:
            if writer is not None:
                writer.close()
        write_atomically(path, draft.read_bytes())
    return done
