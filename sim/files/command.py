"""What all commands share: option groups, how a command starts and fails, how a result is published.

A command is a frozen dataclass: its docstring is its help, its fields are its flags, ``execute`` does the work. Its
module loads quickly; what takes seconds to import (torch, warp, newton, pyribs) is imported inside ``execute``.
"""

import contextlib
import inspect
import io
import os
import re
import select
import shlex
import signal
import sys
import textwrap
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path
from shutil import get_terminal_size
from types import FrameType
from typing import Annotated, Any

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.settings import PositiveInt, check


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
    suit the device. It changes how long the work takes, and no result."""


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


class UserError(Exception):
    """What a user can mend, where no built-in error says it; its text is all that is shown."""

    status = 2
    """Exit status."""


class Interrupted(KeyboardInterrupt):
    """The program was asked to stop; its text says what comes next, for example how to resume."""


def debugging() -> bool:
    """Whether errors are to be shown with their tracebacks: FAULTLINE_DEBUG is set."""
    return os.environ.get("FAULTLINE_DEBUG", "0") not in ("", "0")


def with_traceback(error: BaseException, text: str) -> str:
    """What a process sends of an error to the one that waits for it: a text, and the traceback when debugging."""
    return f"{text}\n{''.join(traceback.format_exception(error))}" if debugging() else text


def run_command(cls: Any, argv: Sequence[str], *, name: str) -> int:
    """Parses the flags of the command that the word ``name`` calls, checks them against their ranges, and runs it.

    A command whose defaults follow from some of its flags has a class method ``defaults(argv)``.

    Returns:
        Exit status: what ``execute`` returns if that is a number, else 0; 2 after one line on stderr for what a user
        can mend (ValueError, OSError, FloatingPointError), after a UserError its own; 130 for Ctrl-C and SIGTERM; 1
        without a word, as of rich, where nobody reads what it prints any more, as in ``faultline ... | head -1``.
        FAULTLINE_DEBUG=1 shows the traceback instead of the line.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        defaults = {"default": cls.defaults(argv)} if hasattr(cls, "defaults") else {}
        command = _parse(cls, argv, name, defaults)
        check(command)
        status = command.execute()
        sys.stdout.flush()
        return status if isinstance(status, int) else 0
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _drop_unread():
            return 1
        remedy = _cache_remedy(error)
        if debugging() or not (remedy or isinstance(error, (ValueError, OSError, FloatingPointError, UserError))):
            raise
        text = " ".join(filter(None, map(str.strip, str(error).splitlines())))
        say(("error:", "bold red"), f" {text}{remedy}", error=True)
        return error.status if isinstance(error, UserError) else 2
    except KeyboardInterrupt as stop:
        print(f"\n{stop}" if isinstance(stop, Interrupted) else "\nStopped.", file=sys.stderr)
        return 130


def _drop_unread() -> bool:
    """Whether nobody reads standard output or errors any more; what is left for them to print is dropped."""
    poll = select.poll()
    for stream in (1, 2):
        poll.register(stream, 0)
    unread = [stream for stream, _ in poll.poll(0)]
    for stream in unread:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    return bool(unread)


def _cache_remedy(error: Exception) -> str:
    """What helps where Warp's or numba's cache of compiled code is damaged, or cannot be written; else nothing."""
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
    """Prints texts, some paired with a style of rich, which a terminal shows; a terminal breaks lines at words."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=error, highlight=False)
    console.print(Text.assemble(*parts), soft_wrap=not console.is_terminal)


def _parse(cls: Any, argv: Sequence[str], name: str, defaults: dict[str, Any]) -> Any:
    """The command with its flags; what tyro says of wrong ones in a box is an error of one line."""
    if {"-h", "--help"} & {*argv}:
        paragraphs, width = (inspect.getdoc(cls) or "").split("\n\n"), max(40, get_terminal_size().columns)
        print("\n\n".join(textwrap.fill(paragraph, width) for paragraph in paragraphs), end="\n\n")
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                cls, prog=f"faultline {name}", args=list(argv), description="", registry=_plain_help(),
                config=(tyro.conf.DisallowNone,), **defaults,
            )  # fmt: skip
    except SystemExit as stop:
        if not stop.code:  # it was asked for help
            sys.stdout.flush()
            raise
        lines = [line.strip(" \u2502\u256d\u256e\u2570\u256f\u2500") for line in said.getvalue().splitlines()]
        _title, *words = [line for line in lines if line.strip("-")]
        text = " ".join(takewhile(lambda line: not line.startswith("For full helptext"), words))
        what, _, help_line = text.partition(" Argument helptext: ")
        if form := re.match(r"(--\S+) (\{.*?\}|\S+)", help_line):
            expected = form[2].strip("{}").replace("|", " or ")
            what = f"{form[1]} must be {expected}, got {_values(argv, form[1])}"
        raise UserError(f"{what.rstrip('.')}; `faultline {name} --help` tells all flags") from None


def _plain_help() -> ConstructorRegistry:
    """What makes the help of flags plain: no default where it is nothing, and lines broken by the terminal alone."""
    registry, asked = ConstructorRegistry(), list[StructTypeInfo]()
    hint = tyro.conf.arg(help_behavior_hint=lambda text: "" if text in ("", "None") else f"(default: {text})")

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if asked:  # tyro's own rules answer
            return None
        asked.append(info)
        spec = ConstructorRegistry.get_struct_spec(info)
        asked.clear()
        if not isinstance(spec, StructConstructorSpec):
            return None

        def helptext(get: Any) -> Callable[[], str | None]:
            return lambda: " ".join(str((get() if callable(get) else get) or "").split()) or None

        fields = [
            replace(field, type=Annotated[field.type, hint], helptext=helptext(field.helptext)) for field in spec.fields
        ]
        return replace(spec, fields=tuple(fields))

    return registry


def _values(argv: Sequence[str], flag: str) -> str:
    """What a flag is given: the words up to the next one."""
    after = argv[argv.index(flag) + 1 :] if flag in argv else [peek(argv, flag) or ""]
    return shlex.join(takewhile(lambda word: not word.startswith("--"), after))


def peek(argv: Sequence[str], flag: str) -> str | None:
    """The last value that a command line gives a flag, as ``--flag value`` or ``--flag=value``; None if it has none."""
    value = None
    for word, following in pairwise([*argv, ""]):
        if word == flag:
            value = following
        elif word.startswith(f"{flag}="):
            value = word.partition("=")[2]
    return value


def _interrupt(signum: int, frame: FrameType | None) -> None:
    while frame is not None:
        if f"{os.sep}llvmlite{os.sep}" in frame.f_code.co_filename:
            # Its C code calls Python back and drops what is raised there: the signal comes again until it is over.
            later = threading.Timer(0.1, os.kill, (os.getpid(), signum))
            later.daemon = True
            later.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def command_line(name: str, **flags: object) -> str:
    """A command as it is typed: ``faultline replay --run runs/x --elite 0``.

    Flags are named by fields; None, False and empty lists are left out, True is a bare flag. Of a path below the
    present folder the rest is shown; any other stays whole, since the command must work.
    """
    words, here = ["faultline", name], f"{Path.cwd()}{os.sep}"
    for field, value in flags.items():
        flag = f"--{field.replace('_', '-')}"
        value = str(value).removeprefix(here) if isinstance(value, str | Path) else value
        if value is True:
            words.append(flag)
        elif isinstance(value, list | tuple):
            words += [flag, *map(str, value)] if value else []
        elif str(value).startswith("-"):  # would be taken for a flag
            words.append(f"{flag}={value}")
        elif value is not None and value is not False:
            words += [flag, str(value)]
    return shlex.join(words)


def split_words(values: Sequence[str]) -> list[str]:
    """The words of arguments; one argument may hold several, separated by spaces or commas."""
    return " ".join(values).replace(",", " ").split()


def chosen_elites(text: str, numbers: Sequence[int], missing: str) -> list[int]:
    """Some of the numbers of elites: separated by spaces or commas, or ``all``; ``missing`` begins the error."""
    known = [str(number) for number in numbers]
    words = known if split_words([text]) == ["all"] else split_words([text])
    if not words or not set(words) <= set(known):
        few = known if len(known) <= 12 else [*known[:10], "...", known[-1]]
        raise ValueError(f"{missing} {text}: expected all, or some of {', '.join(few) or 'none'}")
    return [int(word) for word in dict.fromkeys(words)]


def publish(
    out: Path | None,
    measure: Callable[[], dict[str, Any]],
    show: Callable[[dict[str, Any]], None],
    *,
    draw: Callable[[dict[str, Any]], bytes] | None = None,
) -> dict[str, Any]:
    """Measures, shows and writes a report, which is returned; where to write is tried before the work.

    Without a file ``out`` it is shown alone; of a ``.json`` ``draw`` makes a PNG that is written beside it.
    """
    makers: dict[Path, Callable[[Any], bytes]] = {} if out is None else {out: to_json}
    if out is not None and draw is not None:
        if out.suffix != ".json":
            raise ValueError(f"out must be a file named *.json, beside which the figure is written as .png, got {out}")
        makers[out.with_suffix(".png")] = draw
    for file in makers:
        prepare_output(file)
    report = measure()
    show(report)
    for file, make in makers.items():
        replaced = " (replaced)" if file.exists() else ""
        write_atomically(file, make(report))
        print(f"written to {file}{replaced}")
    return report
