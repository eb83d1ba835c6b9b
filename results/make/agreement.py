"""How far rates at the search's settings lie from contact resolved and from MuJoCo C: agreement.json.

A terrain that was chosen by its rate at some settings owes a part of that rate to chance, which does not come again.
So the terrains, hard-random ones and elites, are drawn at random, and those that fail are chosen by one set of episodes
and judged by another.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.families import find_families
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.crosser import Crosser
from qd.workers.pipeline import Engine
from results.make.common import Script, agreement, crossing_rates, parse
from sim.terrains.spaces.registry import SUPER_GAUSSIAN, get_space
from sim.terrains.terrains import Terrains

KEY = 20261123  # with the seed, the entropy of everything drawn here, and nowhere else
HARD_RANDOM, ELITES, FIRST, SECOND = range(4)  # streams of it
IN_MUJOCO_C = {"hard_random": 150, "elites": 40}
"""Terrains of each set that are crossed in MuJoCo C; elites were chosen by one simulator, and say less."""


def cross_in_all_ways(
    script: Script, crosser: Crosser, name: str, genes: NDArray[np.float32], space: str, *, episodes: int = 40
) -> dict[str, NDArray[np.uint8]]:
    """Outcomes of a set's episodes by how they were crossed, (num_terrains, num_episodes); fewer terrains in MuJoCo C.

    ``search`` has the first starts; ``again`` (the same settings), ``resolved`` and ``mujoco_c`` have the second.
    """
    episodes, in_mujoco_c = (1, 1) if script.small else (episodes, IN_MUJOCO_C[name])
    sequences = [np.random.SeedSequence([KEY, script.seed], spawn_key=(stream,)) for stream in (FIRST, SECOND)]
    first, second = (sequence.generate_state(len(genes), np.uint32).astype(np.uint32) for sequence in sequences)

    def cross(seeds: NDArray[np.uint32], engine: Engine, count: int) -> NDArray[np.uint8]:
        terrains = Terrains(genes=genes[:count], seeds=seeds[:count], space=get_space(space))
        label = f"{name}, {engine}"
        return crosser.cross(script.policy, terrains, replicas=episodes, engine=engine, label=label).outcome

    return {
        "search": cross(first, "search", len(genes)),
        "again": cross(second, "search", len(genes)),
        "resolved": cross(second, "resolved", len(genes)),
        "mujoco_c": cross(second, "mujoco_c", in_mujoco_c),
    }


def compare(outcome: dict[str, NDArray[np.uint8]], families: NDArray[np.int64], seed: int) -> dict[str, Any]:
    """Rates at the search's settings minus those of the other ways; ``both_resolved``: ours resolved minus MuJoCo C.

    Of the terrains crossed in MuJoCo C, ``goal_differences`` has the difference of each, None where one is invalid.
    """
    pairs = {name: ("search", name) for name in ("again", "resolved", "mujoco_c")}
    pairs["both_resolved"] = ("resolved", "mujoco_c")
    numbers: dict[str, Any] = {}
    for name, (ours, theirs) in pairs.items():
        count = len(outcome[theirs])
        numbers[name] = agreement(outcome[ours][:count], outcome[theirs], seed, families[:count])
        if theirs == "mujoco_c":
            rates = [crossing_rates(outcome[way][:count], "goal") for way in (ours, theirs)]
            differences = np.round(rates[0] - rates[1], 4).tolist()
            numbers[name]["goal_differences"] = [None if np.isnan(value) else value for value in differences]
    return numbers


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Crosses both sets in all ways and writes how far they agree."""
    script = parse(__doc__, argv, "agreement.json")
    terrains, elites = (1, 1) if script.small else (300, 150)
    draws = [np.random.default_rng(np.random.SeedSequence([KEY, script.seed], spawn_key=(k,))) for k in range(2)]
    archive = script.read_archive()
    chosen = draws[ELITES].permutation(len(archive))[:elites]
    sets = {
        "hard_random": (SUPER_GAUSSIAN.hard_random(terrains, draws[HARD_RANDOM]), SUPER_GAUSSIAN.name),
        "elites": (archive.genes[chosen], archive.space),
    }
    with Crosser(script.robot, script.compute, cache=script.runs / "crossings") as crosser:
        outcome = {name: cross_in_all_ways(script, crosser, name, *terrains) for name, terrains in sets.items()}
    fails = {
        way: crossing_rates(outcome["elites"][way], "goal") < FAILING_GOAL_RATE
        for way in ("search", "again", "resolved")
    }
    numbers: dict[str, Any] = {
        name: compare(outcome[name], find_families(genes, get_space(space)), script.seed)
        for name, (genes, space) in sets.items()
    }
    for key, way in {"failing": "search", "failing_again": "again", "failing_resolved": "resolved"}.items():
        numbers[key] = int((fails["search"] & fails[way]).sum())
    return script.write(numbers)


if __name__ == "__main__":
    main()
