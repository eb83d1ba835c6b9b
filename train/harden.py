"""Harden a controller: rounds of search and training, until a search no longer finds what breaks it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sim.files.command import OfRobot, OnGround, Where
from sim.files.settings import setting
from sim.robots.training import Draw

Comparison = Literal["hard_random", "first_archive"]
"""What else the trainings of a hardening could be spent on."""


@dataclass(frozen=True, kw_only=True)
class Harden(OfRobot, OnGround, Where):
    """Search for what breaks a controller, train it on all that was found, and search again, for some rounds.

    Each search counts the faults: terrains that a controller of the panel crosses and this one does not. Each training
    is on hand-crafted terrains and on the archives of all searches so far, and its controller is kept if validation
    terrains speak for it. Every controller is evaluated on
    hand-crafted and hard-random terrains and on the held-out elites of every archive. The last step is a search against
    the last controller. Every step is a run of its own under RUN_DIR: search-0, tune-1, search-1 and so on.
    RUN_DIR/rounds.json has the numbers, and `faultline report --run RUN_DIR` makes a page of them. After Ctrl-C or a
    kill the same command goes on.
    """

    policy: Path | None = None
    """Controller to begin with: an rsl_rl checkpoint with layers of any size; the shipped one."""
    rounds: int = setting(3, least=1)
    """Rounds of training. There is one search more than rounds. A larger number later continues a finished run."""
    run_dir: Path | None = None
    """Where to work, and to go on; runs/<robot>-harden-<seed>."""
    seed: int = setting(0, least=0, most=10_000_000)
    """Seed of everything drawn in searches and trainings."""
    search_episodes: int | None = setting(None, least=1)
    """Budget of each search in episodes, rounded up to whole iterations; 400,000 on CUDA (5 minutes on one H200), 2,560
    on the CPU. With fewer, less is found: compare numbers of faults only between searches of the same budget."""
    tune_iterations: int | None = setting(None, least=1)
    """Budget of each round's training in iterations. As of `faultline finetune`, 1,200 on CUDA (Cassie: 3,000). On the
    CPU 100, enough to see that it runs."""
    max_seconds: float | None = setting(None, above=0.0)
    """Stop after so many seconds, as by Ctrl-C. A search loses its present iteration. A training finishes it."""
    tune_num_envs: int | None = setting(None, least=1)
    """Robots of each training: 8,192 on CUDA, more than `faultline finetune` has (Cassie: the paper's 600), 24 on the
    CPU."""
    tune_terrains: int | None = setting(None, least=1)
    """Terrains of each training at a time: 2,000 on CUDA (Cassie: the paper's 100), 12 on the CPU."""
    keep: Literal["best", "last"] = "best"
    """Which controller to go on with after a training. best: the new one only if it reaches the goal no less often on
    validation terrains, and on hand-crafted and hard-random ones at most a point less than the base; else the one
    before. last: always the new one."""
    preset: str | None = None
    """Size of a search's iteration: wide (the default on a GPU), paper, or small (the default on the CPU)."""
    emitters: int | None = setting(None, least=1)
    """Emitters of a search; the preset's."""
    batch_size: int | None = setting(None, least=2)
    """Terrains that an emitter asks for in an iteration; the preset's."""
    replicas: int | None = setting(None, least=1)
    """Episodes a terrain in a search; the preset's."""
    draw: Draw | None = None
    """How a training draws elites at each exchange, as of `faultline finetune`."""
    by: tuple[str, ...] = ()
    """Certifiers as NAME=FILE; the robot's panel if left out, results/<robot>/panel/*.pt. The controller that is
    searched never certifies itself."""
    terrains: int | None = setting(None, least=1)
    """Terrains a set of evaluation and validation; 300 on CUDA (Cassie: 180), 24 on the CPU."""
    episodes: int | None = setting(None, least=1)
    """Episodes a terrain of evaluation and validation; 20 on CUDA, 4 on the CPU."""
    space: str | None = None
    """Terrain space: super_gaussian, course, or one of your own, file.py:CLASS; super_gaussian if left out."""
    against: tuple[Comparison, ...] = ()
    """What to compare the rounds with, after them. hard_random: as many trainings of the same length on hard-random
    terrains. first_archive: the same on the first archive alone, of which the first training is that of the first
    round. A search against the outcome follows."""

    def execute(self) -> int:
        """Runs what is left; returns the exit status 0, also where the time is up.

        Raises:
            ValueError: If a flag's value cannot be used; raised before any long work.
            FloatingPointError: If a training leaves the finite numbers; its last checkpoint is kept.
            Interrupted: On Ctrl-C; what is finished is kept.
            EvaluatorError: If a worker is lost; what is finished is kept.
        """
        from train.hardening import harden

        return harden(self)
