"""How commands begin and end: words of their arguments; an exit code, a line for what can be mended, a results file."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sim.files import prepare_output, to_json, write_atomically

_ALL = "all"


def split_words(values: Sequence[str]) -> list[str]:
    """Words of arguments of which make hands over several in one, apart by spaces or commas."""
    return " ".join(values).replace(",", " ").split()


def chosen_elites(text: str, count: int, whose: object) -> list[int]:
    """Numbers of elites, as a command line names them.

    Args:
        text: Numbers apart by spaces or commas, or ``all``.
        count: How many elites there are.
        whose: What they are of, for the message.

    Raises:
        ValueError: If it is something else, or there is no such elite.
    """
    words = split_words([text])
    known = dict.fromkeys(map(str, range(count)))
    if words == [_ALL]:
        words = list(known)
    unknown = [word for word in words if word not in known]
    if unknown or not words:
        valid = f"expected {_ALL}, or numbers of 0 to {count - 1}" if count else "the archive is empty"
        raise ValueError(f"{whose} has no elite {', '.join(unknown) or repr(text)}: {valid}")
    return [int(word) for word in dict.fromkeys(words)]


def exit_code_of(
    command: Callable[[], int], *, stopped: str = "Stopped.", also: tuple[type[Exception], ...] = ()
) -> int:
    """Runs a command.

    Args:
        command: Returns its exit code.
        stopped: What Ctrl-C makes it say.
        also: Errors of other rooms that end it in a line too.

    Returns:
        That code; 2 for anything a user can mend (ValueError, OSError, FloatingPointError) and 130 for Ctrl-C, after a
        line on stderr.
    """
    try:
        return command()
    except (ValueError, OSError, FloatingPointError, *also) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\n{stopped}", file=sys.stderr)
        return 130


def publish(
    out: Path | None, measure: Callable[[], dict[str, Any]], show: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Measures, shows and writes a report, which is returned; where to write is tried before the work.

    Args:
        out: File to write; None for none.
        measure: Makes the report.
        show: Prints it.

    Raises:
        ValueError: If the file cannot be written to.
    """
    if out is not None:
        prepare_output(out)
    report = measure()
    show(report)
    if out is not None:
        write_atomically(out, to_json(report))
        print(f"written to {out}")
    return report


def show_json(report: dict[str, Any]) -> None:
    """Prints a report as its file has it."""
    print(to_json(report).decode())
