"""What more devices bring: scale.json.

The same evaluation of hard-random terrains by 1 to N Ray workers on one host: with 4,096 robots a GPU, each of which
runs one episode, and at the size of the paper's iteration, which they share. Against one process without Ray.
"""

import statistics
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from qd.search.settings import preset
from qd.workers.compute import Compute, available_cores
from qd.workers.crosser import open_pipeline
from qd.workers.pipeline import PipelineCfg
from results.make.common import parse
from sim.terrains.spaces.registry import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains

ROUNDS = 3
"""Evaluations timed of each, after one that is not; the median counts."""


def time_evaluation(cfg: PipelineCfg, seed: int, rounds: int) -> float:
    """Seconds of one evaluation of as many terrains as ``cfg`` has under way, by whoever it says."""
    genes = SUPER_GAUSSIAN.hard_random(cfg.num_terrains, seed)
    seeds = np.random.SeedSequence(seed).generate_state(cfg.num_terrains, np.uint32)
    with open_pipeline(cfg) as evaluate:
        seconds = [evaluate(Terrains(genes=genes, seeds=seeds)).wall_s for _ in range(rounds + 1)]
        status = evaluate.status()
    if status is not None and (status.workers != cfg.num_workers or status.retries):
        raise RuntimeError(f"expected {cfg.num_workers} workers throughout, got {status}: nothing was measured")
    return statistics.median(seconds[1:])


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Times 1, 2, 4, ... workers, up to all devices of this host."""
    script = parse(__doc__, argv, "scale.json")
    on_gpu = script.device.startswith("cuda")
    terrains, replicas, rounds = (4, 1, 1) if script.small else (256, 16, ROUNDS) if on_gpu else (4, 4, ROUNDS)
    devices = wp.get_cuda_device_count() if on_gpu else available_cores()
    counts = (1,) if script.small else [1 << k for k in range(devices.bit_length())]
    alone = Compute(script.device, workers="1")
    search = preset("paper" if on_gpu else "small", script.robot)
    sizes: Any = {"num_terrains": terrains, "replicas": replicas}
    one_process = PipelineCfg(compute=alone, robot=script.robot, policy=script.policy, **sizes)
    paper_size = 4 if script.small else search.scheduler.num_terrains
    shared = replace(one_process, num_terrains=paper_size, replicas=search.replicas)
    alone_s, shared_alone_s = (time_evaluation(cfg, script.seed, rounds) for cfg in (one_process, shared))
    rate_alone = terrains * replicas / alone_s
    rows = []
    for count in counts:
        on_ray = Compute(script.device.partition(":")[0], workers=f"ray:{count}")  # which GPU is Ray's to say
        wide = replace(one_process, num_terrains=terrains * count, compute=on_ray)
        rate = terrains * count * replicas / time_evaluation(wide, script.seed, rounds)
        iteration_s = time_evaluation(replace(shared, compute=on_ray), script.seed, rounds)
        row = {"workers": count, "num_envs": terrains * count * replicas, "episodes_per_s": rate}
        row["efficiency"] = rate / rate_alone / count
        rows.append(row | {"paper_size_iteration_s": iteration_s, "speedup_paper_size": shared_alone_s / iteration_s})
    without_ray = {"episodes_per_s_without_ray": rate_alone, "iteration_s_without_ray": shared_alone_s}
    return script.write({"paper_size": search.preset, **without_ray, "rows": rows})


if __name__ == "__main__":
    main()
