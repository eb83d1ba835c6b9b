"""What the fitness gains by subtracting standard deviations, the paper's ablation: ablation.json.

After every few iterations up to 200 elites of a search with alpha 1 and of one with alpha 0 cross 40 fresh episodes;
compared are the means of their standard deviations.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from qd.faults.families import find_families
from qd.faults.judge import elite_seeds, fresh_values
from qd.faults.numbers import FRESH_EPISODES, fresh_numbers
from qd.search.archive import Archive
from qd.search.loop import search
from qd.search.settings import SearchCfg
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from results.make.common import ONCE, parse
from sim.terrains.spaces.registry import get_space
from sim.terrains.terrains import Terrains

ALPHAS = {"alpha_1": 1.0, "alpha_0": 0.0}
MAX_ELITES = 200


def look_again(archive: Archive, cfg: SearchCfg, policy: str, crosser: Crosser) -> dict[str, Any]:
    """What fresh episodes say of some of the elites that a search has found so far."""
    stream = (Stream.ABLATED_ELITES,)
    rng = np.random.default_rng(np.random.SeedSequence([cfg.seed, archive.iterations], spawn_key=stream))
    some = archive.rows(np.sort(rng.choice(len(archive), min(len(archive), MAX_ELITES), replace=False)))
    some = replace(some, family=find_families(some.genes, get_space(cfg.space)))
    times = -(-FRESH_EPISODES // cfg.replicas)
    genes, seeds = some.genes.repeat(times, axis=0), elite_seeds(some, cfg.seed, times, stream=Stream.FRESH)
    label = "fresh episodes"
    terrains = Terrains(genes=genes, seeds=seeds, space=get_space(cfg.space))
    result = crosser.cross(policy, terrains, replicas=cfg.replicas, label=label)
    by_elite = {name: value.reshape(len(some), -1, *value.shape[2:]) for name, value in result.arrays.items()}
    result = replace(result, **{name: value[:, :FRESH_EPISODES] for name, value in by_elite.items()})
    return fresh_numbers(some, fresh_values(some, result, cfg.fitness)) | {"elites": len(archive)}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Runs both searches and writes their mean STD with 95 % bootstrap intervals over families."""
    script = parse(__doc__, argv, "ablation.json")
    every = 1 if script.small else 6
    cfg = script.search_cfg(18, seed=script.seed, **ONCE)
    iterations = [*range(every, cfg.iterations + 1, every)]
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in ALPHAS}
    with Crosser(script.robot, script.compute, cache=script.runs / "crossings") as crosser:
        for name, alpha in ALPHAS.items():
            for count in iterations:  # each from the start, so that what was done is found when this is begun again
                of_alpha = replace(cfg, iterations=count, fitness=replace(cfg.fitness, alpha=alpha))
                archive = search(of_alpha, script.runs / "ablation" / f"{name}-{count}", script.compute)
                rows[name].append(look_again(archive, of_alpha, script.policy, crosser))
    columns = {"mean_std": "mean_std", "intervals": "mean_std_interval", "elites": "elites"}
    numbers = {
        name: {run: [row[key] for row in rows_of_run] for run, rows_of_run in rows.items()}
        for name, key in columns.items()
    }
    return script.write({"preset": cfg.preset, "iterations": iterations, **numbers})


if __name__ == "__main__":
    main()
