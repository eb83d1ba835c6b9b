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
from qd.evaluate.sets import elites_sha256, make_sets, paper_terrains
from qd.evaluate.tables import by_kind, kind_mean, terrain_rates
from qd.search.archive import read_archive
from results.make.common import SEEDS, Script, parse, publish_controller, published_controllers, read_made
from sim.controllers.spec import controller_hash
from sim.files.atomic import write_atomically
from sim.files.npz import npz_bytes
from train.cfg import LARGE, FinetuneCfg, RunCfg
from train.finetune import finetune
from train.ppo.checkpoint import CHECKPOINT

MIXES = {"C-HC": "hand-crafted", "C-HR": "hard-random", "C-G": "generated"}
SIZES: dict[str, dict[str, int]] = {"tables": LARGE, "tables_paper_sizes": {}}
"""Robots, terrains at a time and iterations by the file that they are of; the paper's are the default."""
TRAININGS = {f"tables: {name}-{seed}": ("tables", name, seed) for name in MIXES for seed in SEEDS}
TRAININGS |= {f"tables_paper_sizes: {name}": ("tables_paper_sizes", name, SEEDS[0]) for name in MIXES}
"""File, kind and seed of each."""


def train(script: Script, cfg: FinetuneCfg, kind: str, seed: int, run: Path) -> str:
    """File of a controller of a kind that a fine-tuning makes, of the published archive unless ``cfg`` has one."""
    cfg = replace(cfg, mix=MIXES[kind], seed=seed)
    if cfg.mix == "generated":
        cfg = replace(cfg, archive=cfg.archive or (str(script.results / "archive"),))
    policy = run / "policy.pt"
    record = read_made(policy.with_suffix(".train.json"))
    made_here = record.get("sources_sha256") == script.origin["sources_sha256"] and policy.exists()
    elites = [elites_sha256(read_archive(Path(one))) for one in cfg.archive]
    is_alike = [one["sha256"] for one in record.get("settings", {}).get("elites", ())] == elites
    if made_here and is_alike and not (run / CHECKPOINT).exists() and cfg.iterations in (0, record.get("iterations")):
        return str(policy)  # brought here from where it was trained, without its checkpoint
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


def differences_of(rates: Mapping[str, NDArray[np.float64]], families: NDArray[np.int64], seed: int) -> dict[str, Any]:
    """How much more often each kind reaches the goal on one set than one before it: ``C-G - C-HR``.

    Goal rates are of controllers by their name, each of shape (num_terrains,).
    """
    kinds, differences = {kind: np.array(of_kind) for kind, of_kind in by_kind(rates).items()}, {}
    for first, second in itertools.combinations(kinds, 2):
        mean = kind_mean([kinds[second], kinds[first]], families, seed)
        differences[f"{second} - {first}"] = mean and {"goal": mean.pop("mean"), **mean}
    return differences


def main(argv: Sequence[str] | None = None) -> None:
    """Trains and evaluates; parts are trainings alone, a trial evaluates what is published on few terrains."""
    script = parse(__doc__, argv, "tables.json", parts=tuple(TRAININGS))
    published = published_controllers(script)
    if script.parts and not script.small:
        train_controllers(script, script.parts)
        return
    if script.small:
        write_tables(script, {name: published[name] for name in ("base", "C-G")})
        return
    for file in SIZES:
        trainings = [training for training, (of_file, *_) in TRAININGS.items() if of_file == file]
        controllers = {"base": script.policy, **train_controllers(script, trainings)}
        rounds = script.read_so_far(script.results / "rounds.json").get("rounds", ())  # of today's sources
        hardened = published.get("hardened")
        if file == "tables" and hardened and controller_hash(hardened) in [row["policy_sha256"] for row in rounds]:
            controllers["hardened"] = hardened
        write_tables(replace(script, out=script.out.with_stem(file)), controllers)


def write_tables(script: Script, controllers: Mapping[str, str]) -> None:
    """Evaluates controllers on all sets, and writes the file and the rates of its terrains."""
    terrains, episodes = (2, 1) if script.small else (paper_terrains(script.robot.name), 20)
    archive, independent = script.results / "archive", None if script.small else script.results / "independent"
    names = ("hard_random", "generated") if script.small else ()
    sizes: dict[str, Any] = {"terrains": terrains, "episodes": episodes, "seed": script.seed}
    cfg = SetsCfg(sets=names, archive=archive, independent=independent, **sizes)
    draft = script.runs / script.out.name  # what is published is written last, and whole
    tables = evaluate_tables(script.robot, controllers, cfg, compute=script.compute, out=draft)
    archives = {"archive": script.read_archive(), "independent": independent and script.read_archive("independent")}
    sets = make_sets(cfg.sets, terrains, cfg.seed, **archives)
    cache = {"cache": crossings_folder(script.robot), "reward": True}
    crossed = cross_sets(controllers, sets, robot=script.robot, compute=script.compute, episodes=episodes, **cache)
    rates = {name: {by: terrain_rates(result)["goal"] for by, result in row.items()} for name, row in crossed.items()}
    arrays = {f"{name}_goal": np.array(list(of_set.values())) for name, of_set in rates.items()}
    family = {  # each terrain is its own where they are independent
        name: np.arange(len(of_set)) if of_set.families is None else of_set.families for name, of_set in sets.items()
    }
    arrays |= {f"{name}_family": of_set for name, of_set in family.items()} | {"controllers": np.array([*controllers])}
    write_atomically(script.out.with_suffix(".npz"), npz_bytes(arrays))
    differences = {name: differences_of(rates[name], family[name], cfg.seed) for name in sets}
    script.add(tables, {"differences": {name: tables["differences"][name] | differences[name] for name in sets}})


if __name__ == "__main__":
    main()
