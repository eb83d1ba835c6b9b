"""How well controllers cross terrains that they were not trained on.

``python -m train.evaluate.evaluate --robot anymal`` says how often one controller gets through, by terrain type and level, and
its velocity error on flat ground (``rates.json``). With ``--policies``, ``--archive`` or ``--sets`` it makes the tables
of the paper instead: any controllers on the same hand-crafted, hard-random and held-out generated terrains, with
rewards, penalties and intervals (``tables.json``, ``tables.png``). The terrains are drawn from seeds used nowhere else:
not in training, calibration or search.
"""

import sys
from pathlib import Path
from typing import Any

import tyro

from qd.workers.evaluator import EvaluatorCfg, EvaluatorError, check_policy, open_evaluator, origin_of
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import exit_code_of
from sim.policy.spec import ControllerSpec, who_crossed
from train.evaluate.base_rates import VELOCITY_FROM_S, evaluate_sets, print_rates
from train.evaluate.cfg import EvaluateCfg, size_of
from train.evaluate.tables_job import evaluate_tables


def evaluate_base(cfg: EvaluateCfg) -> dict[str, Any]:
    """Rates of one controller: print the table, write the file; returns its content.

    Raises:
        ValueError: If something asked for cannot be had; raised before any long work.
    """
    size = size_of(cfg)
    robot = size.robot
    policy = str(cfg.policy or robot.policy_file)
    out = cfg.out or Path("runs") / f"{who_crossed(robot, policy)}-rates.json"
    prepare_output(out)
    check_policy(policy, robot, size.device)
    evaluator = EvaluatorCfg(
        robot=robot,
        policy=policy,
        num_terrains=size.terrains,
        num_replicas=size.episodes,
        device=size.device,
        workers=cfg.workers,
        penalties_from_s=VELOCITY_FROM_S,
    )
    with open_evaluator(evaluator) as crossings:
        sets = evaluate_sets(crossings, size.terrains, cfg.seed)
    about = {"robot": robot.name, "policy": ControllerSpec.parse(policy).label}
    report = {**origin_of(size.device, cfg.seed, cfg.workers), **about, **sets}
    print_rates(report)
    write_atomically(out, to_json(report))
    print(f"written to {out}")
    return report


def evaluate(cfg: EvaluateCfg) -> dict[str, Any]:
    """Evaluate as told: :func:`train.evaluate.tables_job.evaluate_tables` or :func:`evaluate_base`, with their errors."""
    return evaluate_tables(cfg) if cfg.makes_tables else evaluate_base(cfg)


def main() -> int:
    """Command line; returns the exit status."""
    cfg = tyro.cli(EvaluateCfg, description=__doc__)
    stopped = "Stopped. What is crossed is kept: the same command goes on." if cfg.makes_tables else "Stopped."
    return exit_code_of(lambda: int(evaluate(cfg) is None), stopped=stopped, also=(EvaluatorError,))


if __name__ == "__main__":
    sys.exit(main())
