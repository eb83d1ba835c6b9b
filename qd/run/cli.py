"""How every command of this room starts and fails: with one line on stderr for what a user can mend, no traceback."""

import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import NoReturn, TypeVar

import tyro

from qd.workers.process import EvaluatorError
from sim.files.command import Interrupted, naming_what_is_next  # noqa: F401

_DEBUG = "FAULTLINE_DEBUG"

Arguments = TypeVar("Arguments")


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
