"""Films of crossings: ``python -m qd.show.video --robot anymal --elite 0``, headless, with a GPU or without."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from qd.run.cli import run_command
from qd.run.directory import RUNS, elite_name, folder_for
from qd.run.progress import share_bar
from qd.show.own_terrain import read_own_terrain
from qd.show.recordings import archive_of_robot, policy_of, record_elites, record_heights
from qd.show.replay import as_searched
from qd.workers.evaluator import check_policy, resolve_device
from sim.files.atomic import prepare_output
from sim.files.command import chosen_elites
from sim.policy.spec import spec_of, who_crossed

if TYPE_CHECKING:
    from sim.recording.recorder import Recording
    from sim.robots.robot import RobotCfg

OWN_FOLDER = RUNS / "terrains"
"""Where what is made of a user's own terrains goes."""
_RECORDING = ".recording.npz"
_DISTANCE = 4.6  # of the camera, in standing heights of the robot
_MAX_FPS = 50


@dataclass(frozen=True, kw_only=True)
class VideoCfg:
    """Film a robot on elites of an archive, or on a terrain of your own.

    The episodes are those that `replay` shows. Below the robot stand the map with all paths and what the episode has
    cost so far, each penalty in multiples of its scale. Yellow arrows are contact forces of the feet, red ones those
    beyond the robot's limit. The recording is kept beside the film, so that it can be filmed again elsewhere.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    run: Path | None = None
    """Run directory or archive.npz; the newest of this robot under runs/, else its published archive."""
    elite: str = "0"
    """Number of the elite, 0 the worst; several apart by spaces, or all."""
    terrain: Path | None = None
    """Instead of elites a heightmap of your own: an .npz or a .png (see qd.show.cross)."""
    size: tuple[str, ...] = ()
    """Of that map along x and y [m], such as 16 8; its file's if left out."""
    scale: float | None = None
    """Metres a gray level of that map."""
    offset: float | None = None
    """Height of its gray level 0 [m]."""
    recording: Path | None = None
    """Instead of crossing anything, film what was recorded: a .recording.npz that stands beside a film."""
    policy: str | None = None
    """Controller other than the archive's, or the shipped one."""
    device: str | None = None
    """Where to cross: cpu, cuda or cuda:N; CUDA where there is one."""
    out: Path | None = None
    """File of the film, or with several elites their folder; elite-<number>.mp4 in the run, or of a published one
    in runs/<robot>-published; with another controller elite-<number>-<its name>.mp4."""
    replicas: int = 20
    """Episodes to run."""
    replica: int | None = None
    """Which of them to film; of those that end as most do, the one in the middle by its penalties."""
    ghosts: int = 2
    """How many others to show translucent."""
    seed: int = 0
    """Seed of the episodes."""
    fps: int = 25
    """Pictures a second."""
    shadows: bool = True
    """Whether the sun casts shadows; without a GPU they take half of the time."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """A film to be made of one terrain."""

    recording: "Recording"
    """Of that terrain alone."""
    out: Path
    scales: dict[str, float]


def make_videos(cfg: VideoCfg) -> list[Path]:
    """The command.

    Returns:
        The films.

    Raises:
        FileNotFoundError: If there is no archive, heightmap or recording.
        ValueError: If there is no such elite or episode, no OpenGL, or a file, the controller, the robot or a number is
            not as it must be; all before anything is crossed.
        OSError: If a file cannot be written.
    """
    from sim.recording.renderer import open_context
    from sim.robots.robot import get_robot

    robot = get_robot(cfg.robot)
    if not 1 <= cfg.fps <= _MAX_FPS or cfg.ghosts < 0:
        raise ValueError(f"fps must lie in 1..{_MAX_FPS} and ghosts not be negative, got {cfg.fps} and {cfg.ghosts}")
    if cfg.replica is not None and not 0 <= cfg.replica < cfg.replicas:
        raise ValueError(f"replica must be one of 0..{cfg.replicas - 1}, got {cfg.replica}")
    if sum(given is not None for given in (cfg.run, cfg.terrain, cfg.recording)) > 1:
        raise ValueError("give one of --run, --terrain and --recording")
    open_context(64, 64).free()  # before minutes of crossing
    films = []
    for order in _orders(cfg, robot):
        _film(order, robot, cfg)
        print(f"Film: {order.out}", flush=True)
        films.append(order.out)
    return films


def _orders(cfg: VideoCfg, robot: "RobotCfg") -> Iterator[Order]:
    if cfg.recording is not None:
        yield from _kept_orders(cfg, cfg.recording, robot)
    elif cfg.terrain is not None:
        yield _own_order(cfg, cfg.terrain, robot)
    else:
        yield from _elite_orders(cfg, robot)


def _elite_orders(cfg: VideoCfg, robot: "RobotCfg") -> Iterator[Order]:
    """Films of elites, whose recordings are written before the first is made."""
    found = archive_of_robot(cfg.robot, cfg.run)
    elites = chosen_elites(cfg.elite, len(found.archive), found.run)
    policy, searched = policy_of(found, robot, cfg.policy), spec_of(as_searched(found.run, found.archive)[0], robot)
    single = cfg.out is not None and len(elites) == 1 and not cfg.out.is_dir()
    folder = cfg.out or folder_for(found.run, robot.name)
    outs = (
        [cfg.out] if single and cfg.out else [folder / f"{elite_name(elite, policy, searched)}.mp4" for elite in elites]
    )
    prepare_output(outs[0])
    device = resolve_device(cfg.device)
    check_policy(policy, robot, device)
    with share_bar("crossing") as progress:
        _, recording = record_elites(
            found, elites, device=device, policy=policy, episodes=cfg.replicas, seed=cfg.seed, progress=progress
        )
    scales = dict(zip(found.archive.penalties, found.archive.scales, strict=True))
    parts = [recording.of_terrain(k) for k in range(len(outs))]
    for part, out in zip(parts, outs, strict=True):
        _keep(part, out)
    for part, out in zip(parts, outs, strict=True):
        yield Order(recording=part, out=out, scales=scales)


def _own_order(cfg: VideoCfg, path: Path, robot: "RobotCfg") -> Order:
    terrain = read_own_terrain(path, cfg)
    print(f"{path}: {terrain.fitted}", flush=True)
    device, policy = resolve_device(cfg.device), cfg.policy or str(robot.policy_file)
    check_policy(policy, robot, device)
    out = cfg.out or OWN_FOLDER / f"{path.stem}-{who_crossed(robot, policy)}.mp4"
    prepare_output(out)
    with share_bar("crossing") as progress:
        _, recording = record_heights(
            robot, terrain.heights, label=terrain.label, policy=policy, device=device,
            episodes=cfg.replicas, seed=cfg.seed, progress=progress,
        )  # fmt: skip
    _keep(recording, out)
    return Order(recording=recording, out=out, scales=_scales_of(robot))


def _kept_orders(cfg: VideoCfg, path: Path, robot: "RobotCfg") -> Iterator[Order]:
    from sim.recording.file import read_recording

    recording = read_recording(path)
    if recording.robot != robot.name or recording.joint_names != robot.joint_names:
        raise ValueError(f"{path} is of {recording.robot}, got --robot {robot.name}: give that robot")
    stem = path.name.removesuffix(_RECORDING).removesuffix(".npz")
    single = recording.num_terrains == 1
    for k in range(recording.num_terrains):
        name = f"{stem}.mp4" if single else f"{stem}-{k}.mp4"
        out = cfg.out if cfg.out and single and not cfg.out.is_dir() else (cfg.out or path.parent) / name
        prepare_output(out)
        yield Order(recording=recording.of_terrain(k), out=out, scales=_scales_of(robot))


def _keep(recording: "Recording", out: Path) -> None:
    from sim.recording.file import write_recording

    write_recording(out.with_name(out.stem + _RECORDING), recording)


def _scales_of(robot: "RobotCfg") -> dict[str, float]:
    """The robot's penalty scales; 1 each, and so raw sums, where they were never measured."""
    try:
        scales = robot.read_penalty_scales()
    except ValueError as error:
        print(f"{error}; penalties are drawn as they are, unscaled", flush=True)
        scales = (1.0,) * len(robot.penalties)
    return dict(zip(robot.penalties, scales, strict=True))


def _film(order: Order, robot: "RobotCfg", cfg: VideoCfg) -> None:
    from qd.show.film import VIEW_HEIGHT, WIDTH, follow, frames_of, num_pictures, typical_episode
    from qd.show.mp4 import write_film
    from qd.show.shot import Shot
    from sim.recording.renderer import Renderer

    recording = order.recording
    replicas = recording.replicas.tolist()
    if cfg.replica is not None and cfg.replica not in replicas:
        raise ValueError(f"episode {cfg.replica} was not recorded, expected one of {', '.join(map(str, replicas))}")
    typical = typical_episode(recording, 0, order.scales)
    episode = typical if cfg.replica is None else replicas.index(cfg.replica)
    ghosts = tuple(k for k in range(len(replicas)) if k != episode)[: cfg.ghosts]
    shot = Shot(recording=recording, terrain=0, episode=episode, ghosts=ghosts, scales=order.scales)
    cameras = follow(shot, _DISTANCE * robot.default_base_height)
    heights = recording.heights[0]
    total = num_pictures(shot, cfg.fps)
    with (
        Renderer(robot, heights, width=WIDTH, height=VIEW_HEIGHT, shadows=cfg.shadows) as renderer,
        tqdm(total=total, desc=f"filming {recording.labels[0]}", unit="picture", file=sys.stderr, disable=None) as bar,
    ):
        pictures = frames_of(shot, renderer, cameras, cfg.fps)
        write_film(order.out, pictures, cfg.fps, progress=bar.update)


def main(cfg: VideoCfg) -> None:
    """The command."""
    make_videos(cfg)


if __name__ == "__main__":
    run_command(VideoCfg, main)
