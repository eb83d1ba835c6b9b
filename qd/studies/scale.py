"""What more devices bring: ``faultline scale --counts 1 2 4 --out results/anymal/scale.json``.

The same evaluation by 1 to N Ray workers on one host: with as many environments a worker as keep a GPU busy, and at the
size of the paper's iteration, which they share.
"""

import statistics
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from qd.run.arguments import evaluator_of
from qd.run.settings import preset
from qd.workers.evaluator import EvaluatorCfg, EvaluatorError, open_evaluator, resolve_device, worker_status
from sim.files.command import OfRobot, OnDevice, publish, show_json
from sim.files.records import identity, provenance
from sim.files.settings import check, setting

_PAPER_ITERATIONS = 1000


@dataclass(frozen=True, kw_only=True)
class Scale(OfRobot, OnDevice):
    """Time evaluations on hard-random terrains by different numbers of Ray workers, against one process without Ray."""

    counts: tuple[int, ...] = setting((1, 2, 4), least=1)
    """Numbers of Ray workers to try, rising."""
    terrains: int | None = setting(None, least=1)
    """Terrains a worker; 256 on CUDA, 4 on the CPU."""
    replicas: int | None = setting(None, least=1)
    """Episodes a terrain; 16 on CUDA, 4 on the CPU."""
    preset: str | None = None
    """Whose iteration is shared among the workers; paper on CUDA, small on the CPU."""
    rounds: int = setting(3, least=1)
    """Evaluations timed of each, after one that is not; the median counts."""
    seed: int = setting(0, least=0)
    """Draws terrains and starts."""
    out: Path | None = None
    """Where to write; printed alone if left out."""

    def execute(self) -> None:
        """Times and publishes."""
        publish(self.out, lambda: measure(self), show_json)


def time_evaluation(cfg: EvaluatorCfg, rounds: int, seed: int) -> float:
    """Seconds of one evaluation of ``cfg.num_terrains`` hard-random terrains, by whoever ``cfg`` says; the median.

    Raises:
        EvaluatorError: If fewer workers than wanted took part, or one had to be replaced.
    """
    from sim.space import load_space

    genes = load_space(cfg.space).hard_random(cfg.num_terrains, seed)
    seeds = np.random.SeedSequence(seed).generate_state(cfg.num_terrains, np.uint32)
    with open_evaluator(cfg) as evaluate:
        seconds = [evaluate(genes, seeds).wall_s for _ in range(rounds + 1)]
        found = worker_status(evaluate)
    if found is not None and (found.workers != cfg.num_workers or found.retries):
        raise EvaluatorError(f"expected {cfg.num_workers} workers throughout, got {found}: nothing was measured")
    return statistics.median(seconds[1:])


def measure(args: Scale) -> dict[str, Any]:
    """Everything of ``scale.json``.

    Raises:
        ValueError: If a flag's value cannot be used.
    """
    from sim.robots.robot import get_robot

    check(args)
    if not args.counts or list(args.counts) != sorted(set(args.counts)):
        raise ValueError(f"counts must be numbers of workers that rise, got {args.counts}")
    robot = get_robot(args.robot or "anymal")
    resolve_device(args.device, f"ray:{args.counts[-1]}")  # so many must be there
    device = resolve_device(args.device)
    on_gpu = device.startswith("cuda")
    search = preset(args.preset or ("paper" if on_gpu else "small"), robot)
    terrains, replicas = args.terrains or (256 if on_gpu else 4), args.replicas or (16 if on_gpu else 4)
    shared = evaluator_of(search, robot, str(robot.policy_file), device, "1")
    alone = replace(shared, num_terrains=terrains, num_replicas=replicas)
    alone_s, shared_alone_s = (time_evaluation(cfg, args.rounds, args.seed) for cfg in (alone, shared))
    one = terrains * replicas / alone_s
    print(f"without Ray: {one:,.1f} episodes/s; {shared_alone_s:.2f} s an iteration of {search.preset}", flush=True)
    rows = []
    dealt = "cuda" if on_gpu else "cpu"  # which GPU is Ray's to say
    for count in args.counts:
        wide = replace(alone, num_terrains=terrains * count, workers=f"ray:{count}", device=dealt)
        rate = terrains * count * replicas / time_evaluation(wide, args.rounds, args.seed)
        iteration_s = time_evaluation(replace(shared, workers=f"ray:{count}", device=dealt), args.rounds, args.seed)
        rows.append(
            {
                "workers": count,
                "num_envs": terrains * count * replicas,
                "episodes_per_s": rate,
                "efficiency": rate / one / count,
                "paper_size_iteration_s": iteration_s,
                "speedup_paper_size": shared_alone_s / iteration_s,
            }
        )
        print(
            f"{count} workers: {rate:,.1f} episodes/s, {rows[-1]['efficiency']:.3f} of linear; {iteration_s:.2f} s an "
            f"iteration of {search.preset}, {rows[-1]['speedup_paper_size']:.2f} times as fast",
            flush=True,
        )
    last = rows[-1]
    return {
        **provenance(device, args.seed),
        **identity(robot, robot.policy_file),
        "gpus": last["workers"] if on_gpu else 0,
        "workers": last["workers"],
        "envs_per_worker": terrains * replicas,
        "paper_size": search.preset,
        "episodes_per_s_without_ray": one,
        "iteration_s_without_ray": shared_alone_s,
        "efficiency": last["efficiency"],
        "speedup_paper_size": last["speedup_paper_size"],
        "projected_s": {
            f"{_PAPER_ITERATIONS} iterations of {search.preset}": _PAPER_ITERATIONS * last["paper_size_iteration_s"],
            "as many episodes at full width": _PAPER_ITERATIONS
            * search.episodes_per_iteration
            / last["episodes_per_s"],
        },
        "rows": rows,
    }
