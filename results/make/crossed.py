"""Does a search find more faults where what nobody crosses earns less? Weights of ``--fitness.crossed``: crossed.json.

Searches of preset wide differ in the weight alone. Those with a weight have an iteration less, for their labels. Their
failing elites are crossed with contact resolved and by the robot's panel, which gave the labels, too, by other
episodes. The searches of seed 20 choose the weight; those of other seeds, with it and without, are compared.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from results.make.common import COUNTS, Script, file_name, follow_search, mean_counts, origin_of, parse

WEIGHTS, CHOSEN = (0.0, 0.95), 0.95
CHOOSING, SEEDS = 20, (21, 22, 23)
"""Others than those of search.json."""
EPISODES = 384_000
STAGES = ("fresh", "resolved", "others")
SHARE = "uncrossed_share"
"""Share of the failing elites that no controller of the panel crosses."""
COMPARED = (*COUNTS, SHARE)


def name_part(weight: float, seed: int) -> str:
    """A search by its weight and seed."""
    return f"{weight:g}, seed {seed}"


def run_of(script: Script, weight: float, seed: int) -> Path:
    """The run of a search."""
    return script.runs / "crossed" / file_name(name_part(weight, seed))


def follow(script: Script, weight: float, seed: int) -> dict[str, Any]:
    """Counts of a search with their origin, searched and judged where today's sources have not."""
    cfg = script.search_cfg(seed=seed, crossed=weight, **({"again": 2} if script.small else {}))
    run = run_of(script, weight, seed)
    (counts,) = follow_search(script, run, cfg, script.count_iterations(cfg, EPISODES), COUNTS, STAGES)
    failing, certified = counts["failing"], counts["certified"]
    share = 1.0 - certified / failing if failing and certified is not None else None
    return {"weight": weight, "search_seed": seed, **origin_of(script, run), **counts, SHARE: share}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Writes means of the chosen weight and of 0 with 95 % t intervals over seeds; parts are searches alone."""
    chosen = [(weight, seed) for seed in SEEDS for weight in (0.0, CHOSEN)]
    searches = {name_part(*each): each for each in (*((weight, CHOOSING) for weight in WEIGHTS), *chosen)}
    script = parse(__doc__, argv, "crossed.json", parts=tuple(searches))
    for part in script.parts:
        follow(script, *searches[part])
    if script.parts:
        return {}
    first = [follow(script, weight, CHOOSING) for weight in WEIGHTS]
    seeds = SEEDS[:1] if script.small else SEEDS
    without, with_it = ([follow(script, weight, seed) for seed in seeds] for weight in (0.0, CHOSEN))
    numbers = {
        f"{rows[0]['weight']:g}": {"seeds": len(rows)} | mean_counts(rows, COMPARED) for rows in (without, with_it)
    }
    differences = [
        {name: None if None in (a[name], b[name]) else b[name] - a[name] for name in COMPARED}
        for a, b in zip(without, with_it, strict=True)
    ]
    return script.write(
        {
            "chosen": CHOSEN,
            "weights": numbers,
            "difference": mean_counts(differences, COMPARED),
            "searches": [*first, *without, *with_it],
        }
    )


if __name__ == "__main__":
    main()
