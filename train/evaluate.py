"""How well a controller crosses: success, goal and fallen rates on fresh terrains, velocity error on flat ground.

``python -m train.evaluate --robot anymal`` evaluates the shipped controller. The terrains are drawn from seeds used
nowhere else: not in training, calibration or search.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

from kernels.episode import Outcome
from qd.workers import Evaluate, EvaluatorCfg, EvaluatorError, check_policy, open_evaluator, origin_of, resolve_device
from sim.command import exit_code_of
from sim.files import prepare_output, to_json, write_atomically
from sim.intervals import bootstrap_interval
from sim.robot import get_robot
from sim.rollout import RolloutResult
from sim.terrain import CROSSING_TYPES, NUM_COLS, NUM_ROWS, hand_crafted_crossings, hard_random_genes

FULL = (300, 20)
"""Terrains a set and episodes a terrain of the published tables."""
SMALL = (24, 4)
"""The same on a machine without a GPU."""
VELOCITY_FROM_S = 2.0
"""The velocity error counts from this time of an episode on [s]: before it the robot gets going."""
_TEST_KEY = 20250604  # with the set's number and the seed, the entropy of a test set
_MAX_INVALID_SHARE = 0.25


@dataclass(frozen=True, kw_only=True)
class EvaluateCfg:
    """Cross fresh terrains with a controller and print how often it got through."""

    robot: str = "anymal"
    """Which robot."""
    policy: str | None = None
    """An rsl_rl checkpoint, a TorchScript file or module:callable; the shipped controller."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    terrains: int | None = None
    """Terrains a set; 300 on CUDA, 24 on the CPU."""
    episodes: int | None = None
    """Episodes a terrain; 20 on CUDA, 4 on the CPU."""
    seed: int = 0
    """Draws other test sets."""
    workers: int | Literal["auto"] | None = None
    """Cross on so many Ray workers, a GPU or a CPU core each; auto: as many as there are."""
    out: Path | None = None
    """Where to write the numbers; of the shipped controller and 300 x 20 results/<robot>/base.json, else nowhere."""


def set_rng(number: int, seed: int) -> np.random.Generator:
    """Random numbers of a test set, shared with no other use of ``seed`` in the project."""
    return np.random.default_rng([_TEST_KEY, number, seed])


def terrain_rates(result: RolloutResult) -> dict[str, np.ndarray]:
    """Success, goal and fallen rate of each terrain over its valid episodes, shape (num_terrains,).

    A terrain more than a quarter of whose episodes are invalid has rate NaN.
    """
    valid = ~result.invalid
    count = valid.sum(axis=1)
    usable = count >= (1.0 - _MAX_INVALID_SHARE) * valid.shape[1]
    kinds = {
        "success_rate": ~result.base_collision,
        "goal_rate": result.reached_goal,
        "fallen_rate": result.fallen,
    }
    return {
        name: np.where(usable, (hit & valid).sum(axis=1) / np.maximum(count, 1), np.nan) for name, hit in kinds.items()
    }


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
    rates = terrain_rates(result)
    everywhere = np.ones(len(result.outcome), bool)
    summary = _group(rates, everywhere)
    rng = np.random.default_rng(seed)
    for name, values in rates.items():
        summary[f"{name}_interval"] = bootstrap_interval(values[~np.isnan(values)], rng)
    summary["episodes"] = int(result.outcome.size)
    summary["outcomes"] = {outcome.name.lower(): int((result.outcome == outcome).sum()) for outcome in Outcome}
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
    rngs = [set_rng(number, seed) for number in range(3)]
    crossings, types, levels = hand_crafted_crossings(count, rngs[0])
    sets = {
        "hand_crafted": crossings,
        "hard_random": hard_random_genes(count, rngs[1]),
        "flat": np.zeros((count, NUM_ROWS, NUM_COLS), np.float32),
    }
    results = {}
    for (name, terrains), rng in zip(sets.items(), rngs, strict=True):
        with tqdm(desc=name, total=100, unit="%", disable=None) as bar:

            def show(share: float, bar: tqdm = bar) -> None:
                bar.update(round(100 * share) - bar.n)

            starts = rng.integers(2**32, size=count, dtype=np.uint32)
            results[name] = evaluate(terrains, starts, show)
    return {
        "hand_crafted": summarise(results["hand_crafted"], seed, types=types, levels=levels),
        "hard_random": summarise(results["hard_random"], seed),
        "flat": velocity_error(results["flat"], seed),
    }


def _print_table(report: dict[str, Any]) -> None:
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
    invalid = {name: report[name]["outcomes"]["invalid"] for name in ("hand_crafted", "hard_random")}
    if any(invalid.values()):
        print(f"invalid episodes, left out: {invalid}")


def evaluate(cfg: EvaluateCfg) -> dict[str, Any]:
    """Evaluate as told, print the table, write the file; returns its content.

    Raises:
        ValueError: If something asked for cannot be had; raised before any long work.
    """
    robot = get_robot(cfg.robot)
    device = resolve_device(cfg.device, cfg.workers)
    small = not device.startswith("cuda")
    terrains, episodes = SMALL if small else FULL
    terrains, episodes = cfg.terrains or terrains, cfg.episodes or episodes
    if small and cfg.terrains is None and cfg.episodes is None:
        print(f"No GPU: {terrains} terrains x {episodes} episodes a set instead of {FULL[0]} x {FULL[1]}.")
    policy = str(cfg.policy or robot.policy_file)
    published = cfg.policy is None and (terrains, episodes) == FULL
    out = cfg.out or (Path("results") / robot.name / "base.json" if published else None)
    if out is not None:
        prepare_output(out)
    check_policy(policy, robot.name, device)
    evaluator = EvaluatorCfg(
        robot=robot.name,
        policy=policy,
        num_terrains=terrains,
        num_replicas=episodes,
        device=device,
        workers=cfg.workers,
        penalties_from_s=VELOCITY_FROM_S,
    )
    with open_evaluator(evaluator) as crossings:
        sets = evaluate_sets(crossings, terrains, cfg.seed)
    report = {**origin_of(device, cfg.seed, cfg.workers), "robot": robot.name, "policy": Path(policy).name, **sets}
    _print_table(report)
    if out is not None:
        write_atomically(out, to_json(report))
        print(f"written to {out}")
    return report


def main() -> int:
    """Command line; returns the exit status."""
    cfg = tyro.cli(EvaluateCfg, description=__doc__)
    return exit_code_of(lambda: int(evaluate(cfg) is None), also=(EvaluatorError,))


if __name__ == "__main__":
    sys.exit(main())
