"""Making a pack: faults and near-faults of a judged run, spread over the ways in which its controller fails.

Every terrain is a fault or a *near-fault*: under :data:`NEAR_GOAL_RATE` of the robots reach the goal in 40 fresh
episodes, and it is known to be passable, since another controller is certified on it or the searched one crosses it in
at least half of its episodes. What nobody is known to cross is in no pack.
"""

import hashlib
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive, FaultCounts
from qd.evaluate.evaluate import cross_sets, crossings_folder
from qd.evaluate.pack import (
    HEIGHT_UNIT_M,
    PACK_FILE,
    TERRAINS_FILE,
    draw_worst,
    grouped,
    over_all,
    pack_set,
    rounded,
    rows_of,
)
from qd.evaluate.show import show_pack
from qd.faults import EPISODES, fresh_counts, judgement, rate_of
from qd.fitness import FAILING_GOAL_RATE
from qd.groups import Modes, elites_of, families_of, find_modes, verdict_of
from qd.judge import find_search
from qd.minimise import read_minimal
from qd.run.directory import RESULTS, RUNS
from qd.workers.evaluator import Compute, OpenEvaluator, check_policy, open_evaluator, origin_of
from sim.bank import heights_of
from sim.files.atomic import prepare_output, write_atomically
from sim.files.command import publish
from sim.files.npz import npz_bytes
from sim.files.records import identity
from sim.policy.spec import about_controllers, is_same
from sim.robots.robot import RobotCfg
from sim.spaces.registry import get_space

NEAR_GOAL_RATE = 0.75
"""Goal rate of the searched controller from which on a terrain is no near-fault."""
_OF_A_TERRAIN = ("name", "kind", "elite", "verdict", "mode", "family", "cause")  # also in the npz


class Candidate(NamedTuple):
    """A terrain that may be taken."""

    genes: NDArray[np.float32]
    """Shape (num_genes,)."""
    about: dict[str, Any]
    """What is known of it, as JSON values."""


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
    open_evaluator: OpenEvaluator = open_evaluator,
) -> dict[str, Any]:
    """Chooses terrains of a judged run, lets controllers cross them, and writes the pack.

    Args:
        run: Run directory.
        controllers: Policy of each by its name; if empty, the files of the robot's results and its panel. The searched
            one is always among them.
        compute: Where terrains are crossed.
        robot: Robot that the command line names.
        policy: The searched controller, where it is code or its file has moved.
        space: Terrain space that the command line names.
        size: How many terrains; fewer if the run has fewer.
        episodes: On each terrain.
        seed: Draws the episodes.
        out: Folder to write to; under runs/ if None.
        open_evaluator: Opens simulations.

    Returns:
        The content of ``pack.json``.
    """
    search = find_search(run, robot=robot, policy=policy, space=space)
    cfg, body, searched, archive = search.cfg, search.robot, search.policy, search.read_archive()
    drawn_in = get_space(cfg.space, cfg.space_sha256)
    controllers = {**(controllers or _published_controllers(body))}
    if not any(is_same(searched, crosser) for crosser in controllers.values()):
        controllers = {"searched": searched, **controllers}
    for crosser in controllers.values():
        check_policy(crosser, body, compute.device)
    _check_judged(archive, run)
    candidates, modes, not_passable = candidates_of(archive, run)
    chosen = choose(candidates, size)
    if not chosen:
        raise ValueError(f"{run} must have faults or near-faults, got none and {not_passable} that nobody crosses")
    print(f"{len(chosen)} of {len(candidates)} faults and near-faults; {not_passable} more that nobody crosses.")
    if drawn_in.ground:
        raise ValueError(f"a pack holds heights alone, got terrains of {drawn_in.name}, which have ground of their own")
    heights = rounded(heights_of(np.array([candidate.genes for candidate in chosen]), drawn_in))
    out = out or RUNS / f"{body.name}-pack"
    prepare_output(out / TERRAINS_FILE)

    def measure() -> dict[str, Any]:
        terrains = pack_set(heights, len(heights), seed)
        crossed = cross_sets(
            controllers, {"pack": terrains}, robot=body, compute=compute, episodes=episodes,
            cache=crossings_folder(body), open_evaluator=open_evaluator,
        )["pack"]  # fmt: skip
        rows = {controller: rows_of(result) for controller, result in crossed.items()}
        rates = np.array([[row["goal_rate"] for row in of_crosser] for of_crosser in rows.values()], np.float64).T
        abouts = [candidate.about for candidate in chosen]
        more = {"controllers": np.array([*rows]), "goal_rates": rates, "robot": np.array(body.name)}
        return {
            **origin_of(compute.device, seed, compute.workers),
            **identity(body, searched),
            "space": cfg.space,
            "space_sha256": cfg.space_sha256,
            "episodes": episodes,
            "searched": next(controller for controller, crosser in controllers.items() if is_same(crosser, searched)),
            "iterations": archive.iterations,
            "panel": list(archive.faults.certifiers) if archive.faults else [],
            "candidates": len(candidates),
            "not_known_to_be_passable": not_passable,
            "controllers": about_controllers(controllers, body),
            "rates": {controller: over_all(of_crosser, abouts, seed) for controller, of_crosser in rows.items()},
            "by": grouped(abouts, rows),
            "modes": [
                {"mode": mode.number, "ending": mode.ending, "marked_by": mode.marked_by} for mode in modes.modes
            ],
            "terrains_sha256": write_terrains(out, heights, chosen, more),
            "terrains": [
                about | {"rates": {controller: of_crosser[place] for controller, of_crosser in rows.items()}}
                for place, about in enumerate(abouts)
            ],
        }

    def draw(report: dict[str, Any]) -> bytes:
        return draw_worst(report["terrains"], heights, report["searched"], body.name)

    return publish(out / PACK_FILE, measure, show_pack, draw=draw)


def _published_controllers(robot: RobotCfg) -> dict[str, str]:
    """The shipped controller as ``base``, and the files of the robot's results and its panel by their names."""
    controllers = {"base": str(robot.policy_file)}
    folder = RESULTS / robot.name
    for file in (*sorted(folder.glob("*.pt")), *sorted((folder / "panel").glob("*.pt"))):
        if not any(is_same(str(file), policy) for policy in controllers.values()):
            name = file.stem if file.stem not in controllers else f"{file.parent.name}-{file.stem}"
            controllers[name] = str(file)
    return controllers


def _check_judged(archive: Archive, run: Path) -> None:
    if archive.fresh is None:
        raise ValueError(f"{run} must be judged, got no fresh episodes: run `faultline judge` on it first")
    faults, failing = archive.faults or FaultCounts.none_of(len(archive)), archive.failing
    crossed = faults.resolved_outcomes.any(axis=1) & faults.certifier_outcomes.any(axis=(1, 2))
    if (failing & ~crossed).any():
        raise ValueError(
            f"{run} must have its {failing.sum()} failing elites crossed with contact resolved and by other "
            f"controllers, got {(failing & crossed).sum()}: run `faultline judge` on it first"
        )


def candidates_of(archive: Archive, run: Path) -> tuple[list[Candidate], Modes, int]:
    """The faults and near-faults of a run: elites as they are, and minimal terrains that lack some of their parts.

    Args:
        archive: With fresh values and fault counts.
        run: Its directory, where minimal terrains are read.

    Returns:
        The terrains, the failure modes of the elites among them, and how many failing elites and minimal terrains are
        left out, since nobody is known to cross them.
    """
    assert archive.fresh is not None
    rate = archive.fresh.goal_rate
    near = np.flatnonzero(archive.fresh.valid & (rate < NEAR_GOAL_RATE))
    passable = archive.certified | (rate >= FAILING_GOAL_RATE)
    families = families_of(archive.genes[near], get_space(archive.space, archive.space_sha256))
    modes = find_modes(elites_of(archive.rows(near))) if len(near) else Modes(modes=[], labels=near, silhouettes={})
    kin = {
        number: {"mode": mode, "family": family}
        for number, mode, family in zip(near.tolist(), modes.labels.tolist(), families.tolist(), strict=True)
    }
    minima = read_minimal(run, archive)
    entries = {} if minima is None else {entry["elite"]: entry for entry in minima.numbers["elites"]}
    candidates, not_passable = [], 0
    for number in near.tolist():
        if passable[number]:
            about = _about_elite(archive, number, entries.get(number))
            candidates.append(Candidate(archive.genes[number], about | kin[number]))
        not_passable += not passable[number]
    for number, entry in entries.items():
        if minima is None or not archive.failing[number] or len(entry["bumps"]) == entry["of"]:
            continue  # with all its parts it is the elite itself
        if entry["certificates"]:
            candidates.append(Candidate(minima.genes[number], _about_minimal(entry) | kin[number]))
        not_passable += not entry["certificates"]
    return candidates, modes, int(not_passable)


def _about_elite(archive: Archive, number: int, minimal: dict[str, Any] | None) -> dict[str, Any]:
    return {
        "name": f"elite-{number}",
        "kind": "elite",
        "elite": number,
        "cell": int(archive.cell[number]),
        "iteration": int(archive.iteration[number]),
        "parts": None,
        "verdict": _verdict(verdict_of(archive, number)),
        "cause": None if minimal is None or minimal["cause"] is None else minimal["cause"]["kind"],
        "searched": rate_of(fresh_counts(archive, number)),
        **judgement(archive, number),
    }


def _about_minimal(entry: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": f"elite-{entry['elite']}-minimal",
        "kind": "minimal",
        "elite": entry["elite"],
        "cell": entry["cell"],
        "iteration": entry["iteration"],
        "parts": entry["bumps"],
        "verdict": _verdict(entry["verdict"]),
        "cause": None if entry["cause"] is None else entry["cause"]["kind"],
        "searched": {name: entry[name] for name in ("goal_rate", "goal_interval", "valid_episodes")},
        "resolved": entry["resolved"],
        "certificates": entry["certificates"],
    }


def _verdict(verdict: str) -> str:
    return "fault" if verdict == "fault" else "near-fault"


def choose(candidates: Sequence[Candidate], size: int) -> list[Candidate]:
    """Some of the candidates, so that each beginning of the list is spread as well as can be.

    Next comes a fault before a near-fault, then one of the family that was taken least often, of the failure mode that
    was, of the kind (elite or minimal) that was, and then the one with the lowest goal rate.

    Args:
        candidates: To choose from.
        size: How many; fewer where there are fewer.
    """
    left, taken = list(candidates), list[Candidate]()
    counts = {name: Counter[Any]() for name in ("family", "mode", "kind")}

    def turn(candidate: Candidate) -> tuple[Any, ...]:
        about = candidate.about
        often = (count[about[name]] for name, count in counts.items())
        return about["verdict"] != "fault", *often, about["searched"]["goal_rate"], about["elite"], about["kind"]

    while left and len(taken) < size:
        taken.append(left.pop(min(range(len(left)), key=lambda place: turn(left[place]))))
        for name, count in counts.items():
            count[taken[-1].about[name]] += 1
    return taken


def write_terrains(
    folder: Path, heights: NDArray[np.float32], chosen: Sequence[Candidate], more: dict[str, Any]
) -> str:
    """Writes ``pack.npz``, atomically; equal content gives equal bytes.

    Args:
        folder: Of the pack.
        heights: [m], rounded, shape (N, nrow, ncol).
        chosen: The N terrains.
        more: Further arrays.

    Returns:
        SHA-256 of the file.
    """
    whole = np.rint(heights.astype(np.float64) / HEIGHT_UNIT_M).astype(np.int32)
    abouts = [candidate.about for candidate in chosen]
    content = {
        # Of smooth ground the rise along x hardly changes along y, so that this packs into a third of the bytes.
        "twists": np.diff(np.diff(whole, axis=2, prepend=np.int32(0)), axis=1, prepend=np.int32(0)),
        "height_unit_m": np.array(HEIGHT_UNIT_M),
        "genes": np.array([candidate.genes for candidate in chosen], np.float32),
        **{name: np.array(["" if about[name] is None else about[name] for about in abouts]) for name in _OF_A_TERRAIN},
        "searched_goal_rate": np.array([about["searched"]["goal_rate"] for about in abouts], np.float64),
        **more,
    }
    data = npz_bytes(content, compression=zipfile.ZIP_BZIP2)
    write_atomically(folder / TERRAINS_FILE, data)
    return hashlib.sha256(data).hexdigest()
