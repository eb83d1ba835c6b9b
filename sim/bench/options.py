"""What solver and capacity options cost and change: ``python -m sim.bench.options --robot anymal``.

The same crossings of hard-random terrains under each choice: wall time, rates, mean penalties.
"""

import statistics
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from sim.files.command import exit_code_of, publish
from sim.files.provenance import provenance
from sim.robots.robot import RobotCfg, get_robot
from sim.rollout import Rollout, RolloutResult
from sim.simulation import SolverCfg, resolve_device
from sim.space import SUPER_GAUSSIAN


@dataclass(frozen=True, kw_only=True)
class OptionsCfg:
    """Time the crossings of the paper preset under several solver and capacity options."""

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    policy: str | None = None
    """An rsl_rl checkpoint, a TorchScript or ONNX file, or module:callable; the shipped controller."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    terrains: int = 200
    """Hard-random terrains."""
    episodes: int = 20
    """Episodes a terrain."""
    iterations: tuple[int, ...] = (3, 4, 5, 6, 8, 50)
    """Caps on the Newton iterations to try."""
    ls_iterations: tuple[int, ...] = (10,)
    """Caps on the line search to try with each."""
    njmax: tuple[int, ...] = ()
    """Constraint rows an environment to try with the shipped caps, beside the robot's own."""
    nconmax: tuple[int, ...] = ()
    """Contacts an environment to try with each of them, as many as --njmax."""
    rounds: int = 3
    """Rollouts of each choice; the median counts."""
    seed: int = 0
    """Draws terrains and starts."""
    out: Path | None = None
    """Where to write; printed alone if left out."""


def choices(cfg: OptionsCfg, robot: RobotCfg) -> list[tuple[SolverCfg, RobotCfg]]:
    """Every choice of solver options, then of capacities.

    Raises:
        ValueError: If capacities do not come in pairs, or a number is not positive.
    """
    numbers = (*cfg.iterations, *cfg.ls_iterations, *cfg.njmax, *cfg.nconmax, cfg.rounds, cfg.terrains, cfg.episodes)
    if min(numbers) < 1 or not ((cfg.iterations and cfg.ls_iterations) or cfg.njmax):
        raise ValueError(f"all numbers must be positive, and there must be a choice to try, got {cfg}")
    if len(cfg.njmax) != len(cfg.nconmax):
        raise ValueError(f"--nconmax needs as many numbers as --njmax, got {cfg.nconmax} and {cfg.njmax}")
    found = [
        (SolverCfg(iterations=iterations, ls_iterations=line), robot)
        for iterations in cfg.iterations
        for line in cfg.ls_iterations
    ]
    capacities = zip(cfg.njmax, cfg.nconmax, strict=True)
    return found + [(SolverCfg(), replace(robot, njmax=rows, nconmax=contacts)) for rows, contacts in capacities]


def _means(result: RolloutResult) -> dict[str, Any]:
    """Rates and mean penalties of the valid episodes, None where there are none."""
    valid = ~result.invalid
    means = result.penalties[valid].mean(axis=0).tolist() if valid.any() else [None] * len(result.penalty_names)
    return {
        "success_rate": float(1.0 - result.base_collision[valid].mean()) if valid.any() else None,
        "goal_rate": float(result.reached_goal[valid].mean()) if valid.any() else None,
        "invalid": int(result.invalid.sum()),
        "penalties": dict(zip(result.penalty_names, means, strict=True)),
    }


def _cell(value: float | None, form: str) -> str:
    width = form.partition(".")[0]
    return format("-", f">{width}") if value is None else format(value, form)


def measure(cfg: OptionsCfg) -> dict[str, Any]:
    """Everything of the results file.

    Raises:
        ValueError: If something asked for cannot be had.
    """
    robot, device = get_robot(cfg.robot), resolve_device(cfg.device)
    rng = np.random.default_rng(cfg.seed)
    genes = SUPER_GAUSSIAN.hard_random(cfg.terrains, rng)
    seeds = rng.integers(2**32, size=cfg.terrains, dtype=np.uint32)
    tried = choices(cfg, robot)
    rows = []
    for solver, sized in tqdm(tried, desc="choices", disable=None):
        rollout = Rollout(
            sized,
            cfg.policy or robot.policy_file,
            num_terrains=cfg.terrains,
            num_replicas=cfg.episodes,
            device=device,
            solver=solver,
        )
        results = [rollout.evaluate(genes, seeds) for _ in range(cfg.rounds)]
        last = results[-1]
        wall_s = statistics.median(result.wall_s for result in results)
        rows.append(
            {
                "iterations": solver.iterations,
                "ls_iterations": solver.ls_iterations,
                "njmax": sized.njmax,
                "nconmax": sized.nconmax,
                "wall_s": wall_s,
                "world_steps_per_s": last.outcome.size * last.physics_steps / wall_s,
                **_means(last),
            }
        )
        del rollout
    return {**provenance(device, cfg.seed), "robot": robot.name, "episodes": cfg.terrains * cfg.episodes, "rows": rows}


def _print_table(report: dict[str, Any]) -> None:
    names = list(report["rows"][0]["penalties"])
    head = f"{'iterations':>10} {'search':>6} {'rows':>5} {'contacts':>8} {'wall s':>7} {'M steps/s':>9}"
    print(f"{head} {'success':>7} {'goal':>6} {'invalid':>7} " + " ".join(f"{name:>13}" for name in names))
    for row in report["rows"]:
        print(
            f"{row['iterations']:>10} {row['ls_iterations']:>6} {row['njmax']:>5} {row['nconmax']:>8} "
            f"{row['wall_s']:>7.2f} {row['world_steps_per_s'] / 1e6:>9.3f} "
            f"{_cell(row['success_rate'], '7.4f')} {_cell(row['goal_rate'], '6.4f')} {row['invalid']:>7} "
            + " ".join(_cell(row["penalties"][name], "13.4f") for name in names)
        )


def run(cfg: OptionsCfg) -> int:
    """Measure, print the table, write the file; returns the exit status."""
    publish(cfg.out, lambda: measure(cfg), _print_table)
    return 0


def main() -> int:
    """Command line; returns the exit status."""
    cfg = tyro.cli(OptionsCfg, description=__doc__)
    return exit_code_of(lambda: run(cfg))


if __name__ == "__main__":
    sys.exit(main())
