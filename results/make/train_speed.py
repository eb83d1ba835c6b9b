"""How fast training is, simulation and learning together: train_speed.json, by number of GPUs and robots.

On several GPUs: torchrun --nproc-per-node 2 -m results.make.train_speed; its rows join those of one GPU.
Beside mjlab, in the same run: pip install --target FOLDER mjlab==1.6.0, and MJLAB=FOLDER before the command. It trains
in a process of its own, since it wants other versions of packages (peer.py).
"""

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import torch

from results.make import peer
from results.make.common import Script, parse
from sim.files.provenance import device_name
from train.ppo.learner import CommandVecEnv, Learner, PpoCfg, Ranks
from train.task.task import CommandTask, TaskCfg

WARM_UP = 10
SIZES = ((4096, peer.STEPS), (8192, PpoCfg.steps_per_env))
"""Robots a GPU and steps an iteration: those of mjlab, and those of a training."""


def time_training(script: Script, device: str, num_envs: int, steps: int, iterations: int) -> dict[str, Any]:
    """Median time of an iteration of some steps and what follows from it.

    The shipped controller walks the robots, so that contacts are those of the better part of a training; its weights go
    on being trained.
    """
    task = CommandTask(script.robot, TaskCfg.of(script.robot), num_envs=num_envs, device=device, seed=script.seed)
    cfg = PpoCfg(init_noise_std=0.5, steps_per_env=steps)
    learner = Learner(CommandVecEnv(task), cfg, seed=script.seed)
    shipped = torch.load(script.policy, map_location="cpu", weights_only=True)["actor_state_dict"]
    learner.alg.get_policy().load_state_dict(shipped)
    timed = [learner.iterate() for _ in range(WARM_UP + iterations)][WARM_UP:]
    seconds = statistics.median(step.collection_s + step.learning_s for step in timed)
    return {
        "gpus": learner.ranks.size,
        "device": device_name(device),
        "num_envs": num_envs,
        **{name: getattr(cfg, name) for name in ("steps_per_env", "epochs", "mini_batches", "hidden_dims")},
        "iteration_s": seconds,
        "collection_s": statistics.median(step.collection_s for step in timed),
        "learning_s": statistics.median(step.learning_s for step in timed),
        "train_env_steps_per_s": learner.steps_per_iteration / seconds,
    }


def time_mjlab(folder: str, device: str, num_envs: int) -> dict[str, Any]:
    """The same of mjlab, which lies in a folder."""
    path = os.pathsep.join([folder, *filter(None, [os.environ.get("PYTHONPATH")])])
    words = [sys.executable, "-m", peer.__name__, str(num_envs), device]
    environment = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "disable"}
    done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return {"gpus": 1, "device": device_name(device), **json.loads(done.stdout.splitlines()[-1])}


def main(argv: Sequence[str] | None = None) -> None:
    """Times both sizes, and mjlab if there is one; each row says which run it is of."""
    script = parse(__doc__, argv, "train_speed.json")
    ranks = Ranks.from_environment()
    sizes, iterations = (((8, 24), (16, 24)), 1) if script.small else (SIZES, 40)
    if ranks.size > 1:  # several processes make one training alone
        sizes = sizes[-1:]
    device = ranks.device(script.device)
    rows = [time_training(script, device, *size, iterations) for size in sizes]
    if ranks.size == 1 and (folder := os.environ.get("MJLAB")):
        rows.append(time_mjlab(folder, device, sizes[0][0]))
    origin = {name: script.origin[name] for name in ("command", "commit", "date")}
    if ranks.size > 1:
        origin["command"] = origin["command"].replace("python", f"torchrun --nproc-per-node {ranks.size}", 1)
    rows = [row | origin for row in rows]  # those of other runs stand beside them
    if ranks.is_first:
        gpus = {row["gpus"] for row in rows}
        before = script.read_so_far(script.out, "versions").get("rows", [])
        script.write({"rows": [*(row for row in before if row["gpus"] not in gpus), *rows]})


if __name__ == "__main__":
    main()
