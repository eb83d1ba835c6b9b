"""What a line makes ``make`` run, without running it."""

import os
import shlex
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]


def run_by(line: str) -> list[str]:
    """The last command that a line typed into a shell makes ``make`` run, word by word.

    The line runs without the environment: a ``make`` that runs the tests would hand on its own flags, and with them
    lines about directories it enters and leaves.
    """
    done = subprocess.run(
        ["sh", "-c", f"{line} --dry-run"],
        env={"PATH": os.environ["PATH"]},
        cwd=ROOT, capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    return shlex.split(done.stdout.splitlines()[-1])
