"""Made-up recordings of one terrain: robots walk straight on to where they end."""

from dataclasses import replace

import numpy as np

from kernels.episode import Outcome
from sim.controllers.spec import controller_identity
from sim.recording.recorder import Recording
from sim.robots.find import get_robot
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
