"""Which controller a hardening goes on with after a training: the new one, if validation terrains speak for it.

Two trainings of one recipe differ by several points, and one may end worse than it began. Validation terrains are of
the kinds that are reported, but none of those (:mod:`train.evaluate.sets`).
"""

from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from qd.run.directory import ROUNDS_FILE
from sim.files.atomic import to_json, write_atomically
from sim.policy.spec import controller_hash
from train.evaluate.crossings import cross_all
from train.evaluate.measures import terrain_rates
from train.evaluate.sets import make_sets
from train.rounds import FIXED_SETS, divisible, held_out, read_rounds

if TYPE_CHECKING:
    from train.hardening import Hardening, Tune

MOST_LOST = 0.01
"""How much of its goal rate on hand-crafted and on hard-random terrains a controller may lose against the base."""


def known_choice(job: "Hardening", tune: "Tune") -> bool | None:
    """Whether a training was kept, by ``rounds.json``; None where it does not say, or of another controller."""
    choice = read_rounds(job.path).get("choices", {}).get(tune.run.name)
    if choice is None or choice.get("sha256") != _hashes(job, tune):
        return None
    return bool(choice["kept"])


def choose(job: "Hardening", tune: "Tune") -> None:
    """Crosses the validation terrains with the controllers before and after a training; writes which one is kept.

    Args:
        job: The hardening.
        tune: The training, which is over.

    Raises:
        EvaluatorError: If a worker is lost; what is crossed is kept.
    """
    goal = _goal_rates(job, tune)
    choice = {**verdict(goal["base"], goal["before"], goal["after"]), "goal": goal, "sha256": _hashes(job, tune)}
    content = read_rounds(job.path)
    content["choices"] = {**content.get("choices", {}), tune.run.name: choice}
    write_atomically(job.path / ROUNDS_FILE, to_json(content))
    print(f"{tune.run.name} is {'kept' if choice['kept'] else 'not kept'}: {choice['why']}", flush=True)


def verdict(base: dict[str, float], before: dict[str, float], after: dict[str, float]) -> dict[str, Any]:
    """Whether to go on with a controller, by goal rates on validation terrains.

    Args:
        base: Rate by set of the controller that a hardening begins with.
        before: Of the one before the training.
        after: Of the one after it.

    Returns:
        ``kept``, ``score`` of both (:func:`score`), and ``why``, in words.
    """
    scores = {"before": score(before), "after": score(after)}
    why = f"its goal rate on validation is {scores['after']:.3f}, before {scores['before']:.3f}"
    lost = {name: base[name] - after[name] for name in FIXED_SETS if base[name] - after[name] > MOST_LOST}
    if lost:
        why += "".join(f"; on {name} it is {points:.3f} below the base's" for name, points in lost.items())
    return {"kept": not lost and scores["after"] >= scores["before"], "why": why, "score": scores}


def score(goal: dict[str, float]) -> float:
    """Mean goal rate over hand-crafted terrains, hard-random ones, and all archives together, by rates of sets."""
    archives = [rate for name, rate in goal.items() if name not in FIXED_SETS]
    return fmean([*(goal[name] for name in FIXED_SETS), *([fmean(archives)] if archives else [])])


def _goal_rates(job: "Hardening", tune: "Tune") -> dict[str, dict[str, float]]:
    """Goal rate of the base and of the controllers before and after a training, by validation set."""
    sets = make_sets(FIXED_SETS, job.evaluator.num_terrains, 0, space=job.space, part="validation")
    sets |= {run.name: held_out(job, run, "validation") for run in divisible(tune.archives)}
    named = {"base": job.base, "before": tune.before, "after": tune.policy}
    names = {policy: "base" if policy == job.base else Path(policy).parent.name for policy in named.values()}
    controllers = {name: policy for policy, name in names.items()}
    print("\nOn validation terrains:", flush=True)
    results = cross_all(controllers, sets, job.evaluator, job.path / "crossings", open_evaluator=job.open_evaluator)
    return {
        when: {name: float(np.nanmean(terrain_rates(row[names[policy]])["goal"])) for name, row in results.items()}
        for when, policy in named.items()
    }


def _hashes(job: "Hardening", tune: "Tune") -> list[str | None]:
    """Of the controllers that a choice is between."""
    return [controller_hash(policy) for policy in (job.base, tune.before, tune.policy)]
