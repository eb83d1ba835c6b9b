"""Elites, or terrains of a pack, as files for other programs: ``faultline export --elite 0`` or ``--elite all``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.evaluate.pack import PACK_FILE, pack_folder, read_pack
from qd.groups import VERDICTS, Ranking, rank
from qd.minima import read_minimal
from qd.run.directory import RUNS, folder_for
from qd.run.progress import share_bar
from qd.show.elites import OpenedRun
from sim.bank import terrains_of
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import chosen_elites
from sim.files.records import provenance
from sim.ground import GroundMaps
from sim.maps.terrain_files import FORMATS, ExportedTerrain, check_formats, write_terrain
from sim.policy.loaders import load_checkpoint
from sim.policy.onnx import export_onnx
from sim.robots.find import robot_of
from sim.robots.robot import RobotCfg

INDEX_FILE = "index.json"
"""What was exported, in the folder of the files."""
README_FILE = "README.md"
"""How other programs take the files, beside it."""
_FOLDER = "terrains"
_AT_ONCE = 32  # terrains rasterised


@dataclass(frozen=True, kw_only=True)
class Source:
    """Terrains that may be exported."""

    folder: Path
    """Where their files go if no other folder is named."""
    stems: list[str]
    """Name of each terrain's files."""
    about: list[dict[str, Any]]
    """What is known of each."""
    genes: NDArray[np.float32]
    """Shape (N, num_genes)."""
    heights: Callable[[slice], tuple[NDArray[np.float32], GroundMaps | None]]
    """Heights of some of them [m], shape (n, nrow, ncol), and their ground, if it is not as always."""
    origin: dict[str, Any]
    """Where they come from, for every file."""
    named: dict[str, Any]
    """The same for the index alone."""
    timestep: float
    """Physics step of the robot [s]."""
    ground: tuple[str, ...] = ()
    """What the terrains have maps of beside heights."""


def source_of_archive(opened_run: OpenedRun, elite: str = "0", minimal: str | None = None) -> Source:
    """Elites of an archive, or their minimal terrains; arguments as of :meth:`qd.show.elites.OpenedRun.terrains`."""
    archive, space = opened_run.archive, opened_run.space
    terrains = opened_run.terrains(elite, minimal)
    genes = np.stack([terrain.genes for terrain in terrains])
    minima = read_minimal(opened_run.folder, archive)
    ranking = rank(archive, space, minima, numbers=[terrain.number for terrain in terrains])
    return Source(
        folder=folder_for(opened_run.path, opened_run.robot.name)
        / (_FOLDER if minimal is None else f"minimal-{_FOLDER}"),
        stems=[terrain.stem for terrain in terrains],
        about=[
            about_elite(ranking, row, archive)
            | ({"minimal": terrain.minimal} if terrain.minimal else {})
            | {"terrain": space.describe(terrain.genes)}
            for row, terrain in enumerate(terrains)
        ],
        genes=genes,
        heights=lambda part: terrains_of(genes[part], space),
        origin={"run": str(opened_run.path), "space": archive.space, "space_sha256": archive.space_sha256},
        named=archive.named(),
        timestep=opened_run.robot.physics_dt,
        ground=space.ground,
    )


def source_of_pack(named: str, places: str = "all", robot: str | None = None) -> Source:
    """Terrains of a pack."""
    folder = pack_folder(named)
    pack = read_pack(folder)
    of_robot = robot_of(pack.content, robot, folder / PACK_FILE, flag="pack")
    rows = chosen_elites(places, len(pack), folder)
    return Source(
        folder=RUNS / f"{of_robot.name}-pack-{_FOLDER}",
        stems=[pack.terrains[row]["name"] for row in rows],
        about=[{"robot": of_robot.name, "place": row, **pack.terrains[row]} for row in rows],
        genes=pack.genes[rows],
        heights=lambda part: (pack.heights[rows[part]], None),
        origin={"pack": folder.name, "terrains_sha256": pack.content["terrains_sha256"]},
        named={name: pack.content[name] for name in ("robot", "robot_sha256", "penalty_definition")},
        timestep=of_robot.physics_dt,
    )


def export_terrains(
    source: Source, *, formats: Sequence[str] = tuple(FORMATS), out: Path | None = None, overwrite: bool = False
) -> list[Path]:
    """Writes terrains as files that other programs read."""
    formats, folder = list(dict.fromkeys(formats)), out or source.folder
    check_formats(formats)
    if source.ground and "npz" not in formats:
        raise ValueError(
            f"formats must have npz, which alone holds {' and '.join(source.ground)}, got {', '.join(formats)}"
        )
    if not overwrite:
        _refuse_to_replace(folder, {*source.stems})
    prepare_output(folder / INDEX_FILE)
    origin = {**source.origin, **provenance("cpu", 0)}
    del origin["seed"]  # nothing is drawn
    files, index, count = [], [], len(source.stems)
    with share_bar("exporting") as progress:
        for first in range(0, count, _AT_ONCE):
            part = slice(first, min(first + _AT_ONCE, count))
            grids, maps = source.heights(part)
            for k, heights in enumerate(grids):
                about, stem = source.about[first + k], source.stems[first + k]
                terrain = ExportedTerrain(
                    heights=heights, name=stem, genes=source.genes[first + k], timestep=source.timestep,
                    ground=None if maps is None else maps[k : k + 1],
                )  # fmt: skip
                files += write_terrain(folder, terrain, formats=formats, about={**about, **origin})
                index.append({**about, "files": stem})
                progress(len(index) / count)
    files += [folder / README_FILE, folder / INDEX_FILE]
    write_atomically(files[-2], readme_of(source.stems[0], formats).encode())
    write_atomically(files[-1], to_json({**source.named, "formats": formats, "elites": index, **origin}))
    print(f"{count} terrain{'s' * (count != 1)} as {', '.join(formats)}: {folder}")
    return files


_README = """# Terrains of faultline

x runs along the course (0 to 16 m), y across it (0 to 8 m), z up. Robots start at (2, 4) and walk to (14, 4).
`STEM.json` says what the numbers in its files mean and what is known of the terrain; `index.json` lists all terrains.
The line of MuJoCo is tested, the others follow the sources of these programs.

"""
_PROGRAMS = (
    ("MuJoCo", "xml", "`python -m mujoco.viewer --mjcf=STEM.xml`; with a robot: `scene = mujoco.MjSpec.from_file("
     "'STEM.xml')`, `scene.attach(robot, prefix='robot/', frame=scene.worldbody.add_frame(pos=(2, 4, 0)))`"),
    ("mjlab", "xml", "`SceneCfg(spec_fn=add)` without a terrain, where `add(spec)` calls `spec.attach("
     "mujoco.MjSpec.from_file('STEM.xml'), prefix='terrain/', frame=spec.worldbody.add_frame())`"),
    ("Isaac Lab", "stl", "`import_mesh('STEM', trimesh.load_mesh('STEM.stl'))` of its `TerrainImporter`, or "
     "`scripts/tools/convert_mesh.py` for a USD file"),
    ("Isaac Lab's and legged_gym's generators", "npy", "`convert_height_field_to_mesh(numpy.load('STEM.npy'), 0.05, "
     "0.001)` (x along the rows); it cuts cells along the other diagonal, so between nodes the mesh is truer"),
    ("Gazebo", "sdf", "`gz sim STEM.sdf`, or `<include><uri>/path/to/STEM.sdf</uri></include>` in a world"),
)  # fmt: skip
"""How programs take the files, and the format that it needs."""


def readme_of(stem: str, formats: Sequence[str]) -> str:
    """How other programs take the files of a terrain, a line each."""
    lines = [f"- **{program}**: {words}\n" for program, ending, words in _PROGRAMS if ending in formats]
    return (_README + "".join(lines)).replace("STEM", stem)


def export_controller(policy: str | None, robot: RobotCfg, out: Path, *, overwrite: bool = False) -> None:
    """Writes a robot's controller, an rsl_rl checkpoint or by default the shipped one, as one ONNX file."""
    if out.exists() and not overwrite:
        raise ValueError(f"{out} exists: give --overwrite to replace it, or another --onnx")
    export_onnx(load_checkpoint(policy or robot.policy_file, robot), out)
    print(f"Controller: {out}")


def about_elite(ranking: Ranking, row: int, archive: Archive) -> dict[str, Any]:
    """An elite's verdict, cause, ending and numbers as JSON values: as found, and as 40 fresh episodes say, if any."""
    elite, elites = int(ranking.elites.numbers[row]), ranking.elites
    names = ("fitness", "collision_rate", "goal_rate", "fallen_rate", "episodes")

    def numbers(values: Any) -> dict[str, Any]:
        ratios = dict(zip(archive.penalties, values.ratios[elite].tolist(), strict=True))
        return {**{name: getattr(values, name)[elite].item() for name in names}, "ratios": ratios}

    return {
        "robot": archive.robot,
        "elite": elite,
        "verdict": VERDICTS[elites.verdict[row]] or "not failing",
        "cause": ranking.causes[row] or None,
        "ending": elites.ending(row)[0] if elites.failing[row] else "crossed",
        "in_words": ranking.name(row),
        "iteration": int(archive.iteration[elite]),
        **numbers(archive),
        "fresh": None if archive.fresh is None else numbers(archive.fresh),
    }


def _refuse_to_replace(folder: Path, stems: set[str]) -> None:
    written = (INDEX_FILE, README_FILE)
    replaced = sorted(file.name for file in folder.glob("*") if file.name in written or file.stem in stems)
    if replaced:
        names = ", ".join(replaced[:3]) + ", ..." * (len(replaced) > 3)
        raise ValueError(f"{folder} holds an export already: {names}: give --overwrite to replace it, or another --out")
