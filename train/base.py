"""Train a base controller from scratch on rough terrain."""

import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from train.ppo.cfg import PpoCfg, TrainingFlags, named_robot_and_run
from train.task.cfg import TaskCfg

if TYPE_CHECKING:
    from train.ppo.run import Job

_SMALL_ENVS, _SMALL_ITERATIONS = 32, 20
_KINDS = {"seed": int, "num_envs": int, "iterations": int, "task": TaskCfg, "ppo": PpoCfg}


@dataclass(frozen=True, kw_only=True)
class Train(TrainingFlags):
    """Train a base controller from scratch: PPO on legged_gym's rough-terrain task.

    On CUDA ANYmal trains 8192 robots for 2240 iterations, Cassie 2048 for 3400; on the CPU 32 for 20, enough to see
    that it runs. Ctrl-C or --max-seconds saves and stops; --resume RUN_DIR goes on with the settings of that run, but
    for those that are given. On several GPUs: torchrun --nproc-per-node 4 -m faultline train, each with --num-envs.
    """

    task: TaskCfg
    """The task, with the robot's own settings."""

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The settings that a command line leaves out: those of the resumed run, or of the robot.

        Raises:
            ValueError: If there is no such robot, no such run, or one whose settings cannot be read.
        """
        from sim.robots.robot import get_robot

        name, run = named_robot_and_run(argv)
        robot = get_robot(name)
        if run is None:
            return cls(robot=name, task=TaskCfg.of(robot), ppo=PpoCfg.of(robot))
        from train.ppo.run import read_saved, settings_of

        return cls(robot=name, resume=run, **settings_of(run, read_saved(run, robot, finetuning=False), _KINDS))

    def execute(self) -> int:
        """Trains; returns the exit status: 0, or 130 after Ctrl-C.

        Raises:
            ValueError: If something asked for cannot be had; raised before any long work.
        """
        from train.ppo.learner import Ranks
        from train.ppo.run import Training, run_training

        began = time.monotonic()
        if Ranks.of_environment().is_first:
            job = _job_of(self, began)
            return run_training(job, lambda: Training(job))
        # The other processes of a training print nothing, and their files are thrown away.
        with tempfile.TemporaryDirectory() as folder, Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            job = _job_of(replace(self, run_dir=Path(folder), export=None), began)
            return run_training(job, lambda: Training(job))


def _job_of(flags: Train, began: float) -> "Job":
    """What the flags ask for, checked."""
    from sim.robots.identity import robot_digest
    from sim.robots.robot import get_robot
    from train.ppo.learner import Ranks
    from train.ppo.run import Job, check_resumed, check_training, device_of, prepare_run_dir, read_saved

    robot, device = get_robot(flags.robot), device_of(flags)
    on_cuda = device.startswith("cuda")
    num_envs = flags.num_envs if flags.num_envs is not None else robot.learning.num_envs if on_cuda else _SMALL_ENVS
    iterations = flags.iterations
    if iterations is None:
        iterations = robot.learning.iterations if on_cuda else _SMALL_ITERATIONS
    check_training(flags, flags.task, flags.ppo, robot=robot, num_envs=num_envs)
    if not on_cuda and flags.num_envs is None and flags.iterations is None:
        print(
            f"No GPU: a small training of {num_envs} robots and {iterations} iterations, enough to see that it runs. "
            "A controller that walks takes minutes on one GPU."
        )
    settings = {
        "seed": flags.seed,
        "num_envs": num_envs,
        "iterations": iterations,
        "processes": Ranks.of_environment().size,
        "task": asdict(flags.task),
        "ppo": asdict(flags.ppo),
        "robot_sha256": robot_digest(robot),
    }
    saved = read_saved(flags.resume, robot, finetuning=False) if flags.resume else None
    for change in check_resumed(flags, saved, settings) if saved else []:
        print(f"Changed since the checkpoint: {change}")
    run_dir = prepare_run_dir(flags, f"{robot.name}-base")
    print(f"Training '{robot.name}': {num_envs} robots on {device}, {iterations} iterations, in {run_dir}", flush=True)
    return Job(
        command="train", flags=flags, robot=robot, device=device, num_envs=num_envs, iterations=iterations,
        task=flags.task, ppo=flags.ppo, settings=settings, saved=saved, run_dir=run_dir, began=began,
    )  # fmt: skip
