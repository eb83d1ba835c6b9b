"""One process that evaluates terrains for another, and dies with it."""

import contextlib
import gc
import multiprocessing
import queue
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.resource_tracker import ensure_running
from typing import Any

from sim.files.command import UserError, with_traceback

CONTEXT: Any = multiprocessing.get_context("spawn")
"""How processes begin: a fork of one with threads and CUDA may hang."""


class EvaluatorError(UserError):
    """The evaluation cannot go on; what was saved before is whole."""


class WorkerProcess:
    """A process with a simulation, which ``build``, a module-level function, makes there for ``num_terrains``."""

    def __init__(self, num_terrains: int, build: Callable[[Any, int], Any], cfg: Any) -> None:
        self.connection, theirs = CONTEXT.Pipe()
        self._process = CONTEXT.Process(target=_serve, args=(theirs, cfg, num_terrains, build), daemon=True)
        # A blocked signal stays blocked in the child: Ctrl-C reaches the whole group, and the parent ends its workers.
        ensure_running()  # else the first start begins the tracker, which unblocks the signal again on Python 3.11
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()  # so that its death ends the stream here

    def send(self, *task: Any) -> None:
        """Hands out a task, such as terrains, behind those handed out before; raises what :meth:`receive` does."""
        try:
            self.connection.send(task)
        except OSError:
            while True:  # behind its last results it may have said why it ended
                self.receive()

    def receive(self) -> tuple[str, Any]:
        """The next message: ``ready``, ``progress`` or ``result``, and its value; raises what ended the worker."""
        try:
            message, value = self.connection.recv()
        except (EOFError, OSError):
            self._process.join(timeout=5)
            code = self._process.exitcode
            reason = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
            why = "out of memory?" if code == -signal.SIGKILL else "a crash in compiled code, of a controller's perhaps"
            raise EvaluatorError(f"a worker process died ({reason}): {why}") from None
        if message == "refused":
            raise ValueError(value)
        if message == "failed":
            raise EvaluatorError(f"a worker process failed: {value}")
        return message, value

    def stop(self) -> None:
        """Ends the process, whatever it does."""
        self._process.terminate()
        self._process.join(timeout=5)
        if self._process.is_alive():
            self._process.kill()
        self.connection.close()


def _serve(connection: Connection, cfg: Any, num_terrains: int, build: Callable[[Any, int], Any]) -> None:
    """A worker's life: build, then evaluate until the other end closes."""
    inbox: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
    under_way = 0

    def put_in() -> None:
        nonlocal under_way
        while not under_way or not inbox.empty():
            if (lot := inbox.get()) is None:
                raise EOFError
            crosser.put(*lot)
            under_way += 1

    def report(share: float) -> None:
        put_in()
        connection.send(("progress", share))

    try:
        gc.disable()  # else it takes a third of the time in which Warp and Newton load
        crosser = build(cfg, num_terrains)
        gc.freeze()
        gc.enable()
        connection.send(("ready", None))
        threading.Thread(target=_read, args=(connection, inbox), daemon=True).start()
        while True:
            put_in()
            result = crosser.take(report)
            under_way -= 1
            connection.send(("result", result))
    except (EOFError, ConnectionError):  # the other end is gone: closed, or killed with unread messages
        sys.exit(0)
    except Exception as error:
        refused = isinstance(error, ValueError)
        text = with_traceback(error, str(error) if refused else f"{type(error).__name__}: {error}")
        with contextlib.suppress(ConnectionError):  # nobody may be left to hear it
            connection.send(("refused" if refused else "failed", text))


def _read(connection: Connection, inbox: "queue.SimpleQueue[tuple[Any, ...] | None]") -> None:
    """Takes in what is handed out while the worker crosses terrains, so that nobody waits for it to be read."""
    try:
        while True:
            inbox.put(connection.recv())
    except (EOFError, OSError):
        pass  # the other end is gone
    finally:  # after any failure, or the worker would wait for ever, and the other end for it
        inbox.put(None)
