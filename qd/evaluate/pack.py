"""Packs: terrains on which any controller can be tested, spread over the ways in which a searched one fails."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.evaluate import cross_sets, crossings_folder, sizes_for
from qd.evaluate.figures import draw_gallery
from qd.evaluate.measures import terrain_rates
from qd.evaluate.sets import TerrainSet, set_rng
from qd.evaluate.show import show_pack_test
from qd.faults import EPISODES
from qd.fitness import FAILING_GOAL_RATE
from qd.run.directory import RESULTS, RUNS
from qd.workers.evaluator import Compute, OpenEvaluator, check_policy, open_evaluator, origin_of
from sim.files.atomic import read_json
from sim.files.command import publish
from sim.files.figures import as_png
from sim.files.intervals import bootstrap_interval, wilson_interval
from sim.files.npz import read_arrays
from sim.files.records import identity
from sim.policy.spec import who_crossed
from sim.rates import counted_episodes
from sim.robots.robot import RobotCfg
from sim.rollout import RolloutResult
from sim.terrain import NUM_COLS, NUM_ROWS

PACK_FILE, TERRAINS_FILE = "pack.json", "pack.npz"
PACK_FOLDER = "pack"
"""Of a robot's published results."""
HEIGHT_UNIT_M = 1e-3
"""Heights of a pack are whole numbers of it, in its file and where they are crossed [m]."""
GROUPS = ("verdict", "mode", "cause", "kind", "family")
"""What terrains are grouped by."""

_MAX_BYTES = 1e9  # of an array that is read
_KEYS = ("robot", "robot_sha256", "penalty_definition", "terrains", "rates", "terrains_sha256", "seed", "episodes")
_TESTED = "this"  # the controller that is tested, beside the pack's
_DRAWN = 12  # terrains of a pack in its figure

Row = dict[str, Any]
"""What a controller made of one terrain, as JSON values; rates are None on an invalid one."""


@dataclass(frozen=True, kw_only=True)
class Pack:
    """A pack as its files have it."""

    folder: Path
    heights: NDArray[np.float32]
    """[m], shape (N, nrow, ncol)."""
    genes: NDArray[np.float32]
    """Shape (N, num_genes)."""
    content: dict[str, Any]
    """Of ``pack.json``."""

    @property
    def terrains(self) -> list[dict[str, Any]]:
        """What is known of each."""
        return self.content["terrains"]

    def __len__(self) -> int:
        """N."""
        return len(self.heights)


def evaluate_pack(
    pack: Pack,
    robot: RobotCfg,
    policy: str,
    *,
    compute: Compute,
    terrains: int | None = None,
    episodes: int | None = None,
    seed: int = 0,
    out: Path | None = None,
    open_evaluator: OpenEvaluator = open_evaluator,
) -> dict[str, Any]:
    """Tests one controller on a pack: prints what fails beside the rates of the pack's controllers, and writes it.

    ``terrains`` are the first of the pack. Without it and ``episodes`` (a terrain) there are as many as suit the
    device. Without ``out`` the file lies under runs/. The figure is beside it.
    """
    full = (len(pack), EPISODES)
    count, episodes = sizes_for(compute, terrains, episodes, full=full, small=(min(24, len(pack)), 4))
    check_policy(policy, robot, compute.device)
    chosen = pack_set(pack.heights, min(count, len(pack)), seed)
    abouts = pack.terrains[: len(chosen)]
    controller = who_crossed(robot, policy)

    def measure() -> dict[str, Any]:
        result = cross_sets(
            {controller: policy}, {"pack": chosen}, robot=robot, compute=compute, episodes=episodes,
            cache=crossings_folder(robot), open_evaluator=open_evaluator,
        )["pack"][controller]  # fmt: skip
        rows = rows_of(result)
        beside = {name: [about["rates"][name] for about in abouts] for name in pack.content["rates"]}
        about_pack = {name: pack.content[name] for name in ("robot", "robot_sha256", "terrains_sha256", "episodes")}
        about_pack |= {name: pack.content[name] for name in ("seed", "searched", "modes")}
        return {
            **origin_of(compute.device, seed, compute.workers),
            **identity(robot, policy),
            "episodes": episodes,
            "pack": {**about_pack, "folder": pack.folder.name, "terrains": len(pack)},
            "rates": over_all(rows, abouts, seed),
            "beside": {name: over_all(of_crosser, abouts, seed) for name, of_crosser in beside.items()},
            "by": grouped(abouts, {_TESTED: rows, **beside}),
            "terrains": [about | {"rates": {_TESTED: row}} for about, row in zip(abouts, rows, strict=True)],
        }

    def draw(report: dict[str, Any]) -> bytes:
        return draw_worst(report["terrains"], pack.heights, _TESTED, controller)

    return publish(out or RUNS / f"{controller}-pack.json", measure, show_pack_test, draw=draw)


def pack_set(heights: NDArray[np.float32], count: int, seed: int) -> TerrainSet:
    """The first terrains of a pack, with episodes that nothing else has."""
    seeds = set_rng("pack", seed).integers(2**32, size=len(heights), dtype=np.uint32)
    return TerrainSet(name="pack", terrains=heights[:count], seeds=seeds[:count], numbers=np.arange(count))


def rows_of(result: RolloutResult) -> list[Row]:
    """What crossings say of each terrain: rates, the goal rate with its interval (Wilson), and valid episodes."""
    counted, rates = counted_episodes(result.invalid), terrain_rates(result)
    hits, valid = (result.reached_goal & counted).sum(axis=1).tolist(), counted.sum(axis=1).tolist()
    return [
        {f"{name}_rate": None if np.isnan(values[place]) else float(values[place]) for name, values in rates.items()}
        | {"goal_interval": list(wilson_interval(hits[place], valid[place])), "valid_episodes": valid[place]}
        for place in range(len(valid))
    ]


def fails(row: Row) -> bool:
    """Whether a controller fails a terrain: under half of its valid episodes reach the goal."""
    return row["goal_rate"] is not None and row["goal_rate"] < FAILING_GOAL_RATE


def over_all(rows: Sequence[Row], abouts: Sequence[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Means over terrains with 95 % intervals, bootstrap over families, as JSON values.

    Args:
        rows: What a controller made of each terrain.
        abouts: What is known of each.
        seed: Of the bootstrap.

    Returns:
        ``goal_rate``, ``success_rate`` and ``fallen_rate`` with ``goal_interval`` and so on; of the valid ``terrains``
        how many are ``failing``, and of their ``families`` in how many one is (``failing_families``).
    """
    valid = [place for place, row in enumerate(rows) if row["goal_rate"] is not None]
    families = np.array([abouts[place]["family"] for place in valid], np.int64)
    means: dict[str, Any] = {}
    for name in ("goal", "success", "fallen"):
        values = np.array([rows[place][f"{name}_rate"] for place in valid], np.float64)
        means[f"{name}_rate"] = float(values.mean()) if valid else None
        means[f"{name}_interval"] = bootstrap_interval(values, seed, families=families)
    failing = np.array([fails(rows[place]) for place in valid], bool)
    return means | {
        "failing": int(failing.sum()),
        "terrains": len(valid),
        "failing_families": len(np.unique(families[failing])),
        "families": len(np.unique(families)),
    }


def grouped(abouts: Sequence[dict[str, Any]], rows: Mapping[str, Sequence[Row]]) -> dict[str, list[dict[str, Any]]]:
    """How controllers fare by :data:`GROUPS`: mean goal rates and how many terrains fail.

    Args:
        abouts: What is known of each terrain.
        rows: Controller -> what it made of each.

    Returns:
        Group -> its values, the most frequent first, each with ``terrains`` and, by controller, ``goal_rate`` (None
        without a valid terrain) and ``failing``.
    """
    return {group: _by(group, abouts, rows) for group in GROUPS}


def _by(group: str, abouts: Sequence[dict[str, Any]], rows: Mapping[str, Sequence[Row]]) -> list[dict[str, Any]]:
    members: dict[Any, list[int]] = {}
    for place, about in enumerate(abouts):
        members.setdefault(about[group], []).append(place)
    lines = []
    for value, places in sorted(members.items(), key=lambda pair: (-len(pair[1]), str(pair[0]))):
        some = {controller: [of_crosser[place] for place in places] for controller, of_crosser in rows.items()}
        rates = {
            controller: [row["goal_rate"] for row in chosen if row["goal_rate"] is not None]
            for controller, chosen in some.items()
        }
        lines.append(
            {
                group: value,
                "terrains": len(places),
                "goal_rate": {
                    controller: float(np.mean(known)) if known else None for controller, known in rates.items()
                },
                "failing": {controller: sum(map(fails, chosen)) for controller, chosen in some.items()},
            }
        )
    return lines


def draw_worst(terrains: Sequence[dict[str, Any]], heights: NDArray[np.float32], controller: str, title: str) -> bytes:
    """The terrains with the lowest goal rates of a controller."""
    rates = {place: about["rates"][controller]["goal_rate"] for place, about in enumerate(terrains)}
    places = sorted((place for place, rate in rates.items() if rate is not None), key=rates.__getitem__)[:_DRAWN]
    captions = []
    for place in places:
        about = terrains[place]
        words = filter(None, [about["verdict"], about["cause"], f"{rates[place]:.0%} arrive"])
        captions.append(f"{place}: {about['name']}: {', '.join(words)}")
    failing = sum(fails(about["rates"][controller]) for about in terrains)
    return as_png(draw_gallery(heights[places], captions, f"{title}: fails {failing} of {len(terrains)} terrains"))


def rounded(heights: NDArray[np.floating]) -> NDArray[np.float32]:
    """Heights [m] as a pack has them, in whole numbers of :data:`HEIGHT_UNIT_M`."""
    return (np.rint(np.asarray(heights, np.float64) / HEIGHT_UNIT_M) * HEIGHT_UNIT_M).astype(np.float32)


def pack_folder(named: str) -> Path:
    """The folder of a pack: the one named, or the published one of a robot that is.

    Raises:
        FileNotFoundError: If there is none.
    """
    published = RESULTS / named / PACK_FOLDER
    for folder in (Path(named), published):
        if (folder / PACK_FILE).is_file():
            return folder
    raise FileNotFoundError(f"no pack at {named} or {published}: `faultline export --pack` makes one")


def read_pack(folder: Path) -> Pack:
    """Reads a pack; data only, nothing in it can run.

    Raises:
        ValueError: If it is damaged, or its two files are not of one making.
    """
    file = folder / TERRAINS_FILE
    try:
        content = read_json(folder / PACK_FILE)
        if missing := [name for name in _KEYS if name not in content]:
            raise ValueError(f"{PACK_FILE} lacks {', '.join(missing)}")
        if hashlib.sha256(file.read_bytes()).hexdigest() != content["terrains_sha256"]:
            raise ValueError(f"{TERRAINS_FILE} is not the one that {PACK_FILE} names")
        if not isinstance(content["rates"], dict) or not all("rates" in about for about in content["terrains"]):
            raise ValueError(f"{PACK_FILE} must have the rates of each controller, over all terrains and on each")
        arrays = read_arrays(file, ("twists", "height_unit_m", "genes"), max_bytes=_MAX_BYTES)
        whole = np.cumsum(np.cumsum(arrays["twists"], axis=1), axis=2)
        heights = (whole * float(arrays["height_unit_m"])).astype(np.float32)
        expected = (len(content["terrains"]), NUM_ROWS, NUM_COLS)
        if heights.shape != expected or not np.isfinite(heights).all() or not len(heights):
            raise ValueError(f"heights must be finite, of shape {expected}, got {heights.shape}")
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(f"{folder} must be a pack, but is damaged: {error}: put a copy of it back") from None
    return Pack(folder=folder, heights=heights, genes=arrays["genes"], content=content)
