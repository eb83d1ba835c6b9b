"""How well penalties see failures: penalty_ratios.json.

The mean of each penalty over crossings of hard-random terrains that miss the goal, over its mean over those that reach
it. A ratio near 1 means that the penalty does not see failures.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from qd.workers.crosser import Crosser
from results.make.common import parse
from sim.terrains.spaces.registry import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Crosses 2,000 terrains, 20 episodes each."""
    script = parse(__doc__, argv, "penalty_ratios.json")
    terrains, episodes = (4, 2) if script.small else (2_000, 20)
    seed = script.seed + 1  # penalties are scaled on the terrains of seed 0
    genes = SUPER_GAUSSIAN.hard_random(terrains, seed)
    seeds = np.random.SeedSequence(seed).generate_state(terrains, np.uint32)
    with Crosser(script.robot, script.compute, cache=script.runs / "crossings") as crosser:
        terrains_to_cross = Terrains(genes=genes, seeds=seeds)
        result = crosser.cross(script.policy, terrains_to_cross, replicas=episodes, label="hard-random")
    reached = result.reached_goal & ~result.invalid
    failed = ~result.reached_goal & ~result.invalid
    ratios = {}
    for name, sums in zip(result.penalty_names, np.moveaxis(result.penalties, -1, 0), strict=True):
        of_failed, of_reached = (float(sums[some].mean()) if some.any() else None for some in (failed, reached))
        ratio = of_failed / of_reached if of_failed is not None and of_reached else None
        ratios[name] = {"failing": of_failed, "reached": of_reached, "ratio": ratio}
    counts = {"invalid_episodes": int(result.invalid.sum()), "failing_episodes": int(failed.sum())}
    return script.write({"terrains": terrains, "episodes": int(failed.size), **counts, "penalties": ratios})


if __name__ == "__main__":
    main()
