"""One process that evaluates terrains for another, and dies with it."""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from numpy.typing import NDArray

from sim.files.command import UserError, told

if TYPE_CHECKING:
    from sim.rollout import RolloutResult


class EvaluatorError(UserError):
    """The evaluation cannot go on; what was saved before is whole."""


class Crosser(Protocol):
    """What evaluates a fixed number of terrains, such as :class:`sim.rollout.Rollout`."""

    def evaluate(
        self, terrains: NDArray, seeds: NDArray, *, progress: Callable[[float], None] | None = None
    ) -> "RolloutResult":
        """Cross each terrain."""
        ...


class WorkerProcess:
    """A process that has a simulation of its own.

    Args:
        num_terrains: Terrains it evaluates at once.
        build: Called in the process with ``cfg`` and ``num_terrains``; a module-level function.
        cfg: Anything that can be pickled.
    """

    def __init__(self, num_terrains: int, build: Callable[[Any, int], Crosser], cfg: Any) -> None:
        context = multiprocessing.get_context("spawn")  # a fork of a process with threads and CUDA may hang
        self.num_terrains = num_terrains
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, cfg, num_terrains, build), daemon=True)
        # A blocked signal stays blocked in the child: Ctrl-C reaches the whole group, and the parent ends its workers.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()  # so that its death ends the stream here

    def send(self, terrains: NDArray, seeds: NDArray) -> None:
        """Hands out terrains to evaluate."""
        try:
            self.connection.send((terrains, seeds))
        except OSError:
            self._raise_death()

    def receive(self) -> tuple[str, Any]:
        """The next message: ``ready``, ``progress`` or ``result``, and its value.

        Raises:
            ValueError: If the worker refused its work.
            EvaluatorError: If it failed otherwise, or is dead.
        """
        try:
            message, value = self.connection.recv()
        except (EOFError, OSError):
            self._raise_death()
        if message == "refused":
            raise ValueError(value)
        if message == "failed":
            raise EvaluatorError(f"a worker process failed: {value}")
        return message, value

    def _raise_death(self) -> NoReturn:
        self._process.join(timeout=5)
        code = self._process.exitcode
        reason = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
        raise EvaluatorError(f"a worker process died ({reason}): out of memory?") from None

    def stop(self) -> None:
        """Ends the process, whatever it does."""
        self._process.terminate()
        self._process.join(timeout=5)
        if self._process.is_alive():
            self._process.kill()
        self.connection.close()


def _serve(connection: Connection, cfg: Any, num_terrains: int, build: Callable[[Any, int], Crosser]) -> None:
    """A worker's life: build, then evaluate until the other end closes."""
    os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported: one core a worker
    try:
        crosser = build(cfg, num_terrains)
        connection.send(("ready", None))
        while True:
            terrains, seeds = connection.recv()
            report = lambda share: connection.send(("progress", share))  # noqa: E731
            connection.send(("result", crosser.evaluate(terrains, seeds, progress=report)))
    except (EOFError, ConnectionError):  # the other end is gone: closed, or killed with unread messages
        sys.exit(0)
    except ValueError as error:
        _send_last(connection, "refused", told(error, str(error)))
    except Exception as error:
        _send_last(connection, "failed", told(error, f"{type(error).__name__}: {error}"))


def _send_last(connection: Connection, message: str, value: str) -> None:
    """Says why the process ends, if anybody is left to hear it."""
    with contextlib.suppress(ConnectionError):
        connection.send((message, value))
