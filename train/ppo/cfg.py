"""Settings of the learner, and the flags that both trainings have."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from sim.files.command import OnDevice
from sim.files.settings import check, from_builtins, problems, setting
from sim.robots.training import PaceCfg

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

_ROBOT = "anymal"


@dataclass(frozen=True, kw_only=True)
class PpoCfg(PaceCfg):
    """Settings of the learner; the defaults are legged_gym's, except the steps."""

    hidden_dims: tuple[int, ...] = setting((512, 256, 128), least=1)
    """Hidden layers (ELU) of actor and critic."""
    steps_per_env: int = setting(16, least=1)
    """Control steps an iteration, per environment; legged_gym's 24 are for half as many environments."""
    epochs: int = setting(5, least=1)
    """Passes over the data of an iteration."""
    mini_batches: int = setting(4, least=1)
    """Minibatches a pass."""
    learning_rate: float = setting(1e-3, above=0.0)
    """Learning rate at the start; adapted to the KL divergence from then on."""
    gamma: float = setting(0.99, least=0.0, most=1.0)
    """Discount per control step."""
    lam: float = setting(0.95, least=0.0, most=1.0)
    """Lambda of generalised advantage estimation."""
    clip: float = setting(0.2, above=0.0)
    """Clip range of the probability ratio and of the value."""
    average: float = setting(0.0, least=0.0, most=1.0)
    """Share of all iterations, the last ones, whose actors' weights are averaged into the controller; 0: it is the last
    actor. The mean walks a little more smoothly."""

    @classmethod
    def of(cls, robot: "RobotCfg") -> "PpoCfg":
        """The settings that a robot's controller is learned with."""
        return cls(**{own.name: getattr(robot.learning, own.name) for own in fields(PaceCfg)})


def ppo_problems(cfg: PpoCfg, num_envs: int) -> list[str]:
    """What is wrong with the settings of the learner, one line each.

    Args:
        cfg: The settings.
        num_envs: Environments of one process.
    """
    found = problems(cfg, "ppo.")
    if found:
        return found
    transitions = num_envs * cfg.steps_per_env
    if not cfg.hidden_dims:
        found.append("ppo.hidden_dims must name at least one layer, got none")
    if transitions == 1:
        found.append("an iteration must have at least 2 transitions, got 1: more num_envs or ppo.steps_per_env")
    elif cfg.mini_batches > transitions // 2:
        found.append(
            f"ppo.mini_batches must be at most half of the {num_envs} x {cfg.steps_per_env} transitions of an "
            f"iteration, got {cfg.mini_batches}"
        )
    return found


@dataclass(frozen=True, kw_only=True)
class TrainingFlags(OnDevice):
    """The flags of every training; a run that is resumed has its own settings as defaults."""

    command: ClassVar[str]
    """The word that calls it: train or finetune."""
    robot: str = _ROBOT
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py); its settings are the defaults."""
    num_envs: int | None = setting(None, least=1)
    """Robots trained at once, per process. If left out, as many as suit robot and device."""
    iterations: int | None = setting(None, least=1)
    """Iterations in all, with those before a resume. If left out, as many as suit robot and device."""
    max_seconds: float | None = setting(None, above=0.0)
    """Save and stop in time to be done this many seconds after the start."""
    run_dir: Path | None = None
    """Where to write; a new directory under runs/, or the resumed run."""
    resume: Path | None = None
    """Run directory to go on from."""
    overwrite: bool = False
    """Replace the file that --export names if it is there and of another training."""
    export: Path | None = None
    """Also write the controller to this file and its training record beside it: sim/robots/<robot>.pt ships it,
    <name>.pt beside the settings file of another robot makes it that robot's own."""
    seed: int = setting(0, least=0)
    """Seed of everything drawn."""
    save_every_s: float = setting(60.0, least=0.0)
    """Time between checkpoints [s]."""
    rows: int = setting(100, least=1)
    """Progress rows over the whole training."""
    ppo: PpoCfg = field(default_factory=PpoCfg)

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The settings that a command line leaves out: those of the run that it resumes, or of the robot that it names.

        Raises:
            ValueError: If there is no such robot, no such run, or one whose settings cannot be read.
        """
        from sim.robots.find import get_robot

        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        parser.add_argument("--robot", default=_ROBOT)
        parser.add_argument("--resume", type=Path)
        named = parser.parse_known_args(argv)[0]
        robot = get_robot(named.robot)
        if named.resume is None:
            return cls(robot=named.robot, **cls.begun(robot, None))
        from train.ppo.run import CHECKPOINT, read_saved

        saved = read_saved(named.resume, robot, cls.command)
        try:
            values = cls.begun(robot, saved["extra"]["settings"])
            flags = from_builtins(cls, {**values, "robot": named.robot, "resume": named.resume}, "a training")
            check(flags)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{named.resume / CHECKPOINT} is damaged, or of another version: {error}; put a copy of it back, or "
                "begin a new run"
            ) from None
        return flags

    @classmethod
    def begun(cls, robot: "RobotCfg", settings: dict[str, Any] | None) -> dict[str, Any]:
        """The flags that follow from a robot, or with the ``settings`` of a checkpoint those that it was begun with."""
        raise NotImplementedError
