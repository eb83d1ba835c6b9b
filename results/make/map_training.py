"""What training with errors of the height map brings, ``+map``: map_training.json.

The base is searched on terrains with errors of its map. C-G with them trains on hand-crafted terrains and on these
elites under their errors, C-G without them on elites of the published archive, for as many steps; three seeds each. All
of them and the base cross the failing elites that no training draws, and random terrains with errors of the map and
without, in fresh episodes. Then each is searched anew with them.

On an H200 the archive takes 3 minutes, which the other parts need; a training and its search 3 minutes alone, three of
them side by side on one GPU about 8; the crossings 1 minute.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from qd.evaluate.evaluate import cross_sets
from qd.evaluate.sets import TerrainSet, generated_set, paper_terrains, plain_set
from qd.evaluate.tables import terrain_rates, valid_mean
from qd.faults.numbers import EPISODES
from qd.search.archive import read_archive
from qd.search.fitness import FAILING_GOAL_RATE
from results.make.common import COUNTS, SEEDS, Script, mean_counts, measure_once, parse
from results.make.spaces import search_space
from results.make.tables import SIZES, train
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from train.cfg import FinetuneCfg

SPACE = f"{SUPER_GAUSSIAN.name}+map"
ARCHIVE_EPISODES, SEARCH_EPISODES = 400_000, 130_000
SEARCH_SEED = 1000
"""Of the searches that compare controllers, far from that of the archive."""
KINDS = ("with", "without")
TRAININGS = {f"{kind} {seed}": (kind, seed) for kind in KINDS for seed in SEEDS}
"""Kind and seed of each training."""


def search_map(script: Script, name: str, episodes: int, seed: int, policy: str | None = None) -> dict[str, Any]:
    """Counts of a search with errors of the map, judged; a trial has enough elites to train on some."""
    cfg = script.search_cfg(episodes=episodes, seed=seed, space=SPACE, policy=policy)
    if script.small and name == "archive":
        cfg = replace(cfg, scheduler=replace(cfg.scheduler, batch_size=5))
    _, numbers = search_space(script, f"map_training/{name}", cfg)
    return {"search_seed": seed, **numbers}


def train_kind(script: Script, kind: str, seed: int) -> str:
    """File of C-G that was trained with errors of the map, or as in the tables."""
    sizes = {"num_envs": 4, "terrains": 4, "iterations": 1} if script.small else SIZES["tables"]
    cfg, run = replace(FinetuneCfg.of(script.robot), **sizes), script.runs / "tables" / f"C-G-{seed}"
    if kind == "with":
        run = script.runs / "map_training" / f"C-G-{seed}"
        cfg = replace(cfg, archive=(str(script.runs / "map_training/archive"),))
    return train(script, cfg, "C-G", seed, run)


def make_crossed_sets(script: Script) -> dict[str, TerrainSet]:
    """The base's failing elites that no training draws, and random terrains, with errors of the map and without."""
    archive = read_archive(script.runs / "map_training/archive")
    held_out = generated_set(archive, len(archive), script.seed)
    count = 2 if script.small else paper_terrains(script.robot.name)
    return {
        "held_out": held_out.rows(np.flatnonzero(archive.failing[held_out.numbers] | script.small)),  # few in a trial
        "hard_random_map": plain_set("hard_random", count, script.seed, get_space(SPACE)),
        "hard_random": plain_set("hard_random", count, script.seed),
        "hand_crafted": plain_set("hand_crafted", count, script.seed),
    }


def cross_all(script: Script, trainings: Sequence[str]) -> dict[str, Any]:
    """Mean goal rate of each controller on each set, and how many of its terrains it fails."""
    controllers = {"base": script.policy, **{name: train_kind(script, *TRAININGS[name]) for name in trainings}}
    sets, episodes, cache = make_crossed_sets(script), 1 if script.small else EPISODES, script.runs / "crossings"
    crossed = cross_sets(controllers, sets, robot=script.robot, compute=script.compute, episodes=episodes, cache=cache)
    goal = {name: {by: terrain_rates(result)["goal"] for by, result in row.items()} for name, row in crossed.items()}
    return {
        "terrains": {name: len(of_set) for name, of_set in sets.items()},
        "controllers": {
            by: {
                "goal": {name: valid_mean(goal[name][by]) for name in sets},
                "failing": {name: int((goal[name][by] < FAILING_GOAL_RATE).sum()) for name in sets},
            }
            for by in controllers
        },
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Writes each controller's numbers, and means over seeds with 95 % t intervals.

    Parts are the archive, each training with its search, the base's search and the crossings; ``archive`` comes first,
    ``crossings`` last. A trial has one seed.
    """
    script = parse(__doc__, argv, "map_training.json", parts=("archive", "base", *TRAININGS, "crossings"))
    trainings = [name for name in TRAININGS if not script.small or name.endswith(f" {SEEDS[0]}")]

    def measure(part: str) -> dict[str, Any]:
        if part == "crossings":
            return cross_all(script, trainings)
        if part == "archive":
            return search_map(script, part, ARCHIVE_EPISODES, script.seed)
        policy = None if part == "base" else train_kind(script, *TRAININGS[part])
        return search_map(script, part.replace(" ", "-"), SEARCH_EPISODES, SEARCH_SEED, policy)

    parts = script.parts or ("archive", "base", *trainings, "crossings")
    files = {part: script.runs / "map_training" / f"{part.replace(' ', '-')}.json" for part in parts}
    numbers = {part: measure_once(script, files[part], partial(measure, part)) for part in parts}
    if script.parts:
        return {}
    archive, crossings = numbers.pop("archive"), numbers.pop("crossings")
    rows = {name: {"search": row, **crossings["controllers"][name]} for name, row in numbers.items()}
    means: dict[str, Any] = {}
    for kind in KINDS:
        of_kind = [rows[name] for name in trainings if TRAININGS[name][0] == kind]
        measures = {"search": COUNTS, **dict.fromkeys(("goal", "failing"), crossings["terrains"])}
        means[kind] = {"seeds": len(of_kind)}
        for measure_name, names in measures.items():
            means[kind][measure_name] = mean_counts([row[measure_name] for row in of_kind], tuple(names))
    crossed = {key: value for key, value in crossings.items() if key != "controllers"}
    return script.write({"archive": archive, "crossings": crossed, "controllers": rows, "means": means})


if __name__ == "__main__":
    main()
