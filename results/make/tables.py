"""The paper's tables: controllers trained on three kinds of terrains, on terrains they have not seen: tables.json.

C-HC trains on hand-crafted terrains, C-HR on hard-random ones too, C-G on elites of the published archive too; three
seeds each, of which the first is published as a file. tables.npz has the goal rate of every terrain. The same of one
seed at the paper's sizes is tables_paper_sizes.json.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.evaluate import cross_sets, crossings_folder, evaluate_tables
from qd.evaluate.labels import SetsCfg
from qd.evaluate.sets import TerrainSet, make_sets, paper_terrains
from results.make.common import SEEDS, Script, crossing_rates, parse, publish_controller, published_controllers
from sim.files.atomic import write_atomically
from sim.files.npz import npz_bytes
from train.cfg import LARGE, FinetuneCfg, RunCfg
from train.finetune import finetune

MIXES = {"C-HC": "hand-crafted", "C-HR": "hard-random", "C-G": "generated"}
RESAMPLES = 10_000


SIZES: dict[str, dict[str, int]] = {"tables": {**LARGE, "iterations": 1200}, "tables_paper_sizes": {}}
"""Robots, terrains at a time and iterations by the file that they are of; the paper's are the default."""
TRAININGS = {f"tables: {name}-{seed}": ("tables", name, seed) for name in MIXES for seed in SEEDS}
TRAININGS |= {f"tables_paper_sizes: {name}": ("tables_paper_sizes", name, SEEDS[0]) for name in MIXES}
"""File, kind and seed of each."""


def train(script: Script, cfg: FinetuneCfg, kind: str, seed: int, run: Path) -> str:
    """File of a controller of a kind that a fine-tuning makes, of the published archive if it needs one."""
    cfg = replace(cfg, mix=MIXES[kind], seed=seed)
    if cfg.mix == "generated":
        cfg = replace(cfg, archive=(str(script.results / "archive"),))
    return str(finetune(script.robot, cfg, run, RunCfg(device=script.device)))


def train_controllers(script: Script, trainings: Sequence[str]) -> dict[str, str]:
    """Trains kinds with seeds of one file; returns the files by name, those of further seeds as C-G@1."""
    controllers = {}
    for training in trainings:
        file, name, seed = TRAININGS[training]
        cfg = replace(FinetuneCfg.of(script.robot), **SIZES[file])
        policy = train(script, cfg, name, seed, script.runs / file / f"{name}-{seed}")
        controllers[name if seed == SEEDS[0] else f"{name}@{seed}"] = policy
        if (file, seed) == ("tables", SEEDS[0]):
            publish_controller(script, Path(policy), name)
    return controllers


def kind_difference(
    first: NDArray[np.float64], second: NDArray[np.float64], families: NDArray[np.int64], seed: int
) -> dict[str, Any]:
    """How much more often the first kind of controller reaches the goal than the second.

    Args:
        first: Goal rates of its seeds on the terrains, shape (num_seeds, num_terrains).
        second: Likewise.
        families: Of terrains that are not independent, shape (num_terrains,).
        seed: Of the bootstrap.

    Returns:
        ``goal``, and its 95 % ``interval`` over families and seeds, both resampled.
    """
    known = np.isfinite(first).all(axis=0) & np.isfinite(second).all(axis=0)
    family = np.unique(families[known], return_inverse=True)[1]
    sizes = np.bincount(family).astype(np.float64)
    sums = [np.array([np.bincount(family, row[known]) for row in kind]) for kind in (first, second)]
    rng, draws = np.random.default_rng(seed), []
    for _ in range(RESAMPLES):
        weights = np.bincount(rng.integers(len(sizes), size=len(sizes)), minlength=len(sizes))
        rates = [kind[rng.integers(len(kind), size=len(kind))].mean(axis=0) @ weights for kind in sums]
        draws.append((rates[0] - rates[1]) / (sizes @ weights))
    mean = float((sums[0].mean(axis=0) - sums[1].mean(axis=0)).sum() / sizes.sum())
    return {"goal": mean, "interval": np.quantile(draws, [0.025, 0.975]).tolist()}


def kind_differences(
    rates: Mapping[str, NDArray[np.float64]], families: NDArray[np.int64], seed: int
) -> dict[str, dict[str, Any]]:
    """:func:`kind_difference` of every two kinds on one set, the later one first: ``C-G - C-HR``."""
    kinds: dict[str, list[NDArray[np.float64]]] = {}
    for name, of_controller in rates.items():
        kinds.setdefault(name.partition("@")[0], []).append(of_controller)
    return {
        f"{second} - {first}": kind_difference(np.array(kinds[second]), np.array(kinds[first]), families, seed)
        for first, second in itertools.combinations(kinds, 2)
    }


def families_of(terrains: TerrainSet) -> NDArray[np.int64]:
    """Family of each terrain; each its own where they are independent."""
    return np.arange(len(terrains)) if terrains.families is None else terrains.families


def main(argv: Sequence[str] | None = None) -> None:
    """Trains and evaluates; parts are trainings alone, a trial evaluates what is published on few terrains."""
    script = parse(__doc__, argv, "tables.json", parts=tuple(TRAININGS))
    if script.parts:
        train_controllers(script, script.parts)
        return
    published = published_controllers(script)
    if script.small:
        write_tables(script, {name: published[name] for name in ("base", "C-G")})
        return
    for file in SIZES:
        trainings = [training for training, (of_file, *_) in TRAININGS.items() if of_file == file]
        controllers = {"base": script.policy, **train_controllers(script, trainings)}
        if file == "tables" and "hardened" in published:
            controllers["hardened"] = published["hardened"]
        write_tables(replace(script, out=script.out.with_stem(file)), controllers)


def write_tables(script: Script, controllers: Mapping[str, str]) -> None:
    """Evaluates controllers on all sets, and writes the file and the rates of its terrains."""
    terrains, episodes = (2, 1) if script.small else (paper_terrains(script.robot.name), 20)
    cfg = SetsCfg(
        sets=("hard_random", "generated") if script.small else (),
        archive=script.results / "archive",
        independent=None if script.small else script.results / "independent",
        terrains=terrains,
        episodes=episodes,
        seed=script.seed,
    )
    draft = script.runs / script.out.name  # what is published is written last, and whole
    tables = evaluate_tables(script.robot, controllers, cfg, compute=script.compute, out=draft)
    archive = script.read_archive()
    independent = None if cfg.independent is None else script.read_archive("independent")
    sets = make_sets(cfg.sets, terrains, cfg.seed, archive=archive, independent=independent)
    crossed = cross_sets(
        controllers, sets, robot=script.robot, compute=script.compute, episodes=episodes, reward=True,
        cache=crossings_folder(script.robot),
    )  # fmt: skip
    rates = {
        name: {controller: crossing_rates(result.outcome, "goal") for controller, result in row.items()}
        for name, row in crossed.items()
    }
    arrays = {f"{name}_goal": np.array(list(of_set.values())) for name, of_set in rates.items()}
    arrays |= {f"{name}_family": families_of(of_set) for name, of_set in sets.items()}
    arrays["controllers"] = np.array(list(controllers))
    write_atomically(script.out.with_suffix(".npz"), npz_bytes(arrays))
    script.add(
        tables,
        {"kind_differences": {name: kind_differences(rates[name], families_of(sets[name]), cfg.seed) for name in sets}},
    )


if __name__ == "__main__":
    main()
