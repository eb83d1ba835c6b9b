"""How fast training is, simulation and learning together: train_speed.json, by number of GPUs and robots.

On several GPUs: torchrun --nproc-per-node 2 -m results.make.train_speed; its rows join those of one GPU.
"""

import json
import statistics
from collections.abc import Sequence
from typing import Any

import torch

from results.make.common import Script, is_current, parse
from train.ppo.learner import Learner, PpoCfg, Ranks
from train.task.task import CommandTask, TaskCfg
from train.task.vec_env import CommandVecEnv

WARM_UP = 10


def time_training(script: Script, device: str, num_envs: int, iterations: int) -> dict[str, Any]:
    """Median time of an iteration and what follows from it.

    The shipped controller walks the robots, so that contacts are those of the better part of a training; its weights go
    on being trained.
    """
    task = CommandTask(script.robot, TaskCfg.of(script.robot), num_envs=num_envs, device=device, seed=script.seed)
    learner = Learner(CommandVecEnv(task), PpoCfg(init_noise_std=0.5), seed=script.seed)
    shipped = torch.load(script.policy, map_location="cpu", weights_only=True)["actor_state_dict"]
    learner.alg.get_policy().load_state_dict(shipped)
    timed = [learner.iterate() for _ in range(WARM_UP + iterations)][WARM_UP:]
    seconds = statistics.median(step.collection_s + step.learning_s for step in timed)
    return {
        "gpus": learner.ranks.size,
        "num_envs": num_envs,
        "iteration_s": seconds,
        "collection_s": statistics.median(step.collection_s for step in timed),
        "learning_s": statistics.median(step.learning_s for step in timed),
        "train_env_steps_per_s": learner.steps_per_iteration / seconds,
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Times 4,096 and 8,192 robots a GPU and writes a row each."""
    script = parse(__doc__, argv, "train_speed.json")
    ranks = Ranks.of_environment()
    counts, iterations = ((16,), 1) if script.small else ((4096, 8192), 40)
    rows = [time_training(script, ranks.device(script.device), count, iterations) for count in counts]
    if ranks.is_first:
        sizes = {row["gpus"] for row in rows}
        before = json.loads(script.out.read_text())["rows"] if is_current(script.out) else []
        script.write({"rows": [*(row for row in before if row["gpus"] not in sizes), *rows]})


if __name__ == "__main__":
    main()
