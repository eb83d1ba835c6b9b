"""A pack: terrains on which any controller can be tested, spread over the ways in which the searched one fails.

Every terrain is a fault or a *near-fault*: under :data:`NEAR_GOAL_RATE` of the robots reach the goal in 40 fresh
episodes, and it is known to be passable, since another controller is certified on it or the searched one crosses it in
at least half of its episodes. What nobody is known to cross is in no pack.
"""

import hashlib
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive, FaultCounts
from qd.faults import judgement, rate_of
from qd.fitness import FAILING_GOAL_RATE
from qd.groups import Modes, elites_of, families_of, find_modes, verdict_of
from qd.minimal import fresh_counts
from qd.run.directory import RESULTS
from qd.run.minimise import minimal_of_run
from sim.files.atomic import read_json, write_atomically
from sim.files.command import command_line
from sim.files.npz import npz_bytes, read_arrays

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

PACK_FILE = "pack.json"
TERRAINS_FILE = "pack.npz"
PACK_FOLDER = "pack"
"""Of a robot's published results."""
NEAR_GOAL_RATE = 0.75
"""Goal rate of the searched controller from which on a terrain is no near-fault."""
HEIGHT_UNIT_M = 1e-3
"""Heights of a pack are whole numbers of it, in its file and where they are crossed [m]."""

_MAX_BYTES = 1e9  # of an array that is read
_OF_A_TERRAIN = ("name", "kind", "elite", "verdict", "mode", "family", "cause")  # also in the npz
_KEYS = ("robot", "robot_sha256", "penalty_definition", "terrains", "rates", "terrains_sha256", "seed", "episodes")


class Candidate(NamedTuple):
    """A terrain that may be taken."""

    genes: NDArray[np.float32]
    """Shape (num_genes,)."""
    about: dict[str, Any]
    """What is known of it, as JSON values."""


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """All terrains of a run that may be taken."""

    terrains: list[Candidate]
    modes: Modes
    """Failure modes of the elites among them."""
    not_passable: int
    """Failing elites and minimal terrains that are left out, since nobody is known to cross them."""


def check_judged(archive: Archive, run: Path, robot: "RobotCfg") -> None:
    """That all failing elites of a run, if there are any, were confirmed and certified.

    Raises:
        ValueError: If not, naming the command.
    """
    faults, failing = archive.faults or FaultCounts.none_of(len(archive)), archive.failing
    crossed = {
        "confirm": faults.resolved_outcomes.any(axis=1),
        "certify": faults.certifier_outcomes.any(axis=(1, 2)),
    }
    for name, there in crossed.items():
        if (failing & ~there).any():
            remedy = command_line(name, robot=robot.spec, run=run)
            raise ValueError(
                f"{run} must have its {failing.sum():,} failing elites crossed by `faultline {name}`, which says what "
                f"is a fault, got {(failing & there).sum():,} of them: run `{remedy}` first"
            )


def candidates_of(archive: Archive, run: Path, robot: "RobotCfg") -> Candidates:
    """The faults and near-faults of a run: elites as they are, and minimal terrains that lack some of their parts.

    Args:
        archive: With fresh values and fault counts.
        run: Its directory, where minimal terrains are read.
        robot: Its robot.

    Raises:
        ValueError: If the file of the minimal terrains is damaged.
    """
    from sim.space import get_space  # with Warp: not for `--help`

    assert archive.fresh is not None
    rate, failing = archive.fresh.goal_rate, archive.failing
    near = archive.fresh.valid & (rate < NEAR_GOAL_RATE)
    passable = archive.certified | (rate >= FAILING_GOAL_RATE)
    numbers, judged = minimal_of_run(run, archive, robot)
    entries = {entry["elite"]: entry for entry in numbers["elites"]}
    chosen = np.flatnonzero(near)
    families = dict(
        zip(
            chosen.tolist(),
            families_of(archive.genes[chosen], get_space(archive.space, archive.space_sha256)).tolist(),
            strict=True,
        )
    )
    modes = (
        find_modes(elites_of(archive.rows(chosen))) if len(chosen) else Modes(modes=[], labels=chosen, silhouettes={})
    )
    mode = dict(zip(chosen.tolist(), modes.labels.tolist(), strict=True))
    found, left_out = [], 0
    for number in chosen.tolist():
        kin = {"mode": mode[number], "family": families[number]}
        if passable[number]:
            about = _about_elite(archive, number, entries.get(number))
            found.append(Candidate(archive.genes[number], about | kin))
        left_out += not passable[number]
    for place, entry in enumerate(numbers["elites"]):
        if len(entry["bumps"]) == entry["of"]:
            continue  # the elite itself
        if judged.certified[place]:
            kin = {"mode": mode[entry["elite"]], "family": families[entry["elite"]]}
            found.append(Candidate(judged.genes[place], _about_minimal(entry) | kin))
        left_out += not judged.certified[place]
    assert all(failing[entry["elite"]] for entry in numbers["elites"])
    return Candidates(terrains=found, modes=modes, not_passable=left_out)


def _about_elite(archive: Archive, number: int, minimal: dict[str, Any] | None) -> dict[str, Any]:
    cause = None if minimal is None or minimal["cause"] is None else minimal["cause"]["kind"]
    return {
        "name": f"elite-{number}",
        "kind": "elite",
        "elite": number,
        "cell": int(archive.cell[number]),
        "iteration": int(archive.iteration[number]),
        "parts": None,
        "verdict": _verdict(verdict_of(archive, number)),
        "cause": cause,
        "searched": rate_of(fresh_counts(archive, number)),
        **judgement(archive, number),
    }


def _about_minimal(entry: dict[str, Any]) -> dict[str, Any]:
    """Of an entry of ``minimal.json``."""
    searched = ("goal_rate", "goal_interval", "valid_episodes")
    return {
        "name": f"elite-{entry['elite']}-minimal",
        "kind": "minimal",
        "elite": entry["elite"],
        "cell": entry["cell"],
        "iteration": entry["iteration"],
        "parts": entry["bumps"],
        "verdict": _verdict(entry["verdict"]),
        "cause": None if entry["cause"] is None else entry["cause"]["kind"],
        "searched": {name: entry[name] for name in searched},
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
    while left and len(taken) < size:
        best = min(range(len(left)), key=lambda place: _turn(left[place].about, counts))
        taken.append(left.pop(best))
        for name, count in counts.items():
            count[taken[-1].about[name]] += 1
    return taken


def _turn(about: dict[str, Any], counts: dict[str, Counter[Any]]) -> tuple[Any, ...]:
    taken = (count[about[name]] for name, count in counts.items())
    return about["verdict"] != "fault", *taken, about["searched"]["goal_rate"], about["elite"], about["kind"]


@dataclass(frozen=True, kw_only=True)
class Pack:
    """A pack as its files have it."""

    folder: Path
    heights: NDArray[np.float32]
    """[m], shape (N, nrow, ncol)."""
    genes: NDArray[np.float32] | None
    """Shape (N, num_genes), where the terrains have some."""
    content: dict[str, Any]
    """Of ``pack.json``."""

    @property
    def terrains(self) -> list[dict[str, Any]]:
        """What is known of each."""
        return self.content["terrains"]

    def __len__(self) -> int:
        """N."""
        return len(self.heights)


def rounded(heights: NDArray[np.floating]) -> NDArray[np.float32]:
    """Heights [m] as a pack has them, in whole numbers of :data:`HEIGHT_UNIT_M`."""
    return (np.rint(np.asarray(heights, np.float64) / HEIGHT_UNIT_M) * HEIGHT_UNIT_M).astype(np.float32)


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
    columns = {
        name: np.array([one.about[name] or "" if name == "cause" else one.about[name] for one in chosen])
        for name in _OF_A_TERRAIN
    }
    content = {
        # Of smooth ground the rise along x hardly changes along y, so that this packs into a third of the bytes.
        "twists": np.diff(np.diff(whole, axis=2, prepend=np.int32(0)), axis=1, prepend=np.int32(0)),
        "height_unit_m": np.array(HEIGHT_UNIT_M),
        "genes": np.array([one.genes for one in chosen], np.float32),
        **columns,
        "searched_goal_rate": np.array([one.about["searched"]["goal_rate"] for one in chosen], np.float64),
        **more,
    }
    data = npz_bytes(content, compression=zipfile.ZIP_BZIP2)
    write_atomically(folder / TERRAINS_FILE, data)
    return hashlib.sha256(data).hexdigest()


def pack_folder(named: str) -> Path:
    """The folder of a pack: the one named, or the published one of a robot that is.

    Raises:
        FileNotFoundError: If there is none.
    """
    published = RESULTS / named / PACK_FOLDER
    for folder in (Path(named), published):
        if (folder / PACK_FILE).is_file():
            return folder
    raise FileNotFoundError(
        f"no pack at {named} or {published}: give the folder that holds {PACK_FILE}, or make one with "
        f"`{command_line('pack', robot='anymal')}`"
    )


def read_pack(folder: Path) -> Pack:
    """Reads a pack; data only, nothing in it can run.

    Args:
        folder: As of :func:`pack_folder`.

    Raises:
        ValueError: If it is damaged, or its two files are not of one making.
    """
    from sim.terrain import NUM_COLS, NUM_ROWS  # with Warp: not for `--help`

    file = folder / TERRAINS_FILE
    try:
        content = read_json(folder / PACK_FILE)
        if missing := [name for name in _KEYS if name not in content]:
            raise ValueError(f"{PACK_FILE} lacks {', '.join(missing)}")
        if hashlib.sha256(file.read_bytes()).hexdigest() != content["terrains_sha256"]:
            raise ValueError(f"{TERRAINS_FILE} is not the one that {PACK_FILE} names")
        if not isinstance(content["rates"], dict) or not all("rates" in one for one in content["terrains"]):
            raise ValueError(f"{PACK_FILE} must have the rates of each controller, over all terrains and on each")
        with zipfile.ZipFile(file) as there:
            if "rises.npy" in there.namelist():
                raise ValueError(f"{TERRAINS_FILE} is of an older version, with other heights")
        arrays = read_arrays(file, ("twists", "height_unit_m", "genes"), max_bytes=_MAX_BYTES)
        whole = np.cumsum(np.cumsum(arrays["twists"], axis=1), axis=2)
        heights = (whole * float(arrays["height_unit_m"])).astype(np.float32)
        expected = (len(content["terrains"]), NUM_ROWS, NUM_COLS)
        if heights.shape != expected or not np.isfinite(heights).all() or not len(heights):
            raise ValueError(f"heights must be finite, of shape {expected}, got {heights.shape}")
        return Pack(folder=folder, heights=heights, genes=arrays["genes"], content=content)
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(
            f"{folder} must be a pack, but it is damaged or unfinished: {error}: put a copy of it back, or make it "
            "again with `faultline pack`"
        ) from None
