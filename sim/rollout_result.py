"""What comes of a rollout, and what can be looked at while it runs."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from kernels.episode import Outcome


@dataclass(frozen=True, kw_only=True)
class RolloutResult:
    """What came of every episode; arrays lead with (num_terrains, num_replicas)."""

    penalties: np.ndarray
    """Raw penalty sums times the physics step, unscaled; (T, R, P) float64, NaN where invalid."""
    penalty_names: tuple[str, ...]
    outcome: np.ndarray
    """:class:`kernels.episode.Outcome` of each episode, uint8."""
    fallen: np.ndarray
    """Tilt above 60 degrees at the end, bool."""
    duration_s: np.ndarray
    """Simulated time up to the end [s], float32."""
    final_position: np.ndarray
    """Base position at the end, world-local [m], (T, R, 3) float32."""
    physics_steps: int
    """Physics steps run until the last episode ended."""
    wall_s: float
    paths: np.ndarray | None = None
    """Base position at every control step [m], NaN after the end; (T, R, steps, 3) float32, or None."""
    reward: np.ndarray | None = None
    """Training reward summed to the end of the time, (T, R) float64, NaN where invalid; None unless asked for."""

    @property
    def base_collision(self) -> np.ndarray:
        """Ended by base collision, bool."""
        return self.outcome == Outcome.BASE_COLLISION

    @property
    def reached_goal(self) -> np.ndarray:
        """Ended at the goal, bool."""
        return self.outcome == Outcome.GOAL

    @property
    def invalid(self) -> np.ndarray:
        """Non-finite, too fast or overflowed, bool."""
        return self.outcome == Outcome.INVALID


@dataclass(frozen=True, kw_only=True)
class RolloutState:
    """Device arrays (Warp) of a rollout between two control steps, referred to, not copied; one row an environment."""

    joint_q: Any
    """Joint coordinates, shape (num_envs, 7 + num_joints)."""
    geom_force: Any
    """Contact force on each geom of ``robot.geom_names`` in the last physics step, world frame [N], vectors of shape
    (num_envs, num_geoms)."""
    penalty_sums: Any
    """Columns :data:`kernels.penalties.PENALTIES`, times the physics step, shape (num_envs, 6)."""
    command: Any
    """Command of the coming control step, zero once an episode has ended, shape (num_envs, 3)."""
    outcome: Any
    """:class:`kernels.episode.Outcome`, shape (num_envs,)."""
    steps: Any
    """Physics steps up to the end, shape (num_envs,)."""
