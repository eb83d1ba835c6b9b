"""Elites, or terrains of a pack, as files for other programs: ``faultline export --elite 0`` or ``--elite all``."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.evaluate.pack import PACK_FILE, find_pack, read_pack
from qd.faults.families import VERDICTS, Ranking, rank
from qd.faults.minimise.results import read_minimal
from qd.search.archive import Archive
from qd.search.directory import RUNS, folder_for
from qd.search.progress import Bar
from qd.show.elites import OpenedRun
from sim.controllers.formats.onnx import export_onnx
from sim.controllers.loaders import load_actor
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import choose_elites
from sim.files.provenance import provenance
from sim.robots.find import robot_of
from sim.robots.robot import RobotCfg
from sim.terrains.bank import terrains_of
from sim.terrains.maps.terrain_files import FORMATS, ExportedTerrain, check_formats, write_terrain

INDEX_FILE, README_FILE = "index.json", "README.md"
"""What was exported, and how other programs take it, in the folder of the files."""
_FOLDER = "terrains"


@dataclass(frozen=True, kw_only=True)
class Source:
    """Terrains that may be exported."""

    folder: Path
    """Where their files go if no other folder is named."""
    about: dict[str, dict[str, Any]]
    """What is known of each, by the name of its files."""
    terrains: Iterator[ExportedTerrain]
    """The same ones in the same order."""
    origin: dict[str, Any]


def source_of_archive(opened_run: OpenedRun, elite: str = "", minimal: str | None = None) -> Source:
    """Elites of an archive, or their minimal terrains; arguments as of :meth:`qd.show.elites.OpenedRun.terrains`."""
    archive, space, robot = opened_run.archive, opened_run.space, opened_run.robot
    terrains = opened_run.terrains(elite, minimal)
    minima = read_minimal(opened_run.folder, archive)
    ranking = rank(
        archive, space, minima, half_width=robot.footprint[1], numbers=[terrain.number for terrain in terrains]
    )

    if space.conditions:
        raise ValueError(
            f"a terrain file holds heights and ground, got terrains of {archive.space}, which are crossed under "
            "conditions: replay or film them instead"
        )

    def rasterised() -> Iterator[ExportedTerrain]:
        for _, genes, name, *_ in terrains:
            (heights,), ground = terrains_of(genes[None], space)
            yield ExportedTerrain(heights=heights, name=name, genes=genes, timestep=robot.physics_dt, ground=ground)

    return Source(
        folder=folder_for(opened_run.path, robot.name) / (_FOLDER if minimal is None else f"minimal-{_FOLDER}"),
        about={
            terrain.stem: about_elite(ranking, row, archive)
            | ({"minimal": terrain.minimal} if terrain.minimal else {})
            | {"terrain": space.describe(terrain.genes)}
            for row, terrain in enumerate(terrains)
        },
        terrains=rasterised(),
        origin={
            "run": str(opened_run.path),
            "space": archive.space,
            "space_sha256": archive.space_sha256,
            **archive.named(),
        },
    )


def source_of_pack(named: str, places: str = "all", robot: str | None = None) -> Source:
    """Terrains of a pack."""
    folder = find_pack(named)
    pack = read_pack(folder)
    of_robot = robot_of(pack.content, robot, folder / PACK_FILE, kind="pack")
    rows = choose_elites(places, range(len(pack.terrains)), f"{folder} has no place")
    names = {pack.terrains[row]["name"]: row for row in rows}
    return Source(
        folder=RUNS / f"{of_robot.name}-pack-{_FOLDER}",
        about={name: {"robot": of_robot.name, "place": row, **pack.terrains[row]} for name, row in names.items()},
        terrains=(
            ExportedTerrain(heights=pack.heights[row], name=name, genes=pack.genes[row], timestep=of_robot.physics_dt)
            for name, row in names.items()
        ),
        origin={"pack": folder.name}
        | {name: pack.content[name] for name in ("robot", "robot_sha256", "penalty_definition", "terrains_sha256")},
    )


def export_terrains(
    source: Source, *, formats: Sequence[str] = tuple(FORMATS), out: Path | None = None, overwrite: bool = False
) -> list[Path]:
    """Writes terrains as files that other programs read."""
    formats, folder, count = list(dict.fromkeys(formats)), out or source.folder, len(source.about)
    check_formats(formats)
    common = (INDEX_FILE, README_FILE)
    stored = sorted(file.name for file in folder.glob("*") if file.name in common or file.stem in source.about)
    if stored and not overwrite:
        names = ", ".join(stored[:3]) + ", ..." * (len(stored) > 3)
        raise ValueError(f"{folder} holds an export already: {names}: give --overwrite to replace it, or another --out")
    prepare_output(folder / INDEX_FILE)
    origin = {**source.origin, **provenance("cpu", 0)}
    del origin["seed"]  # nothing is drawn
    files = []
    with Bar("exporting", count) as bar:
        for done, terrain in enumerate(source.terrains, start=1):
            files += write_terrain(folder, terrain, formats=formats, about={**source.about[terrain.name], **origin})
            bar.move_to(done)
    files += [folder / README_FILE, folder / INDEX_FILE]
    write_atomically(files[-2], _README.replace("STEM", next(iter(source.about))).encode())
    index = [{**about, "files": name} for name, about in source.about.items()]
    write_atomically(files[-1], to_json({"formats": formats, "elites": index, **origin}))
    print(f"{count} terrain{'s' * (count != 1)} as {', '.join(formats)}: {folder}")
    return files


_README = """# Terrains of faultline

x runs along the course (0 to 16 m), y across it (0 to 8 m), z up. Robots start at (2, 4) and walk to (14, 4).
`STEM.json` says what the numbers in its files mean and what is known of the terrain; `index.json` lists all terrains.
The line of MuJoCo is tested, the others follow the sources of these programs.

- **MuJoCo**: `python -m mujoco.viewer --mjcf=STEM.xml`; with a robot: `scene = mujoco.MjSpec.from_file('STEM.xml')`,
  `scene.attach(robot, prefix='robot/', frame=scene.worldbody.add_frame(pos=(2, 4, 0)))`
- **mjlab**: `SceneCfg(spec_fn=add)` without a terrain, where `add(spec)` calls `spec.attach(
  mujoco.MjSpec.from_file('STEM.xml'), prefix='terrain/', frame=spec.worldbody.add_frame())`
- **Isaac Lab**: `import_mesh('STEM', trimesh.load_mesh('STEM.stl'))` of its `TerrainImporter`, or
  `scripts/tools/convert_mesh.py` for a USD file
- **Isaac Lab's and legged_gym's generators**: `convert_height_field_to_mesh(numpy.load('STEM.npy'), 0.05, 0.001)`
  (x along the rows); it cuts cells along the other diagonal, so that between the nodes the mesh is truer
- **Gazebo**: `gz sim STEM.sdf`, or `<include><uri>/path/to/STEM.sdf</uri></include>` in a world
"""


def export_controller(policy: str | None, robot: RobotCfg, out: Path, *, overwrite: bool = False) -> None:
    """Writes a robot's controller, an rsl_rl checkpoint or by default the shipped one, as one ONNX file."""
    if out.exists() and not overwrite:
        raise ValueError(f"{out} exists: give --overwrite to replace it, or another --onnx")
    export_onnx(load_actor(policy or robot.policy_file, robot), out)
    print(f"Controller: {out}")


def about_elite(ranking: Ranking, row: int, archive: Archive) -> dict[str, Any]:
    """An elite's verdict, cause, ending and numbers as JSON values: as found, and as 40 fresh episodes say, if any."""
    elite = int(ranking.numbers[row])
    names = ("fitness", "collision_rate", "goal_rate", "fallen_rate", "episodes")

    def numbers(values: Any) -> dict[str, Any]:
        ratios = dict(zip(archive.penalties, values.ratios[elite].tolist(), strict=True))
        return {**{name: getattr(values, name)[elite].item() for name in names}, "ratios": ratios}

    return {
        "robot": archive.robot,
        "elite": elite,
        "verdict": VERDICTS[ranking.verdict[row]] or "not failing",
        "cause": ranking.causes[row] or None,
        "ending": ranking.ending(row)[0] if ranking.failing[row] else "crossed",
        "in_words": ranking.name(row),
        "iteration": int(archive.iteration[elite]),
        **numbers(archive),
        "fresh": None if archive.fresh is None else numbers(archive.fresh),
    }
