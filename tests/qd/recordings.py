"""Made-up recordings of one terrain, where robots walk straight on to their ends; pages and runs for reports."""

import html
import json
import re
from dataclasses import replace

import numpy as np

from kernels.episode import Outcome
from qd.search.archive import read_archive
from qd.search.settings import as_settings, preset
from qd.show.report import report
from sim.controllers.spec import controller_identity
from sim.files.atomic import to_json
from sim.recording.recorder import Recording
from sim.robots.find import get_robot
from tests.builders import fresh_values, small_archive, write_run
from tests.qd.stand_in import PENALTIES

FRAMES = 21


def recording_of(outcomes, ends_x, *, penalties=None, fallen=None, seed=0, frames=FRAMES) -> Recording:
    """Episodes that ended so, there; each penalty grows evenly to its sum.

    Args:
        outcomes: Of each episode.
        ends_x: Where each ended along x [m].
        penalties: Raw sums, shape (episodes, 6); 1 each.
        fallen: Of each episode; nobody.
        seed: Of terrain and episodes.
        frames: Of each episode.
    """
    count, robot = len(outcomes), get_robot("anymal")
    joints, feet = robot.joint_names, robot.foot_geoms
    sums = np.ones((count, 6)) if penalties is None else np.asarray(penalties, float)
    share, shape = np.linspace(0.0, 1.0, frames), (1, count, frames)
    position = np.zeros((*shape, 3), np.float32)
    position[0, :, :, 0] = 2.0 + (np.asarray(ends_x, float)[:, None] - 2.0) * share
    position[0, :, :, 1] = 4.0 + 0.1 * np.arange(count)[:, None]
    quaternion = np.zeros((*shape, 4), np.float32)
    quaternion[..., 0] = 1.0
    return Recording(
        robot="anymal", joint_names=joints, foot_names=feet, penalty_names=PENALTIES, dt=0.02, labels=("made up",),
        heights=np.random.default_rng(seed).normal(0.0, 0.2, (1, 161, 321)).astype(np.float32), genes=None,
        seeds=np.array([seed], np.uint32),
        outcome=np.array([outcomes], np.uint8), invalidity=np.zeros((1, count), np.uint8),
        fallen=np.array([[False] * count if fallen is None else fallen]),
        duration_s=np.full((1, count), 0.02 * (frames - 1), np.float32),
        deviation=np.zeros((1, count), np.float32),
        num_frames=np.full((1, count), frames, np.int32), base_position=position, base_quaternion=quaternion,
        joint_position=np.zeros((*shape, len(joints)), np.float32),
        foot_force=np.zeros((*shape, len(feet), 3), np.float32),
        penalties=(sums[None, :, None, :] * share[:, None]).astype(np.float32),
        command=np.zeros((*shape, 3), np.float32), origin={"policy": "made up"},
        geom_names=robot.geom_names, touching=np.zeros((*shape, len(robot.geom_names)), bool),
    )  # fmt: skip


def stand_in_cross(crossed: list):
    """A service that crosses terrains in no time; their labels go into a list."""

    def cross(requests, progress):
        made = []
        for request in requests:
            crossed.append(request.label)
            number = int("".join(filter(str.isdigit, request.label)) or 0)  # elite 3 of anymal
            ends = (Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.OUT)
            outcomes = [ends[(number + k) % 4] for k in range(request.replicas)]
            seed = int(request.terrain.seeds[0])
            recording = recording_of(outcomes, np.linspace(6.0, 14.0, request.replicas), seed=seed)
            origin = controller_identity(get_robot("anymal"), request.policy) | {"space": "super_gaussian"}
            origin["seed"] = request.seed
            values = {name: getattr(request.terrain, name) for name in ("genes", "heights")}
            values = {name: value for name, value in values.items() if value is not None}
            made.append(replace(recording, labels=(request.label,), origin=origin, **values))
        progress(1.0)
        return made

    return cross


def rows(count: int) -> list[dict]:
    """Lines of a run's metrics."""
    always = {"terrains": 10, "episodes": 40, "invalid_episodes": 1, "wall_s": 2.5}
    steps = range(1, count + 1)
    return [{"iteration": k, "qd_score": 20.0 * k, "elites": 5 * k, "mean_fitness": 1.0 + k, **always} for k in steps]


def grouped_archive(sizes=(6, 9, 5)):
    """Elites of three kinds: robots get stuck, collide, and arrive."""
    return replace(
        small_archive(sum(sizes)),
        goal_rate=np.repeat([0.0, 0.0, 1.0], sizes),
        collision_rate=np.repeat([0.0, 1.0, 0.0], sizes),
        fallen_rate=np.zeros(sum(sizes)),
    )


def text_of(content: bytes) -> str:
    """What a page shows, in one line."""
    words = re.sub(r"<(style|script)>.*?</\1>|<[^>]*>", " ", content.decode(), flags=re.DOTALL)
    return " ".join(html.unescape(words).split())


def make_run(root):
    """A whole run of 20 elites with fresh values."""
    archive = replace(grouped_archive(), iterations=4)
    archive = archive.corrected_by(fresh_values(archive))
    folder = write_run(root / "run", archive)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows(4)))
    small = preset("small", get_robot("anymal"))
    fitness = replace(small.fitness, penalties=archive.penalties, scales=archive.scales)
    settings = as_settings(replace(small, fitness=fitness))
    origin = {"command": "python <script>alert(1)</script>", "commit": "abc", "device": "CPU", "seed": 0,
              "versions": {"numpy": "2"}, "date": "today"}  # fmt: skip
    (folder / "config.json").write_bytes(to_json({"settings": settings, "iterations": 4, "sessions": [], **origin}))
    return folder


def reporter(run, patch):
    """Makes a report in a folder without published tables; returns the page and what was crossed."""
    patch.chdir(run.parent)
    patch.setattr(report, "check_policy", lambda policy, robot, device: None)

    def make(**changes):
        crossed = []
        patch.setattr("qd.show.recordings.RecordingCrosser", lambda robot, device: stand_in_cross(crossed))
        return report.write_report(**{"run": run, "device": "cpu", "num_elites": 1, **changes}), crossed

    return make


def minimal_of(run, count=1):
    """The first failing elites of a run, each with its first part alone as the minimal terrain."""
    archive = read_archive(run)
    numbers = np.flatnonzero(archive.failing)[:count].tolist()
    np.savez(run / "minimal.npz", elite=np.array(numbers), genes=archive.genes[numbers])
    entries = [
        {"elite": n, "cell": int(archive.cell[n]), "iteration": int(archive.iteration[n]), "bumps": [0],
         "words": ["bump of <0.24> m"], "of": 2, "goal_rate": 0.0, "goal_interval": [0.0, 0.088],
         "cause": {"bump": 0, "kind": "rise"}, "margin_m": 0.12, "verdict": "failing"}
        for n in numbers
    ]  # fmt: skip
    (run / "minimal.json").write_bytes(to_json({"elites": entries}))
    return numbers, entries
