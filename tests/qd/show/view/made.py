"""A recording made by hand: a robot that slides along x, with forces and penalties that are easy to reckon with."""

import numpy as np

from kernels.episode import Outcome
from sim.files.records import robot_identity
from sim.recording.recorder import Recording

FRAMES = 6
OUTCOMES = (Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.INVALID)
NUM_FRAMES = (FRAMES, 4, 0)


def make_recording(robot, genes, *, seeds, policy_sha256, replicas=3) -> Recording:
    """Episodes of 6, 4 and 0 frames, and so on in turn."""
    each = (1, replicas)
    num_frames = np.resize(NUM_FRAMES, each).astype(np.int32)
    there = np.arange(FRAMES) < num_frames[..., None]

    def frames(values):
        full = np.broadcast_to(np.asarray(values, np.float32), (*each, FRAMES, *np.shape(values)[1:])).copy()
        full[~there] = np.nan
        return full

    k = np.arange(FRAMES)[:, None]
    force = np.zeros((FRAMES, len(robot.foot_geoms), 3))
    force[1:, 0, 2] = 500.0
    return Recording(
        robot=robot.name,
        joint_names=robot.joint_names,
        foot_names=robot.foot_geoms,
        penalty_names=robot.penalties,
        dt=0.02,
        labels=("made by hand",),
        heights=np.zeros((1, 161, 321), np.float32),
        genes=genes,
        seeds=seeds,
        replicas=np.arange(replicas, dtype=np.int32),
        outcome=np.resize(OUTCOMES, each).astype(np.uint8),
        invalidity=np.resize([4 * (outcome == Outcome.INVALID) for outcome in OUTCOMES], each).astype(np.uint8),
        fallen=np.resize((True, False, False), each),
        duration_s=np.resize((0.09, 0.06, 0.01), each).astype(np.float32),
        num_frames=num_frames,
        base_position=frames(np.concatenate([2.0 + 0.1 * k, 0 * k + 4.0, 0 * k + 0.6], axis=1)),
        base_quaternion=frames(np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (FRAMES, 1))),  # turned left
        joint_position=frames(np.tile(robot.default_joint_pos, (FRAMES, 1))),
        foot_force=frames(force),
        penalties=frames(k * np.arange(1.0, len(robot.penalties) + 1)),
        command=frames(np.tile([0.75, 0.25, 0.5], (FRAMES, 1))),
        geom_names=(),
        touching=np.zeros((*each, FRAMES, 0), bool),
        origin={
            "space": "super_gaussian",
            **robot_identity(robot),
            "policy_sha256": policy_sha256,
            "date": "2026-01-02T03:04:05",
            "commit": "abcdef123456",
        },
    )
