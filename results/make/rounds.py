"""Rounds of hardening, and how much the count of faults differs between searches of one controller: rounds.json.

The base and the last controller are searched twice more, each time with a specialist of its own. The last controller is
published as results/<robot>/hardened.pt. Beside it one training on the published archive alone, of as many steps as
all rounds together, is searched as often.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qd.search import search
from results.make.archive import judge_with_specialist
from results.make.common import Script, parse
from train.cfg import HardenCfg, RunCfg
from train.finetune import finetune
from train.harden import harden

COUNTS = (
    "episodes", "elites", "corrected_elites", "families", "failing", "confirmed", "certified", "faults", "faults_panel",
    "faults_unseen", "fault_families",
)  # fmt: skip

PARTS = ("hardening", "base", "at_once")


def last_policy(rounds: Sequence[Mapping[str, Any]], run: Path) -> Path | None:
    """File of the last training that was kept; None if there is none."""
    kept = [row["tuned"] for row in rounds if row["kept"]]
    return run / kept[-1] / "policy.pt" if kept else None


def search_again(script: Script, name: str, policy: Path | None, seed: int) -> dict[str, Any]:
    """Counts of another search of a controller, as long as those of a hardening; of the shipped one if None."""
    run = script.runs / "rounds" / f"{name}-{seed}"
    cfg = script.search_cfg(13, seed=seed, policy=None if policy is None else str(policy))
    search(cfg, run, script.compute)
    counts = judge_with_specialist(script, run)
    return {"seed": seed, **{key: counts.get(key) for key in COUNTS}}


def train_at_once(script: Script, cfg: HardenCfg) -> Path:
    """A controller that has the steps of all rounds in one training, on the published archive."""
    tune = cfg.sized_tune(script.robot, script.device)
    tune = replace(
        tune, seed=script.seed, archive=(str(script.results / "archive"),), iterations=cfg.rounds * tune.iterations
    )
    return finetune(script.robot, tune, script.runs / "at_once", RunCfg(device=script.device))


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Hardens in three rounds, and searches both ends again; a trial is one tiny round alone.

    Parts are the hardening with the searches of its last controller, those of the base, and the one training.
    """
    script = parse(__doc__, argv, "rounds.json", parts=PARTS)
    seeds = () if script.small else (1000, 1001, 1002)  # far from those of the rounds
    parts = script.parts or PARTS
    cfg = replace(HardenCfg.of(script.robot), seed=script.seed, specialists=not script.small)
    searches = dict[str, list[dict[str, Any]]]()
    if "base" in parts:
        searches["base"] = [search_again(script, "base", None, seed) for seed in seeds]
    if "at_once" in parts and not script.small:
        policy = train_at_once(script, cfg)
        searches["at_once"] = [search_again(script, "at_once", policy, seed) for seed in seeds]
    if "hardening" not in parts:
        return searches
    run = script.runs / "hardening"
    if script.small:
        cfg = replace(
            cfg, rounds=1, search=replace(cfg.search, episodes=16),
            tune=replace(cfg.tune, num_envs=4, terrains=4, iterations=1),
            evaluation=replace(cfg.evaluation, terrains=2, episodes=1),
        )  # fmt: skip
    hardening = harden(script.robot, cfg, run, script.compute, certifiers={} if script.small else None)
    policy = last_policy(hardening["rounds"], run)
    searches["last"] = [search_again(script, "last", policy, seed) for seed in seeds]
    if script.parts:
        return searches
    if policy is not None and not script.small:
        shutil.copyfile(policy, script.results / "hardened.pt")
    return script.write(
        {
            **hardening,
            "seed": script.seed,
            "searches": searches["last"],
            "base_searches": searches["base"],
            "at_once_searches": searches.get("at_once", []),
        }
    )


if __name__ == "__main__":
    main()
