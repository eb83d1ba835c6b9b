"""How far test terrains lie from the elites C-G was trained on: distances.json, RMS of the heights' differences [m].

Elites of one archive descend from each other, and a held-out one may be a near copy of one that was trained on. Then a
rate on held-out elites says little of other terrains. For the same reason failing elites and faults of the published
archives are counted by families, and distinct ones alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from qd.evaluate.sets import (
    hash_elites,
    make_sets,
    nearest_distance,
    paper_terrains,
    read_trained_on,
    split_elites,
)
from qd.faults.families import judged_numbers
from results.make.common import COUNTS, parse, published_controllers


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Measures every set's terrains on the CPU."""
    script = parse(__doc__, argv, "distances.json")
    archive, independent = script.read_archive(), script.read_archive("independent")
    genes, marks = archive.genes[split_elites(archive).train], read_trained_on(published_controllers(script)["C-G"])
    trained_on = genes[[mark in marks for mark in hash_elites(genes)]][: 20 if script.small else None]
    count = 5 if script.small else paper_terrains(script.robot.name)
    names = ("hard_random", "generated", "generated_far", "generated_independent")
    sets = make_sets(names, count, script.seed, archive=archive, independent=independent, space=archive.terrain_space)
    rows = {}
    for name, terrains in sets.items():
        distances = nearest_distance(terrains.terrains.values, trained_on, archive.terrain_space)
        least, median, largest = np.quantile(distances, (0.0, 0.5, 1.0)).tolist()
        rows[name] = {"terrains": len(distances), "median": median, "least": least, "largest": largest}
    counted = {}
    for name in ("archive", "archive_cma_mae", "independent"):
        elites = script.read_archive(name)
        numbers = judged_numbers(elites, elites.terrain_space)
        counted[name] = {"elites": len(elites), **{key: numbers[key] for key in COUNTS if key in numbers}}
    distances = {"iterations": archive.iterations, "trained_on": len(trained_on), "nearest_m": rows}
    return script.write({**distances, "archives": counted})


if __name__ == "__main__":
    main()
