"""What breaks the controller under conditions and terrain alone does not, and how much it bears: conditions.json.

Terrains and conditions are searched together, by three seeds, and so are routes with pushes. Then the elites that fail
are crossed once more, under nominal conditions, and without each kind of condition alone, from the same starts, so that
a kind that does nothing changes nothing. Some that need one kind alone are taken apart. The archives of the first seed
are published in results/<robot>/conditions and route. A search takes 3 minutes of an H200.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.judge import count_outcomes, elite_seeds
from qd.faults.minimise import minimise
from qd.faults.numbers import EPISODES
from qd.search.archive import Archive, goal_rates
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from results.make.common import ARCHIVE_FILES, COUNTS, SEEDS, Script, mean_counts, measure_once, parse
from results.make.spaces import search_space
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.spaces.registry import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains

EPISODES_SEARCHED = 400_000
_EXAMPLES = 2
"""Of each kind of condition."""
_KINDS = [name for name, kind in CONDITIONS.items() if not (kind.asks or kind.needs_arms)]
SPACES = {
    "conditions": "+".join((SUPER_GAUSSIAN.name, *_KINDS)),
    "route": f"{SUPER_GAUSSIAN.name}+command+pushes",
}
PARTS = {f"{name} {seed}": (name, seed) for name in SPACES for seed in SEEDS}
"""Each search by its space and seed."""
_PUBLISHED = (*ARCHIVE_FILES, "minimal.npz", "minimal.json")


def needed_conditions(script: Script, archive: Archive, name: str) -> dict[str, Any]:
    """Which failing elites are crossed under nominal conditions, and which of these without one kind of condition.

    ``name`` is the folder of the search.
    """
    space, rows = archive.terrain_space, np.flatnonzero(archive.failing)
    first = len(space.parts(archive.genes[0])) - len(space.conditions) if len(archive) else 0
    seeds = elite_seeds(archive, script.seed, stream=Stream.ABOUT_CONDITIONS)
    episodes = 1 if script.small else EPISODES
    run = script.runs / name
    with Crosser(script.robot, script.compute, cache=run / "crossings") as crosser:

        def rates(rows: NDArray[np.int64], taken: Sequence[int], label: str) -> NDArray[np.float64]:
            """Goal rates on elites without some kinds of conditions; NaN of an invalid one."""
            genes = space.without(archive.genes[rows], [first + kind for kind in taken])
            terrains = Terrains(genes=genes, seeds=seeds[rows], space=space)
            result = crosser.cross(script.policy, terrains, replicas=episodes, label=label, invalid_ok=True)
            return goal_rates(count_outcomes(result))

        again = rows[rates(rows, (), "as they are") < FAILING_GOAL_RATE]
        cured = again[rates(again, range(len(space.conditions)), "nominal conditions") >= FAILING_GOAL_RATE]
        goals = {kind: rates(cured, [k], f"without {kind}") for k, kind in enumerate(space.conditions)}
    needed = {kind: of_kind >= FAILING_GOAL_RATE for kind, of_kind in goals.items()}
    alone = np.sum([*needed.values()], axis=0) if len(cured) else np.zeros(0)
    examples, minima = dict[int, str](), None
    for kind, is_needed in needed.items():  # some elites that need this kind alone, faults first
        numbers = cured[(alone == 1) & is_needed]
        numbers = numbers[np.argsort(~archive.is_fault[numbers], kind="stable")]
        examples |= dict.fromkeys(numbers[:_EXAMPLES].tolist(), kind)
    if examples and not script.small and name in SPACES:  # of the first seed
        minima = minimise(run, compute=script.compute, elite=" ".join(map(str, examples)), judged=True)
    return {
        "failing_again": len(again),
        "nominal_passes": len(cured),
        "confirmed_and_nominal_passes": int(archive.confirmed[cured].sum()),
        "faults_and_nominal_passes": int(archive.is_fault[cured].sum()),
        "needed": {kind: int(is_needed.sum()) for kind, is_needed in needed.items()},
        "needs_no_single_one": int((alone == 0).sum()),
        "examples": [
            {
                "elite": number,
                "needs": kind,
                "fault": bool(archive.is_fault[number]),
                "conditions": space.condition_text(archive.genes[number]),
                "minimal": minima.describe(number) if minima else None,
            }
            for number, kind in examples.items()
        ],
    }


def search_part(script: Script, name: str, seed: int) -> dict[str, Any]:
    """Numbers of one search; the archive of the first seed is in the folder of the space."""
    folder = name if seed == SEEDS[0] else f"{name}-{seed}"

    def measure() -> dict[str, Any]:
        cfg = script.search_cfg(episodes=EPISODES_SEARCHED, seed=seed, crossed=0.0, space=SPACES[name])
        archive, numbers = search_space(script, folder, cfg)
        return {"search_seed": seed, **numbers, **needed_conditions(script, archive, folder)}

    return measure_once(script, script.runs / f"{folder}.json", measure)


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Searches, and takes conditions away; parts are searches alone, a trial has one seed."""
    script = parse(__doc__, argv, "conditions.json", parts=tuple(PARTS))
    for part in script.parts:
        search_part(script, *PARTS[part])
    if script.parts:
        return {}
    dose = script.read_dose(conditions=True)
    searches = dict[str, list[dict[str, Any]]]()
    for name in SPACES:
        searches[name] = [search_part(script, name, seed) for seed in SEEDS[: 1 if script.small else None]]
        script.publish(script.runs / name, script.out.parent / name, _PUBLISHED)
    means = {name: {"seeds": len(rows), **mean_counts(rows, COUNTS)} for name, rows in searches.items()}
    first = searches["conditions"][0]
    counts = {name: first[name] for name in ("iterations", "reachable_coverage", *COUNTS, "causes")}
    needed = {name: value for name, value in first.items() if name not in counts}
    passes = needed["nominal_passes"]
    parts = {"archive": counts, "nominal_passes": passes, "conditions": needed, "means": means, "searches": searches}
    return script.write(parts | {"dose": dose})


if __name__ == "__main__":
    main()
