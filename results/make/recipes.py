"""Which recipe fine-tunes best: recipes.json. C-HC, C-HR and C-G are trained by each, at the sizes of tables.json.

Those of today's recipe are the first ones of tables.json. As in the paper one recipe serves all three. It is chosen for
both robots together, by the mean goal rate on validation terrains, by which a hardening chooses too, and of which no
other number is made.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from qd.evaluate.evaluate import cross_sets
from qd.evaluate.sets import generated_set, paper_terrains, plain_set
from qd.evaluate.tables import terrain_rates
from results.make.common import SEEDS, Script, file_name, parse
from results.make.tables import MIXES, SIZES, train, train_controllers
from train.cfg import FinetuneCfg, PpoCfg, TaskCfg

RECIPES = ("today's", "the base's own")
TRAININGS = {f"{recipe}: {kind}": (recipe, kind) for recipe in RECIPES for kind in MIXES}


def train_by(script: Script, training: str) -> str:
    """File of the controller that a recipe makes of a kind; today's recipe has made it for the tables."""
    recipe, kind = TRAININGS[training]
    if recipe == RECIPES[0] and not script.small:
        return train_controllers(script, [f"tables: {kind}-{SEEDS[0]}"])[kind]
    sizes = {"num_envs": 4, "terrains": 4, "iterations": 1} if script.small else SIZES["tables"]
    cfg = FinetuneCfg.of(script.robot)
    if recipe == RECIPES[1]:  # rewards and learner of the base's training
        task = TaskCfg.of(script.robot, crosses=True, start_spread=cfg.task.start_spread)
        cfg = replace(cfg, task=task, ppo=replace(PpoCfg.of(script.robot), steps_per_env=cfg.ppo.steps_per_env))
    return train(script, replace(cfg, **sizes), kind, script.seed, script.runs / "recipes" / file_name(training))


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Trains and evaluates on validation terrains; parts are trainings alone, a trial has one."""
    script = parse(__doc__, argv, "recipes.json", parts=tuple(TRAININGS))
    names = script.parts or (list(TRAININGS)[-1:] if script.small else tuple(TRAININGS))
    controllers = {name: train_by(script, name) for name in names}
    if script.parts:
        return {}
    terrains, episodes = (2, 1) if script.small else (paper_terrains(script.robot.name), 20)
    plain = ("hand_crafted", "hard_random")
    sets = {name: plain_set(name, terrains, script.seed, purpose="validation") for name in plain}
    sets["generated"] = generated_set(script.read_archive(), terrains, script.seed, "validation")
    controllers = {"base": script.policy} | controllers
    cache = script.runs / "crossings"
    crossed = cross_sets(controllers, sets, robot=script.robot, compute=script.compute, episodes=episodes, cache=cache)
    goal: dict[str, dict[str, float]] = {name: {} for name in controllers}
    for name, controller in product(sets, controllers):
        goal[controller][name] = float(np.nanmean(terrain_rates(crossed[name][controller])["goal"]))
    score = {
        recipe: float(np.mean([[*goal[name].values()] for name in names if TRAININGS[name][0] == recipe]))
        for recipe in dict.fromkeys(TRAININGS[name][0] for name in names)
    }
    counts = {name: len(of_set) for name, of_set in sets.items()}
    return script.write({"score": score, "goal": goal, "terrains": counts})


if __name__ == "__main__":
    main()
