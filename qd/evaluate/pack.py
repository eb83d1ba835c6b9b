"""Packs: terrains on which any controller can be tested, as two files of a folder.

``pack.npz`` has the terrains, ``pack.json`` what is known of each, and the rates of the controllers that the pack was
made with. A pack is made of judged searches of one controller: its terrains are spread over the causes on which that
fails. A pack does not change: one that is made in its place has the next ``version``. Every terrain is a fault or a
*near-fault*: under :data:`NEAR_GOAL_RATE` of the robots reach the goal in 40 fresh episodes, and it is known to be
passable, since another controller or a witness is certified on it, or the searched one crosses it in at least half of
its episodes. A terrain that nobody is known to cross is in no pack.
"""

import hashlib
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.evaluate import cross_sets, crossings_folder, fill_sizes
from qd.evaluate.labels import MEASURES, RATES, SetsCfg
from qd.evaluate.measures import terrain_rates, valid_interval, valid_mean
from qd.evaluate.sets import TerrainSet, draw_seeds, hash_elites, read_trained_on, set_rng
from qd.evaluate.tables import rate_cells, show_table
from qd.faults.numbers import EPISODES
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from sim.controllers.spec import controller_identity, crosser_name
from sim.files.atomic import read_json, write_atomically
from sim.files.command import publish, say
from sim.files.intervals import RATES as RATE_BOUNDS
from sim.files.intervals import wilson_interval
from sim.files.npz import npz_bytes, read_arrays
from sim.rates import counted_episodes
from sim.robots.robot import ROBOTS, RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.terrains import Terrains

PACK_FILE = "pack.json"
TERRAINS_FILE = "pack.npz"
HEIGHT_UNIT_M = 1e-3  # heights of a pack are whole numbers of it, in its file and where they are crossed [m]
NEAR_GOAL_RATE = 0.75  # goal rate of the searched controller from which on a terrain is no near-fault
_MAX_BYTES = 1e9  # of an array that is read
_KEYS = ("robot", "robot_sha256", "penalty_definition", "terrains", "rates", "terrains_sha256", "seed", "episodes")

Entry = dict[str, Any]  # what a pack says of one terrain, as JSON values; rates by controller


@dataclass(frozen=True, kw_only=True)
class Pack:
    """A pack of N terrains."""

    folder: Path
    heights: NDArray[np.float32]  # [m], shape (N, NUM_ROWS, NUM_COLS)
    genes: NDArray[np.float32]  # shape (N, num_genes)
    content: dict[str, Any]  # of pack.json

    @property
    def name(self) -> str:
        """What a published one is asked for by, ``anymal@1``, or its folder."""
        robot, folder = self.content["robot"], self.folder
        return f"{robot}@" * (robot in ROBOTS and folder.parent == ROBOTS[robot].packs) + folder.name

    @property
    def terrains(self) -> list[Entry]:
        """What the pack says of each terrain."""
        return self.content["terrains"]


def find_pack(name: str) -> Path:
    """The folder of a pack by its path, or a published one: the newest of a shipped robot, or ``anymal@1``."""
    folder, (robot, named, version) = Path(name), name.partition("@")
    packs = ROBOTS[robot].packs if robot in ROBOTS else folder
    versions = sorted(int(pack.parent.name) for pack in packs.glob(f"*/{PACK_FILE}") if pack.parent.name.isdecimal())
    if robot in ROBOTS and versions and not (folder / PACK_FILE).is_file():
        folder = packs / (version if named else str(versions[-1]))
    if not (folder / PACK_FILE).is_file() or (named and not version):
        known = ", ".join(f"{robot}@{number}" for number in versions if robot in ROBOTS) or ", ".join(ROBOTS)
        raise FileNotFoundError(f"no pack {name}: give its folder, or {known}; `faultline export --pack` makes one")
    return folder


def read_pack(folder: Path) -> Pack:
    """Reads a pack; data only, nothing in it can run."""
    file = folder / TERRAINS_FILE
    try:
        content = read_json(folder / PACK_FILE)
        if missing := [name for name in _KEYS if name not in content]:
            raise ValueError(f"{PACK_FILE} lacks {', '.join(missing)}")
        if hashlib.sha256(file.read_bytes()).hexdigest() != content["terrains_sha256"]:
            raise ValueError(f"{TERRAINS_FILE} is not the one that {PACK_FILE} names")
        arrays = read_arrays(file, ("twists", "height_unit_m", "genes"), max_bytes=_MAX_BYTES)
        content = {"version": 1, "licence": None} | content  # which the first packs do not say, nor marks
        for entry, mark in zip(content["terrains"], hash_elites(arrays["genes"]), strict=True):
            entry.setdefault("mark", mark)
        units = np.cumsum(np.cumsum(arrays["twists"], axis=1), axis=2)
        heights = (units * float(arrays["height_unit_m"])).astype(np.float32)
        expected = (len(content["terrains"]), NUM_ROWS, NUM_COLS)
        if heights.shape != expected or not np.isfinite(heights).all() or not len(heights):
            raise ValueError(f"heights must be finite, of shape {expected}, got {heights.shape}")
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(f"{folder} must be a pack, but is damaged: {error}: put a copy of it back") from None
    return Pack(folder=folder, heights=heights, genes=arrays["genes"], content=content)


def write_terrains(folder: Path, heights: NDArray[np.float32], genes: NDArray[np.float32]) -> str:
    """Writes ``pack.npz``, atomically; equal content gives equal bytes. Returns its SHA-256.

    Heights [m], rounded, have shape (N, NUM_ROWS, NUM_COLS), genes (N, num_genes).
    """
    units = np.rint(heights.astype(np.float64) / HEIGHT_UNIT_M).astype(np.int32)
    # Of smooth ground the rise along x hardly changes along y, so that this packs into a third of the bytes.
    twists = np.diff(np.diff(units, axis=2, prepend=np.int32(0)), axis=1, prepend=np.int32(0))
    arrays = {"twists": twists, "height_unit_m": np.array(HEIGHT_UNIT_M), "genes": genes}
    data = npz_bytes(arrays, compression=zipfile.ZIP_BZIP2)
    write_atomically(folder / TERRAINS_FILE, data)
    return hashlib.sha256(data).hexdigest()


def round_heights(heights: NDArray[np.floating]) -> NDArray[np.float32]:
    """Heights [m] as a pack has them, in whole numbers of :data:`HEIGHT_UNIT_M`."""
    return (np.rint(np.asarray(heights, np.float64) / HEIGHT_UNIT_M) * HEIGHT_UNIT_M).astype(np.float32)


def pack_set(heights: NDArray[np.float32], count: int, seed: int) -> TerrainSet:
    """The first ``count`` terrains of a pack; ``seed`` draws their episodes."""
    seeds = draw_seeds(set_rng("pack", seed), len(heights))[:count]
    return TerrainSet(terrains=Terrains(heights=heights[:count], seeds=seeds), numbers=np.arange(len(seeds)))


def evaluate_pack(
    pack: Pack, robot: RobotCfg, policy: str, cfg: SetsCfg, *, compute: Compute, out: Path | None = None
) -> dict[str, Any]:
    """Tests one controller on a pack: prints and writes what it fails beside the rates of the pack's controllers.

    ``cfg`` says how many terrains, the first of the pack, episodes on each, and their seed. Without ``out`` the file
    lies under runs/.
    """
    size = len(pack.terrains)
    count, episodes = fill_sizes(compute, cfg.terrains, cfg.episodes, full=(size, EPISODES), small=(min(24, size), 4))
    check_policy(policy, robot, compute.device)
    terrain_set = pack_set(pack.heights, count, cfg.seed)
    entries = pack.terrains[: len(terrain_set)]
    if trained := count_trained(entries, policy):
        say((f"It was trained on {trained} of these {len(entries)} terrains", "bold"), ": its rates say little.")
    controller = crosser_name(robot, policy)

    def make_report() -> dict[str, Any]:
        sets = {"pack": terrain_set}
        results = cross_sets({controller: policy}, sets, robot, compute, episodes, cache=crossings_folder(robot))
        tested = add_rates(entries, {"this": results["pack"][controller]})
        keys = ("robot", "robot_sha256", "terrains_sha256", "episodes", "seed", "searched", "version", "licence")
        return {
            **compute.origin(cfg.seed),
            **controller_identity(robot, policy),
            "episodes": episodes,
            "trained_on": trained,
            "pack": {key: pack.content[key] for key in keys} | {"folder": pack.name, "terrains": size},
            "rates": summarise_rates(tested, "this", cfg.seed),
            "beside": {name: summarise_rates(entries, name, cfg.seed) for name in pack.content["rates"]},
            "by": {group: count_failing(tested, "this", group) for group in ("verdict", "cause", "kind")},
            "terrains": tested,
        }

    return publish(out or RUNS / f"{controller}-pack.json", make_report, show_pack_test)


def count_trained(entries: Sequence[Entry], policy: str) -> int:
    """On how many terrains, or the elites that these are parts of, a controller was trained, as far as it is known."""
    marks = read_trained_on(policy)
    return sum(entry["mark"] in marks for entry in entries)


def passes(report: dict[str, Any], min_goal_rate: float) -> bool:
    """Whether the lower end of the goal rate's interval of :func:`evaluate_pack` is at least so high; prints both."""
    interval = report["rates"]["goal_interval"]
    low = interval[0] if interval else 0.0  # one family says nothing of the spread
    verdict = ("passes", "bold green") if low >= min_goal_rate else ("fails", "bold red")
    say(verdict, f": the goal rate is at least {low:.3f} (95 %), asked for {min_goal_rate:.3f}")
    return low >= min_goal_rate


def add_rates(entries: Sequence[Entry], results: Mapping[str, RolloutResult]) -> list[Entry]:
    """Entries of terrains with the ``rates`` of controllers, None on an invalid terrain.

    Each controller has three rates, the interval of the goal rate (Wilson), and how many episodes are valid.
    """
    crossed: list[dict[str, Any]] = [{} for _ in entries]
    for controller, result in results.items():
        counted = counted_episodes(result.invalid)
        counts = zip((result.reached_goal & counted).sum(axis=1).tolist(), counted.sum(axis=1).tolist(), strict=True)
        rates = terrain_rates(result)
        for k, (goals, valid) in enumerate(counts):
            row = {f"{name}_rate": float(values[k]) if valid else None for name, values in rates.items()}
            crossed[k][controller] = row | {"goal_interval": [*wilson_interval(goals, valid)], "valid_episodes": valid}
    return [entry | {"rates": row} for entry, row in zip(entries, crossed, strict=True)]


def _read_rates(entries: Sequence[Entry], controller: str, name: str) -> NDArray[np.float64]:
    """A controller's rate on each terrain, shape (N,); NaN on an invalid one."""
    return np.array([entry["rates"][controller][f"{name}_rate"] for entry in entries], np.float64)


def summarise_rates(entries: Sequence[Entry], controller: str, seed: int) -> dict[str, Any]:
    """Means of a controller's rates over terrains with 95 % intervals, bootstrap over families, as JSON values.

    Beside ``goal_rate``, ``goal_interval`` and so on: of the valid ``terrains`` how many are ``failing``, and of their
    ``families`` in how many one is (``failing_families``).
    """
    families = np.array([entry["family"] for entry in entries], np.int64)
    summary: dict[str, Any] = {}
    for name in RATES:
        values = _read_rates(entries, controller, name)
        summary[f"{name}_rate"] = valid_mean(values)
        summary[f"{name}_interval"] = valid_interval(values, seed, families, RATE_BOUNDS)
    goal = _read_rates(entries, controller, "goal")
    failing = goal < FAILING_GOAL_RATE
    valid = ~np.isnan(goal)
    return summary | {
        "failing": int(failing.sum()),
        "terrains": int(valid.sum()),
        "failing_families": len(np.unique(families[failing])),
        "families": len(np.unique(families[valid])),
    }


def count_failing(entries: Sequence[Entry], controller: str, group: str) -> dict[str, dict[str, int]]:
    """How many ``terrains`` there are and ``failing``, by verdict, cause or kind, the most frequent value first."""
    values = np.array([str(entry[group] or "unclear") for entry in entries])
    fails = _read_rates(entries, controller, "goal") < FAILING_GOAL_RATE
    by_frequency = sorted(Counter(values.tolist()).items(), key=lambda item: (-item[1], item[0]))
    return {value: {"terrains": count, "failing": int(fails[values == value].sum())} for value, count in by_frequency}


def show_pack_test(report: dict[str, Any]) -> None:
    """Prints how many terrains of a pack a controller fails, beside the pack's controllers."""
    title = f"pack {report['pack']['folder']} of {report['pack']['robot']}"
    show_pack_rates(title, {"this": report["rates"], **report["beside"]})
    for group, counts in report["by"].items():
        rows = [(value, count["failing"], count["terrains"]) for value, count in counts.items()]
        show_table(f"failed, by {group}", ("", "fails", "of"), rows)


def show_pack_rates(title: str, rates: Mapping[str, dict[str, Any]]) -> None:
    """Prints the rates of controllers on a pack."""
    rows = []
    for name, row in rates.items():
        families = f"{row['failing_families']} of {row['families']}"
        rows.append((name, *rate_cells(row), f"{row['failing']} of {row['terrains']}", families))
    show_table(title, ("", *map(MEASURES.__getitem__, RATES), "fails", "families"), rows)
