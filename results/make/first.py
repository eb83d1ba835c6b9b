"""What the README's two commands take on a fresh machine without a GPU, and what the first finds: first.json.

A clone of this commit gets an environment and a cache of kernels of its own. Nothing else should run meanwhile.
"""

import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qd.search.archive import read_archive
from qd.search.fitness import FAILING_GOAL_RATE
from results.make.common import parse

ROOT = Path(__file__).resolve().parents[2]


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Times the installation, the rest of the first command, and the second; a trial leaves that out."""
    script = parse(__doc__, argv, "first.json")
    name, numbers = script.robot.name, dict[str, Any]()
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "faultline"
        subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
        environment = {**os.environ, "WARP_CACHE_PATH": f"{folder}/kernels", "CUDA_VISIBLE_DEVICES": ""}
        short = ["ARGS=--iterations 1"] if script.small else []
        targets = {"install": [".venv/.search-done"], "archive": ["archive", f"ROBOT={name}", *short]}
        for target, words in (targets if script.small else targets | {"test": ["test"]}).items():
            began = time.perf_counter()
            subprocess.run(["make", "-C", clone, *words], env=environment, check=True)
            numbers[f"{target}_s"] = time.perf_counter() - began
        archive = read_archive(clone / f"runs/{name}-small-0")
    failing = int((archive.goal_rate < FAILING_GOAL_RATE).sum())
    return script.write({**numbers, "elites": len(archive), "failing_as_found": failing})


if __name__ == "__main__":
    main()
