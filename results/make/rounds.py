"""Hardening in rounds against one training of as many steps, and how many faults each leaves: rounds.json.

There are three hardenings and three trainings at once, on the published archive; all have the same sizes. The last
controller of each is searched once, the base by three seeds, each time with a specialist of its own. The first
hardening's is published as results/<robot>/hardened.pt, and crosses the sets of tables.py beside the first one that was
trained at once: tables_at_once.json.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qd.search.loop import search
from results.make.archive import judge_with_specialist
from results.make.common import COUNTS, SEEDS, Script, parse, publish_controller, read_made
from results.make.tables import train, write_tables
from train.cfg import HardenCfg
from train.harden import ROUNDS_FILE, harden

EPISODES = 416_000
SEARCH_SEEDS = 1000
"""Of the further searches, which are as long as those of the rounds: this and the next, far from the rounds' own."""
KEYS = {"base": "base_searches", "hardening": "searches", "at_once": "at_once_searches"}
"""Of the searches of each controller in the file."""
TRAININGS = {f"{name} {seed}": (name, seed) for name in ("hardening", "at_once") for seed in SEEDS}
SEARCHES = {f"search {name} {seed}": (name, seed) for name in KEYS for seed in SEEDS}
COMPARED = "compare"


def cfg_of(script: Script, seed: int) -> HardenCfg:
    """Settings of a hardening, in a trial of one tiny round; specialists judge the further searches alone."""
    cfg = replace(HardenCfg.of(script.robot), seed=seed, specialists=False)
    if not script.small:
        return cfg
    tune = replace(cfg.tune, num_envs=4, terrains=4, iterations=1)
    evaluation = replace(cfg.evaluation, terrains=2, episodes=1)
    return replace(cfg, rounds=1, search=replace(cfg.search, episodes=16), tune=tune, evaluation=evaluation)


def run_of(script: Script, name: str, seed: int) -> Path:
    """The run of a training."""
    return script.runs / f"{name}-{seed}"


def harden_here(script: Script, seed: int) -> dict[str, Any]:
    """All rounds of a hardening; those that are done are read."""
    run, cfg = run_of(script, "hardening", seed), cfg_of(script, seed)
    made = read_made(run / ROUNDS_FILE)
    if len(made.get("rounds", ())) > cfg.rounds:
        return made
    return harden(script.robot, cfg, run, script.compute, certifiers={} if script.small else None)


def controller_of(script: Script, name: str, seed: int) -> Path | None:
    """What a training made: of a hardening the last controller that was kept, None where none was; None of the base."""
    if name == "base":
        return None
    run = run_of(script, name, seed)
    if name == "at_once":
        cfg = cfg_of(script, seed)
        tune = cfg.sized_tune(script.robot, script.device)
        return Path(train(script, replace(tune, iterations=cfg.rounds * tune.iterations), "C-G", seed, run))
    kept = [row["tuned"] for row in harden_here(script, seed)["rounds"] if row["kept"]]
    return run / kept[-1] / "policy.pt" if kept else None


def search_again(script: Script, name: str, seed: int) -> dict[str, Any]:
    """Counts of another search of a controller, as long as those of a hardening."""
    policy = controller_of(script, name, seed)
    if name == "hardening" and policy is None:
        raise ValueError(f"hardening {seed} must have kept a round, got none: there is no controller to search")
    run = script.runs / "rounds" / f"{name}-{seed}"
    named = None if policy is None else str(policy)
    search(script.search_cfg(episodes=EPISODES, seed=SEARCH_SEEDS + seed, policy=named), run, script.compute)
    counts = judge_with_specialist(script, run)
    return {"seed": SEARCH_SEEDS + seed, **{key: counts.get(key) for key in COUNTS}}


def compare(script: Script) -> None:
    """The first of both trainings on the sets of the tables."""
    if (hardened := controller_of(script, "hardening", SEEDS[0])) is not None:
        controllers = {"at_once": str(controller_of(script, "at_once", SEEDS[0])), "hardened": str(hardened)}
        write_tables(replace(script, out=script.out.with_name("tables_at_once.json")), controllers)


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Trains, searches and compares; parts are each of these alone. A trial has one tiny hardening."""
    all_parts = (*TRAININGS, *SEARCHES, COMPARED)
    script = parse(__doc__, argv, "rounds.json", parts=all_parts)
    parts = script.parts or (all_parts[:1] if script.small else all_parts)
    for name, seed in (TRAININGS[part] for part in parts if part in TRAININGS):
        controller_of(script, name, seed)
    searches: dict[str, list[dict[str, Any]]] = {key: [] for key in KEYS.values()}
    for name, seed in (SEARCHES[part] for part in parts if part in SEARCHES):
        searches[KEYS[name]].append(search_again(script, name, seed))
    if COMPARED in parts:
        compare(script)
    if script.parts:
        return searches
    hardenings = [harden_here(script, seed) for seed in SEEDS[: 1 if script.small else None]]
    if not script.small:
        for old in script.results.glob("hardened.*"):
            old.unlink()
        if (hardened := controller_of(script, "hardening", SEEDS[0])) is not None:
            publish_controller(script, hardened, "hardened")
    made = ("command", "commit", "device", "date", "rounds", "choices")
    first = {name: value for name, value in hardenings[0].items() if name not in script.origin}
    rows = [{key: hardening[key] for key in made} for hardening in hardenings]
    return script.write({**first, "hardenings": rows, **searches})


if __name__ == "__main__":
    main()
