"""A controller on a terrain of your own: ``faultline cross --terrain hill.png --size 16 8 --scale 0.001``."""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from qd.run.directory import RUNS
from qd.show.crossed import Crossed, crossed_of, draw_paths
from qd.show.figures import look_of, save_figure
from qd.show.recordings import Recordings, on_heights
from qd.workers.evaluator import origin_of
from qd.workers.invalid import invalid_reasons, reason_words, refuse_all_invalid
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.intervals import rate_words, wilson_interval
from sim.files.records import identity
from sim.ground import GroundMaps
from sim.maps.heightmap import as_terrain, fitted, read_heightmap
from sim.policy.spec import crosser_name
from sim.recording.recorder import Recording
from sim.robots.robot import RobotCfg

OWN_FOLDER = RUNS / "terrains"
"""Where what is made of a user's own terrains goes."""
_LONGEST_NAME = 120  # characters of a path; with robot, controller and ending a file may have 255


class OwnTerrain(NamedTuple):
    """A terrain from a file."""

    file: Path
    heights: NDArray[np.float32]
    """[m], shape (NUM_ROWS, NUM_COLS)."""
    fitted: str
    """What became of the map, in words."""
    ground: GroundMaps | None = None
    """Friction and softness that the file has."""

    @property
    def name(self) -> str:
        """What files about it are called: its path from here, so that two maps of one name have files of their own."""
        path, here = self.file.resolve(), Path.cwd()
        path = path.relative_to(here) if path.is_relative_to(here) else path.relative_to(path.anchor)
        return "-".join(path.parts)[-_LONGEST_NAME:]

    def record(self, robot: RobotCfg, policy: str, *, replicas: int, seed: int, device: str) -> Recording:
        """Crossings of it, which are made if no recording of them is stored."""
        wanted = on_heights(
            self.heights, label=self.file.name, policy=policy, replicas=replicas, seed=seed, ground=self.ground
        )
        return Recordings(robot, device=device).all_of([wanted])[0]


def read_own_terrain(
    file: Path,
    size_m: tuple[float, float] | None = None,
    scale_m: float | None = None,
    offset_m: float | None = None,
) -> OwnTerrain:
    """The terrain that a height map becomes; arguments as of :func:`sim.maps.heightmap.read_heightmap`."""
    heightmap = read_heightmap(file, size_m=size_m, scale_m=scale_m, offset_m=offset_m)
    return OwnTerrain(file, as_terrain(heightmap), fitted(heightmap), heightmap.ground)


def cross_map(
    terrain: OwnTerrain,
    robot: RobotCfg,
    policy: str | None = None,
    *,
    episodes: int = 20,
    seed: int = 0,
    device: str = "cpu",
    out: Path | None = None,
) -> dict[str, Any]:
    """Crosses a map, prints rates and costs, writes numbers and figure."""
    policy = policy or str(robot.policy_file)
    crosser = crosser_name(robot, policy)
    out = out or OWN_FOLDER / f"{terrain.name}-{crosser}.json"
    figure = out.with_name(f"{out.stem}-paths.png")
    given = {terrain.file.resolve(), terrain.file.with_suffix(".json").resolve()}
    if given & {out.resolve(), figure.resolve()}:
        raise ValueError(f"out {out} would overwrite the map, {figure.name} beside it, or its scale: name another file")
    prepare_output(out)
    print(f"{terrain.file}: {terrain.fitted}", flush=True)
    recording = terrain.record(robot, policy, replicas=episodes, seed=seed, device=device)
    refuse_all_invalid(recording.result())
    crossed = crossed_of(recording, recording.penalty_names, (1.0,) * len(recording.penalty_names))
    report = {
        **origin_of(device, seed),
        **identity(robot, policy),
        "terrain": str(terrain.file),
        "terrain_sha256": hashlib.sha256(terrain.file.read_bytes()).hexdigest(),
        "map": terrain.fitted,
        "heights_m": [float(terrain.heights.min()), float(terrain.heights.max())],
        **numbers_of(crossed),
    }
    print(describe(report))
    write_atomically(out, to_json(report))
    save_figure(figure, draw_paths(crossed, f"{crosser} on {terrain.file.name}: {_headline(report)}"))
    print(f"Numbers: {out}\nFigure: {figure}")
    return report


def numbers_of(crossed: Crossed) -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson), ends and raw penalties, over the valid episodes; at least one is."""
    recording, count = crossed.recording, len(crossed.chosen)
    ended = {o.name.lower(): int((recording.outcome[0] == o).sum()) for o in Outcome if 0 < o < Outcome.TILT}
    hits = {"success": count - ended["base_collision"], "goal": ended["goal"], "fallen": crossed.rates["fallen"].hits}
    return {
        "episodes": recording.num_episodes,
        "invalid_episodes": recording.num_episodes - count,
        "invalid_reasons": invalid_reasons(recording.result()),
        "rates": {
            name: {"rate": number / count, "hits": number, "interval": list(wilson_interval(number, count))}
            for name, number in hits.items()
        },
        "outcomes": ended,
        "duration_s": float(recording.duration_s[0, crossed.chosen].mean()),
        "penalties": {
            name: {"mean": float(column.mean()), "std": float(column.std()), "unit": look_of(name).unit}
            for name, column in zip(recording.penalty_names, crossed.penalties.T, strict=True)
        },
    }


def _headline(report: dict[str, Any]) -> str:
    count = report["episodes"] - report["invalid_episodes"]
    goal, success = (rate_words(report["rates"][name]["hits"], count) for name in ("goal", "success"))
    return f"goal {goal}, no base collision {success}"


def describe(report: dict[str, Any]) -> str:
    """The numbers of a terrain, in words."""
    count = report["episodes"] - report["invalid_episodes"]
    lines = [f"{report['robot']} with {report['policy']} on {report['terrain']}, {report['episodes']} episodes:"]
    labels = {"goal": "goal reached", "success": 'no base collision ("success")', "fallen": "fallen"}
    for name, label in labels.items():
        lines.append(f"  {label:30}{rate_words(report['rates'][name]['hits'], count):>30}")
    for name, cost in report["penalties"].items():
        label = f"{name} [{cost['unit']}]"
        lines.append(f"  {label:30}{cost['mean']:>17.2f} +- {cost['std']:<9.2f}")
    lines.append(f"  {'duration [s]':30}{report['duration_s']:>17.1f}")
    if report["invalid_episodes"]:
        why = reason_words(report["invalid_reasons"])
        lines.append(f"  {report['invalid_episodes']} invalid episodes are left out: {why}.")
    lines.append("  Rates with their 95 % intervals (Wilson). A robot that stands still has no base collision either.")
    return "\n".join(lines)
