"""Evaluates over the stand-in on the cluster at RAY_ADDRESS, once a line of its input says so; a program of its own."""

import sys
import time

import numpy as np

from qd.workers.evaluator import EvaluatorCfg, open_evaluator, resolve_device
from tests.qd import crossers

GENES = np.random.default_rng(0).uniform(-1, 1, (12, 64)).astype(np.float32)
SEEDS = np.arange(12, dtype=np.uint32)


def main() -> None:
    """For each line of input, number of workers to wait for: workers at hand and the sum of the penalties."""
    device = resolve_device("cpu", "ray")
    cfg = EvaluatorCfg(robot="anymal", policy="p", num_terrains=12, num_replicas=4, device=device, workers="ray")
    with open_evaluator(cfg, build=crossers.Crosser) as evaluate:
        for line in sys.stdin:
            result = evaluate(GENES, SEEDS)
            for _ in range(400):
                if evaluate.status().workers == int(line):
                    break
                result = evaluate(GENES, SEEDS)
                time.sleep(0.1)
            print("found", evaluate.status().workers, repr(float(result.penalties.sum())), flush=True)


if __name__ == "__main__":
    main()
