"""What breaks the controller under conditions and terrain alone does not, and the dose beside it: conditions.json.

Terrains and conditions are searched together. Then the terrains of the elites that fail are crossed under nominal
conditions, and without each kind of condition alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive, goal_rates
from qd.faults import EPISODES
from qd.fitness import FAILING_GOAL_RATE
from qd.judge import elite_seeds, judge, outcome_counts
from qd.run.directory import RunDirectory
from qd.search import search
from qd.workers.cross import Crossings
from results.make.common import Script, parse, read_made
from results.make.spaces import COUNTS, causes_of
from sim.conditions import KINDS
from sim.spaces.dose import CONDITIONS_SPACE as SPACE
from sim.spaces.registry import get_space

EPISODES_SEARCHED = 400_000
_STREAM = 2000
_EXAMPLES = 10


def search_under_conditions(script: Script) -> tuple[Archive, dict[str, Any]]:
    """The judged archive of a search of terrains and conditions, and its numbers."""
    cfg = script.search_cfg(seed=script.seed, space=SPACE)
    iterations = None if script.small else round(EPISODES_SEARCHED / cfg.episodes_per_iteration)
    run = script.runs / "conditions"
    search(script.search_cfg(iterations, seed=script.seed, space=SPACE), run, script.compute)
    stages = ("fresh",) if script.small else ("fresh", "resolved", "others")
    archive = judge(run, stages=stages, compute=script.compute)
    summary = RunDirectory(run).read_summary()
    return archive, {**{count: summary.get(count) for count in COUNTS}, "causes": causes_of(archive)}


def needed_conditions(script: Script, archive: Archive) -> dict[str, Any]:
    """Which failing elites are crossed under nominal conditions, and which of these without one kind of condition."""
    space, rows = get_space(SPACE), np.flatnonzero(archive.failing)
    first = len(space.parts(archive.genes[0])) - len(KINDS) if len(archive) else 0
    seeds = elite_seeds(archive, script.seed, stream=_STREAM)
    run = script.runs / "conditions"
    with Crossings(script.robot, script.compute, cache=run / "crossings") as crossings:

        def passes(rows: NDArray[np.int64], taken: Sequence[int], label: str) -> NDArray[np.bool_]:
            """Whether half of the robots cross elites without some kinds of conditions."""
            genes = space.without(archive.genes[rows], [first + kind for kind in taken])
            result = crossings.cross(
                script.policy, genes, seeds[rows], replicas=EPISODES, space=SPACE, label=label, invalid_ok=True
            )
            return goal_rates(outcome_counts(result)) >= FAILING_GOAL_RATE

        nominal = passes(rows, range(len(KINDS)), "nominal conditions")
        cured = rows[nominal]
        needed = {kind: passes(cured, [number], f"without {kind}") for number, kind in enumerate(KINDS)}
    alone = np.sum([*needed.values()], axis=0) if len(cured) else np.zeros(0)
    return {
        "failing": len(rows),
        "nominal_passes": len(cured),
        "confirmed_and_nominal_passes": int(archive.confirmed[cured].sum()),
        "faults_and_nominal_passes": int(archive.is_fault[cured].sum()),
        "needed": {kind: int(is_needed.sum()) for kind, is_needed in needed.items()},
        "needs_no_single_one": int((alone == 0).sum()),
        "examples": [
            {
                "elite": int(row),
                "goal_rate": float(archive.fresh.goal_rate[row]) if archive.fresh else None,
                "conditions": space.condition_words(archive.genes[row]),
                "needed": [kind for kind in KINDS if needed[kind][place]],
            }
            for place, row in enumerate(cured[:_EXAMPLES])
        ],
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Searches, and takes conditions away; the doses of conditions are those of dose.json."""
    script = parse(__doc__, argv, "conditions.json")
    archive, numbers = search_under_conditions(script)
    needed = needed_conditions(script, archive)
    file = script.out.with_name("dose.json")
    dose = [row for row in read_made(file).get("dose", []) if row["parameter"] in KINDS]
    return script.write(
        {"archive": numbers, "nominal_passes": needed["nominal_passes"], "conditions": needed, "dose": dose}
    )


if __name__ == "__main__":
    main()
