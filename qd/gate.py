"""The gate of a search for certified failures: other controllers cross what the searched one does not.

Only a terrain that the controller does not cross can be certified, so certifiers are not asked about the others. Their
robots cross what a group failed while those of the controller cross the terrains of the next groups.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qd.archive import OUTCOMES, goal_rates
from qd.faults import outcome_counts
from qd.run.settings import SearchCfg
from qd.workers.evaluator import Evaluate, EvaluatorCfg, episode_seeds, pipeline_of
from qd.workers.shards import MIN_ROWS

if TYPE_CHECKING:
    from qd.fresh import Open

_STREAM = 9  # of the seeds of their episodes
_FAILING_SHARE = 0.5  # of the terrains under way that there are robots for; where more fail, some wait


class Gate:
    """Certifiers, who are handed lots of terrains and give their outcomes in the same order.

    Args:
        certifiers: What lets each of them cross terrains.
    """

    def __init__(self, certifiers: Sequence[Evaluate]) -> None:
        self._pipelines = [pipeline_of(evaluate) for evaluate in certifiers]
        self._lots: deque[int] = deque()

    def put(self, genes: NDArray[np.float32], seeds: NDArray[np.uint32]) -> None:
        """Lets every certifier cross terrains, which may be none; waits for nothing."""
        self._lots.append(len(genes))
        if len(genes):
            for pipeline in self._pipelines:
                pipeline.put(genes, seeds)

    def take(self) -> NDArray[np.int64]:
        """Waits for the lot that was put in first; its episodes by outcome, shape (terrains, num_certifiers, 4)."""
        if not self._lots.popleft():
            return np.zeros((0, len(self._pipelines), len(OUTCOMES)), np.int64)
        return np.stack([outcome_counts(pipeline.take()) for pipeline in self._pipelines], axis=1)

    def clear(self) -> None:
        """Has nothing under way afterwards."""
        self._lots.clear()
        for pipeline in self._pipelines:
            pipeline.clear()


def groups_behind(num_groups: int) -> int:
    """Groups whose failed terrains wait while the next group's are crossed.

    Half of the groups at a time are with the certifiers: fewer, and their robots wait for the last of each small lot;
    more, and those of the controller have too few groups to go on with.
    """
    return max(0, num_groups // 2 - 1)


def certifier_seeds(cfg: SearchCfg, iteration: int, places: slice) -> NDArray[np.uint32]:
    """Seeds of the certifiers' episodes on some places of an iteration, apart from those of the controller's."""
    return episode_seeds(cfg.seed, iteration, cfg.scheduler.num_terrains, stream=_STREAM)[places]


def rates_of(asked: NDArray[np.bool_], counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Goal rates of the certifiers on all terrains.

    Args:
        asked: On which they were asked, shape (T,).
        counts: Their episodes on these by outcome, shape (asked, C, 4).

    Returns:
        Shape (T, C): NaN where nobody was asked, 0 where over a quarter of the episodes are invalid.
    """
    rates = np.full((len(asked), counts.shape[1]), np.nan)
    rates[asked] = np.nan_to_num(goal_rates(counts))
    return rates


@contextmanager
def open_gate(
    cfg: SearchCfg, certifiers: Mapping[str, str], evaluator: EvaluatorCfg, open_evaluator: "Open", *, runs: int = 1
) -> Iterator[Gate | None]:
    """Opens what the certifiers of a search cross terrains with, beside what the controller does.

    Args:
        cfg: The search.
        certifiers: Controllers by name; none for a search without a gate.
        evaluator: As of the controller. They work on the same device, with about as many robots for theirs as the
            controller has for its episodes.
        open_evaluator: Opens it.
        runs: Searches whose terrains are crossed together.

    Yields:
        The gate, or None.
    """
    if not certifiers:
        yield None
        return
    groups = cfg.scheduler.groups
    lot = -(-cfg.scheduler.emitters // groups) * cfg.scheduler.batch_size * runs
    num_terrains = (groups_behind(groups) + 1) * lot
    robots = evaluator.envs_of_worker * evaluator.num_workers
    share = _FAILING_SHARE * num_terrains * cfg.certify_episodes / (evaluator.num_terrains * evaluator.num_replicas)
    own = replace(
        evaluator, num_terrains=num_terrains, num_replicas=cfg.certify_episodes,
        num_envs=max(MIN_ROWS, round(share * robots)),
    )  # fmt: skip
    with ExitStack() as opened:
        yield Gate([opened.enter_context(open_evaluator(replace(own, policy=one))) for one in certifiers.values()])
