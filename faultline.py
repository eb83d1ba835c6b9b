"""The command ``faultline``, and its functions for Python; only what a command or a function needs is loaded.

``faultline.search``, ``judge``, ``evaluate`` and ``finetune`` do what the commands of these names do, ``cross`` lets a
controller cross terrains; docs/searching.md shows them in twenty lines. ``gate`` tests one beside its training.
"""

import difflib
import importlib
import sys
from typing import TYPE_CHECKING, Any

COMMANDS: dict[str, dict[str, tuple[str, str]]] = {
    "First": {
        "archive": ("qd.commands", "search the terrains on which a controller fails"),
        "view": ("qd.show.commands", "look at them in the browser"),
        "report": ("qd.show.commands", "one page about them"),
        "film": ("qd.show.commands", "film how the robot fails on one, or on a map of your own"),
        "judge": ("qd.commands", "which of them are faults of the controller"),
        "export": ("qd.show.commands", "as files, faults as a pack, a controller as ONNX"),
    },
    "Find and measure more": {
        "minimise": ("qd.commands", "which parts of a failing terrain it takes to fail"),
        "evaluate": ("qd.commands", "rates of controllers, of one or compared"),
        "dose": ("qd.commands", "which real obstacle at which size stops a controller"),
        "replay": ("qd.show.commands", "one elite, or a map of your own, again: numbers and paths"),
    },
    "Train": {
        "train": ("train.commands", "train a base controller from scratch"),
        "finetune": ("train.commands", "train a controller further on terrains that broke it"),
        "harden": ("train.commands", "rounds of search and training, until little breaks it"),
    },
    "Bring a robot or a controller": {
        "import": ("qd.commands", "describe a public controller and its robot from what came with it"),
        "check": ("qd.commands", "look at a robot and its controller: does it stand, and walk"),
    },
}
"""Words that may stand after ``faultline``, by what they are for; first the six that a newcomer needs.

Each has the module of its flags, where ``archive`` is the dataclass ``ArchiveCommand``, and a summary.
"""

if TYPE_CHECKING:
    from qd.evaluate.evaluate import evaluate as evaluate
    from qd.evaluate.gate import gate as gate
    from qd.evaluate.sets import make_sets as make_sets
    from qd.faults.judge import judge as judge
    from qd.search.loop import search as search
    from qd.search.settings import preset as preset
    from qd.workers.compute import Compute as Compute
    from qd.workers.crosser import cross as cross
    from sim.robots.find import get_robot as get_robot
    from sim.terrains.terrains import Terrains as Terrains
    from train.cfg import FinetuneCfg as FinetuneCfg
    from train.finetune import finetune as finetune

API = {
    "search": "qd.search.loop",
    "judge": "qd.faults.judge",
    "cross": "qd.workers.crosser",
    "evaluate": "qd.evaluate.evaluate",
    "gate": "qd.evaluate.gate",
    "make_sets": "qd.evaluate.sets",
    "finetune": "train.finetune",
    "preset": "qd.search.settings",
    "FinetuneCfg": "train.cfg",
    "Compute": "qd.workers.compute",
    "get_robot": "sim.robots.find",
    "Terrains": "sim.terrains.terrains",
}
"""Functions and settings for Python by their modules, loaded when they are used; type checkers see them above."""

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Loads what :data:`API` names."""
        if name not in API:
            raise AttributeError(f"module 'faultline' has no attribute '{name}': it has {', '.join(API)}")
        return getattr(importlib.import_module(API[name]), name)


_BY_NAME = {name: command for group in COMMANDS.values() for name, command in group.items()}


def load_command(name: str) -> Any:
    """The dataclass of the flags of a word; its ``execute`` does the work."""
    return getattr(importlib.import_module(_BY_NAME[name][0]), f"{name.capitalize()}Command")


def main(argv: list[str] | None = None) -> int:
    """Runs the command that a command line names; returns its exit status, 2 if there is none of that name."""
    from sim.files.command import run_command, say

    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help", "help"):
        say("usage: faultline COMMAND [OPTIONS]\n\nFind the terrains that break a legged robot's controller.\n")
        for title, group in COMMANDS.items():
            say((f"{title}:", "bold"))
            for name, (_, summary) in group.items():
                say((f"  {name:<12}", "cyan"), summary)
            print()
        say("faultline COMMAND --help tells all of a command. FAULTLINE_DEBUG=1 shows tracebacks of errors.")
        return 0
    if name not in _BY_NAME:
        near = difflib.get_close_matches(name, _BY_NAME, n=1)
        meant = f"did you mean {near[0]}?" if near else "faultline --help lists them"
        say(("error:", "bold red"), f" there is no command '{name}': {meant}", error=True)
        return 2
    return run_command(load_command(name), rest, name=name)


if __name__ == "__main__":
    sys.exit(main())
