"""Varied conditions: is a fault one under other loads, motors, delays, noise and friction, too."""

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.numbers import EPISODES
from qd.faults.stages.base import Judging, Stage, count_outcomes, elite_seeds
from qd.search.archive import OUTCOMES, Archive
from qd.workers.compute import Compute
from qd.workers.pipeline import PipelineCfg, build_simulator
from qd.workers.seeds import Stream
from sim.controllers.spec import controller_hash
from sim.terrains.spaces.under_conditions import varied_genes, varied_space
from sim.terrains.terrains import Terrains


class Varied(Stage):
    """Crosses each fault under 20 draws of conditions, an episode each, by its controller and those that certify it."""

    name = "varied"
    calls = (1, 1)

    def check(self, archive: Archive, judging: Judging, before: Collection[str]) -> None:
        """Refuses a search without faults or that cannot have conditions, and certifiers that are not at hand."""
        super().check(archive, judging, before)
        if "others" not in before and ("fresh" in before or not archive.is_judged):
            raise ValueError(f"stages must have others before varied: {judging.search.run} has no faults to cross")
        _check_certifiers(archive, judging, renewed="others" in before)
        if before:  # else the stage itself finds out at once
            search = judging.search
            compute = judging.crosser.compute
            local = Compute(compute.device if compute.on_gpu else "cpu")
            sizes: dict[str, Any] = {"num_terrains": 1, "replicas": 1, "space": varied_space(search.space).name}
            build_simulator(PipelineCfg(compute=local, robot=search.robot, policy=search.policy, **sizes), 1)

    def run(self, archive: Archive, judging: Judging) -> Archive:
        """The archive with outcomes of all controllers under the same conditions."""
        _check_certifiers(archive, judging)
        search = judging.search
        rows = np.flatnonzero(archive.is_fault)
        space = varied_space(search.space)
        seeds = elite_seeds(archive, search.cfg.seed, EPISODES, stream=Stream.VARIED).reshape(-1, EPISODES)[rows]
        drawn = [varied_genes(search.space, archive.genes[row], draws) for row, draws in zip(rows, seeds, strict=True)]
        genes = np.array(drawn, np.float32).reshape(len(rows), EPISODES, space.num_genes)

        def cross(policy: str, chosen: NDArray[np.bool_], label: str) -> NDArray[np.int64]:
            chosen_genes = genes[chosen].reshape(-1, space.num_genes)
            terrains = Terrains(genes=chosen_genes, seeds=seeds[chosen].ravel(), space=space)
            label = f"{label}, varied conditions"
            result = judging.crosser.cross(policy, terrains, replicas=1, label=label, invalid_ok=True)
            return count_outcomes(result).reshape(-1, EPISODES, len(OUTCOMES)).sum(axis=1)

        outcomes = np.zeros_like(archive.resolved_outcomes)
        outcomes[rows] = cross(search.policy, np.ones(len(rows), bool), "searched")
        others = np.zeros_like(archive.certifier_outcomes)
        for column, name in enumerate(archive.certifiers):
            certified = archive.certificates[rows, column]
            if certified.any():
                others[rows[certified], column] = cross(judging.certifiers[name], certified, name)
        archive = replace(archive, varied_outcomes=outcomes, certifier_varied_outcomes=others)
        num_robust = archive.robust.sum()
        print(f"{num_robust} of {len(rows)} faults are robust: faults under varied conditions, too.", flush=True)
        return archive


def _check_certifiers(archive: Archive, judging: Judging, *, renewed: bool = False) -> None:
    """Refuses faults whose certifier has no file, or another one unless certificates are ``renewed`` before."""
    hashes = {name: str(controller_hash(policy)) for name, policy in judging.certifiers.items()}
    stored = zip(archive.certifiers, archive.certifier_sha256, archive.certificates[archive.is_fault].T, strict=True)
    names = [name for name, digest, certifies in stored if certifies.any() and hashes.get(name) != digest]
    if lost := [name for name in names if not (renewed and name in hashes)]:
        raise ValueError(
            f"certifiers must be those that certify faults of {judging.search.run}, got none or another file for "
            f"{', '.join(lost)}: give the files by --certifiers, or other controllers of these names and the stages "
            "others, varied"
        )
