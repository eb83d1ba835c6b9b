"""Train a base controller from scratch on rough terrain: ``python -m train.base --robot anymal``.

Ctrl-C or ``--max-seconds`` saves and stops; ``--resume RUN_DIR`` goes on where it stopped.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path

import torch
import tyro

from sim.files.atomic import to_json, write_atomically
from sim.files.command import exit_code_of
from sim.files.provenance import provenance
from sim.robots.own import own_hash
from sim.robots.robot import get_robot
from sim.robots.training import LearningCfg
from sim.simulation import resolve_device
from train.ppo.learner import Learner
from train.ppo.ppo import PpoCfg, check_ppo
from train.ppo.progress import Progress
from train.ppo.ranks import Ranks
from train.ppo.resumed import task_and_ppo
from train.ppo.run import (
    CHECKPOINT,
    CONFIG,
    POLICY,
    RESERVE_S,
    StopRequest,
    changes,
    check_least,
    check_limits,
    check_more,
    claimed,
    finish,
    iterate,
    plain,
    prepare_run_dir,
    read_saved,
    resumable,
)
from train.task.cfg import TaskCfg
from train.task.task import CommandTask
from train.task.vec_env import CommandVecEnv

_ROBOT = "anymal"


@dataclass(frozen=True, kw_only=True)
class BaseCfg:
    """Train a base controller from scratch: PPO on legged_gym's rough-terrain task.

    On several GPUs: torchrun --nproc-per-node 4 -m train.base ..., each of which trains --num-envs robots.
    """

    robot: str = _ROBOT
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py); its settings are the defaults of
    task and ppo, but of a resumed run, which has its own."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    num_envs: int | None = None
    """Robots trained at once; those of the resumed run, or 8192 on CUDA (Cassie: 2048), 32 on the CPU."""
    iterations: int | None = None
    """Iterations in all, those before a resume included; those of the resumed run, or 2240 on CUDA (Cassie: 3400), 20
    on the CPU."""
    max_seconds: float | None = None
    """Save and stop in time to be done this many seconds after the start."""
    run_dir: Path | None = None
    """Where to write; runs/<robot>-base-<date>, or the resumed run."""
    resume: Path | None = None
    """Run directory to go on from, as it was begun but for what is given otherwise."""
    export: Path | None = None
    """Also write the controller to this file and its training record beside it: sim/robots/<robot>.pt ships it,
    <name>.pt beside the settings file of another robot makes it that robot's own."""
    seed: int | None = None
    """Seed of everything drawn; 0, or that of the resumed run."""
    save_every_s: float = 60.0
    """A checkpoint every so often [s]."""
    rows: int = 100
    """Progress rows over the whole training."""
    task: TaskCfg
    """The task: :meth:`TaskCfg.of` the robot, with what is to be otherwise."""
    ppo: PpoCfg = field(default_factory=PpoCfg)


def _resolve_size(cfg: BaseCfg, learning: LearningCfg) -> tuple[str, int, int]:
    """Device, number of environments and iterations."""
    device = Ranks.of_environment().device(resolve_device(cfg.device))
    on_cuda = device.startswith("cuda")
    if on_cuda and not torch.cuda.is_available():
        raise ValueError(
            f"device '{device}' asked for, but this torch ({torch.__version__}) has no CUDA: install a CUDA build "
            "or use --device cpu"
        )
    check_least(num_envs=(cfg.num_envs, 1), iterations=(cfg.iterations, 1), seed=(cfg.seed, 0))
    num_envs = cfg.num_envs or (learning.num_envs if on_cuda else 32)
    iterations = cfg.iterations or (learning.iterations if on_cuda else 20)
    if not on_cuda and cfg.num_envs is None and cfg.iterations is None:
        print(
            f"No GPU: a small training of {num_envs} robots and {iterations} iterations, enough to see that it runs. "
            "A controller that walks takes minutes on one GPU."
        )
    return device, num_envs, iterations


def _run_dir(cfg: BaseCfg, robot: str) -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    return cfg.run_dir or cfg.resume or Path("runs") / f"{robot}-base-{stamp}"


def train(cfg: BaseCfg) -> int:
    """Train as told; returns the exit status: 0, or 130 after Ctrl-C.

    Raises:
        ValueError: If something asked for cannot be had; raised before any long work.
    """
    ranks = Ranks.of_environment()
    if ranks.is_first:
        return _train(cfg, ranks)
    with tempfile.TemporaryDirectory() as folder, Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
        return _train(replace(cfg, run_dir=Path(folder), export=None), ranks)


def _train(cfg: BaseCfg, ranks: Ranks) -> int:
    """What one process of a training does; only the first one's files are kept."""
    began = time.monotonic()
    robot = get_robot(cfg.robot)
    saved = read_saved(cfg.resume, robot.name, finetuning=False) if cfg.resume else None
    begun = saved["extra"]["settings"] if saved else {}
    sizes = {name: begun[name] for name in ("num_envs", "iterations") if type(begun.get(name)) is int}
    cfg = replace(cfg, **{name: size for name, size in sizes.items() if getattr(cfg, name) is None})
    device, num_envs, iterations = _resolve_size(cfg, robot.learning)
    check_more(cfg.resume, saved, iterations)
    seed: int = cfg.seed if cfg.seed is not None else begun.get("seed", 0)
    cfg = replace(cfg, seed=seed)
    check_ppo(cfg.ppo, num_envs)
    check_limits(rows=cfg.rows, save_every_s=cfg.save_every_s, max_seconds=cfg.max_seconds)
    run_dir = prepare_run_dir(_run_dir(cfg, robot.name), resume=cfg.resume, export=cfg.export)
    settings = {
        "seed": seed,
        "num_envs": num_envs,
        "iterations": iterations,
        "processes": ranks.size,
        "task": asdict(cfg.task),
        "ppo": asdict(cfg.ppo),
        **own_hash(robot),
    }
    for change in changes(begun, settings) if saved else []:
        print(f"Changed since the checkpoint: {change}")
    print(f"Training '{robot.name}': {num_envs} robots on {device}, {iterations} iterations, in {run_dir}", flush=True)
    with StopRequest() as stop, claimed(run_dir):
        task = CommandTask(robot, cfg.task, num_envs=num_envs, device=device, seed=seed + 1_000_003 * ranks.rank)
        env = CommandVecEnv(task)
        learner = Learner(env, cfg.ppo, seed=seed)
        if saved is not None:
            learner.resume(saved)
        write_atomically(run_dir / CONFIG, to_json({"device": device, **plain(asdict(cfg))}))
        about = {**provenance(device, seed), "settings": settings}
        progress = Progress(run_dir, learner, iterations, rows=cfg.rows, about=about, saved=saved and saved["extra"])
        deadline = began + cfg.max_seconds - RESERVE_S if cfg.max_seconds else float("inf")

        def save() -> None:
            learner.save(run_dir / CHECKPOINT, progress.state())

        try:
            iterate(learner, progress, save=save, save_every_s=cfg.save_every_s, stop=stop, deadline=deadline)
            finish(learner, progress, save=save, policies=[run_dir / POLICY, *([cfg.export] if cfg.export else [])])
        except OSError as error:
            raise resumable(run_dir, error) from error
    if learner.iteration < iterations:
        print(f"Stopped after {learner.iteration} of {iterations} iterations. Go on with: --resume {run_dir}")
    return 130 if stop.requested else 0


def read_arguments(arguments: Sequence[str]) -> BaseCfg:
    """The settings that a command line asks for; where it says nothing, those of the resumed run, or of the robot.

    Raises:
        ValueError: If there is no such robot, no such run, or one whose settings cannot be read.
    """
    named = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    named.add_argument("--robot", default=_ROBOT)
    named.add_argument("--resume", type=Path)
    known = named.parse_known_args(arguments)[0]
    robot = get_robot(known.robot)
    task, ppo = TaskCfg.of(robot), PpoCfg.of(robot)
    if known.resume is not None:
        task, ppo = task_and_ppo(known.resume, read_saved(known.resume, robot.name, finetuning=False), robot)
    default = BaseCfg(robot=known.robot, task=task, ppo=ppo)
    return tyro.cli(BaseCfg, args=arguments, default=default, description=__doc__)


def main() -> int:
    """Command line; returns the exit status."""
    return exit_code_of(lambda: train(read_arguments(sys.argv[1:])))


if __name__ == "__main__":
    sys.exit(main())
