"""Evaluation by a crew of Ray workers.

Whole terrains are handed out. An episode depends on its terrain, seed and replica alone, so a shard may be crossed
anywhere, and a second time after its worker died, hung or answered with nonsense.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import ray
from numpy.typing import NDArray
from ray.exceptions import RayError, RayTaskError

from qd.workers.cluster import connect
from qd.workers.process import Crosser, EvaluatorError
from qd.workers.roster import Member, Roster, nobody_came, reason_of, tell
from qd.workers.shards import MIN_ROWS, checked_count, flaw_of, merged, taken

if TYPE_CHECKING:
    from qd.workers.evaluator import EvaluatorCfg
    from sim.rollout import RolloutResult

_GATHER_S = 60.0  # how long an evaluator that opens waits for the other workers once one is there
_BUILD_LIMIT_S = 900.0  # with a cold kernel cache
_UNSEEN_S = 10.0
_MOST_TRIES = 5  # of which three may be bad luck


@dataclass(frozen=True, kw_only=True)
class CrewStatus:
    """How the workers fare."""

    workers: int
    """Workers at hand."""
    episodes_per_s: tuple[float, ...]
    """Of each that has crossed a shard, in its last one."""
    retries: int
    """Shards that had to be crossed again since the crew was opened."""

    def __str__(self) -> str:
        rates = " + ".join(f"{rate:.1f}" for rate in self.episodes_per_s)
        again = f", {self.retries} shards again" if self.retries else ""
        return f"{self.workers} worker{'s' * (self.workers != 1)} ({rates} episodes/s{again})"


@dataclass
class _Shard:
    """Terrains that one worker crosses."""

    part: slice
    size: int
    """Terrains of the simulation that crosses it; those beyond the shard's own are dropped."""
    tries: int = 0
    result: Any = None


class Crew:
    """Evaluates any number of terrains (:class:`qd.workers.evaluator.Evaluate`) on as many workers as there are.

    Args:
        cfg: What is crossed, with what; ``num_terrains`` at once over all workers.
        build: Makes a worker's simulation.
    """

    def __init__(self, cfg: "EvaluatorCfg", build: Callable[[Any, int], Crosser]) -> None:
        self._cfg, self._roster = cfg, Roster(cfg, build)
        self._retries = self._planned = self._seen = 0

    def open(self) -> None:
        """Gathers the workers, and lets the first compile the kernels, which the others then find compiled.

        Raises:
            ValueError: If the simulation cannot be built as asked for.
            EvaluatorError: If no worker comes, or none that can be used.
        """
        limit_s = self._cfg.worker_limit_s
        for tries in range(1, _MOST_TRIES + 1):
            self._roster.recruit()
            if not self._roster.gather(1, self._roster.patience_s):
                raise nobody_came(self._roster.patience_s)
            self._roster.gather(len(self._roster.members), _GATHER_S)
            first = self._roster.joined[0]
            try:
                ray.get(first.actor.prepare.remote(self._shard_size()), timeout=max(_BUILD_LIMIT_S, limit_s))
                return
            except RayError as error:
                failed = _as_raised(error, f"{first} cannot build its simulation: {reason_of(error)}")
            if isinstance(failed, ValueError) or tries == _MOST_TRIES:
                raise failed
            tell(f"{failed}; another tries")
            self._roster.dismiss(first)

    def close(self) -> None:
        """Ends the workers, whatever they do."""
        self._roster.close()

    def status(self) -> CrewStatus:
        """How the workers fare."""
        joined = self._roster.joined
        rates = tuple(member.episodes_per_s for member in joined if member.episodes_per_s)
        return CrewStatus(workers=len(joined), episodes_per_s=rates, retries=self._retries)

    def __call__(
        self, terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None = None
    ) -> "RolloutResult":
        """Cross each terrain once a replica.

        Raises:
            ValueError: If the arguments do not fit, or a shard is refused by five workers.
            EvaluatorError: If a shard fails on five workers, or none is left and none comes.
        """
        checked_count(terrains, seeds)
        try:
            return self._cross(terrains, seeds, progress)
        except BaseException:  # Ctrl-C too: what is under way is of no later call
            self._roster.dismiss_busy()
            raise

    def _cross(self, terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None) -> "RolloutResult":
        count = len(terrains)
        began = busy_at = time.monotonic()
        size = self._shard_size()
        shards = [_Shard(slice(first, min(first + size, count)), size) for first in range(0, count, size)]
        waiting, shown = deque(range(len(shards))), 0.0
        while any(shard.result is None for shard in shards):
            self._roster.recruit()
            for member in self._roster.joined:
                if waiting and member.task is None:
                    part = shards[waiting[0]].part
                    self._assign(member, waiting.popleft(), terrains[part], seeds[part], size)
            busy = [member for member in self._roster.joined if member.task is not None]
            busy_at = time.monotonic() if busy else busy_at
            if time.monotonic() - busy_at > self._roster.patience_s:
                raise nobody_came(self._roster.patience_s)
            self._roster.wait([member.task for member in busy])
            waiting.extendleft(member.shard for member in busy if not self._look_after(member, shards[member.shard]))
            if progress is not None:
                done = sum(shard.result is not None for shard in shards)
                done += sum(max(0.0, member.share) for member in self._roster.joined if member.task is not None)
                shown = max(shown, min(1.0, done / len(shards)))
                progress(shown)
        whole = merged([shard.result for shard in shards], join=0)
        return replace(whole, wall_s=time.monotonic() - began)

    def _shard_size(self) -> int:
        """Terrains of a shard: for each worker an equal part of those that are crossed at once.

        A simulation is built for one size, so a change in the number of workers counts once it has lasted from one
        evaluation to the next: the place of a worker that died is mostly taken again by then.
        """
        joined = len(self._roster.joined)
        if joined and (not self._planned or joined == self._seen):
            self._planned = joined
        self._seen = joined
        return max(-(-self._cfg.num_terrains // max(1, self._planned)), -(-MIN_ROWS // self._cfg.num_replicas))

    @staticmethod
    def _assign(member: Member, number: int, terrains: NDArray, seeds: NDArray, size: int) -> None:
        member.shard, member.share, member.question = number, 0.0, None
        member.alive_at = member.looked_at = time.monotonic()
        member.task = member.actor.cross.remote(terrains, seeds, size)

    def _look_after(self, member: Member, shard: _Shard) -> bool:
        """Takes a worker's result if it is there; False if the shard must be crossed by another.

        Raises:
            ValueError: If five workers refused the shard.
            EvaluatorError: If it failed on five.
        """
        replicas = self._cfg.num_replicas
        error: BaseException | None = None
        if ray.wait([member.task], timeout=0)[0]:
            try:
                result, seconds = ray.get(member.task)
                flaw = flaw_of(result, shard.size, replicas)
                if flaw is None:
                    shard.result, member.task = taken(result, shard.part.stop - shard.part.start), None
                    member.episodes_per_s = shard.size * replicas / seconds
                    return True
                trouble = f"answered with nonsense: {flaw}"
            except RayError as raised:
                error, trouble = raised, f"failed: {reason_of(raised)}"
        elif self._gets_on(member):
            return True
        else:
            trouble = f"got no further for {self._cfg.worker_limit_s:g} s"
        self._roster.dismiss(member)
        self._retries += 1
        shard.tries += 1
        where = f"terrains {shard.part.start} to {shard.part.stop - 1}"
        if shard.tries >= _MOST_TRIES:
            raise _as_raised(error, f"{where} failed on {_MOST_TRIES} workers; the last, {member}, {trouble}")
        tell(f"{member} {trouble}; {where} are crossed again by another")
        return False

    def _gets_on(self, member: Member) -> bool:
        """Whether a busy worker has moved within the limit; asks it how far it is, without waiting for the answer.

        One that builds its simulation says so and has a limit of its own for that. Time in which nobody looked, since
        this process itself was stopped, is nobody's fault.
        """
        now = time.monotonic()
        if now - member.looked_at > _UNSEEN_S:
            member.alive_at += now - member.looked_at
        member.looked_at = now
        if member.question is None:
            member.question = member.actor.share.remote()
        elif ray.wait([member.question], timeout=0)[0]:
            try:
                share: Any = ray.get(member.question)
            except RayError:  # it died: its task says so too, and why
                share = member.share
            if share != member.share and -share < max(_BUILD_LIMIT_S, self._cfg.worker_limit_s):
                member.share, member.alive_at = share, now
            member.question = None
        return now - member.alive_at < self._cfg.worker_limit_s


def _as_raised(error: BaseException | None, message: str) -> Exception:
    """A ValueError if that is what a worker raised, the user's to mend; else the evaluation's own error."""
    refused = isinstance(error, RayTaskError) and isinstance(error.cause, ValueError)
    return ValueError(message) if refused else EvaluatorError(message)


@contextmanager
def open_crew(cfg: "EvaluatorCfg", build: Callable[[Any, int], Crosser]) -> Iterator[Crew]:
    """Gathers a crew and keeps it until the end; arguments and errors as of :func:`qd.workers.evaluator.open_evaluator`."""
    assert cfg.workers is not None
    connect(cfg.workers)
    crew = Crew(cfg, build)
    try:
        crew.open()
        yield crew
    except RayError as error:
        raise EvaluatorError(f"the Ray cluster failed: {reason_of(error)}") from error
    finally:
        crew.close()
