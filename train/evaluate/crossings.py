"""Every controller on every set: crosses what is not kept yet, and says how far it is."""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from qd.workers.evaluator import Evaluate, EvaluatorCfg
from sim.rollout import RolloutResult
from train.evaluate.kept import KeptCrossings, take_terrains
from train.evaluate.measures import terrain_rates
from train.evaluate.sets import TerrainSet

Open = Callable[[EvaluatorCfg], AbstractContextManager[Evaluate]]
"""Opens what crosses terrains."""

_MOST_ENVS = 16_384  # at once, so that any number of terrains fits a GPU
_FORMAT = "{percentage:3.0f}%|{bar:12}| {desc} [{elapsed}, ETA {remaining}]"


def cross_all(
    controllers: Mapping[str, str],
    sets: Mapping[str, TerrainSet],
    evaluator: EvaluatorCfg,
    kept: KeptCrossings,
    *,
    open_evaluator: Open,
) -> dict[str, dict[str, RolloutResult]]:
    """Let every controller cross every set; what was kept before is not crossed again.

    Args:
        controllers: Policy of each controller by its name.
        sets: Sets by name; of ``generated`` and ``generated_far`` the second is taken from the first.
        evaluator: Where to cross, with what reward and how many episodes; its policy and terrains are not looked at.
        kept: Where crossings are kept, one file a controller and set, as soon as they are done.
        open_evaluator: Opens what crosses terrains.

    Returns:
        Set -> controller -> crossings.

    Raises:
        OSError: If crossings cannot be kept.
        EvaluatorError: If a worker is lost.
    """
    whole = {name: chosen for name, chosen in sets.items() if name != "generated_far" or "generated" not in sets}
    found = {}
    for who, policy in controllers.items():
        for name in whole:
            if (result := kept.read(policy, whole[name])) is not None:
                found[who, name] = result
    todo = {who: [name for name in whole if (who, name) not in found] for who in controllers}
    if found:
        count = len(controllers) * len(whole)
        print(f"{len(found)} of {count} crossings of a set are kept from before in {kept.folder}", flush=True)
    episodes = evaluator.num_replicas * sum(len(whole[name]) for names in todo.values() for name in names)
    with tqdm(total=episodes, file=sys.stderr, dynamic_ncols=True, bar_format=_FORMAT, disable=None) as bar:
        for who, names in todo.items():
            own = replace(evaluator, policy=controllers[who])
            for name, result in _cross_missing(who, own, {name: whole[name] for name in names}, bar, open_evaluator):
                kept.write(controllers[who], whole[name], result)
                found[who, name] = result
    results = {name: {who: found[who, name] for who in controllers} for name in whole}
    if "generated_far" in sets and "generated_far" not in whole:
        far = np.flatnonzero(np.isin(whole["generated"].numbers, sets["generated_far"].numbers))
        results["generated_far"] = {who: take_terrains(one, far) for who, one in results["generated"].items()}
    return {name: results[name] for name in sets}


def _cross_missing(
    who: str, evaluator: EvaluatorCfg, sets: Mapping[str, TerrainSet], bar: tqdm, open_evaluator: Open
) -> Iterator[tuple[str, RolloutResult]]:
    """Crossings of one controller by set, each as soon as it is done; sets of one size share a simulation."""
    for size in sorted({len(chosen) for chosen in sets.values()}, reverse=True):
        bar.set_description_str(f"{who}: building the simulation")
        at_once = min(size, max(1, _MOST_ENVS // evaluator.num_replicas))
        with open_evaluator(replace(evaluator, num_terrains=at_once)) as evaluate:
            for name, chosen in sets.items():
                if len(chosen) == size:
                    bar.set_description_str(f"{who} on {name}")
                    result = _cross(evaluate, chosen, evaluator.num_replicas, bar)
                    bar.write(_line(who, chosen, result))
                    yield name, result


def _cross(evaluate: Evaluate, terrains: TerrainSet, num_replicas: int, bar: tqdm) -> RolloutResult:
    first, count = bar.n, num_replicas * len(terrains)

    def show(share: float) -> None:
        bar.update(first + share * count - bar.n)

    result = evaluate(terrains.terrains, terrains.seeds, show)
    show(1.0)
    return result


def _line(who: str, terrains: TerrainSet, result: RolloutResult) -> str:
    rates = {name: values[~np.isnan(values)] for name, values in terrain_rates(result).items()}
    said = ", ".join(f"{name} {rates[name].mean():.3f}" for name in ("success", "goal") if len(rates[name]))
    size = f"{len(terrains)} terrains x {result.outcome.shape[1]} episodes in {result.wall_s:.0f} s"
    return f"{who} on {terrains.name}: {said or 'all terrains invalid'} ({size})"
