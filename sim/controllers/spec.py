"""How a controller is named on a command line: a file, code, or code that adapts a file."""

import hashlib
import importlib.util
import re
import sys
import sysconfig
import tomllib
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from sim.files.provenance import ROOMS, ROOT
from sim.robots.robot import RobotCfg, robot_identity

SHIPPED = "shipped"  # name of the controller that comes with the robot
_NAMED = re.compile(r"(?P<module>[A-Za-z_][\w.]*|.+\.py):(?P<name>[A-Za-z_][\w.]*)(?:@(?P<file>.+))?", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class ControllerSpec:
    """``file``, ``module:callable`` or ``module:adapter@file``; a Python file may stand for the module."""

    module: str | None = None  # module, or file whose name ends in .py; None if no code is named
    name: str | None = None  # name of the callable in it
    file: str | None = None

    @classmethod
    def parse(cls, spec: str | Path) -> "ControllerSpec":
        """Splits a name into its parts; the name of an existing file is that file."""
        match = None if Path(spec).exists() else _NAMED.fullmatch(str(spec))
        return cls(file=str(spec)) if match is None else cls(**match.groupdict())

    def __str__(self) -> str:
        return "@".join(filter(None, (self.module and f"{self.module}:{self.name}", self.file)))

    @property
    def runs_code(self) -> bool:
        """Whether loading it runs Python."""
        return self.module is not None

    @property
    def label(self) -> str:
        """The name without folders."""
        return str(self.in_folder(Path()))

    @property
    def files(self) -> tuple[Path, ...]:
        """The Python file, the controller's file, and the files of its network, if any."""
        code = [Path(self.module)] if self.module is not None and self.module.endswith(".py") else []
        files = [Path(self.file)] if self.file is not None else []
        if self.file is not None and files[0].suffix == ".toml":
            files += filter(None, (weights_file(files[0], key) for key in ("policy", "encoder")))
        return (*code, *files, *filter(None, [find(file) for file in files for find in (agent_file, data_file)]))

    def in_folder(self, folder: Path) -> "ControllerSpec":
        """The same with its files in another folder."""
        files = [name and str(folder / Path(name).name) for name in (self.module, self.file)]
        is_file = self.module is not None and self.module.endswith(".py")
        return replace(self, module=files[0] if is_file else self.module, file=files[1])


def weights_file(path: Path, key: str = "policy") -> Path | None:
    """File of the weights that a description names, or of that name beside it; None if it cannot be read."""
    try:
        policy = path.parent / tomllib.loads(path.read_text(encoding="utf-8"))[key]
        neighbour = path.parent / policy.name
        return neighbour if neighbour.is_file() and not policy.is_file() else policy
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def agent_file(weights: Path) -> Path | None:
    """The agent.yaml of the training that wrote a .pt file, if it is there."""
    files = (weights.parent / "agent.yaml", weights.parent / "params" / "agent.yaml")
    return next((file for file in files if weights.suffix == ".pt" and file.is_file()), None)


def data_file(weights: Path) -> Path | None:
    """The file beside an .onnx file that holds its weights, if it names one."""
    if weights.suffix.lower() == ".onnx":
        from sim.controllers.formats.onnx_data import find_data_file  # onnx takes a moment to load

        with suppress(OSError, ValueError):  # loading it says so
            return find_data_file(weights)
    return None


def resolve_policy(policy: str, robot: RobotCfg) -> str:
    """The controller that a user or a run names, with the robot's file for :data:`SHIPPED`."""
    return str(robot.policy_file) if policy == SHIPPED else policy


def controller_hash(policy: str | Path) -> str | None:
    """SHA-256 of a controller's file, or of all that it names and the callable's name; None if a file is missing."""
    spec = ControllerSpec.parse(policy)
    files = list(spec.files)
    if spec.module is not None and not spec.module.endswith(".py"):
        module = None
        with suppress(ImportError, ValueError):  # no package of that name
            module = importlib.util.find_spec(spec.module)
        files.insert(0, Path((module and module.origin) or ""))
    if not all(file.is_file() for file in files):
        return None
    hashes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    if spec.module is None and len(hashes) == 1:
        return hashes[0]
    return hashlib.sha256(" ".join([str(spec.name), *hashes]).encode()).hexdigest()


def controller_identity(robot: RobotCfg, policy: str | Path) -> dict[str, str | None]:
    """What a record of a robot under a controller names: both, without folders, and their hashes, or None."""
    controller = {"policy": ControllerSpec.parse(policy).label, "policy_sha256": controller_hash(policy)}
    return {"robot": robot.name, **robot_identity(robot), **controller}


_LIBRARIES = [sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib", "purelib", "platlib")]
_FOLDERS_NOT_OF_USERS = [*map(Path, _LIBRARIES), *(ROOT / room for room in ROOMS)]
_ADVICE = re.compile(
    r"(?s)Weights only load failed.*(trusted source\.|WeightsUnpickler error: )|\. (Please use `torch|This is an int).*"
)  # advice of torch about any file that it refuses: to load it as code, or that it is damaged


def in_one_line(error: BaseException) -> str:
    """Type of an error, the first line of its text, and the innermost line of the user's code in its traceback."""
    lines = _ADVICE.sub("", str(error)).strip().splitlines()
    first = -1 if lines and lines[0].startswith("The following operation failed") else 0  # TorchScript's trace
    text = ": ".join([type(error).__name__, *lines[first:][:1]]).rstrip(".")
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename)
        if not file.name.startswith("<") and not any(map(file.is_relative_to, _FOLDERS_NOT_OF_USERS)):
            return f"{text} ({file}, line {frame.lineno})"
    return text


def run_file(path: Path) -> ModuleType:
    """Runs a Python file as a module, as it is now; it can import its neighbours."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    path = path.resolve()
    name = f"faultline_file_{hashlib.sha256(str(path).encode()).hexdigest()[:16]}"
    module = ModuleType(name)
    module.__file__ = str(path)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # last: a neighbour must not stand in for an installed package
    importlib.invalidate_caches()
    sys.modules[name] = module
    try:
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)  # no .pyc that an edit could outrun
    except (Exception, SystemExit) as error:  # a file can fail with anything
        del sys.modules[name]
        raise ValueError(f"{path} fails: {in_one_line(error)}") from error
    return module


def import_object(module: str, name: str) -> Any:
    """The object called ``name``, with dots into classes, of a module or .py file, which may raise any error."""
    target: Any = run_file(Path(module)) if module.endswith(".py") else importlib.import_module(module)
    for attribute in name.split("."):
        if not hasattr(target, attribute):
            raise AttributeError(f"it has no '{name}', only {', '.join(k for k in vars(target) if k[0] != '_')}")
        target = getattr(target, attribute)
    return target


def describe_controllers(controllers: Mapping[str, str], robot: RobotCfg) -> dict[str, dict[str, str | None]]:
    """Policy, or ``shipped``, and hash of each controller by its name, as files of results have them."""
    shipped = [name for name, policy in controllers.items() if is_same_controller(policy, str(robot.policy_file))]
    labels = {**controllers, **dict.fromkeys(shipped, SHIPPED)}
    return {name: {"policy": labels[name], "sha256": controller_hash(controllers[name])} for name in controllers}


def parse_controllers(policies: Sequence[str], robot: RobotCfg, *, flag: str = "policies") -> dict[str, str]:
    """Policy of each controller by its name, of texts of ``NAME=POLICY``; the robot's as ``base`` without any."""
    text = " ".join(policies).strip() or f"base={SHIPPED}"
    controllers: dict[str, str] = {}
    for item in re.split(r"\s+(?=[^\s=]+=)", text):  # a file's name may hold spaces: split where the next name is
        name, _, policy = item.partition("=")
        if not re.fullmatch(r"[\w.+@-]+", name) or not policy:
            must = "NAME=FILE each, the name of letters, digits and . _ + @ -"
            raise ValueError(f"{flag} must be {must}, got '{item}': write for example C-G=runs/tuned/policy.pt")
        if name in controllers:
            raise ValueError(f"{flag} must have different names, got '{name}' twice: rename one of them")
        controllers[name] = resolve_policy(policy, robot)
    return controllers


def label_suffix(policy: str) -> str:
    """The ending of the names of files about a controller that is not the shipped one, for example ``-C-G``."""
    if Path(policy).name == "controller.toml":  # as all descriptions are called
        policy = Path(policy).resolve().parent.name
    label = re.sub(r"\.(pt|onnx|toml)$", "", ControllerSpec.parse(policy).label)
    return "-" + re.sub(r"[^A-Za-z0-9_.-]+", "-", label)


def crosser_name(robot: RobotCfg, policy: str) -> str:
    """How names of files about a robot and its controller begin: the robot, and its controller unless it is shipped."""
    return robot.name + ("" if is_same_controller(policy, str(robot.policy_file)) else label_suffix(policy))


def is_same_controller(policy: str, other: str) -> bool:
    """Whether two policies are the same controller, by name or by the hash of its files."""
    digest = controller_hash(policy)
    return policy == other or (digest is not None and digest == controller_hash(other))
