"""The queue of episodes: a robot whose episode has ended stores its result and takes the next one.

Any number of episodes runs through a fixed number of robots, on the device, without the host. Which robot takes which
episode changes nothing: a start depends on the terrain's seed and the number of the replica alone.

The terrains are a ring of slots. New terrains take the slots behind the former ones: episode number ``n`` since the
ring was empty is replica ``n % num_replicas`` of slot ``n // num_replicas % num_slots``.
"""

from typing import Any

import warp as wp

from kernels.episode import Episodes, Outcome
from kernels.rewards import Rewards
from kernels.state import make_zeros

_TAKEN = wp.constant(0)
_READY = wp.constant(1)


@wp.struct
class EpisodeQueue:
    """Waiting episodes, the robots of running ones, and the results of ended ones."""

    num_replicas: int
    """Episodes of a terrain."""
    counts: wp.array[int]
    """Episodes taken and episodes ready to be taken since the ring was empty, less whole rounds of it; shape (2,)."""
    seed: wp.array[wp.uint32]
    """Seed of each slot's terrain, shape (num_slots,)."""
    num_ended: wp.array[int]
    """Episodes that have ended on each slot's terrain, shape (num_slots,)."""
    episode_of_env: wp.array[int]
    """Row of the results of each robot's episode, -1 where it waits; shape (num_envs,)."""
    begins: wp.array[int]
    """1 where a robot has just taken an episode, shape (num_envs,)."""
    busy: wp.array[int]
    """Control steps that each robot made for an episode since the host set it to zero, shape (num_envs,)."""
    outcome: wp.array[int]
    """Results, shape (num_slots * num_replicas,): :class:`kernels.episode.Outcome`."""
    invalidity: wp.array[int]
    """:class:`kernels.episode.Invalidity`."""
    steps: wp.array[int]
    """Physics steps up to the end."""
    final_pose: wp.array[wp.transform]
    """Base pose at the end, world-local frame."""
    penalty_sums: wp.array2d[float]
    """Columns :data:`kernels.penalties.PENALTIES`, times the physics step."""
    reward: wp.array[float]
    """Reward of the whole time; empty where nothing is rewarded."""


def make_queue(
    num_envs: int, num_slots: int, num_replicas: int, num_penalties: int, *, rewarded: bool, device: str
) -> EpisodeQueue:
    """Allocate an empty queue for ``num_slots`` terrains at once; ``rewarded`` queues keep rewards too."""
    rows = num_slots * num_replicas
    shapes = {"counts": 2, "penalty_sums": (rows, num_penalties), "reward": rows if rewarded else 0}
    shapes |= dict.fromkeys(("seed", "num_ended"), num_slots)
    shapes |= dict.fromkeys(("episode_of_env", "begins", "busy"), num_envs)
    shapes |= dict.fromkeys(("outcome", "invalidity", "steps", "final_pose"), rows)
    queue = make_zeros(EpisodeQueue, device, **shapes)
    queue.num_replicas = num_replicas
    queue.episode_of_env.fill_(-1)
    return queue


def ring_slices(first: int, count: int, size: int) -> tuple[slice, ...]:
    """``count`` slots from ``first`` on, of a ring of ``size``."""
    whole = slice(first, min(first + count, size))
    rest = first + count - size
    return (whole, slice(0, rest)) if rest > 0 else (whole,)


@wp.func
def _store_result(
    row: int, env: int, episodes: Episodes, penalty_sums: wp.array2d[float], rewards: Rewards, queue_out: EpisodeQueue
):
    queue_out.outcome[row] = episodes.outcome[env]
    queue_out.invalidity[row] = episodes.invalidity[env]
    queue_out.steps[row] = episodes.steps[env]
    queue_out.final_pose[row] = episodes.final_pose[env]
    for k in range(penalty_sums.shape[1]):
        queue_out.penalty_sums[row, k] = penalty_sums[env, k]
    if queue_out.reward.shape[0] > 0:
        queue_out.reward[row] = rewards.total[env]
    wp.atomic_add(queue_out.num_ended, row // queue_out.num_replicas, 1)


@wp.func
def _take_next(queue_out: EpisodeQueue) -> int:
    """Row of the next episode, -1 where none is ready."""
    ready = queue_out.counts[_READY]
    if queue_out.counts[_TAKEN] >= ready:  # waiting robots must not increment it for ever
        return -1
    number = wp.atomic_add(queue_out.counts, _TAKEN, 1)
    if number >= ready:
        return -1
    return number % (queue_out.seed.shape[0] * queue_out.num_replicas)


@wp.kernel
def _turn_over_kernel(
    stepped: wp.array[int],
    rewards: Rewards,
    episodes_out: Episodes,
    penalty_sums_out: wp.array2d[float],
    terrain_of_env_out: wp.array[int],
    queue_out: EpisodeQueue,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    queue_out.begins[env] = 0
    row = queue_out.episode_of_env[env]
    if row >= 0:
        queue_out.busy[env] += 1
    if stepped[env] == Outcome.RUNNING:
        return
    if row >= 0:
        _store_result(row, env, episodes_out, penalty_sums_out, rewards, queue_out)
    row = _take_next(queue_out)
    queue_out.episode_of_env[env] = row
    if row < 0:
        return
    slot = row // queue_out.num_replicas
    # The stream depends on the terrain's seed and the replica alone: neither robot nor slot changes an episode.
    episodes_out.rng[env] = wp.rand_init(int(queue_out.seed[slot]), row % queue_out.num_replicas)
    terrain_of_env_out[env] = slot
    queue_out.begins[env] = 1
    for k in range(penalty_sums_out.shape[1]):
        penalty_sums_out[env, k] = 0.0


def turn_over(
    stepped: Any, rewards: Rewards, episodes_out: Episodes, penalty_sums_out: Any, terrain_of_env_out: Any,
    queue_out: EpisodeQueue,
) -> None:  # fmt: skip
    """Store the results of the episodes that ended, and let their robots take the next ones.

    It moves no robot: :func:`kernels.restart.restart_episodes` does, where ``begins`` is 1.

    ``stepped`` is the outcome that ends a robot's stepping; it differs from ``episodes_out.outcome`` where a robot goes
    on after its crossing has ended. Where an episode begins, ``rng`` and terrain are written and penalty sums are zero.
    """
    outputs = [episodes_out, penalty_sums_out, terrain_of_env_out, queue_out]
    wp.launch(_turn_over_kernel, stepped.shape[0], [stepped, rewards], outputs=outputs, device=stepped.device)


@wp.kernel
def _make_ready_kernel(count: int, queue_out: EpisodeQueue):
    """Grid (1,)."""
    ready = queue_out.counts[_READY]
    taken = wp.min(queue_out.counts[_TAKEN], ready)  # robots that found none have incremented it
    # Whole rounds change no row; left in, they would outgrow an int in a search of many days.
    size = queue_out.seed.shape[0] * queue_out.num_replicas
    rounds = taken // size * size
    queue_out.counts[_TAKEN] = taken - rounds
    queue_out.counts[_READY] = ready - rounds + count


def make_ready(count: int, queue_out: EpisodeQueue) -> None:
    """Let robots take ``count`` more episodes."""
    wp.launch(_make_ready_kernel, 1, inputs=[count], outputs=[queue_out], device=queue_out.counts.device)
