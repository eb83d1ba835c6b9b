"""Checkpoints: the whole state of a search in one file that is checked before it is read, and read as data.

A file is a line of magic, the SHA-256 of the rest, and a pickle. The hash finds damage; against files made to harm, the
unpickler builds only the classes listed here, none of which runs code or opens files when built.
"""

import hashlib
import io
import pickle
from pathlib import Path
from typing import Any

from qd.search.methods import METHODS
from sim.files.atomic import write_atomically

REMEDY = "put a copy of it back, or start a new run"
_KIND = b"faultline search checkpoint "
_MAGIC = _KIND + b"9\n"
_HASH_BYTES = 32
_ADMITTED = {
    "numpy": ("dtype", "ndarray", "float32", "float64", "int32", "int64"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "numpy._core.numeric": ("_frombuffer",),
    "numpy.random._pcg64": ("PCG64",),
    "numpy.random._pickle": ("__bit_generator_ctor", "__generator_ctor"),
    "numpy.random.bit_generator": ("SeedSequence", "__pyx_unpickle_SeedSequence"),
    "ribs.archives._archive_stats": ("ArchiveStats",),
    "ribs.archives._array_store": ("ArrayStore",),
    "ribs.archives._grid_archive": ("GridArchive",),
    "ribs.emitters._evolution_strategy_emitter": ("EvolutionStrategyEmitter",),
    "ribs.emitters._iso_line_emitter": ("IsoLineEmitter",),
    "ribs.emitters.opt._cma_es": ("CMAEvolutionStrategy", "DecompMatrix"),
    "ribs.emitters.rankers": ("ImprovementRanker", "TwoStageImprovementRanker"),
    "qd.search.descriptors": ("Cells",),
    "qd.search.fitness": ("Evaluation", "FitnessCfg"),
    "qd.search.pool": ("Pool",),
    "qd.search.presets": ("SchedulerCfg",),
    "qd.search.scheduler": ("Asked", "Scheduler"),
    "qd.search.surrogate.surrogate": ("Surrogate",),
    "sim.terrains.conditions.likely": ("Disturbance",),
}
"""Classes that a state may hold, by their modules; methods of search beside them, by their names alone."""


class _StateUnpickler(pickle.Unpickler):
    """Builds plain values and the admitted classes."""

    def find_class(self, module: str, name: str) -> Any:
        if name in (methods := {method.__name__: method for method in METHODS.values()}):
            return methods[name]
        if name not in _ADMITTED.get(module, ()):
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is no part of a search")
        return super().find_class(module, name)


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Writes the state of a search, plain values, NumPy arrays and pyribs objects, atomically."""
    payload = pickle.dumps(state, protocol=5)
    write_atomically(path, _MAGIC + hashlib.sha256(payload).digest() + payload)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Reads the state of a search that :func:`save_checkpoint` wrote, as data; a file of anything else is refused."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path} must be a search checkpoint, got: {error.strerror}; {REMEDY}") from None
    header = len(_MAGIC) + _HASH_BYTES
    if not data.startswith(_KIND):
        raise ValueError(f"{path} must start with {_KIND!r}, got {data[: len(_KIND)]!r}: another file's; {REMEDY}")
    if not data.startswith(_MAGIC):
        raise ValueError(f"{path} was written by another version of faultline: start a new run")
    payload = data[header:]
    if hashlib.sha256(payload).digest() != data[len(_MAGIC) : header]:
        damage = f"its {len(payload)} bytes of state do not have their SHA-256"
        raise ValueError(f"{path} is truncated or damaged: {damage}; {REMEDY}")
    try:
        state = _StateUnpickler(io.BytesIO(payload)).load()
    except Exception as error:  # a stream of pickle opcodes can fail with anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{path} is no checkpoint of a search: {reason}; {REMEDY}") from None
    if not isinstance(state, dict):
        raise ValueError(f"{path} is no checkpoint of a search: expected a dictionary, got {type(state).__name__}")
    return state
