"""What all trainings share: a run directory, iterating until told to stop, checkpoints, the controller at the end."""

import io
import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch

from sim.files.atomic import check_writable, locked, read_json, to_json, write_atomically
from train.evaluate.held_out import TRAINED_ON
from train.ppo.learner import Learner, check_entries, read_checkpoint
from train.ppo.progress import STATE, Progress

CHECKPOINT = "checkpoint.pt"
POLICY = "policy.pt"
CONFIG = "config.json"
RESERVE_S = 10.0
"""Kept back of a time limit for the last save [s]."""


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


def check_least(**numbers: tuple[int | None, int]) -> None:
    """Refuse numbers below the least that they may be, each ``name=(number, least)``; none is left to a default.

    Raises:
        ValueError: Naming the first such.
    """
    for name, (number, least) in numbers.items():
        if number is not None and number < least:
            raise ValueError(f"{name} must be at least {least}, got {number}")


def check_limits(*, rows: int, save_every_s: float, max_seconds: float | None) -> None:
    """Refuse limits that mean nothing.

    Raises:
        ValueError: If there is no row, or a time is negative or none.
    """
    if rows < 1:
        raise ValueError(f"rows must be at least 1, got {rows}")
    if not save_every_s >= 0.0:
        raise ValueError(f"save_every_s must be at least 0 s, got {save_every_s}")
    if max_seconds is not None and not max_seconds > 0.0:
        raise ValueError(f"max_seconds must be above 0 s, got {max_seconds}; leave it out for no limit")


def prepare_run_dir(run_dir: Path, *, resume: Path | None, export: Path | None) -> Path:
    """The run directory, made and fit to be written to.

    Args:
        run_dir: Where to write.
        resume: Run to go on from; the only one that may be written over.
        export: Where else the controller goes.

    Raises:
        ValueError: If it holds another run, one of the places cannot be written to, or the controller has another name.
    """
    if export is not None and export.suffix != ".pt":
        raise ValueError(
            f"export must be a file named *.pt, got {export}: python -m sim.policy.export makes ONNX files of it"
        )
    if (run_dir / CHECKPOINT).exists() and (resume is None or run_dir.resolve() != resume.resolve()):
        raise ValueError(
            f"{run_dir} already holds a training run: go on with --resume {run_dir}, or name another --run-dir"
        )
    config = run_dir / CONFIG
    if config.exists() and "settings" in read_json(config):
        raise ValueError(f"{run_dir} holds the run of a search, not of a training: name another --run-dir")
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        if export is not None:
            export.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot write to {error.filename}: {error.strerror}; name another place") from error
    for folder in {run_dir, export.parent if export else run_dir}:
        check_writable(folder)
    return run_dir


def claimed(run_dir: Path) -> AbstractContextManager[None]:
    """Keeps other trainings out of a run directory for the duration of a ``with`` block.

    Raises:
        ValueError: On entering it, if another training works in the directory.
    """
    return locked(run_dir, f"another training works in {run_dir}: let it end, or name another --run-dir")


def plain(value: Any) -> Any:
    """Settings as they come back from a file: paths as text, tuples as lists."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
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


def read_saved(run: Path, robot: str, *, finetuning: bool) -> dict[str, Any]:
    """The checkpoint of a training run, with the progress it had made.

    Args:
        run: Its directory.
        robot: Name of the robot it must be of.
        finetuning: Whether it must be a fine-tuning, else the training of a base controller.

    Raises:
        ValueError: As :func:`train.ppo.learner.read_checkpoint`, or if it is of the other kind.
    """
    path = run / CHECKPOINT
    saved = read_checkpoint(path, robot)
    check_entries(saved["extra"], STATE, path)
    check_entries(saved["extra"]["settings"], {"seed": (int,)}, path)
    _check_kind(run, saved["extra"], finetuning=finetuning)
    if isinstance(saved["extra"]["settings"].get("task"), dict):
        saved["extra"]["settings"]["task"].pop("max_speed", None)  # of older versions; it is the robot's now
    return saved


def check_more(run: Path | None, saved: dict[str, Any] | None, iterations: int) -> None:
    """Refuse fewer iterations in all than the resumed run, if any, has done.

    Raises:
        ValueError: If there are fewer.
    """
    if saved is not None and saved["iter"] > iterations:
        raise ValueError(f"{run} has done {saved['iter']} iterations already: give at least as many in all")


def _check_kind(run: Path, extra: dict[str, Any], *, finetuning: bool) -> None:
    """Refuse to go on from a run of the other kind of training; with the command that does."""
    found = "mix" in extra or "mix" in extra["settings"]
    if found and not finetuning:
        raise ValueError(
            f"{run} is a fine-tuning: go on with make finetune RESUME={run} (python -m train.finetune --resume {run})"
        )
    if finetuning and not found:
        raise ValueError(
            f"{run} is the training of a base controller, not a fine-tuning: go on with make train RESUME={run} "
            f"(python -m train.base --resume {run}), or fine-tune what it made with --policy {run / CHECKPOINT}"
        )


def export_policy(path: Path, learner: Learner, record: dict[str, Any]) -> None:
    """Write the actor under rsl_rl's keys, and the training record ``<stem>.train.json`` beside it."""
    buffer = io.BytesIO()
    marks = {TRAINED_ON: record[TRAINED_ON]} if TRAINED_ON in record else {}  # known of a copy without its record too
    torch.save({"actor_state_dict": learner.actor_state(), "iter": learner.iteration, **marks}, buffer)
    write_atomically(path, buffer.getvalue())
    write_atomically(path.with_suffix(".train.json"), to_json(record))


def iterate(
    learner: Learner,
    progress: Progress,
    *,
    save: Callable[[], None],
    save_every_s: float,
    stop: StopRequest,
    deadline: float,
    before: Callable[[], None] = lambda: None,
) -> None:
    """Iterate until all is done, a stop is requested, or another iteration might end past the deadline.

    Args:
        learner: What learns.
        progress: What is told of every iteration.
        save: Saves everything.
        save_every_s: How often [s].
        stop: Whether to stop.
        deadline: On the clock of :func:`time.monotonic` [s].
        before: Called before each iteration.
    """
    slowest, last_save = 0.0, time.monotonic()

    def wanted() -> bool:
        return learner.iteration < progress.iterations and not stop.requested and time.monotonic() + slowest < deadline

    while learner.ranks.all_want(wanted(), learner.env.device):
        before()
        learner.set_pace(progress.iterations)
        step = learner.iterate()
        if progress.warm:  # the first iteration compiles and is no measure
            slowest = max(slowest, step.collection_s + step.learning_s)
        progress.add(step)
        if time.monotonic() - last_save > save_every_s:
            save()
            last_save = time.monotonic()


def finish(
    learner: Learner,
    progress: Progress,
    *,
    save: Callable[[], None],
    policies: list[Path],
    about: dict[str, Any] | None = None,
) -> None:
    """The last checkpoint, and the controller with its record, ``about`` added, at every place asked for."""
    learner.ranks.check_same([*learner.alg.actor.parameters(), *learner.alg.critic.parameters()])
    progress.close()
    save()
    record = {**progress.record(), **(about or {})}
    for path in policies:
        export_policy(path, learner, record)
        print(f"Controller and training record written to {path} and {path.with_suffix('.train.json').name}")


def resumable(run_dir: Path, error: OSError) -> OSError:
    """An error with how to go on, where that can be done."""
    return OSError(f"{error}. Go on with: --resume {run_dir}") if (run_dir / CHECKPOINT).exists() else error
