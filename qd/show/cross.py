"""A controller on a terrain of your own: ``faultline cross --terrain hill.png --size 16 8 --scale 0.001``."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.run.directory import RUNS
from qd.show.elites import robot_named
from qd.show.figures import look_of, save_figure
from qd.workers.evaluator import check_policy, origin_of, resolve_device
from qd.workers.invalid import invalid_reasons, reason_words, refuse_all_invalid
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import OnDevice, Who, split_words
from sim.files.intervals import rate_words, wilson_interval
from sim.files.records import identity
from sim.policy.spec import who_crossed

if TYPE_CHECKING:
    from qd.show.crossed import Crossed
    from sim.ground import GroundMaps
    from sim.robots.robot import RobotCfg

OWN_FOLDER = RUNS / "terrains"
"""Where what is made of a user's own terrains goes."""
_LONGEST_NAME = 120  # characters of a path; with robot, controller and ending a file may have 255


@dataclass(frozen=True, kw_only=True)
class Mapped:
    """How large and how high a height map is."""

    size: tuple[str, ...] = ()
    """Of the map along x and y [m], such as 16 8; its file's if left out."""
    scale: float | None = None
    """Metres a gray level of the map; its file's if left out."""
    offset: float | None = None
    """Height of its gray level 0 [m]; its file's, or 0."""


@dataclass(frozen=True, kw_only=True)
class Cross(Who, OnDevice, Mapped):
    """Cross a height map of your own: how often does the controller get over, and what does it cost?

    A map is a grid of heights over a rectangle: an .npz with an array `heights` (rows along y, columns along x, floats
    in metres), or a grayscale .png of 8 or 16 bits seen from above (x to the right, y up) with the metres of a gray
    level. Its size in metres is given here, or as `size_m` in the .npz, or with `scale_m` and `offset_m` in a .json of
    the same name beside the .png, such as `faultline export` writes.

    Robots start near x = 2 m, y = 4 m and walk to x = 14 m, y = 4 m. The middle of the map lies on the middle of what
    they cross, 16 m x 8 m. The rest of a larger map is cut off. A smaller one goes on at the height of its edge. The
    map is resampled to 0.05 m: linearly, or by weighted means where it is finer.
    """

    terrain: Path
    """The height map: an .npz or a .png."""
    episodes: int = 20
    """Crossings."""
    seed: int = 0
    """Draws their starts."""
    out: Path | None = None
    """File for the numbers; runs/terrains/<map>-<robot>[-<controller>].json, where <map> is the path of the map with -
    between its folders. The figure ...-paths.png is written beside it. Older files are replaced."""

    def execute(self) -> None:
        """Crosses the map, prints rates and costs, writes numbers and figure."""
        cross(self)


class OwnTerrain(NamedTuple):
    """A terrain from a file."""

    heights: NDArray[np.float32]
    """[m], shape (NUM_ROWS, NUM_COLS)."""
    label: str
    """The file's name."""
    fitted: str
    """What became of the map, in words."""
    ground: "GroundMaps | None" = None
    """Friction and softness that the file has."""


def read_own_terrain(path: Path, args: Mapped) -> OwnTerrain:
    """The terrain that a height map becomes, by the rules of :mod:`sim.maps.heightmap`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no height map, or a number is missing or out of range.
    """
    from sim.maps.heightmap import as_terrain, fitted, read_heightmap

    heightmap = read_heightmap(path, size_m=_size_of(args.size), scale_m=args.scale, offset_m=args.offset)
    return OwnTerrain(as_terrain(heightmap), path.name, fitted(heightmap), heightmap.ground)


def _size_of(words: Sequence[str]) -> tuple[float, ...] | None:
    sides = split_words(words)
    try:
        return tuple(float(side) for side in sides) or None
    except ValueError:
        raise ValueError(f"size must be two lengths in metres such as 16 8, got {' '.join(words)}") from None


def cross(cfg: Cross) -> dict[str, Any]:
    """Reads the map, crosses it, prints rates and costs, writes numbers and figure.

    Returns:
        What the JSON has.

    Raises:
        FileNotFoundError: If there is no height map.
        ValueError: If robot, map, device, controller or a number is not as it must be; before anything is crossed.
        OSError: If a file cannot be written.
        AllInvalidError: If no crossing is valid.
    """
    from qd.show.crossed import crossed_of
    from qd.show.crossing_figures import draw_paths
    from qd.show.recordings import Recordings, on_heights

    robot = robot_named(cfg.robot)
    terrain = read_own_terrain(cfg.terrain, cfg)
    policy = cfg.policy or str(robot.policy_file)
    wanted = on_heights(
        terrain.heights, label=terrain.label, policy=policy, replicas=cfg.episodes, seed=cfg.seed, ground=terrain.ground
    )
    device = resolve_device(cfg.device)
    check_policy(policy, robot, device)
    who = who_crossed(robot, policy)
    out, figure = _outputs(cfg, who)
    prepare_output(out)
    print(f"{cfg.terrain}: {terrain.fitted}", flush=True)
    (recording,) = Recordings(robot, device=device).all_of([wanted])
    origin, about = origin_of(device, cfg.seed, None), _about(cfg, robot, terrain, policy)
    refuse_all_invalid(recording.result())
    crossed = crossed_of(recording, recording.penalty_names, (1.0,) * len(recording.penalty_names))
    report = {**origin, **about, **numbers_of(crossed)}
    print(describe(report))
    replaced = " (replaced)" if out.exists() else ""
    write_atomically(out, to_json(report))
    save_figure(figure, draw_paths(crossed, f"{who} on {terrain.label}: {_headline(report)}"))
    print(f"Numbers: {out}{replaced}\nFigure: {figure}")
    return report


def name_of_map(path: Path) -> str:
    """What files about a map are called: its path from here, so that two maps of one name have files of their own."""
    path, here = path.resolve(), Path.cwd()
    path = path.relative_to(here) if path.is_relative_to(here) else path.relative_to(path.anchor)
    return "-".join(path.parts)[-_LONGEST_NAME:]


def _outputs(cfg: Cross, who: str) -> tuple[Path, Path]:
    """Files of the numbers and of the figure; neither may be the map or the file that says its scale."""
    out = cfg.out or OWN_FOLDER / f"{name_of_map(cfg.terrain)}-{who}.json"
    figure = out.with_name(f"{out.stem}-paths.png")
    given = {cfg.terrain.resolve(), cfg.terrain.with_suffix(".json").resolve()}
    if given & {out.resolve(), figure.resolve()}:
        raise ValueError(
            f"--out {out} would overwrite the map, {figure.name} beside it, or its scale: name another file"
        )
    return out, figure


def _about(cfg: Cross, robot: "RobotCfg", terrain: OwnTerrain, policy: str) -> dict[str, Any]:
    return {
        **identity(robot, policy),
        "terrain": str(cfg.terrain),
        "terrain_sha256": hashlib.sha256(cfg.terrain.read_bytes()).hexdigest(),
        "map": terrain.fitted,
        "heights_m": [float(terrain.heights.min()), float(terrain.heights.max())],
    }


def numbers_of(crossed: "Crossed") -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson), how episodes ended, and raw penalties, over the valid episodes of a terrain.

    Args:
        crossed: The crossings, with every penalty recorded.
    """
    from kernels.episode import Outcome

    recording, count = crossed.recording, len(crossed.chosen)
    ended = {o.name.lower(): int((recording.outcome[0] == o).sum()) for o in Outcome if 0 < o < Outcome.TILT}
    hits = {"success": count - ended["base_collision"], "goal": ended["goal"], "fallen": crossed.rates["fallen"].hits}
    return {
        "episodes": recording.num_episodes,
        "invalid_episodes": recording.num_episodes - count,
        "invalid_reasons": invalid_reasons(recording.result()),
        "rates": {
            name: {
                "rate": number / count if count else None,
                "hits": number,
                "interval": list(wilson_interval(number, count)) if count else None,
            }
            for name, number in hits.items()
        },
        "outcomes": ended,
        "duration_s": float(recording.duration_s[0, crossed.chosen].mean()) if count else None,
        "penalties": {
            name: {"mean": float(column.mean()), "std": float(column.std()), "unit": look_of(name).unit}
            for name, column in zip(recording.penalty_names, crossed.penalties.T, strict=True)
            if count
        },
    }


_LABELS = {"goal": "goal reached", "success": 'no base collision ("success")', "fallen": "fallen"}


def _headline(report: dict[str, Any]) -> str:
    count = report["episodes"] - report["invalid_episodes"]
    words = {"goal": "goal", "success": "no base collision"}
    return ", ".join(f"{label} {rate_words(report['rates'][name]['hits'], count)}" for name, label in words.items())


def describe(report: dict[str, Any]) -> str:
    """The numbers of a terrain, in words."""
    count = report["episodes"] - report["invalid_episodes"]
    lines = [f"{report['robot']} with {report['policy']} on {report['terrain']}, {report['episodes']} episodes:"]
    rates = {label: report["rates"][name]["hits"] for name, label in _LABELS.items()}
    lines += [f"  {label:30}{rate_words(hits, count):>30}" for label, hits in rates.items()]
    for name, cost in report["penalties"].items():
        label = f"{name} [{cost['unit']}]"
        lines.append(f"  {label:30}{cost['mean']:>17.2f} +- {cost['std']:<9.2f}")
    if count:
        lines.append(f"  {'duration [s]':30}{report['duration_s']:>17.1f}")
    if report["invalid_episodes"]:
        why = reason_words(report["invalid_reasons"])
        lines.append(f"  {report['invalid_episodes']} invalid episodes are left out: {why}.")
    lines.append("  Rates with their 95 % intervals (Wilson). A robot that stands still has no base collision either.")
    return "\n".join(lines)
