"""Settings of the learner."""

from dataclasses import dataclass, fields
from typing import Self

from sim.files.settings import PositiveFloat, PositiveInt, Share, problems
from sim.robots.robot import RobotCfg
from sim.robots.training import PaceCfg


@dataclass(frozen=True, kw_only=True)
class PpoCfg(PaceCfg):
    """Settings of the learner; the defaults are legged_gym's, except the steps."""

    hidden_dims: tuple[PositiveInt, ...] = (512, 256, 128)
    """Hidden layers (ELU) of actor and critic."""
    steps_per_env: PositiveInt = 16
    """Control steps an iteration, per environment; legged_gym's 24 are for half as many environments."""
    epochs: PositiveInt = 5
    """Passes over the data of an iteration."""
    mini_batches: PositiveInt = 4
    """Minibatches a pass."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate at the start; adapted to the KL divergence from then on."""
    gamma: Share = 0.99
    """Discount per control step."""
    lam: Share = 0.95
    """Lambda of generalised advantage estimation."""
    clip: PositiveFloat = 0.2
    """Clip range of the probability ratio and of the value."""
    average: Share = 0.0
    """Share of all iterations, the last ones, whose actors' weights are averaged into the controller; 0: it is the last
    actor. The mean walks a little more smoothly."""

    @classmethod
    def of(cls, robot: RobotCfg) -> Self:
        """The settings that a robot's controller is learned with."""
        return cls(**{pace.name: getattr(robot.learning, pace.name) for pace in fields(PaceCfg)})


def ppo_problems(cfg: PpoCfg, num_envs: int) -> list[str]:
    """What is wrong with the settings of a learner on so many environments of one process, one line each."""
    lines = problems(cfg, "ppo.")
    if lines:
        return lines
    transitions = num_envs * cfg.steps_per_env
    if not cfg.hidden_dims:
        lines.append("ppo.hidden_dims must name at least one layer, got none")
    if cfg.mini_batches > transitions // 2:
        lines.append(
            f"ppo.mini_batches must be at most half of the {num_envs} x {cfg.steps_per_env} transitions of an "
            f"iteration, got {cfg.mini_batches}: give fewer, or more num_envs"
        )
    return lines
