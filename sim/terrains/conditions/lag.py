"""Observations that are old."""

from collections import deque
from typing import Any

import warp as wp

from kernels.conditions import DisturbedStep
from sim.terrains.conditions.base import Array, Condition, ConditionDose, Gene, round_steps

MAX_LAG_S = 0.06
"""Largest age of observations [s]."""
_STEP_S = 0.02  # a control step of the shipped robots


@wp.func
def _disturb_lag(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int):
    lag = int(wp.round(row[first] / (float(step.every) * step.dt)))
    if lag > 0:
        age, size = step.memory.age[env, column], step.memory.former.shape[1]
        step.memory.former[env, age % size, column] = step.observation[env, column]
        step.observation[env, column] = step.memory.former[env, wp.max(age - lag, 0) % size, column]


class ObservationLag(Condition):
    """Age of what the controller observes [s]; the first observation is shown until there is one so old."""

    name, cause = "lag", "old observations"
    genes = (
        Gene(
            name="lag", low=0.0, middle=MAX_LAG_S / 2, high=MAX_LAG_S, absent=-1.0, step=_STEP_S, unit="s",
            limits=(0.0, MAX_LAG_S),
        ),
    )  # fmt: skip
    dose = ConditionDose(title="age of observations", values=(0.0, 0.02, 0.04, 0.06))
    disturb = _disturb_lag
    disturbs_last = True

    def text(self, values: Array) -> str:
        """The age in milliseconds."""
        return f"observations {1000 * values[0]:.0f} ms old" if values[0] >= 0.0005 else ""

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Keeps as many observations as are needed."""
        episodes.former_rows = deque(maxlen=1 + round_steps(values[0], episodes.robot.control_dt))

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Shows the oldest rows that are kept."""
        episodes.former_rows.append(rows)
        return episodes.former_rows[0].copy()
