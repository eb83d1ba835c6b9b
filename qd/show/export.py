"""Elites, or terrains of a pack, as files for other programs: ``faultline export --elite 0`` or ``--elite all``."""

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.archive import Archive
from qd.evaluate.pack import PACK_FILE, pack_folder, read_pack
from qd.run.directory import RUNS, folder_for
from qd.show.elites import find_archive
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import OfRobot, Which, chosen_elites, split_words
from sim.files.records import provenance

if TYPE_CHECKING:
    from sim.ground import GroundMaps

INDEX_FILE = "index.json"
"""What was exported, in the folder of the files."""
_FOLDER = "terrains"
_AT_ONCE = 32  # terrains rasterised


@dataclass(frozen=True, kw_only=True)
class Export(OfRobot, Which):
    """Write elites of an archive, or terrains of a pack, as files that other programs read.

    For each elite it writes `elite-N.npz` (heights in m, rows along y; genes; friction and softness where the ground
    has them), `elite-N.png` (16-bit grayscale seen from above; scale and offset in `elite-N.json`), `elite-N.xml`
    (MJCF: a scene of the terrain alone, whose surface is the simulation's, between the nodes too) and `elite-N.stl` (a
    closed block). `faultline cross --terrain elite-N.npz`, or with the .png, crosses it again.
    """

    pack: str | None = None
    """Take the terrains of a pack instead: a folder that `faultline pack` made, or anymal or cassie for the published
    one. --elite counts its terrains, from 0; their files are called as the pack calls them."""
    out: Path | None = None
    """Folder to write to; terrains/ in the run directory, or of a published one in runs/<robot>-published; of minimal
    terrains minimal-terrains/, of a pack runs/<robot>-pack-terrains."""
    formats: tuple[str, ...] = ("npz", "png", "xml", "stl")
    """Which of npz, png, xml and stl to write; several may stand in one, apart by spaces."""
    overwrite: bool = False
    """Replace files of an earlier export; without it the command refuses to."""

    def execute(self) -> None:
        """Writes the files."""
        export(self)


@dataclass(frozen=True, kw_only=True)
class _Source:
    """Terrains that may be exported."""

    numbers: list[int]
    """Those to be exported."""
    folder: Path
    """Where their files go without ``--out``."""
    origin: dict[str, Any]
    """Where they come from, for every file."""
    named: dict[str, Any]
    """The same for the index alone."""
    stem: Callable[[int], str]
    """Name of a terrain's files."""
    genes: Callable[[int], NDArray[np.float32]] | None
    """Of a terrain, shape (num_genes,)."""
    terrains: "Callable[[list[int]], tuple[NDArray[np.float32], GroundMaps | None]]"
    """Heights of some terrains [m], shape (number of them, nrow, ncol), and their ground, if it is not as always."""
    about: Callable[[int], dict[str, Any]]
    """What is known of a terrain."""
    ground: tuple[str, ...] = ()
    """What its terrains have maps of beside heights."""


def export(cfg: Export) -> list[Path]:
    """Writes the files.

    Returns:
        The files, the index last.

    Raises:
        FileNotFoundError: If there is no archive or pack.
        ValueError: If there is no such elite or format, a pack is damaged or of another robot, or there is no room;
            before anything is written.
        OSError: If a file cannot be written.
    """
    from sim.maps.terrain_files import check_formats, write_terrain

    source = _of_archive(cfg) if cfg.pack is None else _of_pack(cfg, cfg.pack)
    elites = source.numbers
    formats = list(dict.fromkeys(split_words(cfg.formats)))
    check_formats(formats)
    _tell_of_ground(source, formats)
    folder = cfg.out or source.folder
    if not cfg.overwrite:
        _refuse_to_replace(folder, {source.stem(elite) for elite in elites})
    _check_room(folder, len(elites), formats)
    prepare_output(folder / INDEX_FILE)
    origin = {**source.origin, **provenance("cpu", 0)}
    del origin["seed"]  # nothing is drawn
    files, index = [], []
    with tqdm(total=len(elites), desc="exporting", unit="terrain", file=sys.stderr, disable=None) as bar:
        for first in range(0, len(elites), _AT_ONCE):
            numbers = elites[first : first + _AT_ONCE]
            grids, maps = source.terrains(numbers)
            for place, (number, heights) in enumerate(zip(numbers, grids, strict=True)):
                about, stem = source.about(number), folder / source.stem(number)
                genes = None if source.genes is None else source.genes(number)
                ground = None if maps is None else maps[place : place + 1]
                told = {**about, **origin}
                files += write_terrain(stem, heights, formats=formats, about=told, genes=genes, ground=ground)
                index.append({**about, "files": stem.name})
                bar.update()
    files.append(folder / INDEX_FILE)
    write_atomically(files[-1], to_json({**source.named, "formats": formats, "elites": index, **origin}))
    what = "elite" if cfg.pack is None and cfg.minimal is None else "terrain"
    print(f"{len(elites)} {what}{'s' * (len(elites) != 1)} as {', '.join(formats)}: {folder}")
    return files


def _tell_of_ground(source: _Source, formats: list[str]) -> None:
    """Says which files hold friction and softness.

    Raises:
        ValueError: If none would.
    """
    if not source.ground:
        return
    others = ", ".join(ending for ending in formats if ending != "npz")
    alone = f"{others} hold{'s' * (',' not in others)} heights alone"
    if "npz" not in formats:
        raise ValueError(
            f"terrains have {' and '.join(source.ground)} of their own, which only npz holds, got --formats "
            f"{' '.join(formats)}: add npz"
        )
    if others:
        print(f"{' and '.join(source.ground).capitalize()} of the ground: in the npz; {alone}.")


def _of_archive(cfg: Export) -> _Source:
    """The elites of an archive."""
    from sim.bank import terrains_of

    found = find_archive(cfg.robot, cfg.run, space=cfg.space)
    archive, space = found.archive, found.space
    minima = None if cfg.minimal is None else found.minima()
    what = "elite" if minima is None else "minimal"

    def genes(elite: int) -> NDArray[np.float32]:
        return archive.genes[elite] if minima is None else minima.genes[elite]

    def about(elite: int) -> dict[str, Any]:
        known = {} if minima is None else {"minimal": minima.entry(elite)}
        return {**about_elite(archive, elite), **known, "terrain": space.describe(genes(elite))}

    return _Source(
        numbers=(
            chosen_elites(cfg.elite, len(archive), found.run)
            if minima is None
            else minima.chosen(str(cfg.minimal), found.run)
        ),
        folder=folder_for(found.run, found.robot.name) / (_FOLDER if minima is None else f"{what}-{_FOLDER}"),
        origin={"run": str(found.run), "space": archive.space, "space_sha256": archive.space_sha256},
        named=archive.named(),
        stem=lambda elite: f"{what}-{elite}",
        genes=genes,
        terrains=lambda numbers: terrains_of(np.stack([genes(elite) for elite in numbers]), space),
        ground=space.ground,
        about=about,
    )


def _of_pack(cfg: Export, named: str) -> _Source:
    """The terrains of a pack."""
    from sim.robots.find import robot_of

    if (cfg.run, cfg.space, cfg.minimal) != (None, None, None):
        raise ValueError(
            "a pack has its own terrains, got --run, --space or --minimal beside --pack: leave one of them out"
        )
    folder = pack_folder(named)
    pack = read_pack(folder)
    robot = robot_of(pack.content, cfg.robot, folder / PACK_FILE, flag="pack")
    return _Source(
        numbers=chosen_elites(cfg.elite, len(pack), folder),
        folder=RUNS / f"{robot.name}-pack-{_FOLDER}",
        origin={"pack": folder.name, "terrains_sha256": pack.content["terrains_sha256"]},
        named={name: pack.content[name] for name in ("robot", "robot_sha256", "penalty_definition")},
        stem=lambda place: pack.terrains[place]["name"],
        genes=None if pack.genes is None else pack.genes.__getitem__,
        terrains=lambda numbers: (pack.heights[numbers], None),
        about=lambda place: {"robot": robot.name, "place": place, **pack.terrains[place]},
    )


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


def _refuse_to_replace(folder: Path, stems: set[str]) -> None:
    there = [file for file in (folder / INDEX_FILE, *folder.glob("*-*")) if file.exists()]
    wanted = {INDEX_FILE, *stems}
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
