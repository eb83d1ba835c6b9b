"""The crossing service: controllers cross terrains, in lots that fill the device, and what is done is kept on disk.

A terrain's episodes depend on the terrain, its seed and the settings of the crossing alone. So each lot is stored as
soon as it is done, with a key for every terrain, and a terrain is found again in whatever lots: a command that was
stopped goes on when it is run again.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from qd.search.progress import Bar
from qd.workers.evaluator import Compute, EvaluatorCfg, Pipeline, available_cores, parse_workers
from qd.workers.invalid import report_invalid
from qd.workers.shards import arrays_of, join_results
from sim.controllers.spec import controller_hash, resolve_policy
from sim.files.atomic import locked, write_atomically
from sim.files.command import Interrupted
from sim.files.npz import array_names, npz_bytes, read_arrays
from sim.files.provenance import code_fingerprint
from sim.mujoco_c.crossing import cross_terrains
from sim.robots.find import get_robot
from sim.robots.identity import robot_identity
from sim.robots.robot import RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.spaces.registry import identity, load_space

How = Literal["searched", "resolved", "mujoco_c"]
"""Physics of the search; the same with contact resolved; MuJoCo C, with contact resolved there too."""

MOST_BYTES = 1_000_000_000
"""Size of a cache folder above which the files that were not used for longest go."""

_LOT_EPISODES = {"cuda": 16_384, "cpu": 20}  # of a worker; two lots are under way
_LOT_TERRAINS = 3_200  # of a worker at most: their height maps take 600 MB
_MUJOCO_C_LOT = 4  # terrains of a process
_KEY, _ROWS = "key", "rows"


class Cache:
    """Arrays in the files of a folder, by key. A damaged file counts as absent, in a printed line.

    Above ``most_bytes`` the files that were not used for longest are removed.
    """

    def __init__(self, folder: Path, *, most_bytes: int = MOST_BYTES) -> None:
        self.folder, self._most_bytes = folder, most_bytes

    def file(self, key: str) -> Path:
        """The file of a key."""
        return self.folder / f"{key}.npz"

    def keys(self, prefix: str = "") -> list[str]:
        """Keys that have a file, sorted."""
        return sorted(file.stem for file in self.folder.glob(f"{prefix}*.npz"))

    def read(self, key: str, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]] | None:
        """The arrays of a key, all of them or those named; None if there are none."""
        file = self.file(key)
        if not file.is_file():
            return None
        try:
            stored = [name for name in array_names(file) if names is None or name in (*names, _KEY)]
            arrays = read_arrays(file, stored)
            if str(arrays.pop(_KEY, "")) != key:
                raise ValueError("it is another key's")
            self.touch(key)
        except Exception as error:  # zip, zlib and npy headers answer damage with a dozen types
            print(f"{file} is damaged ({' '.join(str(error).split())}): it is made again", flush=True)
            file.unlink(missing_ok=True)
            return None
        return arrays

    def touch(self, key: str) -> None:
        """Notes that a file was used."""
        os.utime(self.file(key))

    def write(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Stores the arrays of a key in one step."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.folder):  # commands that run at once may share it
            write_atomically(self.file(key), npz_bytes({_KEY: np.array(key), **arrays}))
            self.remove_least_used(but=key)

    def remove_least_used(self, *, but: str) -> None:
        """Removes the files that were not used for longest, but one, until the folder has its size."""
        files = [(file, file.stat()) for file in self.folder.glob("*.npz")]
        size = sum(stat.st_size for _, stat in files)
        for file, stat in sorted(files, key=lambda pair: pair[1].st_mtime_ns):
            if size <= self._most_bytes:
                return
            if file.stem != but:
                file.unlink(missing_ok=True)
                size -= stat.st_size


class _Stored:
    """Crossings in a cache by the hash of terrain and seed; ``way`` is the hash of all else that they depend on."""

    def __init__(self, cache: Cache, way: str, penalty_names: tuple[str, ...]) -> None:
        self._cache, self._way, self._penalty_names = cache, way, penalty_names
        self._places: dict[bytes, tuple[str, int]] = {}  # of a terrain, the file's key and the row there
        for key in cache.keys(way):
            rows = (cache.read(key, [_ROWS]) or {}).get(_ROWS, np.zeros((0, 32), np.uint8))
            self._places.update({row.tobytes(): (key, place) for place, row in enumerate(rows)})

    def read(self, terrains: NDArray[Any], seeds: NDArray[Any]) -> Iterator[tuple[NDArray[np.intp], RolloutResult]]:
        """Which of the terrains have been crossed, and their results, file by file."""
        by_file: dict[str, list[tuple[int, int]]] = {}
        for number, row in enumerate(_row_keys(terrains, seeds)):
            if place := self._places.get(row):
                by_file.setdefault(place[0], []).append((number, place[1]))
        for key, pairs in by_file.items():
            numbers, places = np.array(pairs).T
            arrays = self._cache.read(key)
            if arrays is None:  # removed or damaged meanwhile
                continue
            del arrays[_ROWS]
            chosen: dict[str, Any] = {name: values[places] for name, values in arrays.items()}
            yield numbers, RolloutResult(**chosen, penalty_names=self._penalty_names)

    def write(self, terrains: NDArray[Any], seeds: NDArray[Any], result: RolloutResult) -> None:
        """Stores a lot."""
        rows = _row_keys(terrains, seeds)
        key = f"{self._way}-{hashlib.sha256(b''.join(rows)).hexdigest()[:32]}"
        self._cache.write(key, {_ROWS: np.array([[*row] for row in rows], np.uint8), **arrays_of(result)})
        self._places.update({row: (key, place) for place, row in enumerate(rows)})


def _row_keys(terrains: NDArray[Any], seeds: NDArray[Any]) -> list[bytes]:
    rows = np.ascontiguousarray(terrains, np.float32)
    shape = str(rows.shape[1:]).encode()
    return [
        hashlib.sha256(shape + row.tobytes() + int(seed).to_bytes(4, "little")).digest()
        for row, seed in zip(rows, seeds, strict=True)
    ]


class Crossings:
    """Lets controllers of a robot cross terrains; a simulation stays open for calls that agree in all but the terrains.

    Crossings that are done are stored in the folder ``cache``, if there is one. ``calls``, if known, count in the bars.
    """

    def __init__(
        self,
        robot: RobotCfg | str,
        compute: Compute,
        *,
        cache: Path | None = None,
        calls: int | None = None,
    ) -> None:
        self.robot, self.compute = get_robot(robot), compute
        self._cache = None if cache is None else Cache(cache)
        self._stored: dict[str, _Stored] = {}
        self._call, self._calls = 0, calls
        self._stack = ExitStack()
        self._opened: tuple[EvaluatorCfg, Pipeline] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the simulation that is open."""
        self._opened = None
        self._stack.close()

    def cross(
        self,
        policy: str,
        terrains: NDArray[Any],
        seeds: NDArray[Any],
        *,
        replicas: int,
        space: str = "super_gaussian",
        how: How = "searched",
        reward: bool = False,
        penalties_from_s: float = 0.0,
        label: str = "",
        at_most: int | None = None,
        invalid_ok: bool = False,
    ) -> RolloutResult:
        """Lets a controller (:func:`sim.controllers.loaders.load_policy`) cross each terrain in ``replicas`` episodes.

        Terrains are genes of a space, shape (B, num_genes), or heights [m], shape (B, nrow, ncol), each with a seed,
        uint32 of shape (B,). Penalties are summed from ``penalties_from_s`` of an episode on [s], with ``reward`` the
        training task's reward too. The progress bar shows ``label``. ``at_most`` are the terrains of the largest call
        to come that agrees with this one: the simulation has room for them. Invalid episodes are reported on stderr
        where they are many; a result without a valid one is returned if ``invalid_ok``.

        The result has one row a terrain. Steps and time are those of the terrains that were not in the cache. MuJoCo C
        tells neither where a robot ended nor whether it had fallen, and not why an episode is invalid.
        """
        if seeds.shape != (len(terrains),):
            raise ValueError(f"seeds must have shape ({len(terrains)},), one a terrain, got {seeds.shape}")
        if replicas < 1 or how not in get_args(How):
            raise ValueError(f"replicas must be 1 or more, how one of {get_args(How)}, got {replicas} and '{how}'")
        self._call += 1
        label = f"{self._call} of {self._calls}: {label}" if self._calls else label
        cfg = EvaluatorCfg(
            robot=self.robot, policy=policy, num_terrains=max(1, len(terrains)), num_replicas=replicas, space=space,
            reward=reward, penalties_from_s=penalties_from_s, resolved=how == "resolved", **vars(self.compute),
        )  # fmt: skip
        if how == "mujoco_c" and (reward or penalties_from_s):
            raise ValueError("MuJoCo C sums no reward, and penalties from the start only")
        if not len(terrains):
            return _no_terrains(cfg, self.robot.penalties)
        stored = self._stored_crossings(cfg, how)
        parts = list(stored.read(terrains, seeds)) if stored else []
        done = np.concatenate([np.zeros(0, np.intp), *(numbers for numbers, _ in parts)])
        missing = np.setdiff1d(np.arange(len(terrains)), done)
        try:
            for part, result in self._cross_lots(cfg, how, terrains[missing], seeds[missing], label, at_most):
                numbers = missing[part]
                if stored:
                    stored.write(terrains[numbers], seeds[numbers], result)
                parts.append((numbers, result))
        except KeyboardInterrupt:
            kept = "; what was crossed is kept, and the same command goes on" if stored else ""
            raise Interrupted(f"Stopped{kept}.") from None
        result = _in_order(parts)
        report_invalid(result, label or policy, all_ok=invalid_ok)
        return result

    def _stored_crossings(self, cfg: EvaluatorCfg, how: How) -> _Stored | None:
        """The cache of what is crossed in one way; None without a cache, or if the controller's code has no file."""
        controller = controller_hash(cfg.policy)
        if self._cache is None or controller is None:
            return None
        space = identity(cfg.space, load_space(cfg.space).sha256)
        way = [robot_identity(self.robot), self.robot.penalties, controller, space]
        way += [cfg.num_replicas, cfg.device.startswith("cuda"), how, cfg.penalties_from_s]
        way += [repr(self.robot.training) if cfg.reward else None]  # whose terms the reward is of
        key = hashlib.sha256(json.dumps([*way, code_fingerprint(("kernels", "sim"))]).encode()).hexdigest()[:32]
        if key not in self._stored:
            self._stored[key] = _Stored(self._cache, key, self.robot.penalties)
        return self._stored[key]

    def _cross_lots(
        self, cfg: EvaluatorCfg, how: How, terrains: NDArray[Any], seeds: NDArray[Any], label: str, at_most: int | None
    ) -> Iterator[tuple[slice, RolloutResult]]:
        """Which of the terrains a lot has, and its result."""
        if not len(terrains):
            return
        if how == "mujoco_c":
            yield from self._cross_in_mujoco_c(cfg, terrains, seeds, label)
            return
        count = max(len(terrains), at_most or 0)
        lot = _lot_size(replace(cfg, num_terrains=count))
        try:
            pipeline = self._open(replace(cfg, num_terrains=min(count, 2 * lot)))
            with Bar(label) as bar:
                yield from pipeline.in_lots(terrains, seeds, lot, bar.move_to)
        except BaseException:
            self.close()  # what failed is not used again
            raise

    def _open(self, cfg: EvaluatorCfg) -> Pipeline:
        """A simulation with room for so many terrains; the one that is open if it serves."""
        if self._opened is not None:
            opened = self._opened[0]
            if replace(opened, num_terrains=cfg.num_terrains) == cfg and opened.num_terrains >= cfg.num_terrains:
                return self._opened[1]
        self.close()
        pipeline = self._stack.enter_context(self.compute.open(cfg))
        self._opened = (cfg, pipeline)
        return pipeline

    def _cross_in_mujoco_c(
        self, cfg: EvaluatorCfg, terrains: NDArray[Any], seeds: NDArray[Any], label: str
    ) -> Iterator[tuple[slice, RolloutResult]]:
        workers, done = parse_workers(cfg.workers), list[RolloutResult]()
        processes = (None if workers.on_ray else workers.count) or available_cores()  # Ray has no part in it
        with Bar(label, len(terrains)) as bar:
            crossings = cross_terrains(
                self.robot, cfg.policy, terrains, seeds, space=load_space(cfg.space),
                num_episodes=cfg.num_replicas, device=cfg.device, processes=processes, resolved=True,
            )  # fmt: skip
            for count, crossed in enumerate(crossings, 1):
                bar.move_to(count)
                done.append(crossed)
                if len(done) == _MUJOCO_C_LOT * processes or count == len(terrains):
                    yield slice(count - len(done), count), join_results(done, join=1)
                    done.clear()


def cross(
    controllers: Mapping[str, str],
    terrains: NDArray[Any],
    seeds: NDArray[Any],
    *,
    robot: RobotCfg | str = "anymal",
    compute: Compute | None = None,
    replicas: int,
    space: str = "super_gaussian",
    how: How = "searched",
    reward: bool = False,
    penalties_from_s: float = 0.0,
    cache: Path | None = None,
) -> dict[str, RolloutResult]:
    """Lets each controller cross each terrain several times: one result a controller, by its name.

    Arguments are those of :class:`Crossings` and :meth:`Crossings.cross`; without ``compute`` the CPU crosses, by a
    process a core.
    """
    with Crossings(robot, compute or Compute(), cache=cache) as crossings:
        return {
            name: crossings.cross(
                resolve_policy(policy, crossings.robot), terrains, seeds, replicas=replicas, space=space, how=how,
                reward=reward, penalties_from_s=penalties_from_s, label=name,
            )
            for name, policy in controllers.items()
        }  # fmt: skip


def _lot_size(cfg: EvaluatorCfg) -> int:
    """Terrains that are crossed between two writes; two lots are under way."""
    episodes = _LOT_EPISODES[cfg.device.partition(":")[0]]
    return max(1, min(episodes // cfg.num_replicas, _LOT_TERRAINS)) * cfg.num_workers


def _in_order(parts: Sequence[tuple[NDArray[np.intp], RolloutResult]]) -> RolloutResult:
    """One result of parts that hold some of the terrains each."""
    order = np.argsort(np.concatenate([numbers for numbers, _ in parts]))
    result = join_results([result for _, result in parts], join=1)
    return replace(result, **{name: values[order] for name, values in arrays_of(result).items()})


def _no_terrains(cfg: EvaluatorCfg, penalty_names: tuple[str, ...]) -> RolloutResult:
    shape = (0, cfg.num_replicas)
    return RolloutResult(
        penalties=np.zeros((*shape, len(penalty_names))), penalty_names=penalty_names,
        outcome=np.zeros(shape, np.uint8), invalidity=np.zeros(shape, np.uint8), fallen=np.zeros(shape, bool),
        duration_s=np.zeros(shape, np.float32), final_position=np.zeros((*shape, 3), np.float32),
        reward=np.zeros(shape) if cfg.reward else None,
    )  # fmt: skip
