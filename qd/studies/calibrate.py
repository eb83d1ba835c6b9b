"""Penalty scales: what each raw penalty comes to on hard-random terrains, so that the six can be added and compared.

The scale of a penalty is its mean over all valid episodes or, where it is 0 in over half of them, over the others.
Scales are measured once with the shipped controller, before any search, and never tuned on an archive.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.run.cli import run_command
from qd.workers.evaluator import EvaluatorCfg, check_policy, open_evaluator, origin_of, resolve_device
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.policy.spec import ControllerSpec

if TYPE_CHECKING:
    from sim.rollout import RolloutResult

_CPU_TERRAINS = 16  # at once: enough to keep some cores busy, little enough memory


@dataclass(frozen=True, kw_only=True)
class CalibrateCfg:
    """Measure the penalty scales of a robot with a controller, on hard-random terrains.

    Writes them beside the robot's own controller, or the settings file of a robot that is not shipped, where every
    search reads them.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    policy: str | None = None
    """Controller: a file, file.py:callable or module:callable; the one that comes with the robot."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    terrains: int = 300
    """Hard-random terrains."""
    replicas: int = 20
    """Episodes a terrain."""
    seed: int = 0
    """Draws terrains and starts."""
    workers: int | Literal["auto"] | None = None
    """Cross on so many Ray workers, a GPU or a CPU core each; auto: as many as there are."""
    out: Path | None = None
    """Where to write; sim/robots/<robot>.scales.json, or <name>.scales.json beside a settings file."""


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


def calibrate(cfg: CalibrateCfg) -> Path:
    """Measure the scales, print them, write the file; returns its path.

    Raises:
        ValueError: If something asked for cannot be had, or a penalty never occurred.
    """
    from sim.robots.robot import get_robot
    from sim.space import SUPER_GAUSSIAN

    if cfg.terrains < 1 or cfg.replicas < 1:
        raise ValueError(f"terrains and replicas must be at least 1, got {cfg.terrains} and {cfg.replicas}")
    robot = get_robot(cfg.robot)
    if cfg.policy is not None and cfg.out is None and robot.settings_file is None:
        raise ValueError(
            "the scales kept with a robot are those of its shipped controller, got another one (--policy): "
            "name a file for its scales with --out"
        )
    device = resolve_device(cfg.device, cfg.workers)
    policy = cfg.policy or str(robot.policy_file)
    check_policy(policy, robot, device)
    out = cfg.out or robot.scales_file
    prepare_output(out)
    print(f"Crossing {cfg.terrains} hard-random terrains {cfg.replicas} times on {device}.", flush=True)
    evaluator = EvaluatorCfg(
        robot=robot,
        policy=policy,
        num_terrains=cfg.terrains if device.startswith("cuda") else min(cfg.terrains, _CPU_TERRAINS),
        num_replicas=cfg.replicas,
        device=device,
        workers=cfg.workers,
    )
    genes = SUPER_GAUSSIAN.hard_random(cfg.terrains, cfg.seed)
    seeds = np.random.SeedSequence(cfg.seed).generate_state(cfg.terrains, np.uint32)
    with open_evaluator(evaluator) as evaluate, tqdm(total=100, unit="%", desc="calibrate", disable=None) as bar:
        result = evaluate(genes, seeds, lambda share: _move(bar, share))
    report = {
        **origin_of(device, cfg.seed, cfg.workers),
        "robot": robot.name,
        "policy": ControllerSpec.parse(policy).label,
        **_measured(result),
    }
    write_atomically(out, to_json(report))
    print("\n".join(f"  {name:<14}{scale:12.4f}" for name, scale in report["scales"].items()))
    print(f"Written to {out}")
    return out


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


def _move(bar: tqdm, share: float) -> None:
    bar.update(round(100 * share) - bar.n)


if __name__ == "__main__":
    run_command(CalibrateCfg, calibrate)
