"""Who works: Ray actors asked for, welcomed, dismissed and replaced as the cluster has devices for them."""

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import ray
from ray.exceptions import RayError, RayTaskError
from tqdm import tqdm

from qd.workers.cluster import num_devices, resources
from qd.workers.process import Crosser, EvaluatorError
from qd.workers.ray_worker import Luggage, RayWorker, build_of_code

if TYPE_CHECKING:
    from qd.workers.evaluator import EvaluatorCfg

_POLL_S = 0.25
_RECRUIT_EVERY_S = 2.0
_COMING_S = 60.0  # least time in which a worker may come
_SILENT_S = 5.0
_REFUSED_PAUSE_S = 60.0
_MOST_REFUSALS = 5  # workers in a row that came and could not be used


@dataclass
class Member:
    """A worker as seen from here."""

    number: int
    actor: Any
    introduction: Any
    """What it will say of itself; None once it has."""
    where: str = "on its way"
    episodes_per_s: float = 0.0
    """In its last shard; 0 before."""
    task: Any = None
    """The result to come of the shard it is at; None while it has none."""
    shard: int = -1
    """Number of that shard."""
    share: float = 0.0
    """How much of it is done; below 0 the seconds it has been building."""
    alive_at: float = 0.0
    """When it last got on."""
    looked_at: float = 0.0
    """When it was last looked after."""
    hired_at: float = field(default_factory=time.monotonic)
    question: Any = None
    """The share to come that it was asked for."""

    def __str__(self) -> str:
        return f"worker {self.number} ({self.where})"


class Roster:
    """Workers, one a device: as many as wanted, or with ``auto`` as many as the cluster has devices at any time.

    Args:
        cfg: What they cross, with what.
        build: Makes a worker's simulation.
    """

    def __init__(self, cfg: "EvaluatorCfg", build: Callable[[Any, int], Crosser]) -> None:
        gpus = int(cfg.device.startswith("cuda"))
        self.members: list[Member] = []
        self._cfg, self._code = cfg, build_of_code()
        self._options = {"num_gpus": gpus, "num_cpus": 1 - gpus}
        # Controller and robot travel once a machine, however many workers there are.
        luggage = Luggage.of(cfg)
        cfg = replace(cfg, device="cuda:0" if gpus else "cpu", robot="")  # the robot is in the luggage
        self._work = cfg, ray.put(luggage), build
        self._number = self._refusals = 0
        self._recruited_at = -np.inf

    @property
    def patience_s(self) -> float:
        """How long a worker may take to come [s]."""
        return max(_COMING_S, self._cfg.worker_limit_s)

    @property
    def joined(self) -> list[Member]:
        """Those that have come."""
        return [member for member in self.members if member.introduction is None]

    def recruit(self) -> None:
        """Asks for the workers that are missing, and welcomes those that have come.

        Raises:
            EvaluatorError: If none that comes can be used.
        """
        now = time.monotonic()
        if now - self._recruited_at > _RECRUIT_EVERY_S:
            self._recruited_at = now
            wanted = self._cfg.workers
            wanted = wanted if isinstance(wanted, int) else num_devices(self._cfg.device)
            for member in [m for m in self.members if m.introduction is not None]:
                if now - member.hired_at > self.patience_s:  # it hangs, or has no place yet
                    self.dismiss(member)
            for _ in range(wanted - len(self.members)):
                self._hire()
        coming = {member.introduction: member for member in self.members if member.introduction is not None}
        for reference in ray.wait([*coming], num_returns=len(coming), timeout=0)[0] if coming else ():
            self._welcome(coming[reference])

    def dismiss(self, member: Member) -> None:
        """Ends a worker, whatever it does."""
        self.members.remove(member)
        with suppress(RayError):  # the whole cluster may be gone
            ray.kill(member.actor)

    def dismiss_busy(self) -> None:
        """Ends those that are at something."""
        for member in [member for member in self.members if member.task is not None]:
            self.dismiss(member)

    def gather(self, count: int, limit_s: float) -> int:
        """Waits for so many workers, or so long; returns how many are there."""
        began = time.monotonic()
        end, told = began + limit_s, False
        while len(self.joined) < count and time.monotonic() < end:
            self.wait([])
            self.recruit()
            if not told and time.monotonic() - began > _SILENT_S:
                tell(f"{len(self.joined)} of {len(self.members)} workers have come; waiting for more")
                told = True
        return len(self.joined)

    def wait(self, tasks: list[Any]) -> None:
        """Until a task is done, somebody has come, or it is time to look after them."""
        coming = [member.introduction for member in self.members if member.introduction is not None]
        if tasks or coming:
            ray.wait([*tasks, *coming], num_returns=1, timeout=_POLL_S)
        else:
            time.sleep(_POLL_S)

    def close(self) -> None:
        """Dismisses everybody."""
        for member in list(self.members):
            self.dismiss(member)

    def _hire(self) -> None:
        self._number += 1
        actor: Any = RayWorker
        actor = actor.options(**self._options).remote(*self._work)
        self.members.append(Member(number=self._number, actor=actor, introduction=actor.introduce.remote()))

    def _welcome(self, member: Member) -> None:
        try:
            host, process, code = ray.get(member.introduction)
        except RayError as error:
            self._refuse(member, f"did not start: {reason_of(error)}")
            return
        member.introduction, member.where = None, f"process {process} on {host}"
        if code != self._code:
            self._refuse(
                member, "has other code or packages than this machine: use the same commit and `make setup` everywhere"
            )
            return
        self._refusals = 0

    def _refuse(self, member: Member, reason: str) -> None:
        self.dismiss(member)
        self._refusals += 1
        if self._refusals >= _MOST_REFUSALS and not self.joined:
            raise EvaluatorError(f"{member} {reason}; so it was with the {self._refusals - 1} before it")
        if self._refusals <= _MOST_REFUSALS:
            tell(f"{member} {reason}")
        if self._refusals >= _MOST_REFUSALS:
            self._recruited_at = time.monotonic() + _REFUSED_PAUSE_S  # those that are there do without


def nobody_came(limit_s: float) -> EvaluatorError:
    """The error for when no worker is left and none comes."""
    return EvaluatorError(f"no worker came within {limit_s:g} s; the cluster has {resources()}")


def reason_of(error: BaseException) -> str:
    """What went wrong with a worker, in one line: the exception it raised, or how it died."""
    if isinstance(error, RayTaskError):
        return f"{type(error.cause).__name__}: {' '.join(str(error.cause).split())}"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def tell(message: str) -> None:
    """A line that leaves progress bars whole."""
    tqdm.write(message, file=sys.stderr)
