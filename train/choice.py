"""Which controller a hardening goes on with after a training: the new one, if validation terrains speak for it.

Two trainings of one recipe differ by several points, and one may end worse than it began. Validation terrains are of
the kinds that are reported, but none of those (:mod:`qd.evaluate.sets`).
"""

from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from qd.evaluate.evaluate import cross_sets
from qd.evaluate.measures import terrain_rates
from qd.evaluate.sets import make_sets
from qd.run.directory import ROUNDS_FILE
from sim.files.atomic import to_json, write_atomically
from sim.policy.spec import controller_hash
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
        AllInvalidError: If no episode on a set is valid.
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
        ``kept``, ``score`` of both, which is the mean over the sets, and ``why``, in words.
    """
    scores = {"before": fmean(before.values()), "after": fmean(after.values())}
    why = f"its goal rate on validation is {scores['after']:.3f}, before {scores['before']:.3f}"
    lost = {name: base[name] - after[name] for name in FIXED_SETS if base[name] - after[name] > MOST_LOST + 1e-9}
    if lost:
        why += "".join(f"; on {name} it is {points:.3f} below the base's" for name, points in lost.items())
    return {"kept": not lost and scores["after"] >= scores["before"], "why": why, "score": scores}


def _goal_rates(job: "Hardening", tune: "Tune") -> dict[str, dict[str, float]]:
    """Goal rate of the base and of the controllers before and after a training, by validation set.

    The elites of all archives are one set, since a small archive has few for validation.
    """
    sets = make_sets(FIXED_SETS, job.terrains, 0, space=job.space, part="validation")
    archives = divisible(tune.archives)
    sets |= {run.name: held_out(job, run, "validation") for run in archives}
    controllers = {"base": job.base, "before": tune.before, "after": tune.policy}
    print(f"\nOn validation terrains, before {tune.run.name} and after:", flush=True)
    results = cross_sets(
        controllers, sets, robot=job.robot, compute=job.compute, episodes=job.episodes, reward=True,
        cache=job.path / "crossings", open_evaluator=job.open_evaluator,
    )  # fmt: skip
    found: dict[str, dict[str, float]] = {}
    for when in controllers:
        rates = {name: terrain_rates(row[when])["goal"] for name, row in results.items()}
        elites = [rates.pop(run.name) for run in archives]
        rates |= {"elites": np.concatenate(elites)} if elites else {}
        found[when] = {name: float(np.nanmean(values)) for name, values in rates.items()}
    return found


def _hashes(job: "Hardening", tune: "Tune") -> list[str | None]:
    """Of the controllers that a choice is between."""
    return [controller_hash(policy) for policy in (job.base, tune.before, tune.policy)]
