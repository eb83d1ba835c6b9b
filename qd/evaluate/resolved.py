"""The tables' terrains again with contact resolved, here and in plain MuJoCo C: how far the search's settings lie off.

None of the sets was selected by the episodes of its tables, so the bias of their rates is that of the settings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.crossings import kept_crossings
from qd.evaluate.measures import interval_of, mean_of
from qd.evaluate.sets import TerrainSet, part_of
from qd.workers.evaluator import EvaluatorCfg, parse_workers
from sim.rates import KINDS, agreement, crossing_rates
from sim.robots.robot import RobotCfg, get_robot
from sim.rollout import RolloutResult
from sim.space import get_space

PLAIN_EPISODES = 10
"""Episodes on each terrain in plain MuJoCo C."""
_KEY = 20250607  # with the seed, the entropy of which terrains are crossed there
Outcomes = Mapping[str, Mapping[str, NDArray[np.uint8]]]
"""Set -> controller -> outcome of each episode, shape (num_terrains, num_episodes)."""


def check_resolved(
    names: Sequence[str],
    mujoco_c: int,
    controllers: Mapping[str, str],
    robot: RobotCfg,
    sets: Mapping[str, TerrainSet],
) -> None:
    """Refuses what cannot be crossed with contact resolved.

    Args:
        names: Controllers to cross so.
        mujoco_c: Terrains of each set to cross in plain MuJoCo C too.
        controllers: Policy of each controller of the tables by its name.
        robot: The robot.
        sets: Sets of the tables.

    Raises:
        ValueError: If a name is none of the controllers or given twice, there is none for MuJoCo C, or MuJoCo C cannot
            have the robot or the terrains.
    """
    unknown = [name for name in names if name not in controllers]
    if unknown or len(set(names)) < len(names):
        raise ValueError(
            f"resolved must name controllers of the tables, each once, some of {', '.join(controllers)}; got "
            f"{', '.join(names)}"
        )
    if not mujoco_c:
        return
    if not names:
        first = next(iter(controllers))
        raise ValueError(
            f"mujoco_c {mujoco_c} is for the controllers of --resolved, got none: name them, as in --resolved {first}"
        )
    from sim.mujoco_c.model import crossing_model, refuse_softness

    try:
        crossing_model(robot, np.zeros((2, 2)))
        for space in {chosen.space for chosen in sets.values()}:
            refuse_softness(get_space(space))
    except ValueError as error:
        raise ValueError(f"{error}, or leave MuJoCo C out with --mujoco-c 0") from None


def outcomes_of(results: Mapping[str, Mapping[str, RolloutResult]]) -> dict[str, dict[str, NDArray[np.uint8]]]:
    """How each episode of crossings ended."""
    return {name: {who: one.outcome for who, one in row.items()} for name, row in results.items()}


def drawn_sets(sets: Mapping[str, TerrainSet], count: int, seed: int) -> dict[str, TerrainSet]:
    """``count`` terrains of each set, drawn at random without replacement, or all of them; in the order of the set."""
    rng = np.random.default_rng([_KEY, seed])
    places = {name: np.sort(rng.permutation(len(chosen))[:count]) for name, chosen in sets.items()}
    return {name: part_of(chosen, places[name], name) for name, chosen in sets.items()}


def cross_in_mujoco_c(
    controllers: Mapping[str, str], sets: Mapping[str, TerrainSet], evaluator: EvaluatorCfg, folder: Path
) -> dict[str, dict[str, NDArray[np.uint8]]]:
    """Lets controllers cross terrains in plain MuJoCo C with contact resolved; what was kept is not crossed again.

    The episodes begin as the tables' do.

    Args:
        controllers: Policy of each controller by its name.
        sets: Terrains by set.
        evaluator: With robot and workers; it has no part in it otherwise.
        folder: Where outcomes are kept, one file a controller and set, after each terrain.

    Returns:
        Set -> controller -> :class:`kernels.episode.Outcome`, shape (num_terrains, :data:`PLAIN_EPISODES`).

    Raises:
        OSError: If a process dies, or a file cannot be written.
    """
    return {
        name: {who: _cross(who, policy, chosen, evaluator, folder) for who, policy in controllers.items()}
        for name, chosen in sets.items()
    }


def _cross(who: str, policy: str, terrains: TerrainSet, evaluator: EvaluatorCfg, folder: Path) -> NDArray[np.uint8]:
    from sim.bank import host_device
    from sim.mujoco_c.crossing import cross_terrains

    own = replace(evaluator, device="cpu", num_replicas=PLAIN_EPISODES, resolved=True, reward=False)
    kept = kept_crossings(folder, own, policy, terrains, simulator="mujoco_c")
    shape = (len(terrains), PLAIN_EPISODES)
    before = kept.read().get("outcome")
    outcome = before if before is not None and before.shape == shape else np.zeros(shape, np.uint8)
    left = np.flatnonzero(outcome[:, 0] == 0)
    if len(left) == 0:
        return outcome
    terrains_left = f"{len(left)} terrain{'s' * (len(left) != 1)} of {terrains.name}"
    print(f"{who} in MuJoCo C on {terrains_left}, {PLAIN_EPISODES} episodes each", flush=True)

    def crossed(terrain: int, crossings: Any) -> None:
        outcome[left[terrain]] = crossings.outcome
        kept.write(outcome=outcome)

    cross_terrains(
        get_robot(evaluator.robot), policy, terrains.terrains[left], terrains.seeds[left],
        space=get_space(terrains.space), num_episodes=PLAIN_EPISODES, device=host_device(),
        processes=parse_workers(evaluator.workers).num_processes, resolved=True, crossed=crossed,
    )  # fmt: skip
    return outcome


def compared(
    tables: Outcomes, others: Outcomes, whole: Mapping[str, TerrainSet], sets: Mapping[str, TerrainSet], seed: int
) -> dict[str, Any]:
    """Rates of other crossings of the tables' terrains, and the bias of the tables' rates against them.

    Args:
        tables: Crossings at the search's settings.
        others: Crossings of all or some of the same terrains.
        whole: Sets of the tables.
        sets: Those terrains.
        seed: Of the bootstrap over terrains, of elites over families.

    Returns:
        Set -> controller -> ``success`` and ``goal`` with ``intervals``, and what :func:`sim.rates.agreement` says:
        ``goal_bias`` is the tables' rate minus the other one.
    """
    found: dict[str, Any] = {}
    for name, row in others.items():
        places = np.searchsorted(np.sort(whole[name].numbers), sets[name].numbers)
        places = np.argsort(whole[name].numbers)[places]
        found[name] = {
            who: _rates(tables[name][who][places], theirs, seed, sets[name].families) for who, theirs in row.items()
        }
    return found


def _rates(
    ours: NDArray[np.uint8], theirs: NDArray[np.uint8], seed: int, families: NDArray[np.int64] | None
) -> dict[str, Any]:
    rates = {kind: crossing_rates(theirs, kind) for kind in KINDS}
    return {
        **{kind: mean_of(values) for kind, values in rates.items()},
        "intervals": {kind: interval_of(values, seed, families) for kind, values in rates.items()},
        **agreement(ours, theirs, seed, families),
    }
