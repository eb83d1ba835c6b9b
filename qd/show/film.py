"""Films of crossings: ``faultline film --elite 0``, without a screen, with a GPU or without."""

import io
import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter1d

from kernels.episode import Outcome
from qd.faults.numbers import SPECIALIST
from qd.faults.searches import CERTIFIERS_FOLDER, controllers_in
from qd.search.progress import Bar
from qd.show.crossed import count_rates, find_failure_time, find_typical_episode, get_ending, make_title
from qd.show.replay import WITNESS, ReplaySource, save
from qd.workers.compute import check_policy
from sim.controllers.spec import SHIPPED, label_suffix, resolve_policy
from sim.files.command import command_line
from sim.mujoco_c.model import surface_heights
from sim.rates import SUCCESS, way_to_end
from sim.recording.recorder import Recording
from sim.recording.renderer import Camera, Renderer, open_context
from sim.robots.robot import RobotCfg
from sim.terrains.maps.picture import LENGTH, height_colors, places
from sim.terrains.terrains import asked_of

FPS = 25  # of a film
_SIZE = (1280, 720)  # of a film [pixels]
GIF_FPS = 12.5  # each picture lasts whole hundredths of a second
GIF_SIZE = (480, 270)  # [pixels]
MAX_GIF_BYTES = 2_000_000
_COLORS = (256, 128, 96, 64, 48, 32, 16)  # of a GIF; fewer where it would be too large
_SUPERSAMPLING = 2  # of a GIF's pictures
_SLOW_S = 1.0  # before the moment of failure
_QUICKNESS = 4.0  # of what is left of a ghost's way
_DISTANCE = 2.5  # of the camera, in heights or lengths of the robot
_SMOOTH_S = 0.8  # over which the camera follows the base
_ELEVATIONS = (-22.0, -32.0, -45.0, -60.0)
_CLEARANCE = 0.05  # of the line of sight over the ground [m]

Picture = NDArray[np.uint8]
"""RGB, shape (height, width, 3)."""
Progress = Callable[[float], None]
"""Called with the share that is done."""


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One episode of a recording of one terrain, and what of it is filmed."""

    recording: Recording
    episode: int
    title: str = ""
    beside: tuple[str, Recording] | None = None  # name of a ghost's controller, and its crossings from the same starts
    whole: bool = False  # from the start to the end, not from ``before_s`` the robot fails to ``after_s`` [s]
    before_s: float = 3.0
    after_s: float = 1.0
    slowness: float = 4.0  # of the second before the robot fails
    fps: float = FPS

    @property
    def end(self) -> float:
        """When the episode ends [s]."""
        return _find_end(self.recording, self.episode)

    @property
    def moment(self) -> float | None:
        """When the robot fails [s]; None if it does not."""
        outcome = self.recording.outcome[0, self.episode]
        return None if outcome == Outcome.GOAL else find_failure_time(self.recording, self.episode)

    @property
    def arrival(self) -> float | None:
        """When the ghost arrives, if there is one that does [s]."""
        if self.beside is None or self.beside[1].outcome[0, self.episode] != Outcome.GOAL:
            return None
        return _find_end(self.beside[1], self.episode)

    @property
    def stop(self) -> float:
        """Until when the robot is shown; then a ghost that arrives later [s]."""
        return (self.end if self.whole or self.moment is None else self.moment) + self.after_s

    @property
    def times(self) -> NDArray[np.float64]:
        """Time of each picture [s]: from before the robot fails to after it, the second before it slower.

        The whole of the episode, or one in which the robot arrives, is shown to ``after_s`` after its end. A ghost that
        arrives later than that is shown to ``after_s`` after its arrival, the rest of its way quickly.
        """
        moment, stop = self.end if self.moment is None else self.moment, self.stop
        begin = 0.0 if self.whole or self.moment is None else max(0.0, moment - self.before_s)
        slow = moment if self.moment is None else max(begin, moment - _SLOW_S)
        arrival = max(stop, self.arrival or 0.0)
        ends = np.array([begin, slow, moment, stop, arrival, arrival + self.after_s * (arrival > stop)])
        played = np.append(0.0, np.cumsum(np.diff(ends) * [1.0, self.slowness, 1.0, 1.0 / _QUICKNESS, 1.0]))
        return np.interp(np.arange(0.0, played[-1] + 1e-9, 1.0 / self.fps), played, ends)


def _find_end(recording: Recording, episode: int) -> float:
    return recording.dt * (int(recording.num_frames[0, episode]) - 1)


def interpolate_pose(poses: NDArray[np.floating], frame: float) -> NDArray[np.floating]:
    """Between two poses in proportion, MuJoCo's coordinates, shape (7 + num_joints,); past the last one the last."""
    share = frame - int(frame)
    first, last = (poses[min(int(frame) + k, len(poses) - 1)].copy() for k in (0, 1))
    last[3:7] *= np.copysign(1.0, first[3:7] @ last[3:7])
    pose = (1.0 - share) * first + share * last
    pose[3:7] /= np.linalg.norm(pose[3:7])
    return pose


def follow(shot: Shot, times: NDArray[np.float64], distance: float) -> list[Camera]:
    """A camera a time, ``distance`` [m] from the base: it follows smoothly, as low as the ground never hides it.

    Once the robot has been shown it follows a ghost that arrives later.
    """
    recording = shot.recording
    base = recording.qpos(0, shot.episode)[:, :3]
    if shot.beside is not None and (shot.arrival or 0.0) > shot.stop:
        shown = np.minimum(np.arange(round(shot.stop / recording.dt)), len(base) - 1)
        base = np.concatenate([base[shown], shot.beside[1].qpos(0, shot.episode)[len(shown) :, :3]])
    smooth = uniform_filter1d(base, max(1, round(_SMOOTH_S / recording.dt)) | 1, axis=0, mode="nearest")
    targets = np.stack([np.interp(times, recording.dt * np.arange(len(base)), axis) for axis in smooth.T], axis=1)
    elevation = clear_elevation(recording.heights[0], targets, distance)
    return [Camera(target=(x, y, z), distance=distance, elevation=elevation) for x, y, z in targets.tolist()]


def clear_elevation(heights: NDArray[np.floating], targets: NDArray[np.floating], distance: float) -> float:
    """The lowest elevation of a camera [deg] from which the ground never hides targets, shape (N, 3)."""
    along = np.linspace(0.1, 1.0, 19)[:, None]
    for elevation in _ELEVATIONS:
        azimuth, tilt = np.deg2rad(Camera.azimuth), np.deg2rad(elevation)
        back = -distance * np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
        sight = targets[:, None] + along * back
        ground = surface_heights(heights.astype(np.float64), sight[..., 0], sight[..., 1])
        if (sight[..., 2] > ground + _CLEARANCE).all():
            return elevation
    return _ELEVATIONS[-1]


def render_pictures(
    shot: Shot,
    robot: RobotCfg,
    times: NDArray[np.float64],
    size: tuple[int, int] = GIF_SIZE,
    *,
    shadows: bool = True,
    progress: Progress | None = None,
) -> Iterator[Picture]:
    """The pictures of a film at times of the episode [s], of a size [pixels], small ones rendered twice as fine."""
    recording = shot.recording
    ghost_name, ghost = shot.beside or ("", None)
    cameras = follow(shot, times, _DISTANCE * max(robot.default_base_height, 2.0 * robot.footprint[0]))
    poses = recording.qpos(0, shot.episode)
    ghost_poses = None if ghost is None else ghost.qpos(0, shot.episode)
    colors = np.rint(255.0 * height_colors(recording.heights[0])[::-1]).astype(np.uint8)
    side = size[0] // 5
    chart = Image.fromarray(colors).resize((side, side * colors.shape[0] // colors.shape[1]))
    draw = ImageDraw.Draw(chart)
    for k in sorted(range(recording.num_episodes), key=lambda k: k == shot.episode):  # the shown one on top
        path = recording.base_position[0, k, : recording.num_frames[0, k], :2]
        shown = k == shot.episode
        draw.line(_locate(chart, path), get_ending(recording, k).color if shown else "white", 1 + 2 * shown)
    if goal := places(asked_of(recording.ground)).get("goal"):
        draw.circle(_locate(chart, np.array([goal]))[0], side / 60, "#009e73", "white")
    speeds = (np.diff(times, append=np.inf) * shot.fps).tolist()
    width, height = (pixels * (1 if size[0] > GIF_SIZE[0] else _SUPERSAMPLING) for pixels in size)
    look: Any = {"width": width, "height": height, "shadows": shadows, "ground": recording.ground}
    with Renderer(robot, recording.heights[0], **look) as renderer:
        for number, (time_s, camera) in enumerate(zip(times.tolist(), cameras, strict=True)):
            frame = min(time_s / recording.dt, float(len(poses) - 1))
            pose = interpolate_pose(poses, frame)
            row = (0, shot.episode, int(frame + 0.5))
            touch: Any = {"touching": recording.touching[row], "foot_force": recording.foot_force[row]}
            beside = None if ghost_poses is None else interpolate_pose(ghost_poses, time_s / recording.dt)
            pixels = renderer.render(pose, camera, ghost=beside, ghost_name=ghost_name, **touch)
            picture = Image.fromarray(pixels).resize(size, Image.Resampling.BOX)
            _write_captions(picture, shot, time_s, speeds[number])
            inset = chart.copy()
            ImageDraw.Draw(inset).circle(_locate(chart, pose[None, :2])[0], chart.width / 40, "white", "black")
            picture.paste(inset, (size[0] - chart.width, 0))
            yield np.asarray(picture)
            if progress is not None:
                progress((number + 1) / len(times))


def _write_captions(picture: Image.Image, shot: Shot, time_s: float, speed: float) -> None:
    """Writes the title at the top, the time at the bottom, and from the moment of failure on how the robot fails."""
    unit = picture.height / 540
    draw = ImageDraw.Draw(picture)

    def write(x: float, y: float, text: str, size: float, color: str, anchor: str = "ls") -> None:
        excess = ImageFont.load_default(size * unit).getlength(text) / (0.78 * picture.width)  # the map is right
        font = ImageFont.load_default(size * unit / max(excess, 1.0))
        edge = max(1, round(2 * unit))
        draw.text((x * unit, y * unit), text, color, font, anchor, stroke_width=edge, stroke_fill="white")

    write(10, 32, shot.title, 28, "black")
    if shot.beside is None:
        success = SUCCESS[asked_of(shot.recording.ground)]
        write(10, 62, f"{success}: {count_rates(shot.recording)['goal_rate']}", 24, "#303030")
    else:
        write(10, 62, f"{shot.beside[0]} {make_title(shot.beside[1]).partition(': ')[2]}", 24, "#0b6e62")
    words = f"  1/{1.0 / speed:.0f} speed" if speed < 0.7 else f"  {speed:.0f} x speed" if 1.4 < speed < np.inf else ""
    time_s = min(time_s, max(shot.end, shot.arrival or 0.0))
    write(picture.width / unit - 10, 528, f"{time_s:.1f} s{words}", 24, "black", "rs")
    if shot.moment is not None and time_s >= shot.moment:
        recording, row = shot.recording, (0, shot.episode)
        failure = way_to_end(recording.outcome[row], asked_of(recording.ground), fallen=bool(recording.fallen[row]))
        write(10, 528, f"{failure} at {shot.moment:.1f} s", 30, get_ending(recording, shot.episode).color)


def _locate(image: Image.Image, positions: NDArray[np.floating]) -> list[tuple[float, float]]:
    """Pixels of positions [m], shape (count, 2), on a map."""
    pixels = image.width / LENGTH * positions.astype(np.float64)
    return [(x, image.height - y) for x, y in pixels.tolist()]


def film(
    shot: Shot,
    robot: RobotCfg,
    *,
    out: Path,
    shadows: bool = True,
    progress: Progress | None = None,
) -> None:
    """Films a shot as the MP4 or GIF that ``out`` is by its name."""
    gif = out.suffix == ".gif"
    size = GIF_SIZE if gif else _SIZE
    shot = replace(shot, fps=GIF_FPS if gif else FPS)
    pictures = render_pictures(shot, robot, shot.times, size, shadows=shadows, progress=progress)
    if gif:
        save(out, as_gif([*pictures]), "Film")
        return
    options: Any = {"quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "error"}  # H.264 that plays everywhere
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "film.mp4"
        with closing(imageio_ffmpeg.write_frames(str(draft), size, fps=FPS, **options)) as writer:
            writer.send(None)
            for picture in pictures:
                writer.send(np.ascontiguousarray(picture))
        save(out, draft.read_bytes(), "Film")


def as_gif(pictures: Sequence[Picture], max_bytes: int = MAX_GIF_BYTES) -> bytes:
    """Pictures of one shape as a GIF that repeats, with as many colours, and then pictures, as its size allows."""
    sample = Image.fromarray(np.concatenate(pictures[:: max(1, len(pictures) // 8)]))
    for step, colors in itertools.product((1, 2, 4), _COLORS):
        palette = sample.quantize(colors, Image.Quantize.FASTOCTREE)
        images = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        options: Any = {"append_images": images[step::step], "duration": round(1000 * step / GIF_FPS)}
        content = io.BytesIO()
        images[0].save(content, "GIF", save_all=True, loop=0, optimize=False, **options)
        if content.tell() <= max_bytes:
            return content.getvalue()
    raise ValueError(f"{len(pictures)} pictures must fit into a GIF of {max_bytes} bytes, got more: write an MP4")


def film_source(
    source: ReplaySource,
    *,
    episode: int | None = None,
    gif: bool = False,
    beside: str | None = None,
    device: str = "cpu",
    out: Path | None = None,
    whole: bool = False,
    shadows: bool = True,
) -> list[Path]:
    """Films of terrains; all is crossed and stored before the first is made.

    ``beside`` names a ghost: a certifier, one of the panel, a file, or ``witness``, which is steered on the elite.
    The ``whole`` of an episode is shown, or the seconds around its failure.
    """
    if not gif and out is not None and out.suffix == ".gif":
        raise ValueError(f"{out} is a GIF by its name: give --gif too")
    files = source.files(".gif" if gif else ".mp4", out)
    replicas = source.terrains[0].request.replicas
    if episode is not None and episode >= replicas:
        raise ValueError(f"episode must be one of 0..{replicas - 1}, got {episode}")
    open_context(64, 64).free()
    ghost_policy = None if beside in (None, WITNESS) else find_ghost(source, beside, device)
    requests = source.steered_requests() if beside == WITNESS else source.requests(ghost_policy)
    recordings = source.record(device)
    ghosts = source.record(device, requests) if beside is not None else []
    for recording, ghost, file in itertools.zip_longest(recordings, ghosts, files):
        other = None if beside is None else (beside if beside == WITNESS else label_suffix(beside)[1:], ghost)
        number = find_typical_episode(recording, source.scales) if episode is None else episode
        title = make_title(recording, source.by)
        shot = Shot(recording=recording, episode=number, title=title, beside=other, whole=whole)
        with Bar(f"filming {recording.labels[0]}") as bar:
            film(shot, source.robot, out=file, shadows=shadows, progress=bar.move_to)
    return files


def find_ghost(source: ReplaySource, name: str, device: str) -> str:
    """The controller of a name of the robot's panel or of a certifier of the run, or of a file or code; checked."""
    robot = source.robot
    run = source.opened_run
    known = controllers_in(robot.panel) | (run.certifiers() if run else {})
    policy = known.get(name, resolve_policy(name, robot))
    try:
        check_policy(policy, robot, device)
    except ValueError as error:
        remedy = ""
        if run is not None and name not in known:
            judge = f"judging again makes its name known: `{run.command('judge')}`"
            if name in controllers_in(run.folder / CERTIFIERS_FOLDER):
                remedy = f"; {name} is in certifiers/ of the run, and {judge}"
            elif name == SPECIALIST:
                train = command_line("finetune", robot=robot.spec, specialist=run.path)
                remedy = f"; the run has no specialist: `{train}` trains one, and {judge}"
        reason = f"got '{name}'" if remedy else str(error)
        rule = f"beside must be {', '.join([*known, SHIPPED])}, {WITNESS}, or a controller as --policy takes it"
        raise ValueError(f"{rule}: {reason}{remedy}") from error
    return policy
