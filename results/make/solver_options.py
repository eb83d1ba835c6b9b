"""What caps on the solver's iterations and its capacities cost and change: solver_options.json.

The same hard-random terrains are crossed under each choice, and once with contact resolved.
"""

import statistics
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from results.make.common import agreement, parse
from sim.crossing import SolverCfg, resolved
from sim.rollout import Rollout, RolloutResult
from sim.spaces.registry import SUPER_GAUSSIAN

ITERATIONS = (3, 4, 5, 6, 8, 50)
CAPACITIES = (0.5, 0.75, 1.5)
"""Most contacts of a robot, by its own number."""


def numbers_of(result: RolloutResult, wall_s: float) -> dict[str, Any]:
    """Rates and mean penalties of the valid episodes, and how fast they were."""
    valid = ~result.invalid
    penalties = result.penalties[valid].mean(axis=0).tolist()
    return {
        "wall_s": wall_s,
        "world_steps_per_s": result.outcome.size * result.physics_steps / wall_s,
        "success_rate": float(1.0 - result.base_collision[valid].mean()),
        "goal_rate": float(result.reached_goal[valid].mean()),
        "invalid": int(result.invalid.sum()),
        "penalties": dict(zip(result.penalty_names, penalties, strict=True)),
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Crosses the terrains under every choice and writes a row each, contact resolved first."""
    script = parse(__doc__, argv, "solver_options.json")
    terrains, episodes, rounds = (2, 2, 1) if script.small else (200, 20, 3)
    genes = SUPER_GAUSSIAN.hard_random(terrains, script.seed)
    seeds = np.random.SeedSequence(script.seed).generate_state(terrains, np.uint32)
    robot = script.robot
    finest, finest_solver = resolved(robot)
    choices = [(finest_solver, finest), *((SolverCfg(iterations=cap), robot) for cap in ITERATIONS)]
    choices += [(SolverCfg(), replace(robot, nconmax=round(share * robot.nconmax))) for share in CAPACITIES]
    rows, reference = [], None
    for solver, sized in choices[-1:] if script.small else choices:
        rollout = Rollout(
            sized, script.policy, num_terrains=terrains, num_replicas=episodes, device=script.device, solver=solver
        )
        results = [rollout.evaluate(genes, seeds) for _ in range(rounds)]  # the median of the times counts
        result = results[-1]
        row = {name: getattr(solver, name) for name in ("iterations", "ls_iterations")}
        row |= {name: getattr(sized, name) for name in ("physics_dt", "nconmax")}
        row |= numbers_of(result, statistics.median(result.wall_s for result in results))
        if reference is not None:
            row["against_resolved"] = agreement(result.outcome, reference.outcome, script.seed)
        reference = reference or result
        rows.append(row)
    return script.write({"episodes": terrains * episodes, "rows": rows})


if __name__ == "__main__":
    main()
