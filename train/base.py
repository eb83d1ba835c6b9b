"""Train a base controller from scratch on rough terrain."""

import os
import tempfile
import time
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from train.ppo.cfg import PpoCfg, TrainingFlags
from train.task.cfg import TaskCfg

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg
    from train.ppo.run import Job

_SMALL = {"num_envs": 32, "iterations": 20}  # on the CPU


@dataclass(frozen=True, kw_only=True)
class Train(TrainingFlags):
    """Train a base controller from scratch: PPO on legged_gym's rough-terrain task.

    On CUDA ANYmal trains 8192 robots for 2240 iterations, Cassie 2048 for 3400; on the CPU 32 for 20, enough to see
    that it runs. Ctrl-C or --max-seconds saves and stops; --resume RUN_DIR goes on with the settings of that run,
    except for flags that are given. On several GPUs: torchrun --nproc-per-node 4 -m faultline train, each with
    --num-envs.
    """

    command: ClassVar[str] = "train"
    task: TaskCfg
    """The task, with the robot's own settings."""

    @classmethod
    def begun(cls, robot: "RobotCfg", settings: dict[str, Any] | None) -> dict[str, Any]:
        """The flags that follow from a robot, or that a run was begun with."""
        if settings is None:
            return {"task": TaskCfg.of(robot), "ppo": PpoCfg.of(robot)}
        return {name: settings[name] for name in ("seed", "num_envs", "iterations", "task", "ppo")}

    def execute(self) -> int:
        """Trains; returns the exit status: 0, or 130 after Ctrl-C.

        Raises:
            ValueError: If a flag's value cannot be used; raised before any long work.
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
    from sim.robots.find import get_robot
    from train.ppo.learner import Ranks
    from train.ppo.run import Job, check_resumed, device_of, prepare_run_dir, read_saved, settings_of, sizes_of

    robot, device = get_robot(flags.robot), device_of(flags)
    on_gpu = {"num_envs": robot.learning.num_envs, "iterations": robot.learning.iterations}
    size = sizes_of(flags, on_gpu, _SMALL, device=device)
    settings = settings_of(flags, robot, size, flags.task, flags.ppo) | {"processes": Ranks.of_environment().size}
    saved = read_saved(flags.resume, robot, flags.command) if flags.resume else None
    for change in check_resumed(flags, saved, settings) if saved else []:
        print(f"Changed since the checkpoint: {change}")
    run_dir = prepare_run_dir(flags, f"{robot.name}-base")
    words = f"{size['num_envs']} robots on {device}, {size['iterations']} iterations"
    print(f"Training '{robot.name}': {words}, in {run_dir}", flush=True)
    return Job(
        flags=flags, robot=robot, device=device, **size, task=flags.task, ppo=flags.ppo, settings=settings, saved=saved,
        run_dir=run_dir, began=began,
    )  # fmt: skip
