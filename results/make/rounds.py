"""Rounds of hardening, and how much the count of faults differs between searches of one controller: rounds.json.

The base and the last controller are searched three times more, each with a specialist of its own. The last one is
published as results/<robot>/hardened.pt. Beside it one training on the published archive alone, of as many steps as
all rounds together, is searched as often, and crosses the sets of tables.py: tables_at_once.json. Three rounds more of
the last controller were not planned: they were begun when its further searches had found more than a quarter of the
base's faults.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qd.search.loop import search
from results.make.archive import judge_with_specialist
from results.make.common import COUNTS, Script, parse, publish_controller, read_made
from results.make.tables import train, write_tables
from train.cfg import HardenCfg
from train.harden import ROUNDS_FILE, harden

EPISODES = 416_000
SEEDS = (1000, 1001, 1002)
"""Of the further searches, which are as long as those of the rounds, and whose seeds are far from theirs."""
MADE = ("command", "commit", "device", "date")
"""Of a hardening, which is older than the file."""
TRAINED, COMPARED = ("hardening", "at_once", "again"), "hardening and at_once"
SEARCHES = {f"{name} {seed}": (name, seed) for name in ("base", *TRAINED) for seed in SEEDS}


def read_hardening(script: Script, name: str = "hardening") -> tuple[dict[str, Any], bool]:
    """What the rounds.json of a hardening says so far, and whether all its rounds are done."""
    made = read_made(script.runs / name / ROUNDS_FILE)
    return made, len(made.get("rounds", ())) > cfg_of(script).rounds


def last_policy(script: Script, name: str = "hardening") -> Path | None:
    """File of the last training of a hardening that was kept; None if there is none."""
    run, (made, is_done) = script.runs / name, read_hardening(script, name)
    rounds = made.get("rounds", ())
    if not is_done:
        raise ValueError(f"{run} must hold a finished hardening, got {len(rounds)} searches: run the part {name} first")
    kept = [row["tuned"] for row in rounds if row["kept"]]
    return run / kept[-1] / "policy.pt" if kept else None


def search_again(script: Script, name: str, policy: Path | None, seed: int) -> dict[str, Any]:
    """Counts of another search of a controller, as long as those of a hardening; of the shipped one if None."""
    run = script.runs / "rounds" / f"{name}-{seed}"
    cfg = script.search_cfg(episodes=EPISODES, seed=seed, policy=None if policy is None else str(policy))
    search(cfg, run, script.compute)
    counts = judge_with_specialist(script, run)
    return {"seed": seed, **{key: counts.get(key) for key in COUNTS}}


def cfg_of(script: Script) -> HardenCfg:
    """Settings of the hardening, in a trial of one tiny round.

    Specialists judge the further searches alone, since no training needs them.
    """
    cfg = replace(HardenCfg.of(script.robot), seed=script.seed, specialists=False)
    if not script.small:
        return cfg
    tune = replace(cfg.tune, num_envs=4, terrains=4, iterations=1)
    evaluation = replace(cfg.evaluation, terrains=2, episodes=1)
    return replace(cfg, rounds=1, search=replace(cfg.search, episodes=16), tune=tune, evaluation=evaluation)


def train_at_once(script: Script) -> Path:
    """A controller that has the steps of all rounds in one training, on the published archive."""
    cfg = cfg_of(script)
    tune = cfg.sized_tune(script.robot, script.device)
    tune = replace(tune, iterations=cfg.rounds * tune.iterations)
    return Path(train(script, tune, "C-G", script.seed, script.runs / "at_once"))


def harden_here(script: Script, name: str = "hardening") -> dict[str, Any]:
    """All rounds of a hardening, or of one again of its last controller; those that are done are read."""
    made, is_done = read_hardening(script, name)
    if is_done:
        return made
    cfg, certifiers = cfg_of(script), {} if script.small else None
    if name == "again":
        cfg = replace(cfg, policy=str(last_policy(script) or script.policy), seed=script.seed + 1)
    return harden(script.robot, cfg, script.runs / name, script.compute, certifiers=certifiers)


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Hardens in three rounds, and searches both ends and the one training again; a trial has one round alone.

    Parts are the trainings, and each search by what it is of and its seed; those of a hardening come after it.
    Where no round is kept there is nothing to search again.
    """
    all_parts = (*TRAINED, *SEARCHES, COMPARED)
    script = parse(__doc__, argv, "rounds.json", parts=all_parts)
    parts = script.parts or (all_parts[:1] if script.small else all_parts)
    hardenings = {name: harden_here(script, name) for name in ("hardening", "again") if name in parts}
    if "at_once" in parts:
        train_at_once(script)
    searches: dict[str, list[dict[str, Any]]] = {name: [] for name in ("base", *TRAINED)}
    for name, seed in (SEARCHES[part] for part in parts if part in SEARCHES):
        policy = None if name == "base" else train_at_once(script) if name == "at_once" else last_policy(script, name)
        if name == "base" or policy is not None:
            searches[name].append(search_again(script, name, policy, seed))
    if COMPARED in parts and (policy := last_policy(script)) is not None:
        controllers = {"at_once": str(train_at_once(script)), "hardened": str(policy)}
        write_tables(replace(script, out=script.results / "tables_at_once.json"), controllers)
    if script.parts:
        return searches
    hardened = last_policy(script)
    if not script.small:
        for old in (script.results / "hardened.pt", script.results / "hardened.train.json"):
            old.unlink(missing_ok=True)
        if hardened is not None:
            publish_controller(script, hardened, "hardened")
    return script.write(
        {
            **{name: value for name, value in hardenings["hardening"].items() if name not in script.origin},
            "hardenings": {name: {key: made[key] for key in MADE} for name, made in hardenings.items()},
            "searches": searches["hardening"],
            "base_searches": searches["base"],
            "at_once_searches": searches["at_once"],
            "again_rounds": hardenings.get("again", {}).get("rounds", []),
            "again_searches": searches["again"],
        }
    )


if __name__ == "__main__":
    main()
