"""Films of crossings: ``faultline film --elite 0``, without a screen, with a GPU or without."""

import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.show.cross import OWN_FOLDER, OwnTerrain
from qd.show.crossed import typical_episode
from qd.show.elites import OpenedRun, Terrain
from qd.show.film_cfg import FilmCfg
from qd.show.replay import record_terrains
from qd.show.shot import VIEW_HEIGHT, WIDTH, Shot, follow, frames_of, num_pictures
from sim.files.atomic import prepare_output, write_atomically
from sim.policy.spec import crosser_name
from sim.recording.file import read_recording, write_recording
from sim.recording.recorder import Recording
from sim.recording.renderer import Renderer, open_context
from sim.robots.find import robot_of
from sim.robots.robot import RobotCfg

RECORDING = ".recording.npz"
"""Ending of the recording that stands beside a film."""
_DISTANCE = 4.6  # of the camera, in standing heights of the robot


def film_elites(
    opened_run: OpenedRun,
    terrains: Sequence[Terrain],
    cfg: FilmCfg,
    *,
    policy: str | None = None,
    replicas: int = 20,
    seed: int = 0,
    device: str = "cpu",
    out: Path | None = None,
) -> list[Path]:
    """Films of an archive's terrains, in the run, in a folder ``out``, or one in a file ``out``.

    All recordings are written before the first film is made.
    """
    controller = opened_run.policy(policy)
    outs = [Path(f"{opened_run.output(terrain.stem, controller)}.mp4") for terrain in terrains]
    if out is not None:
        outs = [out / path.name for path in outs] if len(outs) > 1 or out.is_dir() else [out]
    _check(cfg, outs, replicas)
    recordings = record_terrains(opened_run, terrains, policy=controller, replicas=replicas, seed=seed, device=device)
    scales = dict(zip(opened_run.archive.penalties, opened_run.archive.scales, strict=True))
    return _store_and_film(recordings, opened_run.robot, scales, cfg, outs)


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
) -> list[Path]:
    """A film of a user's own terrain."""
    controller = policy or str(robot.policy_file)
    outs = [out or OWN_FOLDER / f"{terrain.name}-{crosser_name(robot, controller)}.mp4"]
    _check(cfg, outs, replicas)
    print(f"{terrain.file}: {terrain.fitted}", flush=True)
    recording = terrain.record(robot, controller, replicas=replicas, seed=seed, device=device)
    return _store_and_film([recording], robot, scales_of(robot, policy), cfg, outs)


def _store_and_film(
    recordings: Sequence[Recording], robot: RobotCfg, scales: dict[str, float], cfg: FilmCfg, outs: list[Path]
) -> list[Path]:
    for recording, path in zip(recordings, outs, strict=True):
        write_recording(path.with_name(path.stem + RECORDING), recording)
    for recording, path in zip(recordings, outs, strict=True):
        film(recording, robot, scales, cfg, path)
    return outs


def film_recording(
    file: Path, cfg: FilmCfg, *, robot: str | None = None, policy: str | None = None, out: Path | None = None
) -> list[Path]:
    """Films of what was recorded of one terrain or several, beside the recording or in ``out``; nothing is crossed.

    Penalties are drawn by the scales of ``policy``.
    """
    recording = read_recording(file)
    recorded = robot_of({**recording.origin, "robot": recording.robot}, robot, file)
    if recording.joint_names != recorded.joint_names:
        raise ValueError(f"{file} is of other joints than {recorded.name} has: give the --robot that was recorded")
    count, stem = recording.num_terrains, file.name.removesuffix(RECORDING).removesuffix(".npz")
    outs = [(out or file.parent) / (f"{stem}.mp4" if count == 1 else f"{stem}-{k}.mp4") for k in range(count)]
    if out is not None and count == 1 and not out.is_dir():
        outs = [out]
    _check(cfg, outs)
    for k, path in enumerate(outs):
        film(recording.of_terrain(k), recorded, scales_of(recorded, policy), cfg, path)
    return outs


def _check(cfg: FilmCfg, outs: list[Path], replicas: int | None = None) -> None:
    """Refuses an episode that is not crossed or a machine without OpenGL, and prepares the folder, before crossing."""
    if cfg.episode is not None and replicas is not None and cfg.episode >= replicas:
        raise ValueError(f"episode must be one of 0..{replicas - 1}, got {cfg.episode}")
    open_context(64, 64).free()
    prepare_output(outs[0])


def scales_of(robot: RobotCfg, policy: str | None) -> dict[str, float]:
    """The robot's penalty scales; 1 each, and so raw sums, where they were never measured."""
    try:
        scales = robot.read_penalty_scales(policy)
    except ValueError as error:
        print(f"{error}; penalties are drawn as they are, unscaled", flush=True)
        scales = (1.0,) * len(robot.penalties)
    return dict(zip(robot.penalties, scales, strict=True))


def film(recording: Recording, robot: RobotCfg, scales: dict[str, float], cfg: FilmCfg, out: Path) -> None:
    """Films an episode of a recording of one terrain."""
    replicas = recording.replicas.tolist()
    if cfg.episode is not None and cfg.episode not in replicas:
        raise ValueError(f"episode {cfg.episode} was not recorded, expected one of {', '.join(map(str, replicas))}")
    episode = typical_episode(recording, scales) if cfg.episode is None else replicas.index(cfg.episode)
    ghosts = tuple(k for k in range(len(replicas)) if k != episode)[: cfg.ghosts]
    shot = Shot(recording=recording, episode=episode, ghosts=ghosts, scales=scales)
    cameras = follow(shot, _DISTANCE * robot.default_base_height)
    replaced = " (replaced)" if out.exists() else ""
    look: dict[str, Any] = {"shadows": cfg.shadows, "ground": recording.ground}
    with Renderer(robot, recording.heights[0], width=WIDTH, height=VIEW_HEIGHT, **look) as renderer:
        bar: dict[str, Any] = {"desc": f"filming {recording.labels[0]}", "unit": "picture", "disable": None}
        pictures = frames_of(shot, renderer, cameras, cfg.fps)
        write_film(out, tqdm(pictures, total=num_pictures(shot, cfg.fps), file=sys.stderr, **bar), cfg.fps)
    print(f"Film: {out}{replaced}", flush=True)


def write_film(path: Path, pictures: Iterable[NDArray[np.uint8]], fps: int) -> None:
    """Encodes RGB pictures of one shape with even sides as an MP4 (H.264) that plays everywhere, atomically."""
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
        finally:
            if writer is not None:
                writer.close()
        write_atomically(path, draft.read_bytes())
