"""Every command that reads a file which may be damaged, on stand-ins for what takes long, to be run in a child."""

import os
import resource
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kernels.episode import Outcome
from qd.commands import Evaluate
from qd.evaluate import evaluate
from qd.fresh import Reevaluate, reevaluate_run
from qd.show import recordings, replay
from qd.studies import calibrate
from qd.workers import evaluator
from sim.files import command
from tests.kills import searches, trainings
from tests.qd import stand_in
from tests.qd.recordings import recording_of

SCALES = {"scales": dict.fromkeys(stand_in.PENALTIES, 1.0)}


def resume_search(path: Path) -> None:
    """One iteration more than the search had."""
    searches.run(["--resume", str(path), "--device", "cpu", "--iterations", "3", "--policy", searches.POLICY])


def reevaluate_search(path: Path) -> None:
    """All elites again."""
    searches.without_figures()
    argv = ["--run", str(path), "--device", "cpu", "--policy", searches.POLICY]
    if status := command.run_command(_StandInReevaluate, argv, name="reevaluate"):
        sys.exit(status)


@dataclass(frozen=True, kw_only=True)
class _StandInReevaluate(Reevaluate):
    def execute(self) -> None:
        reevaluate_run(self, open_evaluator=stand_in.open_stand_in)


def replay_elite(path: Path) -> None:
    """The worst elite again."""
    recordings.Simulation = lambda robot, device: _cross
    argv = ["--run", str(path), "--device", "cpu", "--replicas", "4", "--policy", searches.POLICY]
    sys.exit(command.run_command(replay.ReplayElite, argv, name="replay"))


def resume_training(run_dir: Path) -> int:
    """One iteration more than the training had."""
    return trainings.train(run_dir, iterations=3, resume=run_dir)


def calibrate_with(policy: Path) -> None:
    """Penalty scales with a controller."""
    evaluator.open_evaluator = stand_in.open_stand_in
    out = str(policy.parent / "scales.json")
    argv = ["--policy", str(policy), "--out", out, "--device", "cpu", "--terrains", "8", "--replicas", "4"]
    argv += ["--most-terrains", "8"]
    sys.exit(command.run_command(calibrate.Calibrate, argv, name="calibrate"))


def evaluate_with(policy: Path) -> int:
    """Crossings with a controller, up to where the simulation would be built."""
    evaluate.cross_sets = lambda *crossed, **how: (_ for _ in ()).throw(SystemExit(0))
    flags = ["--policy", str(policy), "--device", "cpu", "--terrains", "2", "--episodes", "1"]
    return command.run_command(Evaluate, [*flags, "--out", str(policy.parent / "rates.json")], name="evaluate")


def as_nobody(command: Callable[[Path], Any], path: Path) -> Any:
    """A command by a user who owns nothing, where this process may become one."""
    if os.geteuid() == 0:
        os.setgid(65534)
        os.setuid(65534)
    return command(path)


def _cross(wanted: list[recordings.Wanted], progress: Any) -> list[Any]:
    """Recordings of robots that all arrive."""
    made = []
    for one in wanted:
        result = stand_in.evaluate(one.terrain[None], np.array([one.terrain_seed]), one.replicas)
        outcomes = [Outcome.GOAL] * one.replicas
        made.append(recording_of(outcomes, [14.0] * one.replicas, penalties=result.penalties[0]))
    return made


def search_below(limit: int, path: Path, iterations: int) -> None:
    """The search where no file may grow beyond a number of bytes; the log of this process lies open already."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    searches.search(path, iterations=iterations)
