"""The Makefile hands its variables on as they are, and only such flags as the command knows."""

import dataclasses
import importlib
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import tyro

from qd.reevaluate import ReevaluateCfg
from qd.run.arguments import Arguments
from qd.run.next_commands import next_command
from qd.show.cross import CrossCfg
from qd.studies.compare_arguments import Arguments as CompareArguments
from tests.dry_run import ROOT, run_by

ARGUMENTS = {
    "archive": ("qd.run.arguments", "Arguments"),
    "compare": ("qd.studies.compare_arguments", "Arguments"),
    "calibrate": ("qd.studies.calibrate", "CalibrateCfg"),
    "replay": ("qd.show.replay", "ReplayCfg"),
    "report": ("qd.show.report.material", "HtmlReportCfg"),
    "reevaluate": ("qd.reevaluate", "ReevaluateCfg"),
    "evaluate": ("qd.show.cross", "CrossCfg"),  # with TERRAIN
    "video": ("qd.show.video", "VideoCfg"),
    "export": ("qd.show.export", "ExportCfg"),
}
"""Where the arguments of each target's command are."""
VARIABLES = dict(re.findall(r"^FLAG_(\w+) := (\S+)$", (ROOT / "Makefile").read_text(), re.MULTILINE))
"""Variables of the Makefile and the flags they become."""


def command_of(target: str, **variables: str) -> list[str]:
    """What a target with some variables runs."""
    given = [shlex.quote(f"{name}={value.replace('$', '$$')}") for name, value in variables.items()]
    return run_by(" ".join(["make", target, *given]))


def test_the_help_says_what_every_variable_is():
    done = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert [name for name in VARIABLES if f"{name}=" not in done.stdout] == []


NO_MAP = ("POLICIES", "ARCHIVE", "SPLIT_SEED", "SETS", "TERRAINS", "WORKERS")
"""What `make evaluate` refuses beside TERRAIN."""


@pytest.mark.parametrize("target", ARGUMENTS)
def test_every_flag_of_a_target_is_one_of_its_command(target):
    given = [name for name in VARIABLES if target != "evaluate" or name not in NO_MAP]
    command = command_of(target, ROBOT="cassie", **dict.fromkeys(given, "7"))
    module, name = ARGUMENTS[target]
    known = {field.name for field in dataclasses.fields(getattr(importlib.import_module(module), name))}
    given = {word.split("=")[0].removeprefix("--").replace("-", "_") for word in command[3:] if word.startswith("--")}
    assert given <= known
    assert given >= {"robot", *(() if target == "export" else ("device", "policy"))}


ODD = ("a b", "a  b", "it's", '"', "$HOME", "$x", "a#b", "-x", "a=b:c", "*", "ü\\", "`id`", "%", "~")


@pytest.mark.parametrize("name", ODD)
def test_a_run_with_an_odd_name_gets_there(name):
    command = command_of("reevaluate", ROBOT="cassie", RUN=name, WORKER_LIMIT_S="9", SEED="3", PROCESSES="1")
    assert command[:3] == [".venv/bin/python", "-m", "qd.reevaluate"]
    parsed = tyro.cli(ReevaluateCfg, args=command[3:])
    assert parsed == ReevaluateCfg(robot="cassie", run=Path(name), worker_limit_s=9.0, seed=3, processes=1)


@pytest.mark.parametrize("name", ODD)
def test_the_commands_a_search_names_arrive_as_they_were_meant(name):
    placed = Arguments(device="cpu", workers="auto", worker_limit_s=900.0)
    line = next_command("archive", placed, robot="cassie", resume=Path(name), policy=f"{name}.pt", reproduce="no")
    parsed = tyro.cli(Arguments, args=run_by(line)[3:])
    given = {"robot": "cassie", "resume": Path(name), "policy": f"{name}.pt", "reproduce": "no"}
    assert parsed == dataclasses.replace(placed, **given)


def test_a_command_names_only_what_is_not_as_by_default():
    assert next_command("reevaluate", Arguments(), run=Path("runs/x"), seed=0) == "make reevaluate RUN=runs/x SEED=0"
    assert next_command("compare", CompareArguments(processes=2)) == "make compare PROCESSES=2"  # 900 s is its default
    assert next_command("archive", Arguments(worker_limit_s=0.5)) == "make archive WORKER_LIMIT_S=0.5"


def test_a_map_of_ones_own_is_handed_to_the_command_that_crosses_it():
    assert command_of("evaluate", POLICY="a.pt", SIZE="16 8")[2] == "train.evaluate.evaluate"
    command = command_of("evaluate", TERRAIN="my hill.png", SIZE="16 8", SCALE="0.01", EPISODES="40", OUT="a.json")
    assert command[:3] == [".venv/bin/python", "-m", "qd.show.cross"]
    parsed = tyro.cli(CrossCfg, args=command[3:])
    given = {"terrain": Path("my hill.png"), "size": ("16 8",), "scale": 0.01, "episodes": 40, "out": Path("a.json")}
    assert parsed == CrossCfg(robot="anymal", **given)


@pytest.mark.parametrize("name", NO_MAP)
def test_a_map_of_ones_own_is_not_crossed_by_what_says_nothing_of_it(name):
    with pytest.raises(subprocess.CalledProcessError) as failed:
        command_of("evaluate", TERRAIN="my hill.png", **{name: "a b"})
    assert f"crosses one map with one controller, got {name} too: leave out one or the other" in failed.value.stderr


def test_several_words_in_one_variable_are_one_value():
    parsed = tyro.cli(Arguments, args=command_of("archive", WITHOUT="stumble collision", REPRODUCE="yes")[3:])
    assert (parsed.robot, parsed.without, parsed.reproduce) == ("anymal", ("stumble collision",), "yes")
