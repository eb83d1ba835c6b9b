"""How every command of this room starts and fails: with one line on stderr for what a user can mend, no traceback."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn, TypeVar

import tyro

from qd.workers.process import EvaluatorError

_DEBUG = "FAULTLINE_DEBUG"

Arguments = TypeVar("Arguments")


class Interrupted(KeyboardInterrupt):
    """The program was asked to stop; what it says next, such as how to resume, is its text."""


@contextmanager
def naming_what_is_next(state: str, command: Callable[[], str]) -> Iterator[None]:
    """Ends work that is stopped or fails half way with what there is and how to go on.

    Args:
        state: What is saved, after ``Stopped;``.
        command: Says what to do next, once it is known.

    Raises:
        Interrupted: On Ctrl-C.
        EvaluatorError: If a worker is lost.
        OSError: If a file cannot be written.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(f"Stopped; {state}. {command()}") from None
    except (EvaluatorError, OSError) as error:
        raise type(error)(f"{error}. {command()}") from None


def run_command(arguments: type[Arguments], main: Callable[[Arguments], object], argv: list[str] | None = None) -> None:
    """Parses the command line and runs a command.

    Ctrl-C and SIGTERM end it with exit code 130; anything a user can mend (ValueError, OSError, a lost worker) with one
    line and exit code 2. FAULTLINE_DEBUG=1 shows the traceback instead.

    Args:
        arguments: Dataclass of the arguments; its docstring is the help.
        main: The command.
        argv: Arguments, those of the process by default.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    parsed = tyro.cli(arguments, args=argv)
    try:
        main(parsed)
    except (ValueError, OSError, EvaluatorError) as error:
        if os.environ.get(_DEBUG):
            raise
        print(f"error: {' '.join(filter(None, map(str.strip, str(error).splitlines())))}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        print(f"\n{stop}" if isinstance(stop, Interrupted) else "\nStopped.", file=sys.stderr)
        sys.exit(130)


def _interrupt(signum: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
