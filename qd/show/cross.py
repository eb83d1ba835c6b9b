"""A controller on a terrain of your own: ``python -m qd.show.cross --terrain hill.png --size 16 8 --scale 0.001``."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.run.cli import run_command
from qd.run.progress import share_bar
from qd.show.figures import save_figure
from qd.show.own_terrain import OwnTerrain, own_seeds, read_own_terrain
from qd.show.paths_figure import draw_paths
from qd.show.replay import PENALTY_UNITS
from qd.show.video import OWN_FOLDER
from qd.workers.evaluator import check_policy, origin_of, resolve_device
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.intervals import rate_words, wilson_interval
from sim.policy.spec import ControllerSpec, who_crossed

if TYPE_CHECKING:
    from sim.rollout import RolloutResult


@dataclass(frozen=True, kw_only=True)
class CrossCfg:
    """Cross a heightmap of your own: how often does the controller get over, and what does it cost?

    A map is a grid of heights over a rectangle: an .npz with an array `heights` (rows along y, columns along x, floats
    in metres), or a grayscale .png of 8 or 16 bits seen from above (x to the right, y up) with the metres of a gray
    level. Its size in metres is given here, or as `size_m` in the .npz, or with `scale_m` and `offset_m` in a .json of
    the same name beside the .png, such as `make export` writes.

    Robots start near x = 2 m, y = 4 m and walk to x = 14 m, y = 4 m. The middle of the map lies on the middle of the
    16 m x 8 m that they cross: of a larger map the rest is cut off, a smaller one is continued by the height of its
    edge. It is resampled to 0.05 m: linearly, or where it is finer by weighted means.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    terrain: Path
    """The heightmap: an .npz or a .png."""
    size: tuple[str, ...] = ()
    """Of the map along x and y [m], such as 16 8; its file's if left out."""
    scale: float | None = None
    """Metres a gray level; its file's if left out."""
    offset: float | None = None
    """Height of gray level 0 [m]; its file's, or 0."""
    policy: str | None = None
    """Controller other than the shipped one: an rsl_rl checkpoint, a TorchScript or ONNX file, file.py:callable,
    module:callable, or file.py:adapter@FILE for a file that expects another observation."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    episodes: int = 20
    """Crossings."""
    seed: int = 0
    """Draws their starts."""
    out: Path | None = None
    """Where to write the numbers, runs/terrains/<map>-<robot>[-<controller>].json; beside it the figure,
    ...-paths.png."""


def cross(cfg: CrossCfg) -> dict[str, Any]:
    """The command: reads the map, crosses it, prints rates and costs, writes numbers and figure.

    Returns:
        What the JSON has.

    Raises:
        FileNotFoundError: If there is no heightmap.
        ValueError: If robot, map, device, controller or a number is not as it must be; before anything is crossed.
        OSError: If a file cannot be written.
    """
    from sim.robots.robot import get_robot
    from sim.rollout import Rollout

    robot = get_robot(cfg.robot)
    terrain = read_own_terrain(cfg.terrain, cfg)
    if cfg.episodes < 1 or cfg.seed < 0:
        raise ValueError(f"episodes must be at least 1 and seed at least 0, got {cfg.episodes} and {cfg.seed}")
    device, policy = resolve_device(cfg.device), cfg.policy or str(robot.policy_file)
    check_policy(policy, robot, device)
    who = who_crossed(robot, policy)
    out, figure = _outputs(cfg, who)
    prepare_output(out)
    print(f"{cfg.terrain}: {terrain.fitted}", flush=True)
    rollout = Rollout(robot, policy, num_terrains=1, num_replicas=cfg.episodes, device=device)
    with share_bar("crossing") as progress:
        result = rollout.evaluate(
            terrain.heights[None], own_seeds(cfg.seed), record_paths=True, progress=progress
        )
    report = {**origin_of(device, cfg.seed, None), **_about(cfg, robot.name, terrain, policy), **numbers_of(result)}
    print(describe(report))
    write_atomically(out, to_json(report))
    save_figure(figure, draw_paths(terrain.heights, result, f"{who} on {terrain.label}: {_headline(report)}"))
    print(f"Numbers: {out}\nFigure: {figure}")
    return report


def _outputs(cfg: CrossCfg, who: str) -> tuple[Path, Path]:
    """Files of the numbers and of the figure, neither of which may be the map or what says its scale."""
    out = cfg.out or OWN_FOLDER / f"{cfg.terrain.stem}-{who}.json"
    figure = out.with_name(f"{out.stem}-paths.png")
    given = {cfg.terrain.resolve(), cfg.terrain.with_suffix(".json").resolve()}
    if given & {out.resolve(), figure.resolve()}:
        raise ValueError(
            f"--out {out} would overwrite the map, {figure.name} beside it, or its scale: name another file"
        )
    return out, figure


def _about(cfg: CrossCfg, robot: str, terrain: OwnTerrain, policy: str) -> dict[str, Any]:
    from sim.policy.spec import controller_hash

    return {
        "robot": robot,
        "policy": ControllerSpec.parse(policy).label,
        "policy_sha256": controller_hash(policy),
        "terrain": str(cfg.terrain),
        "terrain_sha256": hashlib.sha256(cfg.terrain.read_bytes()).hexdigest(),
        "map": terrain.fitted,
        "heights_m": [float(terrain.heights.min()), float(terrain.heights.max())],
    }


def numbers_of(result: "RolloutResult") -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson), how episodes ended, and raw penalties, over the valid episodes of a terrain.

    Args:
        result: Crossings of one terrain.
    """
    from kernels.episode import Outcome

    valid = ~result.invalid[0]
    flags = {"success": ~result.base_collision[0], "goal": result.reached_goal[0], "fallen": result.fallen[0]}
    values = result.penalties[0, valid]
    return {
        "episodes": len(valid),
        "invalid_episodes": int((~valid).sum()),
        "rates": {name: _rate(int((hit & valid).sum()), int(valid.sum())) for name, hit in flags.items()},
        "outcomes": {o.name.lower(): int((result.outcome[0] == o).sum()) for o in Outcome if o != Outcome.RUNNING},
        "duration_s": float(result.duration_s[0, valid].mean()) if valid.any() else None,
        "penalties": {
            name: {"mean": float(column.mean()), "std": float(column.std()), "unit": PENALTY_UNITS.get(name, "")}
            for name, column in zip(result.penalty_names, values.T, strict=True)
            if len(column)
        },
    }


def _rate(hits: int, count: int) -> dict[str, Any]:
    if not count:
        return {"rate": None, "hits": 0, "interval": None}
    return {"rate": hits / count, "hits": hits, "interval": list(wilson_interval(hits, count))}


_LABELS = {"success": "success (no base collision)", "goal": "goal reached", "fallen": "fallen"}


def _headline(report: dict[str, Any]) -> str:
    count = report["episodes"] - report["invalid_episodes"]
    return ", ".join(f"{name} {rate_words(report['rates'][name]['hits'], count)}" for name in ("success", "goal"))


def describe(report: dict[str, Any]) -> str:
    """The numbers of a terrain, in words."""
    count = report["episodes"] - report["invalid_episodes"]
    lines = [f"{report['robot']} with {report['policy']} on {report['terrain']}, {report['episodes']} episodes:"]
    lines += [f"  {_LABELS[name]:30}{rate_words(rate['hits'], count):>30}" for name, rate in report["rates"].items()]
    for name, cost in report["penalties"].items():
        label = f"{name} [{cost['unit']}]"
        lines.append(f"  {label:30}{cost['mean']:>17.2f} +- {cost['std']:<9.2f}")
    if count:
        lines.append(f"  {'duration [s]':30}{report['duration_s']:>17.1f}")
    if report["invalid_episodes"]:
        lines.append(f"  {report['invalid_episodes']} invalid episodes are left out.")
    lines.append(
        "  Rates with their 95 % intervals (Wilson). A robot that stands still succeeds: read the goal rate too."
    )
    return "\n".join(lines)


def main(cfg: CrossCfg) -> None:
    """The command."""
    cross(cfg)


if __name__ == "__main__":
    run_command(CrossCfg, main)
