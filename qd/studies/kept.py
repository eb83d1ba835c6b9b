"""What long work has crossed so far, in a file, so that the same command goes on where it was stopped."""

import hashlib
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim.files.atomic import write_atomically
from sim.files.npz import array_names, read_arrays
from sim.files.provenance import code_fingerprint
from sim.policy.spec import controller_hash
from sim.robots.identity import robot_identity

if TYPE_CHECKING:
    from qd.workers.evaluator import EvaluatorCfg
    from sim.robots.robot import RobotCfg

_KEY = "key"


class Kept:
    """Arrays in a file beside the one that they are for; they are read again only by work that crosses the same way.

    Args:
        out: The file that they are for; theirs is named ``<its name>.part.npz``.
        robot: The robot.
        evaluator: What crosses.
        drawn: What the terrains were drawn by, as JSON values.
    """

    def __init__(self, out: Path, robot: "RobotCfg", evaluator: "EvaluatorCfg", drawn: list[Any]) -> None:
        from sim.space import space_identity  # which imports Warp: not for `--help`

        self.file = out.with_name(f"{out.stem}.part.npz")
        controller = controller_hash(evaluator.policy)
        way = [robot_identity(robot), controller, space_identity(evaluator.space), evaluator.num_replicas, *drawn]
        way += [evaluator.device.startswith("cuda"), code_fingerprint(("kernels", "sim")), *robot.penalties]
        self._key = None if controller is None else hashlib.sha256(json.dumps(way).encode()).hexdigest()

    @property
    def state(self) -> str:
        """What is kept, in words."""
        where = f"what is crossed is kept in {self.file}"
        return where if self._key else "nothing is kept, since the controller's code has no file"

    def read(self) -> dict[str, NDArray[Any]]:
        """The arrays by name; none if the file is missing, damaged or of something else."""
        try:
            content = read_arrays(self.file, array_names(self.file))
        except Exception:  # zip, zlib and npy headers answer damage with a dozen types
            return {}
        return content if str(content.pop(_KEY, "")) == self._key else {}

    def write(self, **arrays: NDArray[Any]) -> None:
        """Keeps arrays in place of those before.

        Raises:
            OSError: If they cannot be written.
        """
        if self._key is not None:
            buffer = io.BytesIO()
            np.savez(buffer, key=self._key, **arrays)  # pyright: ignore[reportArgumentType] - a text is an array too
            write_atomically(self.file, buffer.getvalue())

    def remove(self) -> None:
        """Removes the file, once the work is done."""
        self.file.unlink(missing_ok=True)
