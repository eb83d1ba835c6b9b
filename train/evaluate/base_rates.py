"""Success, goal and fallen rates of one controller by terrain type and level, and its velocity error on flat ground."""

from typing import Any

import numpy as np
from tqdm import tqdm

from qd.workers.evaluator import Evaluate
from sim.files.intervals import bootstrap_interval
from sim.rollout import RolloutResult
from sim.terrain import CROSSING_TYPES
from train.evaluate.measures import count_outcomes, invalid_lines, terrain_rates
from train.evaluate.sets import plain_set

VELOCITY_FROM_S = 2.0
"""The velocity error counts from this time of an episode on [s]: before it the robot gets going."""


def _group(rates: dict[str, np.ndarray], members: np.ndarray) -> dict[str, Any]:
    chosen = {name: values[members & ~np.isnan(values)] for name, values in rates.items()}
    means = {name: float(values.mean()) if len(values) else None for name, values in chosen.items()}
    return {"terrains": int(members.sum()), **means}


def summarise(
    result: RolloutResult, seed: int, *, types: np.ndarray | None = None, levels: np.ndarray | None = None
) -> dict[str, Any]:
    """Rates over a set of terrains, with 95 % intervals and, where known, by type and level.

    Args:
        result: Crossings of the set.
        seed: Of the bootstrap.
        types: Index into ``CROSSING_TYPES`` of each terrain, shape (num_terrains,).
        levels: Level of each terrain, likewise.
    """
    rates = {f"{name}_rate": values for name, values in terrain_rates(result).items()}
    everywhere = np.ones(len(result.outcome), bool)
    summary = _group(rates, everywhere)
    rng = np.random.default_rng(seed)
    for name, values in rates.items():
        summary[f"{name}_interval"] = bootstrap_interval(values[~np.isnan(values)], rng)
    summary["episodes"] = int(result.outcome.size)
    summary["outcomes"] = count_outcomes(result)
    summary["invalid_terrains"] = int(np.isnan(rates["success_rate"]).sum())
    by_type = by_level = None
    if types is not None:
        by_type = {CROSSING_TYPES[k]: _group(rates, types == k) for k in np.unique(types)}
    if levels is not None:
        by_level = {str(level): _group(rates, levels == level) for level in np.unique(levels)}
    return {**summary, "by_type": by_type, "by_level": by_level}


def velocity_error(result: RolloutResult, seed: int) -> dict[str, Any]:
    """Mean of ``|v_x - v_x,cmd|`` from 2 s to the end of each valid episode [m/s], base frame, every physics step.

    Args:
        result: Crossings whose penalties were summed from :data:`VELOCITY_FROM_S` on.
        seed: Of the bootstrap.
    """
    counted_s = result.duration_s - VELOCITY_FROM_S
    usable = ~result.invalid & (counted_s > 0.0)
    error = result.penalties[..., result.penalty_names.index("vel_x")] / np.where(usable, counted_s, 1.0)
    per_terrain = np.array([row[use].mean() for row, use in zip(error, usable, strict=True) if use.any()])
    return {
        "vx_error_mean": float(error[usable].mean()) if usable.any() else None,
        "vx_error_interval": bootstrap_interval(per_terrain, np.random.default_rng(seed)),
        "episodes": int(usable.sum()),
        "goal_rate": float(result.reached_goal.mean()),
    }


def evaluate_sets(evaluate: Evaluate, count: int, seed: int) -> dict[str, Any]:
    """The three sets of ``base.json``: ``hand_crafted``, ``hard_random`` and ``flat``.

    Args:
        evaluate: Crosses terrains; its penalties count from :data:`VELOCITY_FROM_S` on.
        count: Terrains a set.
        seed: Draws the test sets.
    """
    sets = {name: plain_set(name, count, seed) for name in ("hand_crafted", "hard_random", "flat")}
    results = {}
    for name, chosen in sets.items():
        with tqdm(desc=name, total=100, unit="%", disable=None) as bar:

            def show(share: float, bar: tqdm = bar) -> None:
                bar.update(round(100 * share) - bar.n)

            results[name] = evaluate(chosen.terrains, chosen.seeds, show)
    types, levels = sets["hand_crafted"].types, sets["hand_crafted"].levels
    return {
        "hand_crafted": summarise(results["hand_crafted"], seed, types=types, levels=levels),
        "hard_random": summarise(results["hard_random"], seed),
        "flat": velocity_error(results["flat"], seed),
    }


def print_rates(report: dict[str, Any]) -> None:
    """Print what :func:`evaluate_sets` found."""
    print(f"{'':<24}{'success':>16}{'goal':>16}{'fallen':>8}{'terrains':>10}")
    for name in ("hand_crafted", "hard_random"):
        rows = {name: report[name]}
        for group in ("by_type", "by_level"):
            prefix = "level " if group == "by_level" else ""
            rows |= {f"  {prefix}{key}": value for key, value in (report[name][group] or {}).items()}
        for label, row in rows.items():
            cells = [
                "-" if row[key] is None else f"{row[key]:.3f}" for key in ("success_rate", "goal_rate", "fallen_rate")
            ]
            for k, key in enumerate(("success_rate_interval", "goal_rate_interval")):
                if row.get(key):
                    cells[k] += " [{:.2f} {:.2f}]".format(*row[key])
            print(f"{label:<24}{cells[0]:>16}{cells[1]:>16}{cells[2]:>8}{row['terrains']:>10}")
    error = report["flat"]["vx_error_mean"]
    print(f"flat ground: mean |v_x - command| {'-' if error is None else format(error, '.3f')} m/s")
    for line in invalid_lines({name: report[name]["outcomes"] for name in ("hand_crafted", "hard_random")}):
        print(line)
