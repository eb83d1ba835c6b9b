"""Rounds of hardening, and how much the count of faults differs between searches of one controller: rounds.json.

The base and the last controller are searched three times more, each with a specialist of its own. The last one is
published as results/<robot>/hardened.pt. Beside it one training on the published archive alone, of as many steps as
all rounds together, is searched as often.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qd.search import search
from results.make.archive import judge_with_specialist
from results.make.common import Script, parse, publish_controller
from train.cfg import HardenCfg, RunCfg
from train.finetune import finetune
from train.harden import harden

COUNTS = (
    "episodes", "elites", "corrected_elites", "families", "failing", "confirmed", "certified", "faults", "faults_panel",
    "faults_unseen", "fault_families",
)  # fmt: skip

EPISODES = 416_000
SEEDS = (1000, 1001, 1002)
"""Of the further searches, which are as long as those of the rounds, and whose seeds are far from theirs."""
TRAINED = ("hardening", "at_once")
SEARCHES = {f"{name} {seed}": (name, seed) for name in ("base", *TRAINED) for seed in SEEDS}


def last_policy(rounds: Sequence[Mapping[str, Any]], run: Path) -> Path | None:
    """File of the last training that was kept; None if there is none."""
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
    """Settings of the hardening."""
    return replace(HardenCfg.of(script.robot), seed=script.seed, specialists=not script.small)


def train_at_once(script: Script) -> Path:
    """A controller that has the steps of all rounds in one training, on the published archive."""
    cfg = cfg_of(script)
    tune = cfg.sized_tune(script.robot, script.device)
    tune = replace(
        tune, seed=script.seed, archive=(str(script.results / "archive"),), iterations=cfg.rounds * tune.iterations
    )
    return finetune(script.robot, tune, script.runs / "at_once", RunCfg(device=script.device))


def hardening_of(script: Script) -> tuple[dict[str, Any], Path | None]:
    """Three rounds, or in a trial a tiny one alone; and the last controller."""
    cfg, run = cfg_of(script), script.runs / "hardening"
    if script.small:
        cfg = replace(
            cfg, rounds=1, search=replace(cfg.search, episodes=16),
            tune=replace(cfg.tune, num_envs=4, terrains=4, iterations=1),
            evaluation=replace(cfg.evaluation, terrains=2, episodes=1),
        )  # fmt: skip
    hardening = harden(script.robot, cfg, run, script.compute, certifiers={} if script.small else None)
    return hardening, last_policy(hardening["rounds"], run)


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Hardens in three rounds, and searches both ends and the one training again; a trial has one round alone.

    Parts are the two trainings, and each search by what it is of and its seed; those of a training come after it.
    """
    script = parse(__doc__, argv, "rounds.json", parts=(*TRAINED, *SEARCHES))
    parts = script.parts or (TRAINED[:1] if script.small else (*TRAINED, *SEARCHES))
    trained = {name: make(script) for name, make in {"hardening": hardening_of, "at_once": train_at_once}.items()
               if any(part.startswith(name) for part in parts)}  # fmt: skip
    hardening, hardened = trained.get("hardening", ({}, None))
    policies = {"base": None, "hardening": hardened, "at_once": trained.get("at_once")}
    searches: dict[str, list[dict[str, Any]]] = {name: [] for name in policies}
    for part in parts:
        if part in SEARCHES:
            name, seed = SEARCHES[part]
            searches[name].append(search_again(script, name, policies[name], seed))
    if script.parts:
        return searches
    if hardened is not None and not script.small:
        publish_controller(script, hardened, "hardened")
    return script.write(
        {
            **hardening,
            "seed": script.seed,
            "searches": searches["hardening"],
            "base_searches": searches["base"],
            "at_once_searches": searches["at_once"],
        }
    )


if __name__ == "__main__":
    main()
