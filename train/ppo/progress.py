"""Progress of a training: printed rows, TensorBoard's scalars, and the training record."""

import os
import time
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - made at run time
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
from tensorboard.summary.writer.record_writer import RecordWriter

from kernels.rewards import REWARDS
from qd.search.progress import clock
from sim.files.atomic import explain_failed_write
from sim.files.intervals import format_value
from train.ppo.checkpoint import STD
from train.ppo.learner import Iteration, Learner

_ROWS = 100  # over a whole training
_ENDS = ("time_out", "base_collision", "tilt", "invalid", "goal", "out")
_HEADER = (
    f"{'left':>8} {'iteration':>10} {'steps/s':>8} {'reward':>7} {'length':>7} {'falls':>6} {'goal':>6} {'v err':>6} "
    f"{'level':>6} {'std':>5}"
)


class TrainingProgress:
    """Collects iterations into rows, which are printed, written to TensorBoard and recorded."""

    def __init__(
        self, run_dir: Path, learner: Learner, iterations: int, *, origin: dict[str, Any], saved: dict[str, Any] | None
    ) -> None:
        """Begin a piece of training of ``iterations`` in all; only the first of several processes prints and writes.

        ``origin`` is the provenance of this piece, ``saved`` the :meth:`state` of the pieces before.
        """
        self._learner = learner
        self._iterations = iterations
        self._origin = origin
        self._state = saved or {"env_steps": 0, "wall_s": 0.0, "pieces": [], "curve": []}
        self._state["pieces"].append({**origin, "from_iteration": learner.iteration})
        self._began = time.monotonic() - self._state["wall_s"]
        self._window: list[Iteration] = []
        self._events = run_dir / f"events.out.tfevents.{time.time():.0f}.{os.getpid()}"
        if learner.ranks.is_first:
            _write_event(self._events, Event(file_version="brain.Event:2"))
            print(_HEADER, flush=True)

    def add(self, step: Iteration) -> None:
        """Count an iteration; finish a row if one is due."""
        self._window.append(step)
        self._state["env_steps"] += self._learner.steps_per_iteration
        if self._learner.iteration % max(1, self._iterations // _ROWS) == 0:
            self.finish_row()

    def state(self) -> dict[str, Any]:
        """Plain data for the next piece."""
        return self._state | {"wall_s": round(time.monotonic() - self._began, 1)}

    def record(self) -> dict[str, Any]:
        """The training record: provenance, totals, the pieces of the training, and the curve."""
        return {
            **self._origin,
            "robot": self._learner.env.task.robot.name,
            "iterations": self._learner.iteration,
            "num_envs": self._learner.env.num_envs,
            **self.state(),
        }

    def finish_row(self) -> None:
        """Make a row of the iterations since the last one, if there are any."""
        learner = self._learner
        window = self._window
        task = learner.env.task
        if not window:
            return
        self._window = []
        collection_s = sum(step.collection_s for step in window)
        learning_s = sum(step.learning_s for step in window)
        sums = task.read_statistics()
        episodes = sums["episodes"]
        steps = max(sums["steps"], 1.0)
        dt = task.robot.control_dt
        row = {
            "iteration": learner.iteration,
            "env_steps": self._state["env_steps"],
            "wall_s": self.state()["wall_s"],
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
        self._state["curve"].append(_rounded(row))
        if learner.ranks.is_first:
            self._print(row)
            groups = {"train": row} | {name: values for name, values in row.items() if isinstance(values, dict)}
            scalars = [
                Summary.Value(tag=f"{group}/{name}", simple_value=value)
                for group, values in groups.items()
                for name, value in values.items()
                if isinstance(value, int | float)
            ]
            _write_event(self._events, Event(step=learner.iteration, summary=Summary(value=scalars)))

    def _print(self, row: dict[str, Any]) -> None:
        left_s = (self._iterations - row["iteration"]) * (row["collection_s"] + row["learning_s"])
        forms = {"reward": ".2f", "length_s": ".1f", "fall_rate": ".3f", "goal_rate": ".3f"}
        reward, length, falls, goals = (format_value(row[name], None, form) for name, form in forms.items())
        print(
            f"{clock(left_s):>8} {row['iteration']:>5}/{self._iterations:<4} {row['env_steps_per_s']:>8,.0f} "
            f"{reward:>7} {length:>6}s {falls:>6} {goals:>6} {row['lin_vel_error']:>6.3f} {row['level']:>6.2f} "
            f"{row['noise_std']:>5.2f}",
            flush=True,
        )
        if row["ends"]["invalid"] or row["overflows"]:
            print(f"  {row['ends']['invalid']} invalid states reset, {row['overflows']} steps with a solver overflow")


def _write_event(file: Path, event: Event) -> None:
    """Adds to TensorBoard's file. Its own writer works in a thread, which dies with a traceback on a full disk."""
    event.wall_time = time.time()
    with explain_failed_write(file), file.open("ab") as opened:
        RecordWriter(opened).write(event.SerializeToString())


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return float(f"{value:.5g}") if isinstance(value, float) else value
