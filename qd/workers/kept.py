"""What long work has crossed so far, in a file, so that the same command goes on where it was stopped."""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim.files.atomic import write_atomically
from sim.files.npz import array_names, npz_bytes, read_arrays
from sim.files.records import code_fingerprint, robot_identity
from sim.policy.spec import controller_hash

if TYPE_CHECKING:
    from qd.workers.evaluator import EvaluatorCfg

_KEY = "key"


def key_of(evaluator: "EvaluatorCfg", drawn: list[Any]) -> str | None:
    """The hash of all that the results of crossings depend on.

    Crossings of a CPU and of a GPU differ in their last bits, so the kind of device counts.

    Args:
        evaluator: What crosses.
        drawn: What the terrains and their seeds are, or were drawn by, as JSON values.

    Returns:
        None if nobody can tell whether the controller has changed, since its code has no file.
    """
    from sim.robots.find import get_robot
    from sim.spaces.registry import get_space, identity

    controller = controller_hash(evaluator.policy)
    if controller is None:
        return None
    robot = get_robot(evaluator.robot)
    space = identity(evaluator.space, get_space(evaluator.space).sha256)
    way = [robot_identity(robot), robot.penalties, controller, space]
    way += [evaluator.num_replicas, evaluator.device.startswith("cuda"), evaluator.resolved]
    way += [evaluator.reward, evaluator.penalties_from_s, code_fingerprint(("kernels", "sim"))]
    return hashlib.sha256(json.dumps([*way, *drawn]).encode()).hexdigest()


class Kept:
    """Arrays in a file. Only work that crosses the same way reads them again.

    Args:
        file: The file.
        key: Of :func:`key_of`; with None nothing is kept.
    """

    def __init__(self, file: Path, key: str | None) -> None:
        self.file, self._key = file, key

    @classmethod
    def beside(cls, out: Path, evaluator: "EvaluatorCfg", drawn: list[Any]) -> "Kept":
        """What is kept until a result is written; its file is named ``<name of the result>.part.npz``.

        Args:
            out: File of the result.
            evaluator: As of :func:`key_of`.
            drawn: Likewise.
        """
        return cls(out.with_name(f"{out.stem}.part.npz"), key_of(evaluator, drawn))

    @property
    def state(self) -> str:
        """What is kept, in words."""
        where = f"what is crossed is kept in {self.file}"
        return where if self._key else "nothing is kept, since the controller's code has no file"

    def read(self) -> dict[str, NDArray[Any]]:
        """The arrays by name; none if the file is missing, damaged (which it prints), or of something else."""
        if not self.file.is_file():
            return {}
        try:
            content = read_arrays(self.file, array_names(self.file))
        except Exception as error:  # zip, zlib and npy headers answer damage with a dozen types
            return self.damaged(error)
        return content if str(content.pop(_KEY, "")) == self._mark(content) else {}

    def _mark(self, names: Iterable[str]) -> str:
        """What the file carries: the key, and all names, of which damage may have taken one away."""
        return " ".join([str(self._key), *sorted(names)])

    def damaged(self, why: object) -> dict[str, NDArray[Any]]:
        """Says that the file is damaged, and returns no arrays."""
        print(f"{self.file} is damaged ({' '.join(str(why).split())}): its terrains are crossed again", flush=True)
        return {}

    def write(self, **arrays: NDArray[Any]) -> None:
        """Keeps arrays in place of those before; makes the folder if need be.

        Raises:
            OSError: If they cannot be written.
        """
        if self._key is not None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self.file, npz_bytes({_KEY: np.array(self._mark(arrays)), **arrays}))

    def remove(self) -> None:
        """Removes the file, once the work is done."""
        self.file.unlink(missing_ok=True)
