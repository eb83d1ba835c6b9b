"""What the fitness gains by subtracting standard deviations, the paper's ablation: ablation.json.

Every few iterations up to 200 elites of a search with alpha 1 and of one with alpha 0 cross 40 fresh episodes; compared
are the means of their standard deviations.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from qd.run.directory import RunDirectory
from qd.search import search
from results.make.common import parse

ALPHAS = {"alpha_1": 1.0, "alpha_0": 0.0}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Runs both searches and writes their mean STD with 95 % bootstrap intervals over elites."""
    script = parse(__doc__, argv, "ablation.json")
    every = 1 if script.small else 6
    cfg = script.search_cfg(18, seed=script.seed, reevaluate_every=every)
    rows = {}
    for name, alpha in ALPHAS.items():
        run = script.runs / "ablation" / name
        search(replace(cfg, fitness=replace(cfg.fitness, alpha=alpha)), run, script.compute)
        rows[name] = [row for row in RunDirectory(run).read_metrics() if row["iteration"] % every == 0]
    return script.write(
        {
            "preset": cfg.preset,
            "iterations": [row["iteration"] for row in rows["alpha_1"]],
            "mean_std": {name: [row["mean_std"] for row in of_run] for name, of_run in rows.items()},
            "intervals": {name: [row["mean_std_interval"] for row in of_run] for name, of_run in rows.items()},
            "elites": {name: [row["elites"] for row in of_run] for name, of_run in rows.items()},
        }
    )


if __name__ == "__main__":
    main()
