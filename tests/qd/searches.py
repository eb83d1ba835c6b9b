"""Searches over the stand-in evaluator, for tests of several files."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from qd.search import loop, results
from qd.search.archive import Archive
from qd.search.fitness import FitnessCfg
from qd.search.loop import search
from qd.search.presets import SchedulerCfg
from qd.search.settings import SearchCfg
from qd.show import figures
from qd.workers import crosser
from sim.controllers.spec import controller_hash
from sim.robots.find import get_robot
from sim.robots.robot import robot_identity
from tests.qd import stand_in
from tests.qd.stand_in import compute_by, open_stand_in

ANYMAL = get_robot("anymal")
CFG = SearchCfg(
    robot="anymal",
    **robot_identity(ANYMAL),
    preset="small",
    policy="shipped",
    policy_sha256=controller_hash(ANYMAL.policy_file),
    seed=3,
    iterations=2,
    replicas=4,
    collision_bit=False,
    fitness=FitnessCfg(penalties=stand_in.PENALTIES, scales=stand_in.SCALES),
    scheduler=SchedulerCfg(method="cma_mae+map_elites", emitters=2, batch_size=6, sigma0=0.5, restart_rule=3),
)


def run(path: Path, *, opener=open_stand_in, until=None, **changes) -> Archive:
    """A search, begun or gone on with, whose settings differ from CFG's by some."""
    return search(replace(CFG, **changes), path, compute_by(opener), until=until)


def without_figures(patch: pytest.MonkeyPatch) -> None:
    """Figures take longer to draw than a search over the stand-in takes."""
    for module in (figures, results):
        patch.setattr(module, "write_figures", lambda folder, archive, metrics: [])


@contextmanager
def crossing_by(opener) -> Iterator[None]:
    """``faultline archive`` crosses terrains by this meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crosser, "open_pipeline", opener)
        patch.setattr(loop, "open_pipeline", opener)
        yield


TIMES = ("wall_s", "episodes_per_s", "search_s")
"""What differs between two searches that are the same."""


def rows_of(path: Path, *, timed: bool = False) -> list[dict]:
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if timed or k not in TIMES} for row in rows]
