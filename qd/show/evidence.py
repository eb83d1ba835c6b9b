"""Evidence of certificates: one crossing of each, recorded, kept in the run and shown by replay and film."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kernels.episode import Outcome
from qd.archive import Archive
from qd.faults import EPISODES, certificate_seeds
from qd.run.directory import directory_of
from qd.run.progress import share_bar
from qd.show.recordings import AT_ONCE, Cross, Wanted
from sim.recording.file import read_recording, write_recording

if TYPE_CHECKING:
    from sim.recording.recorder import Recording

FOLDER = "recordings"
"""Folder of a run that holds them."""


def evidence_file(run: Path, archive: Archive, number: int, name: str) -> Path:
    """Where the crossing of an elite by a certifier is kept; named by its cell, since numbers change."""
    return directory_of(run) / FOLDER / f"cell-{archive.cell[number]}-{name}.recording.npz"


def read_evidence(run: Path, archive: Archive, number: int, name: str) -> "Recording":
    """The crossing of an elite by a certifier.

    Args:
        run: Run directory or archive file.
        archive: What it holds.
        number: Of the elite.
        name: Of the certifier.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If the file is damaged, or of another terrain or controller.
    """
    file, faults = evidence_file(run, archive, number, name), archive.faults
    if faults is None or name not in faults.certifiers or not file.exists():
        raise FileNotFoundError(
            f"no crossing of elite {number} by {name} is kept at {file}: `faultline certify --record` keeps one of "
            "each certificate"
        )
    recording = read_recording(file)
    digest = faults.certifier_sha256[faults.certifiers.index(name)]
    if recording.genes is None or not np.array_equal(recording.genes, archive.genes[number][None]):
        raise ValueError(f"{file} must be of elite {number}, got another terrain: delete it and record it again")
    if recording.origin.get("policy_sha256") != digest:
        raise ValueError(f"{file} must be of certifier {name}, got another controller: delete it and record it again")
    return recording


def record_certificates(
    run: Path,
    archive: Archive,
    chosen: Sequence[int],
    certifiers: Mapping[str, str],
    *,
    seed: int,
    device: str,
    cross: Cross,
) -> int:
    """Records one crossing of each certificate that has none yet: of its 20 episodes the first that reaches the goal.

    Args:
        run: Run directory.
        archive: With certificates.
        chosen: Numbers of elites.
        certifiers: Controllers by their names in the archive.
        seed: The search's.
        device: Warp device name, by which terrains are crossed one by one or many at once.
        cross: Crosses terrains.

    Returns:
        How many were recorded.
    """
    faults = archive.faults
    assert faults is not None
    certified, seeds = faults.certificates(), certificate_seeds(archive, seed)
    missing = [
        (name, number)
        for name in certifiers
        for number in chosen
        if certified[number, faults.certifiers.index(name)] and not _is_kept(run, archive, number, name)
    ]
    if not missing:
        return 0
    at_once, kept = AT_ONCE if device.startswith("cuda") else 1, 0
    with share_bar(f"recording {len(missing)} certificates") as progress:
        for name, policy in certifiers.items():
            own = [number for by, number in missing if by == name]
            for part in (own[first : first + at_once] for first in range(0, len(own), at_once)):
                wanted = [
                    Wanted(
                        label=f"elite {number} of {archive.robot}, by {name}", terrain=archive.genes[number],
                        policy=policy, replicas=EPISODES, seed=seed, terrain_seed=int(seeds[number]),
                        space=archive.space,
                    )
                    for number in part
                ]  # fmt: skip
                for number, recording in zip(part, cross(wanted, lambda share: None), strict=True):
                    arrived = np.flatnonzero(recording.outcome[0] == Outcome.GOAL)
                    if len(arrived):  # on a GPU the same episodes differ in their last bits
                        file = evidence_file(run, archive, number, name)
                        file.parent.mkdir(exist_ok=True)
                        write_recording(file, recording.of_episode(int(arrived[0])))
                        kept += 1
                progress((missing.index((name, part[-1])) + 1) / len(missing))
    return kept


def _is_kept(run: Path, archive: Archive, number: int, name: str) -> bool:
    try:
        read_evidence(run, archive, number, name)
    except (OSError, ValueError):
        return False
    return True
