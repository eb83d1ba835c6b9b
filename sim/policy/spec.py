"""How a controller is named on a command line: a file, code, or code that adapts a file."""

import hashlib
import importlib
import importlib.util
import inspect
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

SHIPPED = "shipped"
"""Name of the controller that comes with the robot."""
_NAMED = re.compile(r"(?P<place>[A-Za-z_][\w.]*|.+\.py):(?P<name>[A-Za-z_][\w.]*)(?:@(?P<file>.+))?", re.DOTALL)


class RobotWithController(Protocol):
    """What the names of controllers take of a robot's settings."""

    @property
    def name(self) -> str:
        """What files are called after it."""
        ...

    @property
    def policy_file(self) -> Path:
        """The controller that comes with it."""
        ...


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
        """Splits a name into its parts; the name of an existing file is that file."""
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


def spec_of(policy: str, robot: RobotWithController) -> str:
    """What to load a controller from that a user or a run names, :data:`SHIPPED` among them."""
    return str(robot.policy_file) if policy == SHIPPED else policy


def name_of(policy: str | Path, robot: RobotWithController) -> str:
    """How files of results and settings name a controller, the inverse of :func:`spec_of`.

    The robot's own is :data:`SHIPPED` there, since its file lies elsewhere on each machine.
    """
    return SHIPPED if is_same(str(policy), str(robot.policy_file)) else str(policy)


def controller_hash(policy: str | Path) -> str | None:
    """SHA-256 of a controller: of its file, or of the code's file, the controller's and the callable's name.

    What code reads beside its own file is not in it.

    Returns:
        None if a file is missing, or the code of a module has none.
    """
    spec = ControllerSpec.parse(policy)
    files = list(spec.files)
    if spec.place is not None and not spec.place.endswith(".py"):
        files.insert(0, Path(_origin_of(spec.place)))
    if not all(file.is_file() for file in files):
        return None
    hashes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    if spec.place is None:
        return hashes[0]
    return hashlib.sha256(" ".join([str(spec.name), *hashes]).encode()).hexdigest()


def _origin_of(module: str) -> str:
    """File of a module; empty if there is no such module."""
    try:
        found = importlib.util.find_spec(module)
    except (ImportError, ValueError):  # no package of that name
        found = None
    return "" if found is None or found.origin is None else found.origin


_ROOT = Path(__file__).resolve().parents[2]
_NOT_THEIRS = (
    *(_ROOT / room for room in ("kernels", "sim", "qd", "train")),
    *(Path(sysconfig.get_path(kind)) for kind in ("stdlib", "platstdlib", "purelib", "platlib")),
)


def in_one_line(error: BaseException, code: Any = None) -> str:
    """Kind of an error, the first line of what it says, and the line of the user's code that it comes from.

    Args:
        error: What was raised.
        code: The function or class that was called; it is named if the error came before its first line.
    """
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = ": ".join([type(error).__name__, *lines[:1]])
    if isinstance(error, SyntaxError):  # which says file and line itself
        return f"{text}: `{error.text.strip()}`" if error.text else text
    return f"{text}{_place_of(error) or place_of_code(code)}"


def _place_of(error: BaseException) -> str:
    """The innermost line of a traceback that is neither the project's nor an installed package's, in brackets."""
    theirs = [
        (frame.filename, frame.lineno)
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith("<") and not _is_installed(Path(frame.filename))
    ]
    return f" ({_short(theirs[-1][0])}, line {theirs[-1][1]})" if theirs else ""


def _is_installed(file: Path) -> bool:
    return any(file.is_relative_to(folder) for folder in _NOT_THEIRS)


def _short(file: str) -> str:
    """A path from the working directory, if it lies below."""
    path = Path(file)
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def place_of_code(code: Any) -> str:
    """File and line of a function or class, in brackets; empty if it has none."""
    try:
        return f" ({_short(inspect.getfile(code))}, line {inspect.getsourcelines(code)[1]})"
    except (TypeError, OSError):
        return ""


def run_file(path: Path) -> ModuleType:
    """Runs a Python file as a module of its own, as it is now; its neighbours can be imported from it.

    Raises:
        ValueError: If there is no such file, or it fails.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    path = path.resolve()
    name = f"faultline_file_{hashlib.sha256(str(path).encode()).hexdigest()[:16]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is no Python file: expected a name that ends in .py")
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # last: a neighbour must not stand in for an installed package
    importlib.invalidate_caches()
    sys.modules[name] = module
    try:
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)  # no .pyc that an edit could outrun
    except (Exception, SystemExit) as error:  # a file can fail with anything
        del sys.modules[name]
        raise ValueError(f"{path} fails: {in_one_line(error)}{_commas(error, path)}") from error
    return module


def _commas(error: BaseException, path: Path) -> str:
    """Where a file that is no Python may have a comma in place of a decimal point."""
    lines = path.read_text(errors="replace").splitlines() if isinstance(error, SyntaxError) else []
    found = [str(number) for number, line in enumerate(lines, 1) if re.search(r"=\s*[-+]?\d+,\d", line)]
    return f"; is the comma in line {', '.join(found)} a decimal point?" if found else ""


def find_named(place: str, name: str) -> Any:
    """What a module or a Python file calls ``name``.

    Args:
        place: An importable module, or a file whose name ends in .py.
        name: Dots reach into classes.

    Raises:
        Exception: Anything, if it cannot be run or has no such name.
    """
    found: Any = run_file(Path(place)) if place.endswith(".py") else importlib.import_module(place)
    for part in name.split("."):
        if not hasattr(found, part):
            raise AttributeError(f"it has no '{name}', only {', '.join(k for k in vars(found) if k[0] != '_')}")
        found = getattr(found, part)
    return found


MARK = "@"
"""Between the kind of a controller and its seed: C-G, C-G@1 and C-G@2 are of kind C-G."""


def kind_of(name: str) -> str:
    """The kind of a controller by its name."""
    return name.split(MARK)[0]


def firsts(names: Iterable[str]) -> list[str]:
    """The first controller of each kind, in order."""
    found: dict[str, str] = {}
    for name in names:
        found.setdefault(kind_of(name), name)
    return list(found.values())


def about_controllers(controllers: Mapping[str, str], robot: RobotWithController) -> dict[str, dict[str, str | None]]:
    """Policy and hash of each controller by its name, as files of results have them; ``shipped`` is the robot's own.

    Args:
        controllers: Policy of each by its name.
        robot: The robot.
    """
    return {
        who: {"policy": name_of(policy, robot), "sha256": controller_hash(policy)}
        for who, policy in controllers.items()
    }


def controllers_of(policies: Sequence[str], robot: RobotWithController, *, flag: str = "policies") -> dict[str, str]:
    """Policy of each controller by its name, in the order given; the shipped one as ``base`` if there is none.

    Args:
        policies: ``NAME=FILE``, ``NAME=module:callable`` or ``NAME=shipped``; one text may hold several, separated
            by spaces.
        robot: The robot, whose controller is the shipped one.
        flag: The flag that names them, for errors.

    Raises:
        ValueError: If one has no name, or two have the same.
    """
    text = " ".join(policies).strip() or f"base={SHIPPED}"
    found: dict[str, str] = {}
    for item in re.split(r"\s+(?=[^\s=]+=)", text):  # a file's name may hold spaces: split where the next name is
        name, _, policy = item.partition("=")
        if not re.fullmatch(r"[\w.+@-]+", name) or not policy:
            raise ValueError(
                f"{flag} must be NAME=FILE each, the name of letters, digits and . _ + @ -, got '{item}': "
                "write for example C-G=runs/tuned/policy.pt"
            )
        if name in found:
            raise ValueError(f"{flag} must have different names, got '{name}' twice: rename one of them")
        found[name] = spec_of(policy, robot)
    return found


def named_file(text: str) -> str:
    """``NAME=FILE`` of a controller that is named so, or by its file alone, whose name it then has."""
    if re.match(r"[\w.+@-]+=", text):
        return text
    return f"{Path(ControllerSpec.parse(text).label).stem}={text}"


def certifier_hash(name: str, policy: str) -> str:
    """SHA-256 of a certifier, which its certificates name.

    Raises:
        ValueError: If it has none.
    """
    digest = controller_hash(policy)
    if digest is None:
        raise ValueError(
            f"certifier {name} must have a file, which its certificates name by hash, got {policy}: give a file"
        )
    return digest


def label_suffix(policy: str) -> str:
    """The ending of the names of files about a controller that is not the usual one, for example ``-C-G``."""
    label = ControllerSpec.parse(policy).label.removesuffix(".pt").removesuffix(".onnx")
    return "-" + re.sub(r"[^A-Za-z0-9_.-]+", "-", label)


def who_crossed(robot: RobotWithController, policy: str) -> str:
    """What files about a robot and its controller are called: by its name, and by the controller if not the shipped."""
    return robot.name + ("" if is_same(policy, str(robot.policy_file)) else label_suffix(policy))


def is_same(policy: str, other: str) -> bool:
    """Whether two names are of the same controller, by name or by its files."""
    digest = controller_hash(policy)
    return policy == other or (digest is not None and digest == controller_hash(other))
