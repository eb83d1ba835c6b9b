"""The flags of train, finetune and harden."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

from sim.files.command import WorkerFlags, peek
from sim.files.settings import from_builtins, select_settings
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from train.cfg import FinetuneCfg, HardenCfg, RunCfg, TrainCfg


@dataclass(frozen=True, kw_only=True)
class _TrainingFlags(RunCfg):
    """The flags of every training."""

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the file of another (mine/go2/robot.toml); its settings are the defaults."""
    run_dir: Path | None = None
    """Where to write; a new directory under runs/."""
    resume: Path | None = None
    """Directory of a training to go on with, by its own settings."""


@dataclass(frozen=True, kw_only=True)
class TrainCommand(_TrainingFlags, TrainCfg):
    """Train a base controller from scratch: PPO on legged_gym's rough-terrain task.

    On CUDA ANYmal trains 8192 robots for 2240 iterations, Cassie 2048 for 3400; on the CPU 32 for 20, enough to see
    that it runs. Ctrl-C or SIGTERM saves and stops; --resume RUN_DIR goes on. On several GPUs: torchrun
    --nproc-per-node 4 -m faultline train --run-dir RUN_DIR, each with --num-envs.
    """

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The settings of the robot, or of the training to go on with, that a command line names."""
        return cls(**_read_defaults(TrainCfg, TrainCfg.of, argv))

    def execute(self) -> None:
        """Trains."""
        from train.ppo.training import train

        robot = get_robot(self.robot)
        run_dir = _run_dir(self, f"{robot.name}-base")
        train(robot, select_settings(TrainCfg, self), run_dir, select_settings(RunCfg, self))


@dataclass(frozen=True, kw_only=True)
class FinetuneCommand(_TrainingFlags, FinetuneCfg):
    """Fine-tune a controller by PPO on hand-crafted terrains and on those of an archive (the paper's C-G).

    On CUDA the sizes are the paper's, on the CPU small ones, enough to see that it runs. Ctrl-C or SIGTERM saves
    and stops; --resume RUN_DIR goes on. With --specialist RUN it trains a certifier for a search.
    """

    specialist: Path | None = None
    """Run of a search. Trains its controller further on all elites that it fails (on CUDA 8192 robots, 2000 terrains at
    a time, 1000 iterations) and writes RUN/certifiers/specialist.pt, which `faultline judge` asks. The same command
    goes on."""

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The settings of the robot, or of the training to go on with, that a command line names."""
        make = FinetuneCfg.of if peek(argv, "--specialist") is None else FinetuneCfg.specialist
        return cls(**_read_defaults(FinetuneCfg, make, argv))

    def execute(self) -> None:
        """Fine-tunes."""
        from train.finetune import finetune, train_specialist

        robot = get_robot(self.robot)
        cfg = select_settings(FinetuneCfg, self)
        run = select_settings(RunCfg, self)
        if self.specialist is None:
            finetune(robot, cfg, _run_dir(self, f"{robot.name}-{self.mix}"), run)
            return
        given = [name for name in ("resume", "run_dir", "export", "archive") if getattr(self, name)]
        if given or self.mix != "generated":
            raise ValueError(f"--specialist takes archive and places of its run, got {', '.join(given) or self.mix}")
        train_specialist(robot, self.specialist, cfg, run)


@dataclass(frozen=True, kw_only=True)
class HardenCommand(HardenCfg, WorkerFlags):
    """Search for what breaks a controller, train it on all that was found, and search again, for some rounds.

    Each search counts the faults: terrains that another controller crosses and this one does not. Each training is on
    hand-crafted terrains and on the archives of all searches so far, and its controller is kept if validation terrains
    speak for it. The last step is a search against the last controller. RUN_DIR/rounds.json has the numbers, and
    `faultline report --run RUN_DIR` makes a page of them. After Ctrl-C or a kill the same command goes on.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the file of another (mine/go2/robot.toml); its settings are the defaults."""
    run_dir: Path | None = None
    """Where to work, and to go on; runs/<robot>-harden-<seed>."""

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The settings of the robot that a command line names."""
        robot = get_robot(peek(argv, "--robot") or "anymal")
        return cls(robot=robot.spec, **vars(HardenCfg.of(robot)))

    def execute(self) -> None:
        """Hardens."""
        from qd.workers.compute import Compute
        from train.harden import harden

        robot, compute = get_robot(self.robot), Compute.resolve(self.device, self.workers, self.num_envs)
        run_dir = self.run_dir or Path("runs") / f"{robot.name}-harden-{self.seed}"
        harden(robot, select_settings(HardenCfg, self), run_dir, compute)


def _read_defaults(kind: type[TrainCfg], make: Callable[[RobotCfg], TrainCfg], argv: Sequence[str]) -> dict[str, Any]:
    """The settings of a new training of the robot that a command line names, or of the one that it goes on with."""
    robot = get_robot(peek(argv, "--robot") or "anymal")
    resume = peek(argv, "--resume")
    if resume is None:
        return {"robot": robot.spec, **vars(make(robot))}
    from train.ppo.training import read_saved

    settings = read_saved(Path(resume), "train" if kind is TrainCfg else "finetune", robot.name)["settings"]
    known = {setting.name for setting in fields(kind)}
    values = {name: value for name, value in settings.items() if name in known}
    if ":" in str(values.get("space")):
        del values["space"]  # code of a user's space is named again
    return {"robot": robot.spec, "resume": Path(resume), **vars(from_builtins(kind, values, resume))}


def _run_dir(flags: _TrainingFlags, name: str) -> Path:
    """Where a training works; a new directory is called after ``name`` and the time."""
    from qd.search.directory import free_path

    if flags.resume is not None and flags.run_dir is not None:
        raise ValueError("--resume goes on where it is, got --run-dir too: leave it out")
    return flags.run_dir or flags.resume or free_path(f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
