"""What to type next: commands that go on with a run or look at it again, as the Makefile takes them."""

import shlex
from pathlib import Path
from typing import Protocol


class Placed(Protocol):
    """The arguments that say where a command works."""

    @property
    def device(self) -> str | None:
        """Warp device name."""

    @property
    def workers(self) -> str | None:
        """Who works."""
        ...


def make_command(target: str, **variables: str | int | Path | None) -> str:
    """A command as one types it: ``make replay ROBOT=anymal RUN=runs/x ELITE=0``.

    Args:
        target: Of the Makefile.
        variables: Its variables by their names in small letters; None is left out.
    """
    given = [(name.upper(), str(value)) for name, value in variables.items() if value is not None]
    return " ".join([f"make {target}", *(f"{name}={_quoted(value)}" for name, value in given)])


def next_command(target: str, args: Placed, **variables: str | int | Path | None) -> str:
    """A command that works where another one worked: ``make archive RESUME=runs/x DEVICE=cpu``.

    Args:
        target: Of the Makefile.
        args: Where the other one worked; what is not as by default is handed on.
        variables: As of :func:`make_command`.
    """
    return make_command(
        target,
        **variables,
        device=args.device,
        workers=args.workers,
    )


def _quoted(value: str) -> str:
    """A value as make gets it through the shell; make takes a lone dollar for a variable of its own."""
    return shlex.quote(value.replace("$", "$$"))
