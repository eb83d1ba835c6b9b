"""The command: its words, how it fails, and that help loads nothing that takes seconds."""

import ast
import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest

import faultline

ROOT = Path(__file__).resolve().parents[1]
WORDS = {name: command for group in faultline.COMMANDS.values() for name, command in group.items()}
HEAVY = ("torch", "warp", "newton", "mujoco", "ribs", "rsl_rl", "matplotlib", "scipy", "viser", "ray")


def loaded_by(*argv: str) -> tuple[str, set[str]]:
    """What a command line prints, and the heavy packages that it loads, in a process of its own."""
    script = f"import sys, faultline; faultline.main(sys.argv[1:]); print('LOADED', *{{*{HEAVY!r}}} & {{*sys.modules}})"
    command = [sys.executable, "-c", script, *argv]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    text, _, loaded = done.stdout.rpartition("LOADED")
    return text, set(loaded.split())


def test_help_names_every_command_the_six_of_a_newcomer_first_and_loads_nothing():
    text, loaded = loaded_by("--help")
    named = [line.split()[0] for line in text.splitlines() if line.startswith("  ")]
    assert sorted(named) == sorted(WORDS)
    assert named[:6] == ["archive", "view", "report", "film", "judge", "export"] and loaded == set()


@pytest.mark.parametrize("name", WORDS)
@pytest.mark.slow
def test_a_command_is_a_frozen_dataclass_whose_help_teaches_and_is_quick(name):
    text, loaded = loaded_by(name, "--help")
    assert f"usage: faultline {name}" in text and loaded <= {"warp"}  # which names of conditions take 0.2 s to load
    command = faultline.load_command(name)
    assert dataclasses.is_dataclass(command) and command.__dataclass_params__.frozen
    assert callable(command.execute)
    assert command.__doc__ and not command.__doc__.startswith(f"{command.__name__}(")  # else dataclass made it


@pytest.mark.parametrize(("given", "meant"), [("achive", "did you mean archive?"), ("xyz", "--help lists them")])
def test_an_unknown_word_gets_a_suggestion(capsys, given, meant):
    assert faultline.main([given]) == 2
    error = capsys.readouterr().err
    assert f"'{given}'" in error and meant in error
    assert faultline.main([]) == 0 and "usage: faultline COMMAND" in capsys.readouterr().out


def test_the_functions_for_python_are_loaded_and_known_to_type_checkers():
    tree = ast.parse(Path(faultline.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.col_offset]
    typed = {alias.asname: node.module for node in imports for alias in node.names if alias.asname}
    assert typed == faultline.API
    assert all(callable(getattr(faultline, name)) for name in faultline.API)
    with pytest.raises(AttributeError, match="nobody"):
        faultline.nobody  # noqa: B018
