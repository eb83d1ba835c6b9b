"""How well penalties see failures: how much more a crossing that misses the goal costs than one that reaches it.

The penalties of velocities are squared errors. Absolute ones, by which versions before searched, are summed beside them
from the same crossings, for comparison alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim.files.command import Who, publish
from sim.files.records import identity, provenance
from sim.files.settings import setting

if TYPE_CHECKING:
    from sim.rollout import Rollout, RolloutResult

_SQUARED = ("yaw_rate", "vel_x", "vel_y")
_AT_ONCE = {"cuda": 500, "cpu": 16}  # terrains
_CPU_ROBOTS = 32  # at once


@dataclass(frozen=True, kw_only=True)
class PenaltyRatios(Who):
    """Compare each penalty's mean over crossings that miss the goal with its mean over those that reach it.

    The terrains are hard-random ones. A ratio near 1 means that the penalty does not see failures. The penalties
    yaw_rate, vel_x and vel_y are squared errors; the ratios of absolute errors are shown beside theirs.
    """

    terrains: int = setting(2_000, least=1)
    """Hard-random terrains."""
    replicas: int = setting(20, least=1)
    """Episodes a terrain."""
    seed: int = setting(1, least=0)
    """Draws terrains and starts."""
    device: str | None = None
    """Warp device, cuda:0 or cpu; the GPU if there is one."""
    out: Path | None = None
    """File to write; runs/<robot>-penalty-ratios.json."""

    def execute(self) -> dict[str, Any]:
        """Crosses the terrains and publishes the ratios.

        Raises:
            ValueError: If a flag's value cannot be used.
            AllInvalidError: If no episode is valid.
        """
        from qd.run.directory import RUNS
        from qd.run.progress import share_bar
        from qd.workers.evaluator import check_policy, resolve_device
        from sim.robots.robot import get_robot
        from sim.rollout import Rollout
        from sim.space import SUPER_GAUSSIAN

        robot, device = get_robot(self.robot or "anymal"), resolve_device(self.device, None)
        policy = self.policy or str(robot.policy_file)
        check_policy(policy, robot, device)
        genes = SUPER_GAUSSIAN.hard_random(self.terrains, self.seed)
        seeds = np.random.SeedSequence(self.seed).generate_state(self.terrains, np.uint32)
        at_once = min(self.terrains, _AT_ONCE[device.partition(":")[0]])

        def measure() -> dict[str, Any]:
            num_envs = _CPU_ROBOTS if device == "cpu" else None
            rollout = Rollout(
                robot, policy, num_terrains=at_once, num_replicas=self.replicas, num_envs=num_envs, device=device
            )
            parts: list[tuple[RolloutResult, NDArray[np.float64]]] = []
            with share_bar("penalty-ratios") as progress:
                for first in range(0, self.terrains, at_once):
                    turn = slice(first, first + at_once)
                    parts.append(crossed_with_absolute(rollout, genes[turn], seeds[turn]))
                    progress(min(1.0, (first + at_once) / self.terrains))
            return {**provenance(device, self.seed), **identity(robot, policy), **ratios_of(parts)}

        return publish(self.out or RUNS / f"{robot.name}-penalty-ratios.json", measure, _show)


class AbsoluteErrors:
    """Sums absolute errors beside the squared ones of a rollout's episodes (:class:`sim.rollout.Watcher`).

    The absolute error of a control step is the root of the mean of its physics steps' squares.

    Args:
        rollout: The crossing.
        num_episodes: That are run.
    """

    def __init__(self, rollout: "Rollout", num_episodes: int) -> None:
        from kernels.penalties import PENALTIES

        self._rollout = rollout
        self._columns = [PENALTIES.index(name) for name in _SQUARED]
        self._before = self._squared()
        self.sums: NDArray[np.float64] = np.zeros((num_episodes, len(_SQUARED)))
        """Time integral of each error of :data:`_SQUARED`, shape (num_episodes, 3)."""

    def _squared(self) -> NDArray[np.float64]:
        return self._rollout.state.penalty_sums.numpy()[:, self._columns].astype(np.float64)

    def before_step(self) -> None:
        """Remembers the sums so far."""
        self._before = self._squared()

    def after_step(self) -> None:
        """Adds what the step has added."""
        episode = self._rollout.state.episode.numpy()
        busy = episode >= 0
        added = np.maximum(0.0, self._squared() - self._before)[busy]
        self.sums[episode[busy]] += np.sqrt(added * self._rollout.robot.control_dt)


def crossed_with_absolute(
    rollout: "Rollout", terrains: NDArray[Any], seeds: NDArray[Any]
) -> "tuple[RolloutResult, NDArray[np.float64]]":
    """Crosses terrains, and sums the absolute errors of velocities too.

    Args:
        rollout: The crossing.
        terrains: As of :meth:`sim.rollout.Rollout.evaluate`, T of them.
        seeds: One each.

    Returns:
        The result, and the sums of :class:`AbsoluteErrors`, shape (T, R, 3).
    """
    shape = (len(terrains), rollout.num_replicas)
    watcher = AbsoluteErrors(rollout, shape[0] * shape[1])
    result = rollout.evaluate(terrains, seeds, watcher=watcher)
    return result, watcher.sums.reshape(*shape, len(_SQUARED))


def ratios_of(parts: "list[tuple[RolloutResult, NDArray[np.float64]]]") -> dict[str, Any]:
    """Means over episodes that missed and that reached the goal, and their ratio.

    Args:
        parts: Of :func:`crossed_with_absolute`.

    Returns:
        ``terrains``, ``episodes``, ``invalid_episodes``, ``failing_episodes``; ``penalties``, by name, and
        ``absolute``, by name of those that are squared: ``failing``, ``reached`` (means, raw) and ``ratio``. None where
        there is no such episode, or the mean of those that reached the goal is 0.

    Raises:
        AllInvalidError: If no episode is valid.
    """
    from qd.workers.invalid import refuse_all_invalid

    results = [result for result, _ in parts]
    invalid = np.concatenate([result.invalid for result in results])
    if invalid.all():
        refuse_all_invalid(results[0])
    reached = np.concatenate([result.reached_goal for result in results])
    names = results[0].penalty_names
    penalties = np.concatenate([result.penalties for result in results])
    absolute = np.concatenate([sums for _, sums in parts])
    failing = ~invalid & ~reached
    return {
        "terrains": len(invalid),
        "episodes": int(invalid.size),
        "invalid_episodes": int(invalid.sum()),
        "failing_episodes": int(failing.sum()),
        "penalties": {name: _ratio(penalties[..., k], failing, reached) for k, name in enumerate(names)},
        "absolute": {
            name: _ratio(absolute[..., k], failing, reached) for k, name in enumerate(_SQUARED) if name in names
        },
    }


def _ratio(
    sums: NDArray[np.float64], failing: NDArray[np.bool_], reached: NDArray[np.bool_]
) -> dict[str, float | None]:
    failed, arrived = (float(sums[chosen].mean()) if chosen.any() else None for chosen in (failing, reached))
    ratio = failed / arrived if failed is not None and arrived else None
    return {"failing": failed, "reached": arrived, "ratio": ratio}


def _show(report: Mapping[str, Any]) -> None:
    from sim.files.intervals import value_words

    print(
        f"{report['failing_episodes']} of {report['episodes']} episodes missed the goal. "
        "Mean of a penalty over them, over its mean over those that reached it:"
    )
    for kind, label in (("penalties", ""), ("absolute", ", absolute errors")):
        for name, row in report[kind].items():
            print(f"  {name + label:<28}{value_words(row['ratio'], None, '.1f'):>8}")
