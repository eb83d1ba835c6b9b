"""Fresh episodes on every elite: does the controller fail it, to which family does it belong, what stops the robot."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from qd.faults.families import find_failing_causes, find_families
from qd.faults.numbers import FRESH_EPISODES
from qd.faults.searches import Search
from qd.faults.stages.base import Judging, Stage, elite_seeds
from qd.search.archive import Archive, FreshValues
from qd.search.fitness import BIT_EPISODES, FitnessCfg, evaluate_rollout
from qd.workers.seeds import Stream
from sim.rollout import RolloutResult
from sim.terrains.terrains import Terrains


class Fresh(Stage):
    """Crosses every elite in 40 fresh episodes, since an elite is the best of many noisy evaluations."""

    name = "fresh"

    def check(self, archive: Archive, judging: Judging, before: Collection[str]) -> None:
        """Any search can be judged."""

    def run(self, archive: Archive, judging: Judging) -> Archive:
        """The archive with fresh values, families and causes, by descending corrected fitness."""
        search = judging.search
        seeds = elite_seeds(archive, search.cfg.seed, stream=Stream.FRESH)
        terrains = Terrains(genes=archive.genes, seeds=seeds, space=search.space)
        result = judging.crosser.cross(search.policy, terrains, replicas=FRESH_EPISODES, label="fresh episodes")
        corrected = archive.corrected_by(fresh_values(archive, result, search.cfg.fitness))
        if not np.array_equal(archive.cell, corrected.cell):
            print(f"Elites of {search.run} are numbered anew: by their fresh episodes, the hardest first.", flush=True)
        return with_families(corrected, search)


def fresh_values(archive: Archive, result: RolloutResult, fitness: FitnessCfg) -> FreshValues:
    """The values of an archive's elites by 40 fresh episodes on each."""
    cells = archive.cells
    fresh = evaluate_rollout(result, cells, fitness)
    collided = (result.base_collision & ~result.invalid)[:, :BIT_EPISODES].any(axis=1)
    cell = cells.find_cells(fresh.ratios, collided)
    reproduced = fresh.valid & cells.are_neighbours(archive.cell, cell)
    return FreshValues(**{**vars(fresh), "cell": cell}, reproduced=reproduced)


def with_families(archive: Archive, search: Search) -> Archive:
    """The archive with the family and the cause of each elite, as its fresh episodes have it."""
    families = find_families(archive.genes, search.space)
    causes = find_failing_causes(archive, search.space, search.robot.half_width)
    return replace(archive, family=families, cause=causes)
