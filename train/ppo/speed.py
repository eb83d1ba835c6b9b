"""How fast training is: environment steps per second with learning."""

import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim.files.command import OfRobot, OnDevice, publish, show_json
from sim.files.settings import check, setting
from train.ppo.cfg import PpoCfg
from train.task.cfg import TaskCfg

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg


@dataclass(frozen=True, kw_only=True)
class TrainSpeed(OfRobot, OnDevice):
    """Time training iterations, simulation and learning together.

    On several GPUs: torchrun --nproc-per-node 2 -m faultline train-speed; each has --num-envs robots.
    """

    num_envs: tuple[int, ...] = setting((4096, 8192), least=1)
    """Numbers of robots to time."""
    iterations: int = setting(40, least=1)
    """Iterations timed, after 10 that are not."""
    seed: int = setting(0, least=0)
    """Seed of everything drawn."""
    out: Path | None = None
    """Also write the numbers to this file."""

    def execute(self) -> None:
        """Times what is asked for, prints it and writes the file.

        Raises:
            ValueError: If a flag's value cannot be used; raised before any long work.
        """
        from sim.device import resolve_device
        from sim.files.records import provenance
        from sim.robots.find import get_robot
        from train.ppo.learner import Ranks

        check(self)
        ranks = Ranks.of_environment()
        robot, device = get_robot(self.robot), ranks.device(resolve_device(self.device))

        def measure() -> dict[str, Any]:
            size = {"iterations": self.iterations, "device": device, "seed": self.seed}
            runs = [time_training(robot, count, **size) for count in self.num_envs]
            return {**provenance(device, self.seed), "robot": robot.name, "training": runs}

        if ranks.is_first:
            publish(self.out, measure, show_json)
        else:
            measure()


def time_training(robot: "RobotCfg", num_envs: int, *, iterations: int, device: str, seed: int) -> dict[str, Any]:
    """Median time of an iteration and what follows from it.

    The shipped controller, where there is one, walks the robots, so that contacts are those of the better part of a
    training; its weights go on being trained.
    """
    import torch

    from train.ppo.learner import Learner
    from train.task.task import CommandTask
    from train.task.vec_env import CommandVecEnv

    task = CommandTask(robot, TaskCfg.of(robot), num_envs=num_envs, device=device, seed=seed)
    learner = Learner(CommandVecEnv(task), PpoCfg(init_noise_std=0.5), seed=seed)
    if robot.policy_file.exists():
        shipped = torch.load(robot.policy_file, map_location="cpu", weights_only=True)["actor_state_dict"]
        learner.alg.get_policy().load_state_dict(shipped)
    for _ in range(10):
        learner.iterate()
    timed = [learner.iterate() for _ in range(iterations)]
    seconds = statistics.median(step.collection_s + step.learning_s for step in timed)
    return {
        "num_envs": num_envs,
        "gpus": learner.ranks.size,
        "iteration_s": seconds,
        "collection_s": statistics.median(step.collection_s for step in timed),
        "learning_s": statistics.median(step.learning_s for step in timed),
        "train_env_steps_per_s": learner.steps_per_iteration / seconds,
    }
