"""Packs: terrains on which any controller can be tested, spread over the causes on which a searched one fails.

Every terrain is a fault or a *near-fault*: under :data:`NEAR_GOAL_RATE` of the robots reach the goal in 40 fresh
episodes, and it is known to be passable, since another controller is certified on it or the searched one crosses it in
at least half of its episodes. What nobody is known to cross is in no pack.
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

from qd.evaluate.evaluate import cross_sets, crossings_folder, sizes_for
from qd.evaluate.marks import marks_of, recorded_marks
from qd.evaluate.measures import interval_of, mean_of, terrain_rates
from qd.evaluate.sets import TerrainSet, set_rng
from qd.evaluate.show import show_pack, show_pack_test
from qd.faults.families import families_of, rank, verdict_of
from qd.faults.judge import certifiers_of, find_search
from qd.faults.minimise.results import read_minimal
from qd.faults.numbers import EPISODES, SPECIALIST, fresh_counts, judgement, rate_of
from qd.search.archive import Archive
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.evaluator import Compute, check_policy
from sim.controllers.spec import about_controllers, crosser_name, is_same
from sim.files.atomic import prepare_output, read_json, write_atomically
from sim.files.command import publish, say
from sim.files.intervals import RATES, wilson_interval
from sim.files.npz import npz_bytes, read_arrays
from sim.files.records import identity
from sim.rates import counted_episodes
from sim.robots.robot import RobotCfg
from sim.robots.shipped import ROBOTS
from sim.rollout import RolloutResult
from sim.terrains.bank import heights_of
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.registry import get_space

PACK_FILE, TERRAINS_FILE = "pack.json", "pack.npz"
HEIGHT_UNIT_M = 1e-3
"""Heights of a pack are whole numbers of it, in its file and where they are crossed [m]."""
NEAR_GOAL_RATE = 0.75
"""Goal rate of the searched controller from which on a terrain is no near-fault."""
GROUPS = ("verdict", "cause", "kind")

_MAX_BYTES = 1e9  # of an array that is read
_KEYS = ("robot", "robot_sha256", "penalty_definition", "terrains", "rates", "terrains_sha256", "seed", "episodes")
_RATES = ("goal", "success", "fallen")

About = dict[str, Any]
"""What is known of one terrain, as JSON values; ``rates`` by controller."""
Candidate = tuple[About, NDArray[np.float32]]
"""What is known of a terrain that a pack may have, and its genes."""


@dataclass(frozen=True, kw_only=True)
class Pack:
    """A pack of N terrains as its files have it."""

    folder: Path
    heights: NDArray[np.float32]
    """[m], shape (N, nrow, ncol)."""
    genes: NDArray[np.float32]
    """Shape (N, num_genes)."""
    content: dict[str, Any]
    """Of ``pack.json``."""

    @property
    def terrains(self) -> list[About]:
        """What is known of each."""
        return self.content["terrains"]


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
) -> dict[str, Any]:
    """Tests one controller on a pack: prints what fails beside the rates of the pack's controllers, and writes it.

    ``terrains`` are the first of the pack. Without it and ``episodes`` (a terrain) there are as many as suit the
    device. Without ``out`` the file lies under runs/.
    """
    size = len(pack.terrains)
    count, episodes = sizes_for(compute, terrains, episodes, full=(size, EPISODES), small=(min(24, size), 4))
    check_policy(policy, robot, compute.device)
    chosen = pack_set(pack.heights, min(count, size), seed)
    known = pack.terrains[: len(chosen)]
    controller = crosser_name(robot, policy)

    def measure() -> dict[str, Any]:
        result = cross_sets(
            {controller: policy}, {"pack": chosen}, robot=robot, compute=compute, episodes=episodes,
            cache=crossings_folder(robot),
        )["pack"][controller]  # fmt: skip
        abouts = with_rates(known, {"this": result})
        keys = ("robot", "robot_sha256", "terrains_sha256", "episodes", "seed", "searched")
        return {
            **compute.origin(seed),
            **identity(robot, policy),
            "episodes": episodes,
            "pack": {key: pack.content[key] for key in keys} | {"folder": pack.folder.name, "terrains": size},
            "rates": rates_over_all(abouts, "this", seed),
            "beside": {name: rates_over_all(known, name, seed) for name in pack.content["rates"]},
            "by": {group: failing_by(group, abouts, "this") for group in GROUPS},
            "terrains": abouts,
        }

    return publish(out or RUNS / f"{controller}-pack.json", measure, show_pack_test)


def passes(report: dict[str, Any], least: float) -> bool:
    """Whether the lower end of the goal rate's interval of :func:`evaluate_pack` is at least so high; prints both."""
    limits = report["rates"]["goal_interval"]
    low = limits[0] if limits else 0.0  # of one family nothing is known of the spread
    word, style = ("passes", "bold green") if low >= least else ("fails", "bold red")
    say((word, style), f": the goal rate is at least {low:.3f} (95 %), asked for {least:.3f}")
    return low >= least


def make_pack(
    run: Path,
    controllers: Mapping[str, str],
    *,
    compute: Compute,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
    size: int = 100,
    episodes: int = EPISODES,
    seed: int = 0,
    out: Path | None = None,
) -> dict[str, Any]:
    """Chooses terrains of a judged run, lets controllers cross them, and writes the pack; returns what its JSON has.

    Without ``controllers`` (policies by name) these are the shipped one and the run's certifiers. The searched one is
    always among them; ``policy`` names it where it is code or its file has moved. Robot and space are those that the
    command line names. There are ``size`` terrains, fewer if the run has fewer, and ``episodes`` on each, which
    ``seed`` draws. Without ``out`` the folder lies under runs/.
    """
    search = find_search(run, robot=robot, policy=policy, space=space)
    if search.space.ground or search.space.conditions:
        raise ValueError(
            f"a pack holds heights alone, got terrains of {search.space.name}, which have ground or conditions of "
            "their own"
        )
    body, searched, archive = search.robot, search.policy, search.read_archive()
    controllers = {**(controllers or {"base": str(body.policy_file), **certifiers_of(search)})}
    if not any(is_same(searched, other) for other in controllers.values()):
        controllers = {"searched": searched, **controllers}
    for other in controllers.values():
        check_policy(other, body, compute.device)
    faults = archive.counts
    crossed = faults.resolved_outcomes.any(axis=1) & faults.certifier_outcomes.any(axis=(1, 2))
    if archive.fresh is None or (archive.failing & ~crossed).any():
        raise ValueError(
            f"{run} must have its failing elites crossed with contact resolved and by other controllers, got "
            f"{(archive.failing & crossed).sum()} of {archive.failing.sum()}: run `faultline judge` on it first"
        )
    candidates, not_passable = candidates_of(archive, run)
    trained_on = set[str]().union(*(recorded_marks(other) for name, other in controllers.items() if name != SPECIALIST))
    marks = marks_of(archive.genes)
    candidates = [candidate for candidate in candidates if marks[candidate[0]["elite"]] not in trained_on]
    chosen = choose_terrains(candidates, size)
    if not chosen:
        raise ValueError(
            f"{run} must have faults or near-faults that no controller but a specialist was trained on, got none and "
            f"{not_passable} that nobody crosses"
        )
    print(f"{len(chosen)} of {len(candidates)} faults and near-faults; {not_passable} more that nobody crosses.")
    genes = np.array([genes for _, genes in chosen], np.float32)
    heights = round_heights(heights_of(genes, search.space))
    out = out or RUNS / f"{body.name}-pack"
    prepare_output(out / TERRAINS_FILE)

    def measure() -> dict[str, Any]:
        crossed = cross_sets(
            controllers, {"pack": pack_set(heights, len(heights), seed)}, robot=body, compute=compute,
            episodes=episodes, cache=crossings_folder(body),
        )["pack"]  # fmt: skip
        abouts = with_rates([about for about, _ in chosen], crossed)
        return {
            **compute.origin(seed),
            **identity(body, searched),
            "space": search.cfg.space,
            "space_sha256": search.cfg.space_sha256,
            "episodes": episodes,
            "searched": next(name for name, other in controllers.items() if is_same(other, searched)),
            "iterations": archive.iterations,
            "certifiers": list(faults.certifiers),
            "candidates": len(candidates),
            "not_known_to_be_passable": not_passable,
            "controllers": about_controllers(controllers, body),
            "rates": {name: rates_over_all(abouts, name, seed) for name in controllers},
            "terrains_sha256": write_terrains(out, heights, genes),
            "terrains": abouts,
        }

    return publish(out / PACK_FILE, measure, show_pack)


def candidates_of(archive: Archive, run: Path) -> tuple[list[Candidate], int]:
    """The faults and near-faults of a run: elites as they are, and minimal terrains that lack some of their parts.

    Beside them stands how many failing elites and minimal terrains are left out, since nobody is known to cross them.
    """
    assert archive.fresh is not None
    space, minima = get_space(archive.space, archive.space_sha256), read_minimal(run, archive)
    rate = archive.fresh.goal_rate
    near = np.flatnonzero(archive.fresh.valid & (rate < NEAR_GOAL_RATE))
    families = dict(zip(near.tolist(), families_of(archive.genes[near], space).tolist(), strict=True))
    causes = rank(archive, space, minima).causes if len(near) else ()

    candidates: list[Candidate] = []
    not_passable = 0

    def add(number: int, parts: list[int] | None, genes: NDArray[np.float32], verdict: str, **known: Any) -> None:
        about = {
            "name": f"elite-{number}{'' if parts is None else '-minimal'}",
            "kind": "elite" if parts is None else "minimal",
            "elite": number,
            "cell": int(archive.cell[number]),
            "iteration": int(archive.iteration[number]),
            "parts": parts,
            "verdict": "fault" if verdict == "fault" else "near-fault",
            "cause": causes[number] or None,
            "family": families[number],
        }
        candidates.append((about | known, genes))

    for number in near.tolist():
        if archive.certified[number] or rate[number] >= FAILING_GOAL_RATE:
            known = {"searched": rate_of(fresh_counts(archive, number)), **judgement(archive, number)}
            add(number, None, archive.genes[number], verdict_of(archive, number), **known)
        else:
            not_passable += 1
    for entry in minima.numbers["elites"] if minima else ():
        number = entry["elite"]
        if not archive.failing[number] or len(entry["bumps"]) == entry["of"]:
            continue  # with all its parts it is the elite itself
        if minima and entry["certificates"]:
            searched = {name: entry[name] for name in ("goal_rate", "goal_interval", "valid_episodes")}
            known = {"searched": searched, "resolved": entry["resolved"], "certificates": entry["certificates"]}
            add(number, entry["bumps"], minima.genes[number], entry["verdict"], **known)
        else:
            not_passable += 1
    return candidates, not_passable


def choose_terrains(candidates: Sequence[Candidate], size: int) -> list[Candidate]:
    """Some candidates, so that each beginning of the list is spread as well as can be.

    Next comes a fault before a near-fault, then one of the family that was chosen least often, of the cause that was,
    of the kind (elite or minimal) that was, and then the one with the lowest goal rate.
    """
    left, chosen = list(candidates), list[Candidate]()
    counts = Counter[Any]()

    def turn(place: int) -> tuple[Any, ...]:
        about, _ = left[place]
        often = (counts[name, about[name]] for name in ("family", "cause", "kind"))
        return about["verdict"] != "fault", *often, about["searched"]["goal_rate"], about["elite"], about["kind"]

    while left and len(chosen) < size:
        about, _ = candidate = left.pop(min(range(len(left)), key=turn))
        chosen.append(candidate)
        counts.update((name, about[name]) for name in ("family", "cause", "kind"))
    return chosen


def pack_set(heights: NDArray[np.float32], count: int, seed: int) -> TerrainSet:
    """The first terrains of a pack, with episodes that nothing else has."""
    seeds = set_rng("pack", seed).integers(2**32, size=len(heights), dtype=np.uint32)
    return TerrainSet(terrains=heights[:count], seeds=seeds[:count], numbers=np.arange(count))


def with_rates(abouts: Sequence[About], crossed: Mapping[str, RolloutResult]) -> list[About]:
    """What is known of terrains with the ``rates`` of controllers, None on an invalid terrain.

    Each controller has three rates, the interval of the goal rate (Wilson), and how many episodes are valid.
    """
    of_all: list[dict[str, Any]] = [{} for _ in abouts]
    for controller, result in crossed.items():
        counted, rates = counted_episodes(result.invalid), terrain_rates(result)
        hits, valid = (result.reached_goal & counted).sum(axis=1).tolist(), counted.sum(axis=1).tolist()
        for place, row in enumerate(of_all):
            values = {f"{name}_rate": float(values[place]) if valid[place] else None for name, values in rates.items()}
            interval = list(wilson_interval(hits[place], valid[place]))
            row[controller] = values | {"goal_interval": interval, "valid_episodes": valid[place]}
    return [about | {"rates": rates} for about, rates in zip(abouts, of_all, strict=True)]


def _rates(abouts: Sequence[About], controller: str, name: str) -> NDArray[np.float64]:
    """A rate on each terrain; NaN on an invalid one."""
    return np.array([about["rates"][controller][f"{name}_rate"] for about in abouts], np.float64)


def rates_over_all(abouts: Sequence[About], controller: str, seed: int) -> dict[str, Any]:
    """Means of a controller's rates over terrains with 95 % intervals, bootstrap over families, as JSON values.

    Beside ``goal_rate``, ``goal_interval`` and so on: of the valid ``terrains`` how many are ``failing``, and of their
    ``families`` in how many one is (``failing_families``).
    """
    families = np.array([about["family"] for about in abouts], np.int64)
    summary: dict[str, Any] = {}
    for name in _RATES:
        values = _rates(abouts, controller, name)
        summary |= {f"{name}_rate": mean_of(values), f"{name}_interval": interval_of(values, seed, families, RATES)}
    goal = _rates(abouts, controller, "goal")
    failing, valid = goal < FAILING_GOAL_RATE, ~np.isnan(goal)
    return summary | {
        "failing": int(failing.sum()),
        "terrains": int(valid.sum()),
        "failing_families": len(np.unique(families[failing])),
        "families": len(np.unique(families[valid])),
    }


def failing_by(group: str, abouts: Sequence[About], controller: str) -> dict[str, dict[str, int]]:
    """How many ``terrains`` there are and ``failing``, by one of :data:`GROUPS`, the most frequent value first."""
    counts = Counter(str(about[group] or "unclear") for about in abouts)
    fails = _rates(abouts, controller, "goal") < FAILING_GOAL_RATE
    failing = Counter(str(about[group] or "unclear") for about, fail in zip(abouts, fails, strict=True) if fail)
    return {
        value: {"terrains": count, "failing": failing[value]}
        for value, count in sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))
    }


def round_heights(heights: NDArray[np.floating]) -> NDArray[np.float32]:
    """Heights [m] as a pack has them, in whole numbers of :data:`HEIGHT_UNIT_M`."""
    return (np.rint(np.asarray(heights, np.float64) / HEIGHT_UNIT_M) * HEIGHT_UNIT_M).astype(np.float32)


def write_terrains(folder: Path, heights: NDArray[np.float32], genes: NDArray[np.float32]) -> str:
    """Writes ``pack.npz``, atomically; equal content gives equal bytes. Returns its SHA-256.

    Heights [m], rounded, have shape (N, nrow, ncol), genes (N, num_genes).
    """
    whole = np.rint(heights.astype(np.float64) / HEIGHT_UNIT_M).astype(np.int32)
    # Of smooth ground the rise along x hardly changes along y, so that this packs into a third of the bytes.
    twists = np.diff(np.diff(whole, axis=2, prepend=np.int32(0)), axis=1, prepend=np.int32(0))
    content = {"twists": twists, "height_unit_m": np.array(HEIGHT_UNIT_M), "genes": genes}
    data = npz_bytes(content, compression=zipfile.ZIP_BZIP2)
    write_atomically(folder / TERRAINS_FILE, data)
    return hashlib.sha256(data).hexdigest()


def pack_folder(named: str) -> Path:
    """The folder of a pack: the one named, or the published one of a shipped robot of that name."""
    folder = Path(named)
    if named in ROBOTS and not (folder / PACK_FILE).is_file():
        folder = ROBOTS[named].pack
    if not (folder / PACK_FILE).is_file():
        raise FileNotFoundError(
            f"no pack at {folder}: give its folder, or one of {', '.join(ROBOTS)}; `faultline export --pack` makes one"
        )
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
        whole = np.cumsum(np.cumsum(arrays["twists"], axis=1), axis=2)
        heights = (whole * float(arrays["height_unit_m"])).astype(np.float32)
        expected = (len(content["terrains"]), NUM_ROWS, NUM_COLS)
        if heights.shape != expected or not np.isfinite(heights).all() or not len(heights):
            raise ValueError(f"heights must be finite, of shape {expected}, got {heights.shape}")
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(f"{folder} must be a pack, but is damaged: {error}: put a copy of it back") from None
    return Pack(folder=folder, heights=heights, genes=arrays["genes"], content=content)
