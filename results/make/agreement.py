"""How far rates at the search's settings lie from contact resolved and from MuJoCo C: agreement.json.

A terrain that was chosen by its rate at some settings owes a part of that rate to chance, which does not come again.
So the terrains, hard-random ones and elites, are drawn at random, and those that fail are chosen by one set of episodes
and judged by another. Routes and pushes are hard-random, too. Most of the time is MuJoCo C's: 3,200 episodes of routes
and pushes take 3 minutes on 32 cores.
"""

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.tables import terrain_rates, valid_interval, valid_mean
from qd.faults.families import find_families
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.crosser import Crosser
from qd.workers.pipeline import Engine
from results.make.common import Script, measure_once, parse
from sim.files.intervals import DIFFERENCES
from sim.terrains.spaces.registry import SUPER_GAUSSIAN, get_space
from sim.terrains.terrains import Terrains

KEY = 20261123  # with the seed, the entropy of everything drawn here, and nowhere else
HARD_RANDOM, ELITES, FIRST, SECOND, ROUTES, PUSHES = range(6)  # streams of it
IN_MUJOCO_C = {"hard_random": 150, "elites": 40, "routes": 40, "pushes": 40}
"""Terrains of each set that are crossed in MuJoCo C; elites were chosen by one simulator, and say less."""
DISTURBED = {"routes": (f"{SUPER_GAUSSIAN.name}+command", ROUTES), "pushes": (f"{SUPER_GAUSSIAN.name}+pushes", PUSHES)}
"""Space and stream of the sets that are disturbed in time, all of which are crossed in MuJoCo C."""

Rates = dict[str, NDArray[np.float64]]
"""By measure as :func:`qd.evaluate.tables.terrain_rates` has them."""


def cross_in_all_ways(
    script: Script, crosser: Crosser, name: str, genes: NDArray[np.float32], space: str, *, episodes: int = 40
) -> dict[str, Rates]:
    """Rates on a set's terrains by how they were crossed; of fewer terrains in MuJoCo C.

    ``search`` has the first starts; ``again`` (the same settings), ``resolved`` and ``mujoco_c`` have the second.
    """
    episodes, in_mujoco_c = (1, 1) if script.small else (episodes, IN_MUJOCO_C[name])
    sequences = [np.random.SeedSequence([KEY, script.seed], spawn_key=(stream,)) for stream in (FIRST, SECOND)]
    first, second = (sequence.generate_state(len(genes), np.uint32).astype(np.uint32) for sequence in sequences)

    def cross(seeds: NDArray[np.uint32], engine: Engine, count: int) -> Rates:
        terrains = Terrains(genes=genes[:count], seeds=seeds[:count], space=get_space(space))
        label = f"{name}, {engine}"
        return terrain_rates(crosser.cross(script.policy, terrains, replicas=episodes, engine=engine, label=label))

    return {
        "search": cross(first, "search", len(genes)),
        "again": cross(second, "search", len(genes)),
        "resolved": cross(second, "resolved", len(genes)),
        "mujoco_c": cross(second, "mujoco_c", in_mujoco_c),
    }


def compare(rates: dict[str, Rates], families: NDArray[np.int64], seed: int) -> dict[str, Any]:
    """Rates at the search's settings minus those of the other ways; ``both_resolved``: ours resolved minus MuJoCo C.

    ``terrains`` are those valid in both. Each rate has the mean difference (``success_bias``), its 95 % bootstrap
    interval over ``families`` (``success_bias_interval``), and the mean absolute one (``success_difference``), None
    without terrains. Of MuJoCo C, ``goal_differences`` has the difference of each terrain, None where one is invalid.
    """
    pairs = {name: ("search", name) for name in ("again", "resolved", "mujoco_c")}
    pairs["both_resolved"] = ("resolved", "mujoco_c")
    numbers: dict[str, dict[str, Any]] = {name: {} for name in pairs}
    for (name, (ours, theirs)), kind in product(pairs.items(), ("success", "goal")):
        count = len(rates[theirs][kind])
        differences = rates[ours][kind][:count] - rates[theirs][kind]
        numbers[name] |= {
            "terrains": int(np.isfinite(differences).sum()),
            f"{kind}_bias": valid_mean(differences),
            f"{kind}_bias_interval": valid_interval(differences, seed, families[:count], DIFFERENCES),
            f"{kind}_difference": valid_mean(np.abs(differences)),
        }
        if (kind, theirs) == ("goal", "mujoco_c"):
            rounded = np.round(differences, 4).tolist()
            numbers[name]["goal_differences"] = [None if np.isnan(value) else value for value in rounded]
    return numbers


def draw_set(script: Script, name: str) -> tuple[NDArray[np.float32], str]:
    """Genes of a set, and their space."""
    space, stream = DISTURBED.get(name, (SUPER_GAUSSIAN.name, ELITES if name == "elites" else HARD_RANDOM))
    draw = np.random.default_rng(np.random.SeedSequence([KEY, script.seed], spawn_key=(stream,)))
    if name == "elites":
        archive = script.read_archive()
        return archive.genes[draw.permutation(len(archive))[: 1 if script.small else 150]], archive.space
    count = 1 if script.small else IN_MUJOCO_C[name] if name in DISTURBED else 300
    return get_space(space).hard_random(count, draw), space


def measure_set(script: Script, name: str) -> dict[str, Any]:
    """How far rates on a set agree, the mean rate of each way, and how many that fail as found fail again."""
    genes, space = draw_set(script, name)
    with Crosser(script.robot, script.compute, cache=script.runs / "crossings") as crosser:
        rates = cross_in_all_ways(script, crosser, name, genes, space)
    fails = {way: rates[way]["goal"] < FAILING_GOAL_RATE for way in ("search", "again", "resolved")}
    return {
        **compare(rates, find_families(genes, get_space(space)), script.seed),
        "rates": {way: {kind: valid_mean(values) for kind, values in of_way.items()} for way, of_way in rates.items()},
        "failing": {way: int((fails["search"] & of_way).sum()) for way, of_way in fails.items()},
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Crosses the sets in all ways and writes how far they agree; parts are sets, beside those measured before.

    A file that ``lacks`` sets is made anew by results/make/all.sh.
    """
    script = parse(__doc__, argv, "agreement.json", parts=tuple(IN_MUJOCO_C))
    sets: dict[str, Any] = {}
    for name in IN_MUJOCO_C:
        file = script.runs / "agreement" / f"{name}.json"
        if name in (script.parts or IN_MUJOCO_C) or script.read_so_far(file):
            sets[name] = measure_once(script, file, partial(measure_set, script, name))
    keys = {"search": "failing", "again": "failing_again", "resolved": "failing_resolved"}
    failing = {keys[way]: count for way, count in sets.get("elites", {}).get("failing", {}).items()}
    return script.write({**sets, **failing, "lacks": [name for name in IN_MUJOCO_C if name not in sets]})


if __name__ == "__main__":
    main()
