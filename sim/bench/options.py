"""What solver and capacity options cost and change: the same crossings under each choice."""

import itertools
import statistics
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from sim.commands import SolverOptions
from sim.files.intervals import value_words
from sim.files.records import identity, provenance
from sim.rates import KINDS, agreement
from sim.robots.robot import RobotCfg, get_robot
from sim.rollout import Rollout, RolloutResult
from sim.simulation import SolverCfg, resolve_device, resolved
from sim.space import SUPER_GAUSSIAN


def choices(cfg: SolverOptions, robot: RobotCfg) -> list[tuple[SolverCfg, RobotCfg]]:
    """Every choice of solver options, then of capacities; resolved contact before them, if asked for.

    Raises:
        ValueError: If capacities do not come in pairs, or there is nothing to try.
    """
    if not (cfg.iterations and cfg.ls_iterations) and not cfg.njmax:
        raise ValueError("there must be a choice to try, got none: give --iterations or --njmax")
    if len(cfg.njmax) != len(cfg.nconmax):
        raise ValueError(f"--nconmax needs as many numbers as --njmax, got {cfg.nconmax} and {cfg.njmax}")
    caps = itertools.product(cfg.iterations, cfg.ls_iterations)
    capacities = zip(cfg.njmax, cfg.nconmax, strict=True)
    fine, fine_solver = resolved(robot)
    return [
        *([(fine_solver, fine)] if cfg.resolved else []),
        *((SolverCfg(iterations=newton, ls_iterations=line), robot) for newton, line in caps),
        *((SolverCfg(), replace(robot, njmax=rows, nconmax=contacts)) for rows, contacts in capacities),
    ]


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


def measure(cfg: SolverOptions) -> dict[str, Any]:
    """Everything of the results file.

    Raises:
        ValueError: If a flag's value cannot be used.
    """
    robot, device = get_robot(cfg.robot), resolve_device(cfg.device)
    policy = cfg.policy or robot.policy_file
    rng = np.random.default_rng(cfg.seed)
    genes = SUPER_GAUSSIAN.hard_random(cfg.terrains, rng)
    seeds = rng.integers(2**32, size=cfg.terrains, dtype=np.uint32)
    tried = choices(cfg, robot)
    rows, fine = [], None
    for solver, sized in tqdm(tried, desc="choices", disable=None):
        rollout = Rollout(
            sized,
            policy,
            num_terrains=cfg.terrains,
            num_replicas=cfg.episodes,
            device=device,
            solver=solver,
        )
        results = [rollout.evaluate(genes, seeds) for _ in range(cfg.rounds)]
        last = results[-1]
        if cfg.resolved and fine is None:
            fine = last
        wall_s = statistics.median(result.wall_s for result in results)
        rows.append(
            {
                "physics_dt": sized.physics_dt,
                "iterations": solver.iterations,
                "ls_iterations": solver.ls_iterations,
                "njmax": sized.njmax,
                "nconmax": sized.nconmax,
                "wall_s": wall_s,
                "world_steps_per_s": last.outcome.size * last.physics_steps / wall_s,
                **_means(last),
                **(
                    {}
                    if fine is None or fine is last
                    else {"against_resolved": agreement(last.outcome, fine.outcome, cfg.seed)}
                ),
            }
        )
        del rollout
    return {
        **provenance(device, cfg.seed),
        **identity(robot, policy),
        "episodes": cfg.terrains * cfg.episodes,
        "rows": rows,
    }


def print_rows(report: dict[str, Any]) -> None:
    """Prints a row a choice."""
    names = list(report["rows"][0]["penalties"])
    head = f"{'step':>5} {'iterations':>10} {'search':>6} {'rows':>5} {'contacts':>8} {'wall s':>7} {'M steps/s':>9}"
    print(f"{head} {'goal':>6} {'no base collision':>17} {'invalid':>7} " + " ".join(f"{name:>13}" for name in names))
    for row in report["rows"]:
        print(
            f"{row['physics_dt']:>5g} {row['iterations']:>10} {row['ls_iterations']:>6} {row['njmax']:>5} "
            f"{row['nconmax']:>8} "
            f"{row['wall_s']:>7.2f} {row['world_steps_per_s'] / 1e6:>9.3f} "
            f"{value_words(row['goal_rate'], None, '.4f'):>6} {value_words(row['success_rate'], None, '.4f'):>17} "
            f"{row['invalid']:>7} "
            + " ".join(f"{value_words(row['penalties'][name], None, '.4f'):>13}" for name in names)
        )
        apart = row.get("against_resolved")
        for kind in KINDS if apart else ():
            bias = value_words(apart[f"{kind}_bias"], apart[f"{kind}_bias_interval"], "+.4f")
            size = value_words(apart[f"{kind}_difference"], None, ".4f")
            print(f"{'':>16} {kind}: {bias} of resolved contact's, {size} apart")
