"""Crossings and recordings on disk: arrays by key, in a folder of bounded size."""

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.files.atomic import locked, write_atomically
from sim.files.npz import npz_bytes, read_arrays
from sim.rollout import RolloutResult
from sim.terrains.terrains import Terrains

MAX_BYTES = 1_000_000_000
"""Size of a folder above which the least recently used files are removed."""
_KEY = "key"
_ROWS = "rows"


class Cache:
    """Arrays in the files of a folder, by key; the least recently used are removed, a damaged one counts as absent."""

    def __init__(self, folder: Path, *, max_bytes: int = MAX_BYTES) -> None:
        self.folder = folder
        self._max_bytes = max_bytes

    def file(self, key: str) -> Path:
        """The file of a key."""
        return self.folder / f"{key}.npz"

    def keys(self, prefix: str = "") -> list[str]:
        """Keys that have a file, sorted."""
        return sorted(file.stem for file in self.folder.glob(f"{prefix}*.npz"))

    def read(self, key: str, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]] | None:
        """The arrays of a key; None if there are none. Reading only those of some ``names`` is no use of the file."""
        file = self.file(key)
        try:
            arrays = read_arrays(file, None if names is None else [*names, _KEY])
            if str(arrays.pop(_KEY, "")) != key:
                raise ValueError("it is another key's")
        except FileNotFoundError:  # never written, or removed by another process
            return None
        except Exception as error:  # zip, zlib and npy headers answer damage with a dozen types
            with locked(self.folder):
                if file.is_file():
                    print(f"{file} is damaged ({' '.join(str(error).split())}): it is made again", flush=True)
                    file.unlink(missing_ok=True)
            return None
        if names is None:
            self.touch(key)
        return arrays

    def touch(self, key: str) -> None:
        """Notes that a file was used."""
        with suppress(FileNotFoundError):
            os.utime(self.file(key))

    def write(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Stores the arrays of a key in one step."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.folder):  # commands that run at once may share it
            write_atomically(self.file(key), npz_bytes({_KEY: np.array(key), **arrays}))
            self.remove_least_used(but=key)

    def remove_least_used(self, *, but: str) -> None:
        """Removes the least recently used files but one until the folder has its size."""
        files = []
        for file in self.folder.glob("*.npz"):
            with suppress(FileNotFoundError):  # removed by another process
                files.append((file.stat().st_mtime_ns, file.stat().st_size, file))
        size = sum(size for _, size, _ in files)
        for _, file_size, file in sorted(files):
            if size > self._max_bytes and file.stem != but:
                file.unlink(missing_ok=True)
                size -= file_size


class StoredCrossings:
    """Lots in a cache, by digests of terrains and seeds; ``settings`` hashes all else that episodes depend on."""

    def __init__(self, cache: Cache, settings: str, penalty_names: tuple[str, ...]) -> None:
        self._cache, self._settings, self._penalty_names = cache, settings, penalty_names
        self._index: dict[bytes, tuple[str, int]] = {}  # of a terrain, the file's key and the row there
        for key in cache.keys(settings):  # not those that other processes write later
            if stored := cache.read(key, [_ROWS]):
                self._index.update({row.tobytes(): (key, number) for number, row in enumerate(stored[_ROWS])})

    def read(self, terrains: Terrains) -> Iterator[tuple[NDArray[np.intp], RolloutResult]]:
        """Which of the terrains have been crossed, and their results, file by file."""
        by_file: dict[str, list[tuple[int, int]]] = {}
        for number, digest in enumerate(terrains.digests()):
            if entry := self._index.get(digest):
                by_file.setdefault(entry[0], []).append((number, entry[1]))
        for key, pairs in by_file.items():
            numbers, rows = np.array(pairs).T
            arrays = self._cache.read(key)
            if arrays is None:  # removed or damaged meanwhile
                continue
            del arrays[_ROWS]
            chosen: dict[str, Any] = {name: values[rows] for name, values in arrays.items()}
            yield numbers, RolloutResult(**chosen, penalty_names=self._penalty_names)

    def write(self, terrains: Terrains, result: RolloutResult) -> None:
        """Stores a lot."""
        digests = terrains.digests()
        key = f"{self._settings}-{hashlib.sha256(b''.join(digests)).hexdigest()[:32]}"
        self._cache.write(key, {_ROWS: np.array([[*row] for row in digests], np.uint8), **result.arrays})
        self._index.update({row: (key, number) for number, row in enumerate(digests)})
