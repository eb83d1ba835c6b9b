"""The reward of a whole crossing on the device: which control steps are paid for, and what they add up to."""

from typing import Any

import warp as wp

from kernels.episode import Outcome

_RUNNING = wp.constant(int(Outcome.RUNNING))
_BASE_COLLISION = wp.constant(int(Outcome.BASE_COLLISION))
_INVALID = wp.constant(int(Outcome.INVALID))


@wp.struct
class PaidSteps:
    """What the reward of an episode is summed in, shape (num_envs,) unless said otherwise."""

    running: wp.array[int]
    """1 if the episode had not ended when the control step began."""
    valid: wp.array[int]
    """1 if the step just made is paid for."""
    fallen: wp.array[int]
    """1 if it ended the episode by a base collision."""
    reward: wp.array[float]
    """Reward of the step just made."""
    total: wp.array[float]
    """Reward of the episode so far."""
    previous_action: wp.array2d[float]
    """Clipped action of the step before, shape (num_envs, num_joints)."""
    previous_joint_vel: wp.array2d[float]
    """Joint rates at the end of the step before [rad/s], shape (num_envs, num_joints)."""


def make_paid_steps(num_envs: int, num_joints: int) -> PaidSteps:
    """Allocate on the current device; :func:`start_paying` is due before the first step."""
    steps = PaidSteps()
    for name in ("running", "valid", "fallen"):
        setattr(steps, name, wp.zeros(num_envs, dtype=int))
    for name in ("reward", "total"):
        setattr(steps, name, wp.zeros(num_envs, dtype=float))
    for name in ("previous_action", "previous_joint_vel"):
        setattr(steps, name, wp.zeros((num_envs, num_joints), dtype=float))
    return steps


@wp.kernel
def _start_paying_kernel(joint_qd: wp.array2d[float], steps_out: PaidSteps):
    """Grid (num_envs,)."""
    env = wp.tid()
    steps_out.running[env] = 1
    steps_out.valid[env] = 0
    steps_out.fallen[env] = 0
    steps_out.reward[env] = 0.0
    steps_out.total[env] = 0.0
    for j in range(steps_out.previous_action.shape[1]):
        steps_out.previous_action[env, j] = 0.0
        steps_out.previous_joint_vel[env, j] = joint_qd[env, 6 + j]


def start_paying(joint_qd: Any, steps_out: PaidSteps) -> None:
    """Begin the sums of robots that were just put down.

    Args:
        joint_qd: Joint velocities at the start, shape (num_envs, 6 + num_joints).
        steps_out: Nothing summed, no action before.
    """
    wp.launch(
        _start_paying_kernel,
        dim=joint_qd.shape[0],
        inputs=[joint_qd],
        outputs=[steps_out],
        device=joint_qd.device,
    )


@wp.kernel
def _mark_paid_kernel(outcome: wp.array[int], steps_out: PaidSteps):
    """Grid (num_envs,)."""
    env = wp.tid()
    running = steps_out.running[env]
    steps_out.valid[env] = wp.where(outcome[env] == _INVALID, 0, running)
    steps_out.fallen[env] = wp.where(outcome[env] == _BASE_COLLISION, running, 0)
    steps_out.running[env] = wp.where(outcome[env] == _RUNNING, 1, 0)


def mark_paid(outcome: Any, steps_out: PaidSteps) -> None:
    """Find the robots whose control step is paid for: it began before the end, and did not end in an invalid state.

    The step of a base collision itself counts, as it does in training.

    Args:
        outcome: :class:`kernels.episode.Outcome` after the step, shape (num_envs,).
        steps_out: Writes ``valid`` and ``fallen``, and ``running`` for the next step.
    """
    wp.launch(_mark_paid_kernel, dim=outcome.shape[0], inputs=[outcome], outputs=[steps_out], device=outcome.device)


@wp.kernel
def _add_paid_kernel(action: wp.array2d[float], joint_qd: wp.array2d[float], steps_out: PaidSteps):
    """Grid (num_envs,)."""
    env = wp.tid()
    steps_out.total[env] += steps_out.reward[env]
    for j in range(action.shape[1]):
        steps_out.previous_action[env, j] = action[env, j]
        steps_out.previous_joint_vel[env, j] = joint_qd[env, 6 + j]


def add_paid(action: Any, joint_qd: Any, steps_out: PaidSteps) -> None:
    """Add the rewards of the step just made, and keep what the next step's rewards compare with.

    Args:
        action: Clipped action of the step, shape (num_envs, num_joints).
        joint_qd: Joint velocities after it, shape (num_envs, 6 + num_joints).
        steps_out: Adds ``reward`` to ``total``; writes ``previous_action`` and ``previous_joint_vel``.
    """
    wp.launch(
        _add_paid_kernel,
        dim=joint_qd.shape[0],
        inputs=[action, joint_qd],
        outputs=[steps_out],
        device=joint_qd.device,
    )
