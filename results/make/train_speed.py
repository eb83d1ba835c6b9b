"""How fast training is, simulation and learning together: train_speed.json, by number of GPUs and robots.

On several GPUs: torchrun --nproc-per-node 2 -m results.make.train_speed; its rows join those of one GPU.
``--parts gate`` measures in place of it what a gate of the published pack costs a training, called every 500 iterations
on its GPU, and every 50 on another device: gate.json.
Beside mjlab, in the same run: pip install --target FOLDER mjlab==1.6.0, and MJLAB=FOLDER before the command. It trains
in a process of its own, since it wants other versions of packages (peer.py).
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from qd.evaluate.gate import GateProcess, gate
from results.make import peer
from results.make.common import Script, parse
from sim.files.provenance import device_name
from train.ppo.learner import CommandVecEnv, Learner, PpoCfg, Ranks
from train.task.task import CommandTask, TaskCfg

WARM_UP = 10
SIZES = ((4096, peer.STEPS), (8192, PpoCfg.steps_per_env))
"""Robots a GPU and steps an iteration: those of mjlab, and those of a training."""
GATE = """seed = {seed}
[[check]]
pack = "{robot}@1"
limit = 0.5
"""
GATED = {"same_gpu": (500, 3), "other_device": (50, 8)}
"""How many iterations lie between two gates, and how many gates are timed."""


def make_learner(script: Script, device: str, num_envs: int, steps: int) -> tuple[Learner, PpoCfg]:
    """A training that has begun, and its settings.

    The shipped controller walks the robots, so that contacts are those of the better part of a training; its weights go
    on being trained.
    """
    task = CommandTask(script.robot, TaskCfg.of(script.robot), num_envs=num_envs, device=device, seed=script.seed)
    cfg = PpoCfg(init_noise_std=0.5, steps_per_env=steps)
    learner = Learner(CommandVecEnv(task), cfg, seed=script.seed)
    shipped = torch.load(script.policy, map_location="cpu", weights_only=True)["actor_state_dict"]
    learner.alg.get_policy().load_state_dict(shipped)
    for _ in range(WARM_UP):
        learner.iterate()
    return learner, cfg


def time_training(script: Script, device: str, num_envs: int, steps: int, iterations: int) -> dict[str, Any]:
    """Median time of an iteration of some steps and what follows from it."""
    learner, cfg = make_learner(script, device, num_envs, steps)
    timed = [learner.iterate() for _ in range(iterations)]
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


def time_gates(script: Script, device: str) -> dict[str, Any]:
    """What gates cost a training: ``cost`` is the share by which iterations are slower with them.

    On the training's GPU one gate at a time runs, between stretches without one; its cost is spread over the iterations
    between two calls. On the other device gates are called as often as they are to be, whether or not those before them
    have ended.
    """
    learner, _ = make_learner(script, device, *((8, 24) if script.small else SIZES[-1]))

    def iterate(count: int) -> list[float]:
        steps = [learner.iterate() for _ in range(count)]
        return [step.collection_s + step.learning_s for step in steps]

    rows = dict[str, Any]()
    others = {"same_gpu": device, "other_device": "cuda:1" if torch.cuda.device_count() > 1 else "cpu"}
    pause = 2 if script.small else 100
    with tempfile.TemporaryDirectory() as folder:
        for first, (name, (every, count)) in enumerate(GATED.items()):
            every, count = (1, 1) if script.small else (every, count)
            alone, beside, called = iterate(pause), list[float](), list[GateProcess]()
            for k in range(count):
                file = Path(folder, f"{name}-{k}.toml")
                file.write_text(GATE.format(seed=1000 * first + k, robot=script.robot.name))  # nothing is in the cache
                how = {"out": file.with_suffix(".json"), "device": others[name]}
                called.append(gate(script.policy, script.robot.name, file, **how))
                if name == "other_device":
                    beside += iterate(every)
                    continue
                while not called[-1].ended:
                    beside += iterate(1)
                alone += iterate(pause)
            slower = sum(beside) - len(beside) * statistics.mean(alone)
            rows[name] = {
                "device": device_name(others[name]),
                "every": every,
                "gates": count,
                "check_s": statistics.median(each.result(600.0)["checks"][0]["wall_s"] for each in called),
                "iteration_s_alone": statistics.mean(alone),
                "iteration_s_beside": statistics.mean(beside),
                "iterations_beside": len(beside) / count,
                "cost": slower / (count * every * statistics.mean(alone)),
            }
    return {"num_envs": learner.env.num_envs, **rows}


def time_mjlab(folder: str, device: str, num_envs: int) -> dict[str, Any]:
    """The same of mjlab, which lies in a folder."""
    path = os.pathsep.join([folder, *filter(None, [os.environ.get("PYTHONPATH")])])
    words = [sys.executable, "-m", peer.__name__, str(num_envs), device]
    environment = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "disable"}
    done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return {"gpus": 1, "device": device_name(device), **json.loads(done.stdout.splitlines()[-1])}


def main(argv: Sequence[str] | None = None) -> None:
    """Times both sizes, and mjlab if there is one; each row says which run it is of."""
    script = parse(__doc__, argv, "train_speed.json", parts=("gate",))
    ranks = Ranks.from_environment()
    sizes, iterations = (((8, 24), (16, 24)), 1) if script.small else (SIZES, 40)
    if ranks.size > 1:  # several processes make one training alone
        sizes = sizes[-1:]
    device = ranks.device(script.device)
    if script.parts:
        replace(script, out=script.out.with_name("gate.json")).write({"gate": time_gates(script, device)})
        return
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
