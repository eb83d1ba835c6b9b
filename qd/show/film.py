"""Films of crossings: ``faultline film --elite 0``, without a screen, with a GPU or without."""

import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.show.cross import OWN_FOLDER, OwnTerrain
from qd.show.elites import Found, Terrain
from qd.show.film_cfg import FilmCfg
from qd.show.replay import record_terrains
from qd.show.shot import VIEW_HEIGHT, WIDTH, Shot, follow, frames_of, num_pictures, typical_episode
from sim.files.atomic import prepare_output, write_atomically
from sim.policy.spec import who_crossed
from sim.recording.file import read_recording, write_recording
from sim.recording.recorder import Recording
from sim.recording.renderer import Renderer, open_context
from sim.robots.find import robot_of
from sim.robots.robot import RobotCfg

RECORDING = ".recording.npz"
"""Ending of the recording that stands beside a film."""
_DISTANCE = 4.6  # of the camera, in standing heights of the robot


def film_elites(
    found: Found,
    terrains: Sequence[Terrain],
    cfg: FilmCfg,
    *,
    policy: str | None = None,
    replicas: int = 20,
    seed: int = 0,
    device: str = "cpu",
    out: Path | None = None,
) -> list[Path]:
    """Films of an archive's terrains, whose recordings are written before the first film is made.

    Args:
        found: The archive.
        terrains: Some of its terrains.
        cfg: How the films look.
        policy: Another controller than was searched.
        replicas: Episodes of each.
        seed: Draws them.
        device: Warp device name.
        out: The film, or the folder of several.

    Returns:
        The films.
    """
    controller = found.policy(policy)
    outs = [Path(f"{found.output(terrain.stem, controller)}.mp4") for terrain in terrains]
    if out is not None:
        outs = [out / path.name for path in outs] if len(outs) > 1 or out.is_dir() else [out]
    _check(cfg, replicas)
    prepare_output(outs[0])
    recordings = record_terrains(found, terrains, policy=controller, replicas=replicas, seed=seed, device=device)
    for recording, path in zip(recordings, outs, strict=True):
        write_recording(path.with_name(path.stem + RECORDING), recording)
    scales = dict(zip(found.archive.penalties, found.archive.scales, strict=True))
    for recording, path in zip(recordings, outs, strict=True):
        film(recording, found.robot, scales, cfg, path)
    return outs


def film_map(
    terrain: OwnTerrain,
    robot: RobotCfg,
    cfg: FilmCfg,
    *,
    policy: str | None = None,
    replicas: int = 20,
    seed: int = 0,
    device: str = "cpu",
    out: Path | None = None,
) -> Path:
    """A film of a user's own terrain; arguments as of :func:`film_elites`."""
    controller = policy or str(robot.policy_file)
    out = out or OWN_FOLDER / f"{terrain.name}-{who_crossed(robot, controller)}.mp4"
    _check(cfg, replicas)
    prepare_output(out)
    print(f"{terrain.file}: {terrain.fitted}", flush=True)
    recording = terrain.record(robot, controller, replicas=replicas, seed=seed, device=device)
    write_recording(out.with_name(out.stem + RECORDING), recording)
    film(recording, robot, scales_of(robot, policy), cfg, out)
    return out


def film_recording(
    file: Path, cfg: FilmCfg, *, robot: str | None = None, policy: str | None = None, out: Path | None = None
) -> list[Path]:
    """Films of what was recorded; nothing is crossed.

    Args:
        file: The recording, of one terrain or several.
        cfg: How the films look.
        robot: Name or settings file of the robot; the recording's if None.
        policy: Controller by whose scales penalties are drawn.
        out: The film, or the folder of several; beside the recording if None.
    """
    recording = read_recording(file)
    _check(cfg)
    recorded = robot_of({**recording.origin, "robot": recording.robot}, robot, file)
    if recording.joint_names != recorded.joint_names:
        raise ValueError(f"{file} is of other joints than {recorded.name} has: give the --robot that was recorded")
    count, stem = recording.num_terrains, file.name.removesuffix(RECORDING).removesuffix(".npz")
    outs = [(out or file.parent) / (f"{stem}.mp4" if count == 1 else f"{stem}-{k}.mp4") for k in range(count)]
    if out is not None and count == 1 and not out.is_dir():
        outs = [out]
    prepare_output(outs[0])
    for k, path in enumerate(outs):
        film(recording.of_terrain(k), recorded, scales_of(recorded, policy), cfg, path)
    return outs


def _check(cfg: FilmCfg, replicas: int | None = None) -> None:
    """Refuses an episode that is not crossed, or a machine without OpenGL, before minutes of crossing."""
    if cfg.episode is not None and replicas is not None and cfg.episode >= replicas:
        raise ValueError(f"episode must be one of 0..{replicas - 1}, got {cfg.episode}")
    open_context(64, 64).free()


def scales_of(robot: RobotCfg, policy: str | None) -> dict[str, float]:
    """The robot's penalty scales; 1 each, and so raw sums, where they were never measured."""
    try:
        scales = robot.read_penalty_scales(policy)
    except ValueError as error:
        print(f"{error}; penalties are drawn as they are, unscaled", flush=True)
        scales = (1.0,) * len(robot.penalties)
    return dict(zip(robot.penalties, scales, strict=True))


def film(recording: Recording, robot: RobotCfg, scales: dict[str, float], cfg: FilmCfg, out: Path) -> None:
    """Films an episode of a recording of one terrain.

    Raises:
        ValueError: If there is no such episode, or no OpenGL.
        OSError: If the film cannot be written.
    """
    replicas = recording.replicas.tolist()
    if cfg.episode is not None and cfg.episode not in replicas:
        raise ValueError(f"episode {cfg.episode} was not recorded, expected one of {', '.join(map(str, replicas))}")
    episode = typical_episode(recording, scales) if cfg.episode is None else replicas.index(cfg.episode)
    ghosts = tuple(k for k in range(len(replicas)) if k != episode)[: cfg.ghosts]
    shot = Shot(recording=recording, episode=episode, ghosts=ghosts, scales=scales)
    cameras = follow(shot, _DISTANCE * robot.default_base_height)
    replaced = " (replaced)" if out.exists() else ""
    with (
        Renderer(
            robot, recording.heights[0], width=WIDTH, height=VIEW_HEIGHT, shadows=cfg.shadows, ground=recording.ground
        ) as renderer,
        tqdm(
            total=num_pictures(shot, cfg.fps), desc=f"filming {recording.labels[0]}", unit="picture", file=sys.stderr,
            disable=None,
        ) as bar,
    ):  # fmt: skip
        write_film(out, frames_of(shot, renderer, cameras, cfg.fps), cfg.fps, progress=bar.update)
    print(f"Film: {out}{replaced}", flush=True)


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
