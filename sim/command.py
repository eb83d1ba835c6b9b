"""How every command of sim and train ends: an exit code, and one line on stderr for what a user can mend."""

import sys
from collections.abc import Callable


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
