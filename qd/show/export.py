"""Elites, or terrains of a pack, as files for other programs: ``faultline export --elite 0`` or ``--elite all``."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from qd.evaluate.pack import PACK_FILE, find_pack, read_pack
from qd.faults.families import VERDICTS, Ranking
from qd.search.archive import Archive
from qd.search.directory import RUNS, output_folder
from qd.search.progress import Bar
from qd.show.elites import EliteTerrain, OpenedRun
from sim.controllers.formats.onnx import export_onnx
from sim.controllers.loaders import load_actor
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import choose_elites
from sim.files.provenance import provenance
from sim.files.templates import open_templates
from sim.robots.find import resolve_robot
from sim.robots.robot import RobotCfg
from sim.terrains.bank import make_terrains
from sim.terrains.maps.terrain_files import FORMATS, ExportedTerrain, check_formats, write_terrain

_FOLDER = "terrains"
_TEMPLATES = open_templates(Path(__file__).parent / "templates")


def export_elites(
    opened_run: OpenedRun, elite: str = "", minimal: str | None = None, *, out: Path | None = None, **options: Any
) -> list[Path]:
    """Writes elites or minimal terrains; ``options`` may have ``formats``, all by default, and ``overwrite``."""
    archive, space = opened_run.archive, opened_run.space
    if space.has_conditions:
        got = f"terrains of {archive.space}, which are crossed under conditions: replay or film them instead"
        raise ValueError(f"a terrain file holds heights and ground, got {got}")
    terrains = opened_run.terrains(elite, minimal)
    ranking = opened_run.rank(numbers=[terrain.number for terrain in terrains])

    def build(terrain: EliteTerrain) -> ExportedTerrain:
        (heights,), ground = make_terrains(terrain.genes[None], space)
        shape: Any = {"heights": heights, "genes": terrain.genes, "ground": ground}
        return ExportedTerrain(name=terrain.stem, timestep=opened_run.robot.physics_dt, **shape)

    about = {
        terrain.stem: _describe_elite(ranking, row, archive)
        | ({"minimal": terrain.minimal} if terrain.minimal else {})
        | {"terrain": space.describe(terrain.genes)}
        for row, terrain in enumerate(terrains)
    }
    origin = {"run": str(opened_run.path), "space": archive.space, "space_sha256": archive.space_sha256}
    name = _FOLDER if minimal is None else f"minimal-{_FOLDER}"
    folder = output_folder(opened_run.path, opened_run.robot.name) / name
    return _export(about, map(build, terrains), origin | archive.named(), out or folder, **options)


def export_pack(
    named: str, elite: str, robot: str | None = None, *, out: Path | None = None, **options: Any
) -> list[Path]:
    """Writes terrains of a pack, by their index; ``options`` are those of :func:`export_elites`."""
    folder = find_pack(named)
    pack = read_pack(folder)
    pack_robot = resolve_robot(pack.content, robot, folder / PACK_FILE, kind="pack")
    indices = choose_elites(elite, range(len(pack.terrains)), f"{folder} has no place")
    rows = {pack.terrains[index]["name"]: index for index in indices}
    about = {name: {"robot": pack_robot.name, "place": row, **pack.terrains[row]} for name, row in rows.items()}
    keys = ("robot", "robot_sha256", "penalty_definition", "terrains_sha256")
    origin = {"pack": pack.name} | {key: pack.content[key] for key in keys}
    out = out or RUNS / f"{pack_robot.name}-pack-{_FOLDER}"
    terrains = (
        ExportedTerrain(name=name, heights=pack.heights[row], genes=pack.genes[row], timestep=pack_robot.physics_dt)
        for name, row in rows.items()
    )
    return _export(about, terrains, origin, out, **options)


def _export(
    about: dict[str, dict[str, Any]],
    terrains: Iterable[ExportedTerrain],
    origin: dict[str, Any],
    folder: Path,
    *,
    formats: Sequence[str] = tuple(FORMATS),
    overwrite: bool = False,
) -> list[Path]:
    """Writes terrains with what is known of them by their names, an index and how to use them."""
    formats = list(dict.fromkeys(formats))
    check_formats(formats)
    index_file, readme_file = folder / "index.json", folder / "README.md"
    stored = sorted(file.name for file in folder.glob("*") if file in (index_file, readme_file) or file.stem in about)
    if stored and not overwrite:
        names = ", ".join(stored[:3]) + ", ..." * (len(stored) > 3)
        raise ValueError(f"{folder} holds an export already: {names}: give --overwrite to replace it, or another --out")
    prepare_output(index_file)
    origin = {**origin, **provenance("cpu", 0)}
    del origin["seed"]  # nothing is drawn
    files = []
    with Bar("exporting", len(about)) as bar:
        for done, terrain in enumerate(terrains, start=1):
            files += write_terrain(folder, terrain, formats=formats, about=about[terrain.name] | origin)
            bar.move_to(done)
    readme = _TEMPLATES.get_template("export.md").render(stem=next(iter(about)))
    write_atomically(readme_file, f"{readme}\n".encode())
    index = [{**facts, "files": name} for name, facts in about.items()]
    write_atomically(index_file, to_json({"formats": formats, "elites": index, **origin}))
    print(f"{len(about)} terrain{'s' * (len(about) != 1)} as {', '.join(formats)}: {folder}")
    return [*files, readme_file, index_file]


def export_controller(policy: str | None, robot: RobotCfg, out: Path, *, overwrite: bool = False) -> None:
    """Writes a robot's controller, an rsl_rl checkpoint or by default the shipped one, as one ONNX file."""
    if out.exists() and not overwrite:
        raise ValueError(f"{out} exists: give --overwrite to replace it, or another --onnx")
    export_onnx(load_actor(policy or robot.policy_file, robot), out)
    print(f"Controller: {out}")


def _describe_elite(ranking: Ranking, row: int, archive: Archive) -> dict[str, Any]:
    """An elite's verdict, cause, ending and numbers as JSON values: as found, and by 40 fresh episodes, if any."""
    elite = int(ranking.numbers[row])
    names = ("fitness", "collision_rate", "goal_rate", "fallen_rate", "episodes")

    def list_numbers(values: Any) -> dict[str, Any]:
        ratios = dict(zip(archive.penalties, values.ratios[elite].tolist(), strict=True))
        return {**{name: getattr(values, name)[elite].item() for name in names}, "ratios": ratios}

    return {
        "robot": archive.robot,
        "elite": elite,
        "verdict": VERDICTS[ranking.verdict[row]] or "not failing",
        "cause": ranking.causes[row] or None,
        "ending": ranking.ending(row)[0],
        "in_words": ranking.name(row),
        "iteration": int(archive.iteration[elite]),
        **list_numbers(archive),
        "fresh": None if archive.fresh is None else list_numbers(archive.fresh),
    }
