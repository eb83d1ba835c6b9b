"""Training a base controller; the loop of all trainings, their checkpoints, and the controller with its record."""

import io
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import torch
from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - made at run time
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
from tensorboard.summary.writer.record_writer import RecordWriter

from kernels.rewards import REWARDS
from qd.evaluate.sets import TRAINED_ON
from qd.search.archive import ARCHIVE_FILE
from qd.search.directory import CHECKPOINT_FILE
from qd.search.progress import clock
from qd.search.settings import differences
from sim.controllers.described import format_controller
from sim.controllers.spec import is_same_controller
from sim.device import resolve_device
from sim.files.atomic import explain_failed_write, locked, prepare_output, read_json, to_json, write_atomically
from sim.files.command import Interrupted
from sim.files.intervals import format_value
from sim.files.provenance import provenance
from sim.robots.robot import RobotCfg, robot_digest
from train.cfg import RUN, RunCfg, TrainCfg
from train.ppo.checkpoint import CHECKPOINT, DESCRIPTION, POLICY, STD, Start, read_checkpoint, write_checkpoint
from train.ppo.learner import CommandVecEnv, Iteration, Learner, Ranks
from train.task.task import CommandTask
from train.task.tiles import Mix

DESCRIBED = "controller.toml"
"""File of a training's directory with the description of its controller, if it has one."""
CONFIG = "config.json"
SAVE_EVERY_S = 60.0
_SEED_STEP = 1_000_003  # between the tasks of two processes
_FREE = ("iterations", "archive", "space")
"""Settings that may differ when a training goes on. Of archives and spaces, hashes are compared."""

_ROWS = 100  # over a whole training
_ENDS = ("time_out", "base_collision", "tilt", "invalid", "goal", "out", "strayed")
_HEADER = (
    f"{'left':>8} {'iteration':>10} {'steps/s':>8} {'reward':>7} {'length':>7} {'falls':>6} {'goal':>6} {'v err':>6} "
    f"{'level':>6} {'std':>5}"
)


@contextmanager
def stop_request() -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets, so that a training ends its iteration and saves. A second signal kills."""
    stop = threading.Event()

    def request(kind: int, _frame: object) -> None:
        stop.set()
        signal.signal(kind, signal.SIG_DFL)

    handlers = {kind: signal.signal(kind, request) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for kind, handler in handlers.items():
            signal.signal(kind, handler)


def train(robot: RobotCfg, cfg: TrainCfg, run_dir: Path, run: RunCfg = RUN) -> Path:
    """Trains a controller by PPO on legged_gym's rough-terrain task; returns its file, ``<run_dir>/policy.pt``.

    It goes on where the directory holds a checkpoint of the same settings. torchrun may start several processes of it,
    each with its GPU and ``cfg.num_envs`` robots. ``run_dir`` gets checkpoint, controller, record and TensorBoard file.
    """
    device = find_device(run.device)
    cfg = cfg.sized(robot, device)
    settings = dump_settings(cfg, robot)
    saved = read_saved(run_dir, "train", robot.name) if (run_dir / CHECKPOINT).exists() else None
    if saved is not None:
        check_resumed(run_dir, saved, settings)
    with run_directory(run_dir, run.export):
        if Ranks.from_environment().is_first:
            sizes = f"{cfg.num_envs} robots on {device}, {cfg.iterations} iterations"
            print(f"Training '{robot.name}': {sizes}, in {run_dir}", flush=True)
        return Training(robot, cfg, run_dir, device=device, settings=settings, saved=saved).run(run.export)


def find_device(name: str | None) -> str:
    """Warp device name of this process of a training; ``name`` is what the user asked for."""
    device = Ranks.from_environment().device(resolve_device(name))
    if device.startswith("cuda") and not torch.cuda.is_available():
        problem = f"device '{device}' asked for, but this torch ({torch.__version__}) has no CUDA"
        raise ValueError(f"{problem}: install a CUDA build or use --device cpu")
    return device


def dump_settings(cfg: TrainCfg, robot: RobotCfg) -> dict[str, Any]:
    """The settings that determine a training, checked, as plain values."""
    cfg.check(robot)
    return {**asdict(cfg), "robot_sha256": robot_digest(robot)}


@contextmanager
def run_directory(run_dir: Path, export: Path | None) -> Iterator[None]:
    """Makes and locks the directory of a training, and checks that files can be written there."""
    if not Ranks.from_environment().is_first:
        yield
        return
    if any((run_dir / name).exists() for name in (ARCHIVE_FILE, CHECKPOINT_FILE)):
        raise ValueError(f"{run_dir} must be the directory of a training, got that of a search: give another")
    if export is not None:
        if export.suffix != ".pt":
            raise ValueError(f"export must be a file named *.pt, got {export}")
        if export.exists() and not is_same_controller(str(export), str(run_dir / POLICY)):
            raise ValueError(f"export {export} exists and is of another training: move it, or name another")
        prepare_output(export)
    prepare_output(run_dir / CONFIG)  # last: what is refused leaves no directory
    with locked(run_dir, f"another training works in {run_dir}: let it end, or give another directory"):
        yield


def read_saved(run_dir: Path, kind: Literal["train", "finetune"], robot: str) -> dict[str, Any]:
    """The checkpoint in a training's directory; refuses one of another kind or robot."""
    saved = read_checkpoint(run_dir / CHECKPOINT)
    if (saved["kind"], saved["robot"]) != (kind, robot):
        got = f"one of `faultline {saved['kind']}` with robot {saved['robot']}: give another directory"
        raise ValueError(f"{run_dir} must hold a run of `faultline {kind} --robot {robot}`, got {got}")
    return saved


def check_resumed(run_dir: Path, saved: dict[str, Any], settings: dict[str, Any]) -> None:
    """Refuses to go on with other settings than a training was begun with, or with fewer iterations than are done."""
    both = (saved["settings"], settings)
    before, now = ({name: value for name, value in each.items() if name not in _FREE} for each in both)
    if different := differences(before, now):
        raise ValueError(f"{run_dir} was begun with other settings: {', '.join(different)}: give those")
    if (done := saved["iter"]) > (wanted := settings["iterations"]):
        raise ValueError(f"iterations must be at least {done}, which {run_dir} has done, got {wanted}")


def is_finished(run_dir: Path, iterations: int, export: Path | None) -> bool:
    """Whether a training has done its iterations and written its controller, also to ``export``."""
    record = (run_dir / POLICY).with_suffix(".train.json")
    if export is not None:
        last_written = ".toml" if (run_dir / DESCRIBED).exists() else ".train.json"
        if not (export.with_suffix(last_written).exists() and is_same_controller(str(export), str(run_dir / POLICY))):
            return False
    return record.exists() and read_json(record).get("iterations") == iterations


class Training:
    """A training, of a base controller or, with a mix of terrains, a fine-tuning.

    Attributes:
        critic_iterations: First iterations, in which the critic learns alone.
        averaged_from: The iteration after which actors count into the controller.
    """

    def __init__(
        self,
        robot: RobotCfg,
        cfg: TrainCfg,
        run_dir: Path,
        *,
        device: str,
        settings: dict[str, Any],
        saved: dict[str, Any] | None,
        mix: Mix | None = None,
        facts: dict[str, Any] | None = None,
        start: Start | None = None,
    ) -> None:
        """Begins, with the networks of ``start`` if given, or goes on from a checkpoint (:func:`read_saved`).

        Without ``mix`` robots walk on the tiles of the curriculum. Checkpoint and record have ``settings``
        (:func:`dump_settings`) under one key and each of ``facts`` under its own.
        """
        self._cfg, self._run_dir, self._settings, self._mix = cfg, run_dir, settings, mix
        self._facts = facts or {}
        self.critic_iterations: int = self._facts.get("critic_iterations", 0)
        self.averaged_from = max(round((1.0 - cfg.ppo.average) * cfg.iterations), self.critic_iterations)
        ranks = Ranks.from_environment()
        tiles = mix and (mix.next() if saved is None else mix.restore(saved["mix"]))
        seed = cfg.seed + _SEED_STEP * ranks.rank
        self.task = CommandTask(robot, cfg.task, num_envs=cfg.num_envs, device=device, seed=seed, tiles=tiles)
        # On given terrains every episode is whole, because the crossings of each terrain are counted.
        env = CommandVecEnv(self.task, start and start.controller)
        self.learner = Learner(env, cfg.ppo, seed=cfg.seed, random_ages=mix is None)
        if saved is not None:
            self.learner.resume(saved)
        elif start is not None:
            self.learner.start_from(start)
        self._origin = {**provenance(device, cfg.seed), "settings": settings, "processes": ranks.size}
        self._progress = saved["progress"] if saved else {"env_steps": 0, "wall_s": 0.0, "pieces": [], "curve": []}
        self._progress["pieces"].append({**self._origin, "from_iteration": self.learner.iteration})
        self._began = time.monotonic() - self._progress["wall_s"]
        self._window: list[Iteration] = []  # iterations since the last row
        self._events = run_dir / f"events.out.tfevents.{time.time():.0f}.{os.getpid()}"
        if ranks.is_first:
            self._write_event(file_version="brain.Event:2")
            print(_HEADER, flush=True)

    def before_iteration(self) -> None:
        """Exchanges a mix's terrains when that is due; lets the actor learn after its critic's first iterations."""
        if self._mix is None:
            return
        iteration = self.learner.iteration
        if iteration // self._mix.cfg.recipe.swap_every > self._mix.swap:
            self.task.exchange(self._mix.next(self.task.counts()))
            self.learner.begin()
        self.learner.alg.let_actor_learn(iteration >= self.critic_iterations)
        if iteration == self.critic_iterations:
            self.learner.alg.begin_actor()

    def state(self) -> dict[str, Any]:
        """Content of a checkpoint."""
        controller = self.learner.env.controller
        return {
            **self.learner.state(),
            "kind": "train" if self._mix is None else "finetune",
            "settings": self._settings,
            "progress": self._dump_progress(),
            **({} if controller is None else {DESCRIPTION: format_controller(controller)}),
            **({} if self._mix is None else {"mix": self._mix.state(self.task.counts())}),
            **self._facts,
        }

    def run(self, export: Path | None) -> Path:
        """Iterates until all is done or a stop is requested, and saves, also to ``export``; returns the controller."""
        learner = self.learner
        ranks = learner.ranks
        if ranks.is_first:
            write_atomically(self._run_dir / CONFIG, to_json(self._settings))
        last_save = time.monotonic()
        if learner.iteration - learner.averaged < self.averaged_from:  # a shorter training averaged other actors
            learner.count_into_mean(False)
        with stop_request() as stop:
            while ranks.all_true(learner.iteration < self._cfg.iterations and not stop.is_set(), learner.env.device):
                self.before_iteration()
                step = learner.iterate()
                learner.count_into_mean(learner.iteration > self.averaged_from)
                self._window.append(step)
                self._progress["env_steps"] += learner.steps_per_iteration
                if learner.iteration % max(1, self._cfg.iterations // _ROWS) == 0:
                    self._finish_row()
                if time.monotonic() - last_save > SAVE_EVERY_S and ranks.is_first:
                    write_checkpoint(self._run_dir / CHECKPOINT, self.state())
                    last_save = time.monotonic()
            self._finish(export)
        if stop.is_set():
            done = f"{learner.iteration} of {self._cfg.iterations} iterations"
            raise Interrupted(f"Stopped after {done}; the same command goes on in {self._run_dir}.")
        return self._run_dir / (POLICY if learner.env.controller is None else DESCRIBED)

    def _finish(self, export: Path | None) -> None:
        learner = self.learner
        learner.ranks.check_same([*learner.alg.actor.parameters(), *learner.alg.critic.parameters()])
        self._finish_row()
        if not learner.ranks.is_first:
            return
        write_checkpoint(self._run_dir / CHECKPOINT, self.state())
        done = {"robot": self.task.robot.name, "iterations": learner.iteration, "num_envs": learner.env.num_envs}
        record = {**self._origin, **done, **self._dump_progress(), "averaged": learner.averaged, **self._facts}
        for path in filter(None, (self._run_dir / POLICY, export)):
            write_controller(path, learner, record)
            file = path
            if learner.env.controller is not None:
                file = path.with_suffix(".toml") if path == export else path.with_name(DESCRIBED)
                write_atomically(file, format_controller(replace(learner.env.controller, policy=path.name)).encode())
            print(f"Controller and training record written to {file} and {path.with_suffix('.train.json').name}")

    def _dump_progress(self) -> dict[str, Any]:
        """Plain data for the next piece of the training."""
        return self._progress | {"wall_s": round(time.monotonic() - self._began, 1)}

    def _finish_row(self) -> None:
        """Makes a row of the iterations since the last one, if there are any."""
        window, self._window = self._window, []
        if not window:
            return
        learner, task = self.learner, self.task
        collection_s = sum(step.collection_s for step in window)
        learning_s = sum(step.learning_s for step in window)
        sums = task.read_statistics()
        episodes = sums["episodes"]
        steps = max(sums["steps"], 1.0)
        dt = task.robot.control_dt
        row = {
            "iteration": learner.iteration,
            "env_steps": self._progress["env_steps"],
            "wall_s": self._dump_progress()["wall_s"],
            "env_steps_per_s": len(window) * learner.steps_per_iteration / (collection_s + learning_s),
            "collection_s": collection_s / len(window),
            "learning_s": learning_s / len(window),
            "episodes": int(episodes),
            "reward": sums["episode_reward"] / episodes if episodes else None,
            "length_s": sums["episode_steps"] / episodes * dt if episodes else None,
            "fall_rate": (sums["base_collision"] + sums["tilt"]) / episodes if episodes else None,
            "goal_rate": sums["goal"] / episodes if episodes and task.cfg.crosses else None,
            "ends": {name: int(sums[name]) for name in _ENDS},
            "overflows": int(sums["overflow"]),
            "lin_vel_error": sums["lin_vel_error"] / steps,
            "yaw_rate_error": sums["yaw_rate_error"] / steps,
            "level": float(task.levels.float().mean()),
            "level_by_type": task.level_by_type(),
            "terms": {name: sums[name] / (steps * dt) for name in REWARDS},
            "losses": window[-1].losses,
            "learning_rate": learner.alg.learning_rate,
            "noise_std": float(learner.actor_state()[STD].mean()),
        }
        self._progress["curve"].append(_rounded(row))
        if not learner.ranks.is_first:
            return
        left_s = (self._cfg.iterations - learner.iteration) * (row["collection_s"] + row["learning_s"])
        forms = {"reward": ".2f", "length_s": ".1f", "fall_rate": ".3f", "goal_rate": ".3f"}
        reward, length, falls, goals = (format_value(row[name], None, form) for name, form in forms.items())
        print(
            f"{clock(left_s):>8} {learner.iteration:>5}/{self._cfg.iterations:<4} {row['env_steps_per_s']:>8,.0f} "
            f"{reward:>7} {length:>6}s {falls:>6} {goals:>6} {row['lin_vel_error']:>6.3f} {row['level']:>6.2f} "
            f"{row['noise_std']:>5.2f}",
            flush=True,
        )
        if row["ends"]["invalid"] or row["overflows"]:
            print(f"  {row['ends']['invalid']} invalid states reset, {row['overflows']} steps with a solver overflow")
        groups = {"train": row} | {name: values for name, values in row.items() if isinstance(values, dict)}
        tagged = {f"{group}/{name}": value for group, values in groups.items() for name, value in values.items()}
        numbers = {tag: value for tag, value in tagged.items() if isinstance(value, int | float)}
        scalars = [Summary.Value(tag=tag, simple_value=value) for tag, value in numbers.items()]
        self._write_event(step=learner.iteration, summary=Summary(value=scalars))

    def _write_event(self, **content: Any) -> None:
        """Adds to TensorBoard's file. Its own writer works in a thread, which dies with a traceback on a full disk."""
        with explain_failed_write(self._events), self._events.open("ab") as opened:
            RecordWriter(opened).write(Event(wall_time=time.time(), **content).SerializeToString())


def write_controller(path: Path, learner: Learner, record: dict[str, Any]) -> None:
    """Writes the actor, or the mean of the last ones, and the training record ``<stem>.train.json`` beside it.

    Layers are in half precision, whose error is small beside the differences between trainings. Readers compute in
    single precision, so that a controller behaves the same wherever it is measured.
    """
    buffer = io.BytesIO()
    trained_on = {TRAINED_ON: record[TRAINED_ON]} if TRAINED_ON in record else {}  # for a copy without its record
    actor = learner.mean_actor_state()
    for key, half in {key: value.half() for key, value in actor.items() if value.ndim > 1}.items():
        if half.isfinite().all():  # not if a number is too large for half precision
            actor[key] = half
    activation = "elu" if learner.env.controller is None else learner.env.controller.activation
    torch.save({"actor_state_dict": actor, "activation": activation, "iter": learner.iteration, **trained_on}, buffer)
    write_atomically(path, buffer.getvalue())
    write_atomically(path.with_suffix(".train.json"), to_json(record))


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return float(f"{value:.5g}") if isinstance(value, float) else value
