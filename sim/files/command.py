"""What all commands share: option groups, how a command starts and fails, how a result is published.

A command is a frozen dataclass: docstring and fields are its help and flags, ``execute`` imports what loads slowly.
"""

import inspect
import os
import re
import select
import shlex
import signal
import sys
import textwrap
import threading
import time
import traceback
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from shutil import get_terminal_size
from types import FrameType
from typing import Annotated, Any

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.settings import PositiveInt, check_settings


@dataclass(frozen=True, kw_only=True)
class RobotFlag:
    """The option that says which robot."""

    robot: str | None = None
    """Which robot: anymal, cassie, or the file of another (mine/go2/robot.toml, my_robot.py); anymal if left out."""


@dataclass(frozen=True, kw_only=True)
class ControllerFlags(RobotFlag):
    """Options that say which robot, under which controller."""

    policy: str | None = None
    """Controller other than the robot's own: a controller.toml, an rsl_rl checkpoint, a TorchScript or ONNX file,
    file.py:callable, module:callable, or file.py:adapter@FILE for a file that expects another observation."""


@dataclass(frozen=True, kw_only=True)
class DeviceFlag:
    """The option that says on which device a command works."""

    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""


@dataclass(frozen=True, kw_only=True)
class WorkerFlags(DeviceFlag):
    """Options that say where a command works."""

    workers: str | None = None
    """Worker processes: a number of them on the CPU (one a core if left out), ray for one on every device of a Ray
    cluster, or ray:N for N of them. RAY_ADDRESS names a running cluster."""
    num_envs: PositiveInt | None = None
    """How many robots walk at once, over all workers. Each takes one episode after another. If left out, as many as
    suit the device. It changes how long the work takes, and no result but by rounding on a GPU."""


@dataclass(frozen=True, kw_only=True)
class SpaceFlag:
    """The option that names the terrain space of a run."""

    space: str | None = None
    """Terrain space of the run, where it is one of your own: file.py:CLASS. A space that only the run names is not
    loaded."""


@dataclass(frozen=True, kw_only=True)
class EliteFlags(SpaceFlag):
    """Options that say which elite of which run."""

    run: Path | None = None
    """Run directory; the newest of this robot under runs/, else its published archive."""
    elite: str = ""
    """Numbers of the elites, from 0, by falling fitness: one, several as in --elite "0 3", or all; view takes the
    first. If left out, the worst, with which the viewer begins."""
    minimal: str | None = None
    """Instead of whole elites, the minimal terrains that `faultline minimise` left of them: numbers of the elites, as
    --elite has them; all are those that have one."""


_EXTRAS = {"rsl_rl": "train", "tensordict": "train", "tensorboard": "train", "onnx": "onnx", "onnxruntime": "onnx"}
"""Extras of pyproject.toml by the modules of theirs that are imported; what searches and shows needs none."""
BEGAN = time.monotonic()  # when the program began [s]
Report = dict[str, Any]
Draw = Callable[[Report], bytes]


class UserError(Exception):
    """An error that a user can mend, where no built-in type fits; only its text is shown."""

    status = 2  # of the exit


class Interrupted(KeyboardInterrupt):
    """The program stops because the user asked for it; the text says how to go on."""


def debugging() -> bool:
    """Whether errors are to be shown with their tracebacks: FAULTLINE_DEBUG is set."""
    return os.environ.get("FAULTLINE_DEBUG", "0") not in ("", "0")


def with_traceback(error: BaseException, text: str) -> str:
    """A text about an error, for another process; when debugging, the traceback too."""
    return f"{text}\n{''.join(traceback.format_exception(error))}" if debugging() else text


def run_command(cls: Any, argv: Sequence[str], *, name: str) -> int:
    """Parses the flags of the command that the word ``name`` calls, checks them, runs it, and returns its exit status.

    That is 2, or a UserError's, for wrong flags and what a user can mend, with one line on stderr, and for any other
    error, with the traceback, as all have where FAULTLINE_DEBUG=1; 130 for Ctrl-C and SIGTERM; 1 if the output is
    closed, as in ``faultline ... | head -1``. The class method ``defaults(argv)`` makes defaults follow from flags.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        if int(version("mujoco").partition(".")[0]) > 3:
            raise UserError(f"mujoco must be of version 3, as Newton needs it, got {version('mujoco')}: `make setup`")
        command = _parse(cls, argv, name)
        check_settings(command)
        status = command.execute()
        sys.stdout.flush()
        return status if isinstance(status, int) else 0
    except Exception as error:
        poll = select.poll()
        poll.register(1, 0)
        poll.register(2, 0)
        if isinstance(error, BrokenPipeError) and (closed := poll.poll(0)):  # what is left to print is dropped
            for stream, _ in closed:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            return 1
        remedy = _find_remedy(error)
        if debugging() or not (remedy or isinstance(error, (ValueError, OSError, FloatingPointError, UserError))):
            traceback.print_exc()
            return 2
        text = " ".join(filter(None, map(str.strip, str(error).splitlines())))
        say(("error:", "bold red"), f" {text}{remedy}", error=True)
        return error.status if isinstance(error, UserError) else 2
    except SystemExit as stop:
        return int(stop.code or 0)
    except KeyboardInterrupt as stop:
        print(f"\n{stop}" if isinstance(stop, Interrupted) else "\nStopped.", file=sys.stderr)
        return 130


def _find_remedy(error: Exception) -> str:
    """The remedy for a missing package, and for a cache of compiled code of Warp or numba; else an empty text."""
    if isinstance(error, ModuleNotFoundError) and (extra := _EXTRAS.get(str(error.name))):
        return f": `make setup` installs all packages, and pip install 'faultline[{extra}]' those that are missing"
    folder = Path(os.environ.get("WARP_CACHE_PATH") or Path.home() / ".cache" / "warp").absolute()
    if re.search(r"Failed to load (CPU|CUDA) module", str(error)):
        return f": the compiled kernels in {folder} are damaged: remove that folder, they are compiled again"
    file = Path(str(error.filename)).absolute() if isinstance(error, OSError) and error.filename else None
    if file is not None and (file.is_relative_to(folder) or folder.is_relative_to(file)):
        return f": kernels are compiled into {folder}: let WARP_CACHE_PATH name a folder that can be written"
    if "no locator available" in str(error):
        return ": let NUMBA_CACHE_DIR name a folder that can be written"
    return ""


def say(*parts: str | tuple[str, str], error: bool = False) -> None:
    """Prints texts, or (text, rich style) pairs; in a terminal, lines break between words."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=error, highlight=False)
    console.print(Text.assemble(*parts), soft_wrap=not console.is_terminal)


def _parse(cls: Any, argv: Sequence[str], name: str) -> Any:
    """The command with its flags; SystemExit after help, or after a message about wrong flags."""
    if get_terminal_size().columns < 40:
        os.environ["COLUMNS"] = "40"  # tyro never ends in a narrower terminal
    if {"-h", "--help"} & {*argv}:
        for paragraph in (inspect.getdoc(cls) or "").split("\n\n"):
            print(textwrap.fill(paragraph, get_terminal_size().columns), end="\n\n")
    options: dict[str, Any] = {"description": "", "registry": _plain_help(cls), "config": (tyro.conf.DisallowNone,)}
    if hasattr(cls, "defaults"):
        options["default"] = cls.defaults(argv)
    try:
        return tyro.cli(cls, prog=f"faultline {name}", args=list(argv), **options)
    finally:
        sys.stdout.flush()


def _plain_help(cls: Any) -> ConstructorRegistry:
    """Makes the help of flags plain: no default where it is None, and lines broken by the terminal alone."""
    registry = ConstructorRegistry()
    hint = tyro.conf.arg(help_behavior_hint=lambda text: "" if text in ("", "None") else f"(default: {text})")
    busy = False

    def join_lines(helptext: Any) -> str | None:  # and fill names in braces with the command's ``help_values()``
        text: Any = (helptext() if callable(helptext) else helptext) or ""
        return " ".join((text.format_map(cls.help_values()) if "{" in text else text).split()) or None

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        nonlocal busy
        if busy:  # tyro's own rules answer
            return None
        busy = True
        spec = ConstructorRegistry.get_struct_spec(info)
        busy = False
        if not isinstance(spec, StructConstructorSpec):
            return None
        fields = [
            replace(field, type=Annotated[field.type, hint], helptext=partial(join_lines, field.helptext))
            for field in spec.fields
        ]
        return replace(spec, fields=tuple(fields))

    return registry


def peek(argv: Sequence[str], flag: str) -> str | None:
    """The last value that a command line gives a flag, as ``--flag value`` or ``--flag=value``; None if it has none."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(flag, nargs="?", dest="value")
    return parser.parse_known_args(argv)[0].value


def _interrupt(signum: int, frame: FrameType | None) -> None:
    if any(f"{os.sep}llvmlite{os.sep}" in caller.f_code.co_filename for caller, _ in traceback.walk_stack(frame)):
        # Its C code calls Python back and drops what is raised there: the signal comes again until it is over.
        later = threading.Timer(0.1, os.kill, (os.getpid(), signum))
        later.daemon = True
        later.start()
    else:
        raise KeyboardInterrupt


def command_line(name: str, **flags: object) -> str:
    """A command as it is typed, with paths from here; None, False and empty lists are left out, True is a bare flag."""
    argv = ["faultline", name]
    for field, value in flags.items():
        flag = f"--{field.replace('_', '-')}"
        value = str(value).removeprefix(f"{Path.cwd()}{os.sep}") if isinstance(value, str | Path) else value
        if value is True:
            argv.append(flag)
        elif isinstance(value, list | tuple):
            argv += [flag, *map(str, value)] if value else []
        elif str(value).startswith("-"):  # would be taken for a flag
            argv.append(f"{flag}={value}")
        elif value is not None and value is not False:
            argv += [flag, str(value)]
    return shlex.join(argv)


def split_values(arguments: Sequence[str]) -> list[str]:
    """The values in arguments, each of which may hold several, separated by spaces or commas."""
    return " ".join(arguments).replace(",", " ").split()


def choose_elites(text: str, numbers: Sequence[int], missing: str) -> list[int]:
    """Some of the numbers of elites: separated by spaces or commas, or ``all``; ``missing`` begins the error."""
    choices = [str(number) for number in numbers]
    chosen = choices if split_values([text]) == ["all"] else split_values([text])
    if not chosen or not set(chosen) <= set(choices):
        shown = choices if len(choices) <= 12 else [*choices[:10], "...", choices[-1]]
        raise ValueError(f"{missing} {text}: expected all, or some of {', '.join(shown) or 'none'}")
    return [int(number) for number in dict.fromkeys(chosen)]


def publish(
    out: Path | None, measure: Callable[[], Report], show: Callable[[Report], None], *, draw: Draw | None = None
) -> Report:
    """Measures a report, shows it, writes it to the JSON ``out``, beside the PNG of ``draw``, and returns it."""
    writers: dict[Path, Callable[..., bytes]] = {} if out is None else {out: to_json}
    if out is not None and draw is not None:
        if out.suffix != ".json":
            raise ValueError(f"out must be a file named *.json, beside which the figure is written as .png, got {out}")
        writers[out.with_suffix(".png")] = draw
    for file in writers:
        prepare_output(file)  # before the work
    report = measure()
    show(report)
    for file, write in writers.items():
        replaced = " (replaced)" if file.exists() else ""
        write_atomically(file, write(report))
        print(f"written to {file}{replaced}")
    return report
