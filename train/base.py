"""Train a base controller from scratch on rough terrain: ``python -m train.base --robot anymal``.

Ctrl-C or ``--max-seconds`` saves and stops; ``--resume RUN_DIR`` goes on where it stopped.
"""

import argparse
import io
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
import tyro

from sim.command import exit_code_of
from sim.files import check_writable, read_json, to_json, write_atomically
from sim.provenance import provenance
from sim.robot import get_robot
from sim.simulation import resolve_device
from train.learner import Learner, check_entries, read_checkpoint
from train.ppo import PpoCfg
from train.progress import STATE, Progress
from train.ranks import Ranks
from train.task import CommandTask
from train.task_cfg import TaskCfg
from train.vec_env import CommandVecEnv

CHECKPOINT = "checkpoint.pt"
POLICY = "policy.pt"
CONFIG = "config.json"
_ROBOT = "anymal"
_RESERVE_S = 10.0  # kept back of --max-seconds for the last save


@dataclass(frozen=True, kw_only=True)
class BaseCfg:
    """Train a base controller from scratch: PPO on legged_gym's rough-terrain task.

    On several GPUs: torchrun --nproc-per-node 4 -m train.base ..., each of which trains --num-envs robots.
    """

    robot: str = _ROBOT
    """Which robot; its own settings are the defaults of task."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    num_envs: int | None = None
    """Robots trained at once; 8192 on CUDA, 32 on the CPU."""
    iterations: int | None = None
    """Iterations in all, those before a resume included; 2240 on CUDA, 20 on the CPU."""
    max_seconds: float | None = None
    """Save and stop in time to be done this many seconds after the start."""
    run_dir: Path | None = None
    """Where to write; runs/<robot>-base-<date>, or the resumed run."""
    resume: Path | None = None
    """Run directory to go on from."""
    export: Path | None = None
    """Also write the controller to this file and its training record beside it (sim/robots/<robot>.pt ships it)."""
    seed: int | None = None
    """Seed of everything drawn; 0, or that of the resumed run."""
    save_every_s: float = 60.0
    """A checkpoint every so often [s]."""
    rows: int = 100
    """Progress rows over the whole training."""
    task: TaskCfg
    """The task: :meth:`TaskCfg.of` the robot, with what is to be otherwise."""
    ppo: PpoCfg = field(default_factory=PpoCfg)


class StopRequest:
    """Set by Ctrl-C or SIGTERM: the iteration at hand is finished, then everything is saved. A second one kills."""

    def __init__(self) -> None:
        """Not asked yet; listens inside a ``with`` block."""
        self.requested = False

    def __enter__(self) -> "StopRequest":
        self._before = {kind: signal.signal(kind, self._handle) for kind in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for kind, handler in self._before.items():
            signal.signal(kind, handler)

    def _handle(self, kind: int, _frame: object) -> None:
        self.requested = True
        signal.signal(kind, signal.SIG_DFL)


def _resolve_size(cfg: BaseCfg) -> tuple[str, int, int]:
    """Device, number of environments and iterations."""
    device = Ranks.of_environment().device(resolve_device(cfg.device))
    on_cuda = device.startswith("cuda")
    if on_cuda and not torch.cuda.is_available():
        raise ValueError(
            f"device '{device}' asked for, but this torch ({torch.__version__}) has no CUDA: install a CUDA build "
            "or use --device cpu"
        )
    num_envs = cfg.num_envs or (8192 if on_cuda else 32)
    iterations = cfg.iterations or (2240 if on_cuda else 20)
    if not on_cuda and cfg.num_envs is None and cfg.iterations is None:
        print(
            f"No GPU: a small training of {num_envs} robots and {iterations} iterations, enough to see that it runs. "
            "A controller that walks takes about 6 minutes on one GPU."
        )
    return device, num_envs, iterations


def _prepare_run_dir(cfg: BaseCfg) -> Path:
    """The run directory, made and fit to be written to."""
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    run_dir = cfg.run_dir or cfg.resume or Path("runs") / f"{cfg.robot}-base-{stamp}"
    if (run_dir / CHECKPOINT).exists() and (cfg.resume is None or run_dir.resolve() != cfg.resume.resolve()):
        raise ValueError(
            f"{run_dir} already holds a training run: go on with --resume {run_dir}, or name another --run-dir"
        )
    config = run_dir / CONFIG
    if config.exists() and "settings" in read_json(config):
        raise ValueError(f"{run_dir} holds the run of a search, not of a training: name another --run-dir")
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        if cfg.export is not None:
            cfg.export.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot write to {error.filename}: {error.strerror}; name another place") from error
    for folder in {run_dir, cfg.export.parent if cfg.export else run_dir}:
        check_writable(folder)
    return run_dir


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return str(value) if isinstance(value, Path) else value


def changes(before: dict[str, Any], after: dict[str, Any], prefix: str = "") -> list[str]:
    """What differs between two nested settings, one line each."""
    found = []
    for key in sorted(before.keys() | after.keys()):
        old, new = before.get(key), after.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            found += changes(old, new, f"{prefix}{key}.")
        elif old != new:
            found.append(f"{prefix}{key} {old} -> {new}")
    return found


def _read_saved(path: Path, robot: str) -> dict[str, Any]:
    """The checkpoint of a training run, with the progress it had made."""
    saved = read_checkpoint(path, robot)
    check_entries(saved["extra"], STATE, path)
    check_entries(saved["extra"]["settings"], {"seed": (int,)}, path)
    return saved


def export_policy(path: Path, learner: Learner, record: dict[str, Any]) -> None:
    """Write the actor under rsl_rl's keys, and the training record ``<stem>.train.json`` beside it."""
    buffer = io.BytesIO()
    torch.save({"actor_state_dict": learner.actor_state(), "iter": learner.iteration}, buffer)
    write_atomically(path, buffer.getvalue())
    write_atomically(path.with_suffix(".train.json"), to_json(record))


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
    device, num_envs, iterations = _resolve_size(cfg)
    saved = _read_saved(cfg.resume / CHECKPOINT, cfg.robot) if cfg.resume else None
    seed: int = cfg.seed if cfg.seed is not None else saved["extra"]["settings"]["seed"] if saved else 0
    cfg = replace(cfg, seed=seed)
    run_dir = _prepare_run_dir(cfg)
    settings = {
        "seed": seed,
        "num_envs": num_envs,
        "processes": ranks.size,
        "task": asdict(cfg.task),
        "ppo": asdict(cfg.ppo),
    }
    for change in changes(saved["extra"]["settings"], settings) if saved else []:
        print(f"Changed since the checkpoint: {change}")
    print(f"Training '{robot.name}': {num_envs} robots on {device}, {iterations} iterations, in {run_dir}", flush=True)
    with StopRequest() as stop:
        task = CommandTask(robot, cfg.task, num_envs=num_envs, device=device, seed=seed + 1_000_003 * ranks.rank)
        env = CommandVecEnv(task)
        learner = Learner(env, cfg.ppo, seed=seed)
        if saved is not None:
            learner.resume(saved)
        write_atomically(run_dir / CONFIG, to_json({"device": device, **_plain(asdict(cfg))}))
        about = {**provenance(device, seed), "settings": settings}
        progress = Progress(run_dir, learner, iterations, rows=cfg.rows, about=about, saved=saved and saved["extra"])
        deadline = began + cfg.max_seconds - _RESERVE_S if cfg.max_seconds else float("inf")
        try:
            _iterate(learner, progress, cfg, run_dir / CHECKPOINT, stop, deadline)
            _finish(learner, progress, cfg, run_dir)
        except OSError as error:
            if not (run_dir / CHECKPOINT).exists():
                raise
            raise OSError(f"{error}. Go on with: --resume {run_dir}") from error
    if learner.iteration < iterations:
        print(f"Stopped after {learner.iteration} of {iterations} iterations. Go on with: --resume {run_dir}")
    return 130 if stop.requested else 0


def _finish(learner: Learner, progress: Progress, cfg: BaseCfg, run_dir: Path) -> None:
    """The last checkpoint, the controller and its record."""
    learner.ranks.check_same([*learner.alg.actor.parameters(), *learner.alg.critic.parameters()])
    progress.close()
    learner.save(run_dir / CHECKPOINT, progress.state())
    record = progress.record()
    for path in (run_dir / POLICY, cfg.export):
        if path is not None:
            export_policy(path, learner, record)
            print(f"Controller and training record written to {path} and {path.with_suffix('.train.json').name}")


def _iterate(
    learner: Learner, progress: Progress, cfg: BaseCfg, checkpoint: Path, stop: StopRequest, deadline: float
) -> None:
    """Iterate until all is done, a stop is requested, or another iteration might end past the deadline."""
    iterations = progress.iterations
    slowest = 0.0
    last_save = time.monotonic()
    ranks, device = learner.ranks, learner.env.device

    def wanted() -> bool:
        return learner.iteration < iterations and not stop.requested and time.monotonic() + slowest < deadline

    while ranks.all_want(wanted(), device):
        step = learner.iterate()
        if progress.warm:  # the first iteration compiles and is no measure
            slowest = max(slowest, step.collection_s + step.learning_s)
        progress.add(step)
        if time.monotonic() - last_save > cfg.save_every_s:
            learner.save(checkpoint, progress.state())
            last_save = time.monotonic()


def read_arguments(arguments: Sequence[str]) -> BaseCfg:
    """The settings that a command line asks for, those of the named robot where it says nothing.

    Raises:
        ValueError: If there is no such robot.
    """
    named = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    named.add_argument("--robot", default=_ROBOT)
    name = named.parse_known_args(arguments)[0].robot
    default = BaseCfg(robot=name, task=TaskCfg.of(get_robot(name)))
    return tyro.cli(BaseCfg, args=arguments, default=default, description=__doc__)


def main() -> int:
    """Command line; returns the exit status."""
    return exit_code_of(lambda: train(read_arguments(sys.argv[1:])))


if __name__ == "__main__":
    sys.exit(main())
