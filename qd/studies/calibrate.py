"""Penalty scales: what each raw penalty comes to on hard-random terrains, so that the six can be added and compared.

The scale of a penalty is its mean over all valid episodes or, where it is 0 in over half of them, over the others.
Scales are measured once with the shipped controller, before any search, and never tuned on an archive.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim.files.command import Where, Who, publish
from sim.files.settings import check, setting
from sim.robots.identity import identity

if TYPE_CHECKING:
    from qd.fresh import Open
    from sim.rollout import RolloutResult

_CPU_TERRAINS = 16  # at once: enough to keep some cores busy, little enough memory


@dataclass(frozen=True, kw_only=True)
class Calibrate(Who, Where):
    """Measure the penalty scales of a robot with a controller, on hard-random terrains.

    Writes them beside the robot's own controller, or beside the settings file of a robot that is not shipped, where
    every search reads them.
    """

    terrains: int = setting(300, least=1)
    """Hard-random terrains."""
    replicas: int = setting(20, least=1)
    """Episodes a terrain."""
    space: str = "super_gaussian"
    """Terrain space that they are drawn from."""
    seed: int = setting(0, least=0)
    """Draws terrains and starts."""
    out: Path | None = None
    """Where to write; sim/robots/<robot>.scales.json, or <name>.scales.json beside a settings file."""

    def execute(self, *, open_evaluator: "Open | None" = None) -> None:
        """Measures the scales and publishes them.

        Args:
            open_evaluator: Opens what crosses the terrains.

        Raises:
            ValueError: If something asked for cannot be had, or a penalty never occurred.
        """
        from qd.run.progress import share_bar
        from qd.workers import evaluator as workers
        from sim.crossing import CrossingCfg
        from sim.robots.robot import get_robot
        from sim.space import get_space

        check(self)
        robot = get_robot(self.robot or "anymal")
        if self.policy is not None and self.out is None and robot.settings_file is None:
            raise ValueError(
                "the scales kept with a robot are those of its shipped controller, got another one (--policy): "
                "name a file for its scales with --out"
            )
        device, policy = workers.resolve_device(self.device, self.workers), self.policy or str(robot.policy_file)
        workers.check_policy(policy, robot, device)
        evaluator = workers.EvaluatorCfg(
            robot=robot,
            policy=policy,
            num_terrains=self.terrains if device.startswith("cuda") else min(self.terrains, _CPU_TERRAINS),
            num_replicas=self.replicas,
            device=device,
            workers=self.workers,
            space=self.space,
        )
        genes = get_space(self.space).hard_random(self.terrains, self.seed)
        seeds = np.random.SeedSequence(self.seed).generate_state(self.terrains, np.uint32)

        def measure() -> dict[str, Any]:
            print(f"Crossing {self.terrains} hard-random terrains {self.replicas} times on {device}.", flush=True)
            opened = open_evaluator or workers.open_evaluator
            with opened(evaluator) as evaluate, share_bar("calibrate") as progress:
                result = evaluate(genes, seeds, progress)
            return {
                **workers.origin_of(device, self.seed, self.workers),
                **identity(robot, policy),
                "space": self.space,
                "crossing": asdict(CrossingCfg()),
                **_measured(result),
            }

        publish(self.out or robot.scales_file, measure, _show)


def penalty_scales(result: "RolloutResult") -> dict[str, float]:
    """Scale of each penalty over the valid episodes of a rollout.

    Raises:
        ValueError: If no episode is valid, or a penalty is 0 in all of them.
    """
    rows: NDArray[np.float64] = np.asarray(result.penalties, dtype=np.float64)[~result.invalid]
    if len(rows) == 0:
        raise ValueError("no episode was valid: there is nothing to measure a scale by; look at the controller")
    scales = {}
    for name, values in zip(result.penalty_names, rows.T, strict=True):
        hit = values > 0.0
        if not hit.any():
            raise ValueError(
                f"penalty '{name}' is 0 in all {len(values)} episodes, so it has no scale: "
                "leave it out of the robot's penalties, or calibrate on more terrains"
            )
        scales[name] = float(values[hit].mean() if hit.mean() < 0.5 else values.mean())
    return scales


def _measured(result: "RolloutResult") -> dict[str, Any]:
    """The scales, and what they were measured on."""
    rows = np.asarray(result.penalties)[~result.invalid]
    shares = (rows > 0.0).mean(axis=0).tolist()
    return {
        "terrains": result.invalid.shape[0],
        "episodes": int(result.invalid.size),
        "invalid_episodes": int(result.invalid.sum()),
        "scales": penalty_scales(result),
        "share_of_episodes_with": dict(zip(result.penalty_names, shares, strict=True)),
    }


def _show(report: dict[str, Any]) -> None:
    print("\n".join(f"  {name:<14}{scale:12.4f}" for name, scale in report["scales"].items()))
