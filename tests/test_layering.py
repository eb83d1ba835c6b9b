"""The shape of the house: which room may import what, and how long a file may be."""

import ast
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("kernels", "sim", "qd", "train")  # a room may import itself and the rooms before it
QD_DOORS_FOR_TRAIN = ("search", "judge", "faults", "archive", "groups", "evaluate", "run", "workers", "fitness")
MAX_HIDDEN = 250
"""Imports inside functions and TYPE_CHECKING blocks over all rooms: commands load lazily, hardly anything else does."""
LIBRARY_DOORS = {  # a room, or a folder of one
    "warp": ("kernels", "sim"),
    "newton": ("sim",),
    "mujoco": ("sim",),
    "mujoco_warp": ("sim",),
    "ribs": ("qd",),
    "rsl_rl": ("train",),
    "PIL": ("sim", "qd"),
    "imageio_ffmpeg": ("qd",),
    "torch": ("sim", "train", "qd/search/surrogate"),
    "onnx": ("sim", "train"),
    "onnxruntime": ("sim",),
    "viser": ("qd/show/view",),
}
MAX_LINES = 500
FILES = [path.relative_to(ROOT) for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]


def imported_names(path: Path, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything imported anywhere in a file, inside functions and by name too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = path.parent.parts[: len(path.parent.parts) - node.level + 1] if node.level else ()
            module = ".".join((*package, *filter(None, [node.module])))
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", None)
            if function in ("import_module", "__import__"):
                yield node.lineno, str(node.args[0].value)


def offences_of(path: Path, source: str) -> list[str]:
    """What a file of a room does that the house forbids, one line each."""
    room = path.parts[0]
    offences = []
    for line, name in imported_names(path, ast.parse(source)):
        top, _, rest = name.partition(".")
        if top in ROOMS and ROOMS.index(top) > ROOMS.index(room):
            offences.append(f"{path}:{line}: {room} may not import {name}: imports point {' <- '.join(ROOMS)}")
        elif room == "train" and top == "qd" and rest.partition(".")[0] not in QD_DOORS_FOR_TRAIN:
            offences.append(f"{path}:{line}: of qd, train may import only {', '.join(QD_DOORS_FOR_TRAIN)}, not {name}")
        elif path.is_relative_to("sim/files") and top in ROOMS and not name.startswith("sim.files"):
            offences.append(f"{path}:{line}: sim/files may not import {name}: it imports nothing of the rooms")
        elif top == "tests":
            offences.append(f"{path}:{line}: {room} may not import {name}: tests are not shipped")
        elif not any(path.is_relative_to(door) for door in LIBRARY_DOORS.get(top, ROOMS)):
            offences.append(f"{path}:{line}: {room} may not import {name}: only {' and '.join(LIBRARY_DOORS[top])} may")
    lines = len(source.splitlines())
    if lines > MAX_LINES:
        offences.append(f"{path}: {lines} lines, at most {MAX_LINES}: give one of its responsibilities a file")
    return offences


@pytest.mark.parametrize("path", FILES, ids=str)
def test_file_keeps_to_its_room(path):
    assert offences_of(path, (ROOT / path).read_text(encoding="utf-8")) == []


def test_no_modules_import_each_other_in_a_circle():
    """Inside functions too, but for the door to Ray."""
    names = {str(path.with_suffix("")).replace("/", ".").removesuffix(".__init__"): path for path in FILES}
    modules = {}
    for name, path in names.items():
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        imported = {full if full in names else full.rpartition(".")[0] for _, full in imported_names(path, tree)}
        modules[name] = (imported & names.keys()) - {name, "qd.workers.ray_workers"}
    assert {name.partition(".")[0] for name in modules} == set(ROOMS)
    while leaves := {name for name, imported in modules.items() if not imported & modules.keys()}:
        modules = {name: imported for name, imported in modules.items() if name not in leaves}
    while tops := modules.keys() - set().union(*modules.values()):
        modules = {name: imported for name, imported in modules.items() if name not in tops}
    assert sorted(modules) == []


def test_few_imports_are_hidden_and_only_the_registry_loads_commands():
    hidden, offenders = 0, []
    for path in FILES:
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        hidden += sum(isinstance(node, ast.Import | ast.ImportFrom) and node.col_offset > 0 for node in ast.walk(tree))
        offenders += [path for _, name in imported_names(path, tree) if name.split(".")[1:2] == ["commands"]]
        offenders += [path for _, name in imported_names(path, tree) if ".show.commands" in name]
    assert offenders == []
    assert hidden <= MAX_HIDDEN


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("kernels/a.py", "import sim"),
        ("sim/a.py", "def f():\n    from qd.search.archive import read"),
        ("qd/a.py", "import importlib\nimportlib.import_module('train.base')"),
        ("qd/a.py", "__import__('torch')"),
        ("qd/a.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch"),
        ("train/a.py", "from ..qd.show import figures"),
        ("sim/a.py", "from tests.oracles import height"),
        ("sim/files/a.py", "from sim.robots.robot import RobotCfg"),
        ("sim/a.py", "x = 1\n" * 501),
    ],
)
def test_an_offender_is_caught(path, source):
    assert len(offences_of(Path(path), source)) == 1


def test_a_wheel_has_every_file_of_the_rooms():
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    packages = {path.parent.relative_to(ROOT) for room in ROOMS for path in (ROOT / room).rglob("__init__.py")}
    packed = {path.relative_to(ROOT).as_posix() for package in packages for path in (ROOT / package).glob("*.py")}
    for package, patterns in rules.items():
        folders = packages if package == "*" else [Path(*package.split("."))]
        for folder in folders:
            packed |= {p.relative_to(ROOT).as_posix() for rule in patterns for p in (ROOT / folder).glob(rule)}
    tracked = subprocess.run(["git", "ls-files", *ROOMS], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert [file for file in tracked.splitlines() if file not in packed] == []
    assert all((ROOT / room / "py.typed").exists() for room in ROOMS)
