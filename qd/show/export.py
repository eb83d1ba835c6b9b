"""Elites as files for other programs: ``faultline export --elite 0`` or ``--elite all``."""

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.archive import Archive
from qd.run.directory import folder_for
from qd.show.elites import find_archive
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import OfRobot, Which, chosen_elites, split_words
from sim.files.provenance import provenance

INDEX_FILE = "index.json"
"""What was exported, in the folder of the files."""
_FOLDER = "terrains"
_AT_ONCE = 32  # terrains rasterised


@dataclass(frozen=True, kw_only=True)
class Export(OfRobot, Which):
    """Write elites of an archive as files that other programs read.

    Of each elite: `elite-N.npz` (heights in m, rows along y; genes), `elite-N.png` (16-bit grayscale seen from above;
    scale and offset in `elite-N.json`), `elite-N.xml` (MJCF: a scene of the terrain alone, whose surface is the
    simulation's, between the nodes too) and `elite-N.stl` (a closed block). `faultline cross --terrain elite-N.npz`, or
    with the .png, crosses it again.
    """

    out: Path | None = None
    """Folder to write to; terrains/ in the run directory, or of a published one in runs/<robot>-published."""
    formats: tuple[str, ...] = ("npz", "png", "xml", "stl")
    """Which of npz, png, xml and stl to write; several may stand in one, apart by spaces."""
    overwrite: bool = False
    """Replace files of an earlier export; without it the command refuses to."""

    def execute(self) -> None:
        """Writes the files."""
        export(self)


def export(cfg: Export) -> list[Path]:
    """Writes the files.

    Returns:
        The files, the index last.

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If there is no such elite or format, or no room; before anything is written.
        OSError: If a file cannot be written.
    """
    from sim.bank import heights_of
    from sim.maps.terrain_files import check_formats, write_terrain

    found = find_archive(cfg.robot, cfg.run, space=cfg.space)
    elites = chosen_elites(cfg.elite, len(found.archive), found.run)
    formats = list(dict.fromkeys(split_words(cfg.formats)))
    check_formats(formats)
    folder = cfg.out or folder_for(found.run, found.robot.name) / _FOLDER
    if not cfg.overwrite:
        _refuse_to_replace(folder, elites)
    _check_room(folder, len(elites), formats)
    prepare_output(folder / INDEX_FILE)
    of_space = {"space": found.archive.space, "space_sha256": found.archive.space_sha256}
    origin = {"run": str(found.run), **of_space, **provenance("cpu", 0)}
    del origin["seed"]  # nothing is drawn
    archive, files, index = found.archive, [], []
    space = found.space
    with tqdm(total=len(elites), desc="exporting", unit="elite", file=sys.stderr, disable=None) as bar:
        for first in range(0, len(elites), _AT_ONCE):
            numbers = elites[first : first + _AT_ONCE]
            for elite, heights in zip(numbers, heights_of(archive.genes[numbers], space), strict=True):
                about = {**about_elite(archive, elite), "terrain": space.describe(archive.genes[elite])}
                stem = folder / f"elite-{elite}"
                genes: NDArray[np.float32] = archive.genes[elite]
                files += write_terrain(stem, heights, formats=formats, about={**about, **origin}, genes=genes)
                index.append({**about, "files": stem.name})
                bar.update()
    files.append(folder / INDEX_FILE)
    write_atomically(files[-1], to_json({**archive.named(), "formats": formats, "elites": index, **origin}))
    print(f"{len(elites)} elite{'s' * (len(elites) != 1)} as {', '.join(formats)}: {folder}")
    return files


def about_elite(archive: Archive, elite: int) -> dict[str, Any]:
    """An elite's numbers as JSON values: as found, and under ``fresh`` what 40 fresh episodes say, None if none did.

    Args:
        archive: Its archive.
        elite: Its number.
    """
    names = ("fitness", "collision_rate", "goal_rate", "fallen_rate", "episodes")

    def numbers(values: Any) -> dict[str, Any]:
        ratios = dict(zip(archive.penalties, values.ratios[elite].tolist(), strict=True))
        return {**{name: getattr(values, name)[elite].item() for name in names}, "ratios": ratios}

    return {
        "robot": archive.robot,
        "elite": elite,
        "iteration": int(archive.iteration[elite]),
        **numbers(archive),
        "fresh": None if archive.fresh is None else numbers(archive.fresh),
    }


def _refuse_to_replace(folder: Path, elites: list[int]) -> None:
    there = [file for file in (folder / INDEX_FILE, *folder.glob("elite-*")) if file.exists()]
    wanted = {INDEX_FILE, *(f"elite-{elite}" for elite in elites)}
    found = sorted({file.name for file in there if file.name == INDEX_FILE or file.stem in wanted})
    if found:
        names = ", ".join(found[:3]) + ", ..." * (len(found) > 3)
        raise ValueError(f"{folder} holds an export already: {names}: give --overwrite to replace it, or another --out")


def _check_room(folder: Path, count: int, formats: list[str]) -> None:
    from sim.maps.terrain_files import TYPICAL_BYTES

    needed = count * sum(TYPICAL_BYTES[ending] for ending in formats)
    free = shutil.disk_usage(_that_exists(folder)).free
    print(f"Writing about {needed / 1e6:,.0f} MB to {folder}.", flush=True)
    if needed > free:
        raise ValueError(
            f"{folder} has room for {free / 1e6:,.0f} MB, but {count} elites as {', '.join(formats)} take about "
            f"{needed / 1e6:,.0f} MB: leave stl out (--formats), or give another --out"
        )


def _that_exists(folder: Path) -> Path:
    """The folder, or the nearest above it that is there."""
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())
