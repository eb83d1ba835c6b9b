"""What all trainings share: a job, iterating until told to stop, checkpoints, the controller at the end."""

import io
import signal
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from qd.evaluate.marks import TRAINED_ON
from qd.run.settings import differences
from sim.device import resolve_device
from sim.files.atomic import locked, prepare_output, read_json, to_json, write_atomically
from sim.files.command import command_line
from sim.files.records import check_robot, provenance, robot_digest
from sim.files.settings import problems
from sim.policy.spec import is_same
from sim.robots.robot import RobotCfg
from sim.spaces.registry import is_own
from train.ppo.cfg import PpoCfg, TrainingFlags, ppo_problems
from train.ppo.learner import Learner, Ranks, check_entries, read_checkpoint
from train.ppo.progress import STATE, Progress
from train.task.cfg import TaskCfg, task_problems
from train.task.curriculum import Tiles
from train.task.task import CommandTask
from train.task.vec_env import CommandVecEnv

CHECKPOINT = "checkpoint.pt"
POLICY = "policy.pt"
CONFIG = "config.json"
_RESERVE_S = 10.0  # of a time limit, for the last save
_SEED_STEP = 1_000_003  # between the tasks of two processes


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


@dataclass(frozen=True, kw_only=True)
class Job:
    """A training that can begin: everything that a user may have got wrong has been checked."""

    flags: TrainingFlags
    robot: RobotCfg
    device: str
    """Warp device name."""
    num_envs: int
    iterations: int
    task: TaskCfg
    ppo: PpoCfg
    settings: dict[str, Any]
    """What makes the training what it is: plain values, as a checkpoint keeps them."""
    saved: dict[str, Any] | None
    """The checkpoint that it goes on from."""
    run_dir: Path
    began: float
    """When the command began, on the clock of :func:`time.monotonic` [s]."""


def device_of(flags: TrainingFlags) -> str:
    """Warp device name of this process of a training.

    Raises:
        ValueError: If there is no such device, or torch has no CUDA for it.
    """
    device = Ranks.of_environment().device(resolve_device(flags.device))
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(
            f"device '{device}' asked for, but this torch ({torch.__version__}) has no CUDA: install a CUDA build "
            "or use --device cpu"
        )
    return device


def sizes_of(flags: TrainingFlags, on_gpu: dict[str, int], small: dict[str, int], *, device: str) -> dict[str, int]:
    """Sizes of a training: those of its flags; left out, those ``on_gpu``, or the ``small`` ones of the CPU."""
    on_cuda = device.startswith("cuda")
    sizes = on_gpu if on_cuda else small
    if not on_cuda and flags.num_envs is None and flags.iterations is None:
        print(
            f"No GPU: a small training of {sizes['num_envs']} robots and {sizes['iterations']} iterations, enough to "
            "see that it runs. A whole one takes minutes on one GPU."
        )
    given = {name: getattr(flags, name) for name in sizes}
    return {**sizes, **{name: value for name, value in given.items() if value is not None}}


def settings_of(
    flags: TrainingFlags, robot: RobotCfg, size: dict[str, int], task: TaskCfg, ppo: PpoCfg
) -> dict[str, Any]:
    """The settings that every training has, checked, as plain values.

    Raises:
        ValueError: If nothing can be learned with flags or settings, naming all that are wrong.
    """
    own = [line for line in problems(flags) if not line.startswith(("task.", "ppo."))]
    found = [*own, *task_problems(task, robot.control_dt), *ppo_problems(ppo, size["num_envs"])]
    if found:
        raise ValueError("; ".join(found))
    return {
        "seed": flags.seed,
        "num_envs": size["num_envs"],
        "iterations": size["iterations"],
        "task": asdict(task),
        "ppo": asdict(ppo),
        "robot_sha256": robot_digest(robot),
    }


def prepare_run_dir(flags: TrainingFlags, name: str) -> Path:
    """The run directory, made and fit to be written to; a new one is called after ``name`` and the date.

    Raises:
        ValueError: If it holds another run, one of the places cannot be written to, or the controller has another name.
    """
    run_dir = flags.run_dir or flags.resume or _new_place(f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")
    export, resume = flags.export, flags.resume
    if export is not None and export.suffix != ".pt":
        raise ValueError(
            f"export must be a file named *.pt, got {export}: faultline export-policy makes an ONNX file of it"
        )
    if (run_dir / CHECKPOINT).exists() and (resume is None or run_dir.resolve() != resume.resolve()):
        raise ValueError(
            f"{run_dir} already holds a training run: go on with --resume {run_dir}, or name another --run-dir"
        )
    config = run_dir / CONFIG
    if config.exists() and "settings" in read_json(config):
        raise ValueError(f"{run_dir} holds the run of a search, not of a training: name another --run-dir")
    if export is not None:
        if export.exists() and not flags.overwrite and not is_same(str(export), str(run_dir / POLICY)):
            raise ValueError(f"{export} is there already: give --overwrite to replace it, or another --export")
        prepare_output(export)
    prepare_output(config)  # last: what is refused leaves no run directory
    return run_dir


def _new_place(name: str) -> Path:
    """A directory that is not there yet: small trainings may begin in the same second."""
    place, number = Path("runs") / name, 1
    while place.exists():
        number += 1
        place = Path("runs") / f"{name}-{number}"
    return place


# Going on with a run ---------------------------------------------------------------------------------------------


def read_saved(run: Path, robot: RobotCfg, command: str) -> dict[str, Any]:
    """The checkpoint of a run of this robot, with the progress it had made.

    Args:
        run: Its directory.
        robot: The robot.
        command: What goes on with it: train or finetune.

    Raises:
        ValueError: As :func:`train.ppo.learner.read_checkpoint`, or if it is the run of the other command, or of
            the robot before it changed.
    """
    path = run / CHECKPOINT
    saved = read_checkpoint(path, robot.name)
    extra = saved["extra"]
    check_entries(extra, STATE, path)
    made_by = "finetune" if "mix" in extra or "mix" in extra["settings"] else "train"
    if made_by != command:
        kind = "a fine-tuning" if made_by == "finetune" else "the training of a base controller, not a fine-tuning"
        other = f", or fine-tune what it made with `{command_line(command, robot=robot.spec, policy=path)}`"
        raise ValueError(
            f"{run} is {kind}: go on with `{command_line(made_by, robot=robot.spec, resume=run)}`"
            f"{other if command == 'finetune' else ''}"
        )
    if command == "finetune":
        check_entries(extra, {"mix": (dict,)}, path)
    check_robot(extra["settings"], robot, path, "begin a new run")
    return saved


def check_resumed(flags: TrainingFlags, saved: dict[str, Any], settings: dict[str, Any]) -> list[str]:
    """How the present settings of a run that goes on differ from those it was begun with, one line each.

    Raises:
        ValueError: If it has done more iterations already than they ask for.
    """
    if saved["iter"] > settings["iterations"]:
        raise ValueError(f"{flags.resume} has done {saved['iter']} iterations already: give at least as many in all")
    there = saved["extra"]["settings"]
    older = {"task": {"start_spread": 0.0, **there["task"]}, "ppo": {"average": 0.0, **there["ppo"]}}
    return differences({**there, **older}, settings)  # older ones name neither


# The training itself ---------------------------------------------------------------------------------------------


class Training:
    """A training at work: the task, what learns on it, and how far it is.

    Attributes:
        job: What was asked for.
        task: The robots.
        learner: PPO on them.
        progress: Rows and record.
    """

    extra: dict[str, Any]
    """What record and checkpoint say beside the progress; of a fine-tuning the elites it was trained on."""

    def __init__(self, job: Job, *, tiles: Tiles | None = None, random_ages: bool = True) -> None:
        """Begin, or go on from the checkpoint of the job, on ``tiles`` or else on those of the curriculum."""
        self.job, self.extra = job, {}
        seed, rank = job.flags.seed, Ranks.of_environment().rank
        self.task = CommandTask(
            job.robot, job.task, num_envs=job.num_envs, device=job.device, seed=seed + _SEED_STEP * rank, tiles=tiles
        )
        self.learner = Learner(CommandVecEnv(self.task), job.ppo, seed=seed, random_ages=random_ages)
        if job.saved is not None:
            self.learner.resume(job.saved)
        self.progress = Progress(
            job.run_dir,
            self.learner,
            job.iterations,
            rows=job.flags.rows,
            about={**provenance(job.device, seed), "settings": job.settings},
            saved=job.saved and job.saved["extra"],
        )

    def before_iteration(self) -> None:
        """What a kind of training does before each iteration: nothing."""

    @property
    def averaged_from(self) -> int:
        """The iteration after which actors count into the controller."""
        return round((1.0 - self.job.ppo.average) * self.job.iterations)

    def next_command(self) -> str:
        """The command to look at the controller with."""
        return command_line("evaluate", robot=self.job.robot.spec, policy=self.job.run_dir / POLICY)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the learner."""
        return {**self.progress.state(), **self.extra}

    def save(self) -> None:
        """Writes a checkpoint."""
        self.learner.save(self.job.run_dir / CHECKPOINT, self.state())

    def iterate(self, stop: StopRequest) -> None:
        """Iterates until all is done, a stop is requested, or another iteration might end past the time limit."""
        learner, flags = self.learner, self.job.flags
        deadline = self.job.began + flags.max_seconds - _RESERVE_S if flags.max_seconds else float("inf")
        if learner.iteration - learner.averaged < self.averaged_from:  # of a shorter run: its last ones are others
            learner.count_into_mean(False)
        slowest, last_save = 0.0, time.monotonic()

        def wanted() -> bool:
            in_time = time.monotonic() + slowest < deadline
            return learner.iteration < self.job.iterations and not stop.requested and in_time

        while learner.ranks.all_want(wanted(), learner.env.device):
            self.before_iteration()
            step = learner.iterate()
            learner.count_into_mean(learner.iteration > self.averaged_from)
            if self.progress.warm:  # the first iteration compiles and is no measure
                slowest = max(slowest, step.collection_s + step.learning_s)
            self.progress.add(step)
            if time.monotonic() - last_save > flags.save_every_s:
                self.save()
                last_save = time.monotonic()

    def finish(self) -> None:
        """Writes the last checkpoint, and the controller with its record at every place asked for."""
        learner = self.learner
        learner.ranks.check_same([*learner.alg.actor.parameters(), *learner.alg.critic.parameters()])
        self.progress.close()
        self.save()
        record = {**self.progress.record(), "averaged": learner.averaged, **self.extra}
        export = self.job.flags.export
        of = f"the mean of the last {learner.averaged} actors" if learner.averaged > 1 else "the last actor"
        for path in (self.job.run_dir / POLICY, *([export] if export else [])):
            export_policy(path, learner, record)
            print(f"Controller ({of}) and training record written to {path} and {path.with_suffix('.train.json').name}")


def export_policy(path: Path, learner: Learner, record: dict[str, Any]) -> None:
    """Writes the actor, or the mean of the last ones, and the training record ``<stem>.train.json`` beside it.

    Layers are in half precision, which takes half of the room and is finer than what training leaves to chance. All
    who read the file compute in single precision, so that a controller is its file, wherever it is measured.
    """
    buffer = io.BytesIO()
    marks = {TRAINED_ON: record[TRAINED_ON]} if TRAINED_ON in record else {}  # known of a copy without its record too
    actor = {key: _in_half(value) if value.ndim > 1 else value for key, value in learner.mean_actor_state().items()}
    torch.save({"actor_state_dict": actor, "iter": learner.iteration, **marks}, buffer)
    write_atomically(path, buffer.getvalue())
    write_atomically(path.with_suffix(".train.json"), to_json(record))


def _in_half(weights: torch.Tensor) -> torch.Tensor:
    """In half precision; as they are where it has no such large numbers."""
    half = weights.half()
    return half if bool(half.isfinite().all()) else weights


def run_training(job: Job, begin: Callable[[], Training]) -> int:
    """Trains what ``begin`` makes of a job, and says how to go on; returns the exit status: 0, or 130 after Ctrl-C.

    Raises:
        ValueError: If the run is another training's, or its checkpoint does not fit.
        FloatingPointError: If the training leaves the finite numbers; the last checkpoint is kept.
        OSError: If a file cannot be written.
    """
    run_dir, checkpoint = job.run_dir, job.run_dir / CHECKPOINT
    space = getattr(job.flags, "space", None)
    named = space if space and is_own(space) else None
    again = {"resume": run_dir, "space": named, "export": job.flags.export, "overwrite": job.flags.overwrite}
    go_on = f"Go on with: {command_line(job.flags.command, robot=job.robot.spec, **again)}"
    busy = f"another training works in {run_dir}: let it end, or name another --run-dir"
    with StopRequest() as stop, locked(run_dir, busy):
        training = begin()
        flags = asdict(job.flags, dict_factory=_given)
        write_atomically(run_dir / CONFIG, to_json({**flags, "device": job.device}))
        try:
            training.iterate(stop)
            training.finish()
        except OSError as error:
            raise (OSError(f"{error}. {go_on}") if checkpoint.exists() else error) from error
        except FloatingPointError as error:
            kept = "the last checkpoint is kept" if checkpoint.exists() else "nothing was saved before"
            raise FloatingPointError(f"{error}; {kept} in {run_dir}: lower --ppo.learning-rate") from error
    done, following = training.learner.iteration, training.next_command()
    if done < job.iterations:
        print(f"Stopped after {done} of {job.iterations} iterations. {go_on}")
    else:
        print(f"Next, see what it did:  {following}")
    return 130 if stop.requested else 0


def _given(flags: list[tuple[str, Any]]) -> dict[str, Any]:
    """Flags as JSON has them: those that were left out are absent, paths are text."""
    return {name: _as_text(value) for name, value in flags if value is not None}


def _as_text(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_as_text(item) for item in value]
    return str(value) if isinstance(value, Path) else value
