"""Films of crossings: ``faultline film --elite 0``, without a screen, with a GPU or without."""

import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.run.directory import folder_for
from qd.show.cross import OWN_FOLDER, Mapped, name_of_map, read_own_terrain
from qd.show.elites import find_archive, robot_named
from qd.workers.evaluator import check_policy, resolve_device
from sim.files.atomic import prepare_output, write_atomically
from sim.files.command import OnDevice, Which, Who, chosen_elites
from sim.files.settings import check, setting
from sim.policy.spec import who_crossed

if TYPE_CHECKING:
    from sim.recording.recorder import Recording
    from sim.robots.robot import RobotCfg

_RECORDING = ".recording.npz"
_DISTANCE = 4.6  # of the camera, in standing heights of the robot


@dataclass(frozen=True, kw_only=True)
class Film(Who, OnDevice, Which, Mapped):
    """Film a robot on elites of an archive, or on a terrain of your own.

    The episodes are those that `faultline replay` shows. Below the robot stand the map with all paths and what the
    episode has cost so far, each penalty in multiples of its scale. Yellow arrows are contact forces of the feet, red
    ones those beyond the robot's limit. The recording is kept beside the film, so that it can be filmed again
    elsewhere. Without --out a film is elite-<number>.mp4 in the run, or of a published one in runs/<robot>-published;
    with another controller elite-<number>-<its name>.mp4; of a minimal terrain minimal-<number>.mp4.
    """

    terrain: Path | None = None
    """Instead of elites a height map of your own: an .npz or a .png (see `faultline cross --help`)."""
    recording: Path | None = None
    """Instead of crossing anything, film what was recorded: a .recording.npz that stands beside a film."""
    out: Path | None = None
    """File of the film, or with several elites their folder."""
    replicas: int = setting(20, least=1)
    """Episodes to run."""
    replica: int | None = setting(None, least=0)
    """Which episode to film. If left out, of the episodes that end as most do, the one with the median penalties."""
    ghosts: int = setting(2, least=0)
    """How many others to show translucent."""
    seed: int = setting(0, least=0)
    """Seed of the episodes."""
    fps: int = setting(25, least=1, most=50)
    """Pictures a second."""
    shadows: bool = True
    """Whether the sun casts shadows; without a GPU they take half of the time."""

    def execute(self) -> None:
        """Makes the films."""
        make_films(self)


class Order(NamedTuple):
    """A film to be made of one terrain."""

    recording: "Recording"
    """Of that terrain alone."""
    robot: "RobotCfg"
    out: Path
    scales: dict[str, float]


def make_films(cfg: Film) -> list[Path]:
    """Makes the films that are asked for; returns their files.

    Raises:
        FileNotFoundError: If there is no archive, heightmap or recording.
        ValueError: If there is no such elite or episode, no OpenGL, or a file, the controller, the robot or a number is
            not as it must be; all before anything is crossed.
        OSError: If a file cannot be written.
    """
    from sim.recording.renderer import open_context

    check(cfg)
    if cfg.replica is not None and cfg.replica >= cfg.replicas:
        raise ValueError(f"replica must be one of 0..{cfg.replicas - 1}, got {cfg.replica}")
    if sum(given is not None for given in (cfg.run, cfg.terrain, cfg.recording)) > 1:
        raise ValueError("give one of --run, --terrain and --recording")
    open_context(64, 64).free()  # before minutes of crossing
    if cfg.recording is not None:
        orders = _kept_orders(cfg, cfg.recording)
    elif cfg.terrain is not None:
        orders = iter([_own_order(cfg, cfg.terrain)])
    else:
        orders = _elite_orders(cfg)
    films = []
    for order in orders:
        replaced = " (replaced)" if order.out.exists() else ""
        _film(order, cfg)
        print(f"Film: {order.out}{replaced}", flush=True)
        films.append(order.out)
    return films


def _elite_orders(cfg: Film) -> Iterator[Order]:
    """Films of elites, whose recordings are written before the first is made."""
    from qd.show.recordings import Recordings, on_elite

    found = find_archive(cfg.robot, cfg.run, cfg.policy, space=cfg.space)
    archive, robot = found.archive, found.robot
    minima = None if cfg.minimal is None else found.minima()
    if minima is None:
        elites, what = chosen_elites(cfg.elite, len(archive), found.run), "elite"
    else:
        elites, what = minima.chosen(str(cfg.minimal), found.run), "minimal"
    policy = found.policy(cfg.policy)
    suffix = found.suffix(policy)
    if cfg.out is not None and len(elites) == 1 and not cfg.out.is_dir():
        outs = [cfg.out]
    else:
        folder = cfg.out or folder_for(found.run, robot.name)
        outs = [folder / f"{what}-{elite}{suffix}.mp4" for elite in elites]
    device = resolve_device(cfg.device)
    check_policy(policy, robot, device)
    prepare_output(outs[0])
    whole = "elite" if minima is None else "minimal terrain of elite"
    wanted = [
        on_elite(
            archive, elite, policy=policy, replicas=cfg.replicas, seed=cfg.seed,
            label=f"{whole} {elite} of {len(archive):,} of {found.folder}",
            minimal=None if minima is None else minima.genes[elite],
        )
        for elite in elites
    ]  # fmt: skip
    scales = dict(zip(archive.penalties, archive.scales, strict=True))
    orders = [
        Order(recording, robot, out, scales)
        for recording, out in zip(Recordings(robot, device=device).all_of(wanted), outs, strict=True)
    ]
    for order in orders:
        _keep(order)
    yield from orders


def _own_order(cfg: Film, path: Path) -> Order:
    from qd.show.recordings import Recordings, on_heights

    robot, terrain = robot_named(cfg.robot), read_own_terrain(path, cfg)
    print(f"{path}: {terrain.fitted}", flush=True)
    device, policy = resolve_device(cfg.device), cfg.policy or str(robot.policy_file)
    check_policy(policy, robot, device)
    out = cfg.out or OWN_FOLDER / f"{name_of_map(path)}-{who_crossed(robot, policy)}.mp4"
    prepare_output(out)
    wanted = on_heights(
        terrain.heights, label=terrain.label, policy=policy, replicas=cfg.replicas, seed=cfg.seed, ground=terrain.ground
    )
    (recording,) = Recordings(robot, device=device).all_of([wanted])
    order = Order(recording, robot, out, _scales_of(robot, cfg.policy))
    _keep(order)
    return order


def _kept_orders(cfg: Film, path: Path) -> Iterator[Order]:
    from sim.recording.file import read_recording
    from sim.robots.find import robot_of

    recording = read_recording(path)
    robot = robot_of({**recording.origin, "robot": recording.robot}, cfg.robot, path)
    if recording.joint_names != robot.joint_names:
        raise ValueError(f"{path} is of other joints than {robot.name} has: give the --robot that was recorded")
    stem = path.name.removesuffix(_RECORDING).removesuffix(".npz")
    single = recording.num_terrains == 1
    for k in range(recording.num_terrains):
        name = f"{stem}.mp4" if single else f"{stem}-{k}.mp4"
        out = cfg.out if cfg.out and single and not cfg.out.is_dir() else (cfg.out or path.parent) / name
        prepare_output(out)
        yield Order(recording.of_terrain(k), robot, out, _scales_of(robot, cfg.policy))


def _keep(order: Order) -> None:
    from sim.recording.file import write_recording

    write_recording(order.out.with_name(order.out.stem + _RECORDING), order.recording)


def _scales_of(robot: "RobotCfg", policy: str | None) -> dict[str, float]:
    """The robot's penalty scales; 1 each, and so raw sums, where they were never measured."""
    try:
        scales = robot.read_penalty_scales(policy)
    except ValueError as error:
        print(f"{error}; penalties are drawn as they are, unscaled", flush=True)
        scales = (1.0,) * len(robot.penalties)
    return dict(zip(robot.penalties, scales, strict=True))


def _film(order: Order, cfg: Film) -> None:
    from qd.show.shot import VIEW_HEIGHT, WIDTH, Shot, follow, frames_of, num_pictures, typical_episode
    from sim.recording.renderer import Renderer

    recording, robot = order.recording, order.robot
    replicas = recording.replicas.tolist()
    if cfg.replica is not None and cfg.replica not in replicas:
        raise ValueError(f"episode {cfg.replica} was not recorded, expected one of {', '.join(map(str, replicas))}")
    typical = typical_episode(recording, order.scales)
    episode = typical if cfg.replica is None else replicas.index(cfg.replica)
    ghosts = tuple(k for k in range(len(replicas)) if k != episode)[: cfg.ghosts]
    shot = Shot(recording=recording, episode=episode, ghosts=ghosts, scales=order.scales)
    cameras = follow(shot, _DISTANCE * robot.default_base_height)
    heights = recording.heights[0]
    total = num_pictures(shot, cfg.fps)
    with (
        Renderer(
            robot, heights, width=WIDTH, height=VIEW_HEIGHT, shadows=cfg.shadows, ground=recording.ground
        ) as renderer,
        tqdm(total=total, desc=f"filming {recording.labels[0]}", unit="picture", file=sys.stderr, disable=None) as bar,
    ):
        pictures = frames_of(shot, renderer, cameras, cfg.fps)
        write_film(order.out, pictures, cfg.fps, progress=bar.update)


def write_film(
    path: Path, pictures: Iterator[NDArray[np.uint8]], fps: int, progress: Callable[[], object] | None = None
) -> int:
    """Encodes pictures as an MP4 (H.264) that plays everywhere, atomically.

    Args:
        path: File to write.
        pictures: RGB, all of one shape, with even sides.
        fps: Pictures a second.
        progress: Called after every picture.

    Returns:
        How many pictures there were.

    Raises:
        OSError: If the film cannot be encoded or written.
    """
    import imageio_ffmpeg

    done = 0
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "film.mp4"
        writer: Any = None
        try:
            for picture in pictures:
                if writer is None:
                    size = (picture.shape[1], picture.shape[0])
                    writer = imageio_ffmpeg.write_frames(
                        str(draft), size, fps=fps, quality=7, macro_block_size=2, ffmpeg_log_level="error"
                    )
                    writer.send(None)
                writer.send(np.ascontiguousarray(picture))
                done += 1
                if progress is not None:
                    progress()
        finally:
            if writer is not None:
                writer.close()
        write_atomically(path, draft.read_bytes())
    return done
