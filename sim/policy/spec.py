"""How a controller is named on a command line: a file, code, or code that adapts a file."""

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

SHIPPED = "shipped"
"""Name of the controller that comes with the robot."""
_NAMED = re.compile(
    r"(?P<place>[A-Za-z_][\w.]*|.+\.py):(?P<name>[A-Za-z_][\w.]*)(?:@(?P<file>.+))?",
    re.DOTALL,
)


@dataclass(frozen=True, kw_only=True)
class ControllerSpec:
    """``file``, ``module:callable`` or ``module:adapter@file``; a Python file may stand for the module."""

    place: str | None = None
    """Module, or file whose name ends in .py; None if no code is named."""
    name: str | None = None
    """What to take of it."""
    file: str | None = None
    """The controller's file, if any."""

    @classmethod
    def parse(cls, spec: str | Path) -> "ControllerSpec":
        """Takes a name apart; anything that is there as a file is a file."""
        match = _NAMED.fullmatch(str(spec))
        if match is None or Path(spec).exists():
            return cls(file=str(spec))
        return cls(**match.groupdict())

    def __str__(self) -> str:
        if self.place is None:
            return str(self.file)
        return f"{self.place}:{self.name}" + ("" if self.file is None else f"@{self.file}")

    @property
    def runs_code(self) -> bool:
        """Whether loading it runs Python."""
        return self.place is not None

    @property
    def label(self) -> str:
        """The name without folders."""
        return str(self.in_folder(Path()))

    @property
    def files(self) -> tuple[Path, ...]:
        """The Python file and the controller's file, as far as there are such."""
        code = self.place if self.place is not None and self.place.endswith(".py") else None
        return tuple(Path(file) for file in (code, self.file) if file is not None)

    def in_folder(self, folder: Path) -> "ControllerSpec":
        """The same with its files in another folder."""
        place, file = self.place, self.file
        if place is not None and place.endswith(".py"):
            place = str(folder / Path(place).name)
        return ControllerSpec(place=place, name=self.name, file=file and str(folder / Path(file).name))

    def digest(self) -> str | None:
        """SHA-256 of the file, or of all files and the callable's name; None without files, or if one is missing.

        The code of an importable module is not in it.
        """
        if not self.files or not all(file.is_file() for file in self.files):
            return None
        hashes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in self.files]
        if self.place is None:
            return hashes[0]
        return hashlib.sha256(" ".join([str(self.name), *hashes]).encode()).hexdigest()


def spec_of(policy: str, robot: "RobotCfg") -> str:
    """What to load a controller from that a user or a run names, :data:`SHIPPED` among them."""
    return str(robot.policy_file) if policy == SHIPPED else policy
