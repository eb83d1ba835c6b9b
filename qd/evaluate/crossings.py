"""Every controller on every set: crosses what is not kept yet, keeps it, and says how far it is.

Crossings are kept on disk, so that a killed evaluation goes on. A file carries the hash of all that its numbers
depend on: controller, terrains, seeds, episodes, kind of device, code and packages. So it is never out of date,
whichever command asks for it.
"""

import hashlib
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from qd.evaluate.measures import terrain_rates
from qd.evaluate.sets import TerrainSet
from qd.fresh import Open
from qd.workers.evaluator import Evaluate, EvaluatorCfg
from qd.workers.invalid import tell_invalid
from qd.workers.kept import Kept, key_of
from qd.workers.shards import flaw_of
from sim.rollout import RolloutResult

_MOST_TERRAINS = 2_000  # under way at once: 400 MB of height maps
_FORMAT = "{percentage:3.0f}%|{bar:12}| {desc} [{elapsed}, ETA {remaining}]"
_HOW = " with contact resolved"
_FIELDS = tuple(field.name for field in fields(RolloutResult))


def take_terrains(result: RolloutResult, places: np.ndarray) -> RolloutResult:
    """Crossings of some of the terrains, shape (num_places,) of integers, in the order given."""
    values = {name: getattr(result, name) for name in _FIELDS}
    return replace(result, **{name: value[places] for name, value in values.items() if isinstance(value, np.ndarray)})


def kept_crossings(
    folder: Path, evaluator: EvaluatorCfg, policy: str, terrains: TerrainSet, *, simulator: str = ""
) -> Kept:
    """Where crossings of a controller on a set are kept.

    Args:
        folder: One file a controller and set.
        evaluator: What crosses; its policy and terrains do not count.
        policy: The controller.
        terrains: The set.
        simulator: What crosses them if it is no evaluator.
    """
    parts = [hashlib.sha256(part.tobytes()).hexdigest() for part in (terrains.terrains, terrains.seeds)]
    drawn = [*parts, simulator] if simulator else parts
    key = key_of(replace(evaluator, policy=policy, space=terrains.space), drawn)
    name = "-".join(filter(None, [terrains.name, simulator, key[:24] if key else "not-kept"]))
    return Kept(folder / f"{name}.npz", key)


class KeptCrossings:
    """A folder of crossings, one file a controller and set.

    Args:
        folder: Where they are kept; made when the first is written.
        evaluator: What crosses; its policy and terrains do not count.
    """

    def __init__(self, folder: Path, evaluator: EvaluatorCfg) -> None:
        self.folder, self._evaluator = folder, evaluator

    def _kept(self, policy: str, terrains: TerrainSet) -> Kept:
        return kept_crossings(self.folder, self._evaluator, policy, terrains)

    def file(self, policy: str, terrains: TerrainSet) -> Path:
        """Where the crossings of one controller on one set are kept."""
        return self._kept(policy, terrains).file

    def read(self, policy: str, terrains: TerrainSet) -> RolloutResult | None:
        """Crossings that are kept; None if there are none, or their file is damaged, which it prints."""
        kept = self._kept(policy, terrains)
        found: dict[str, Any] = {name: array if array.ndim else array.item() for name, array in kept.read().items()}
        if not found:
            return None
        if missing := set(_FIELDS) - {"reward"} - found.keys():
            kept.damaged(f"no {', '.join(sorted(missing))}")
            return None
        found["penalty_names"] = tuple(found["penalty_names"].tolist())
        result = RolloutResult(**found)
        # Bits that flipped before they were written have no checksum.
        if flaw := flaw_of(result, len(terrains), self._evaluator.num_replicas):
            kept.damaged(flaw)
            return None
        return result

    def write(self, policy: str, terrains: TerrainSet, result: RolloutResult) -> None:
        """Keeps crossings.

        Raises:
            OSError: If they cannot be written.
        """
        values = {name: getattr(result, name) for name in _FIELDS}
        self._kept(policy, terrains).write(**{name: np.asarray(v) for name, v in values.items() if v is not None})


def cross_all(
    controllers: Mapping[str, str],
    sets: Mapping[str, TerrainSet],
    evaluator: EvaluatorCfg,
    folder: Path,
    *,
    open_evaluator: Open,
) -> dict[str, dict[str, RolloutResult]]:
    """Let every controller cross every set; what was kept before is not crossed again.

    Args:
        controllers: Policy of each controller by its name.
        sets: Sets by name; of ``generated`` and ``generated_far`` the second is taken from the first.
        evaluator: Where to cross, with what reward and how many episodes; its policy and terrains do not count.
        folder: Where crossings are kept, one file a controller and set, as soon as they are done.
        open_evaluator: Opens what crosses terrains.

    Returns:
        Set -> controller -> crossings.

    Raises:
        OSError: If crossings cannot be kept.
        EvaluatorError: If a worker is lost.
        AllInvalidError: If no episode of a controller on a set is valid.
    """
    whole = {name: chosen for name, chosen in sets.items() if name != "generated_far" or "generated" not in sets}
    kept, found = KeptCrossings(folder, evaluator), {}
    first: dict[str, str] = {}
    for who, policy in controllers.items():  # a controller with two names crosses once, under the first of them
        first.setdefault(policy, who)
    alone = {who: policy for policy, who in first.items()}
    for who, policy in alone.items():
        for name in whole:
            if (result := kept.read(policy, whole[name])) is not None:
                found[who, name] = result
    todo = {who: [name for name in whole if (who, name) not in found] for who in alone}
    if found:
        count = len(alone) * len(whole)
        how = _HOW * evaluator.resolved
        print(f"{len(found)} of {count} crossings of a set{how} are kept from before in {folder}", flush=True)
    episodes = evaluator.num_replicas * sum(len(whole[name]) for names in todo.values() for name in names)
    with tqdm(total=episodes, file=sys.stderr, dynamic_ncols=True, bar_format=_FORMAT, disable=None) as bar:
        for who, names in todo.items():
            own = replace(evaluator, policy=controllers[who])
            for name, result in _cross_missing(who, own, {name: whole[name] for name in names}, bar, open_evaluator):
                kept.write(controllers[who], whole[name], result)
                found[who, name] = result
    results = {name: {who: found[first[policy], name] for who, policy in controllers.items()} for name in whole}
    if "generated_far" in sets and "generated_far" not in whole:
        far = np.flatnonzero(np.isin(whole["generated"].numbers, sets["generated_far"].numbers))
        results["generated_far"] = {who: take_terrains(one, far) for who, one in results["generated"].items()}
    return {name: results[name] for name in sets}


def _cross_missing(
    who: str, evaluator: EvaluatorCfg, sets: Mapping[str, TerrainSet], bar: tqdm, open_evaluator: Open
) -> Iterator[tuple[str, RolloutResult]]:
    """Crossings of one controller by set, each as soon as it is done; sets of one terrain space share a simulation."""
    for space in dict.fromkeys(chosen.space for chosen in sets.values()):
        own = {name: chosen for name, chosen in sets.items() if chosen.space == space}
        bar.set_description_str(f"{who}: building the simulation")
        at_once = min(max(map(len, own.values())), _MOST_TERRAINS)
        with open_evaluator(replace(evaluator, num_terrains=at_once, space=space)) as evaluate:
            for name, chosen in own.items():
                what = f"{who} on {name}{_HOW * evaluator.resolved}"
                bar.set_description_str(what)
                result = _cross(evaluate, chosen, evaluator.num_replicas, bar)
                tell_invalid(result, what)
                bar.write(_line(what, chosen, result))
                yield name, result


def _cross(evaluate: Evaluate, terrains: TerrainSet, num_replicas: int, bar: tqdm) -> RolloutResult:
    first, count = bar.n, num_replicas * len(terrains)

    def show(share: float) -> None:
        bar.update(first + share * count - bar.n)

    result = evaluate(terrains.terrains, terrains.seeds, show)
    show(1.0)
    return result


def _line(what: str, terrains: TerrainSet, result: RolloutResult) -> str:
    rates = {name: values[~np.isnan(values)] for name, values in terrain_rates(result).items()}
    words = {"goal": "goal", "success": "no base collision"}
    said = ", ".join(f"{word} {rates[name].mean():.3f}" for name, word in words.items() if len(rates[name]))
    size = f"{len(terrains)} terrains x {result.outcome.shape[1]} episodes in {result.wall_s:.0f} s"
    return f"{what}: {said or 'all terrains invalid'} ({size})"
