"""Searches over the stand-in evaluator, for tests of several files."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from qd.fitness import FitnessCfg
from qd.fresh import Reevaluate, reevaluate_run
from qd.run.arguments import Job
from qd.run.directory import RunDirectory, origin_in
from qd.run.settings import SchedulerCfg, SearchCfg
from qd.search import run_search
from qd.show import figures
from qd.workers.evaluator import EvaluatorCfg
from sim.files.records import provenance, robot_identity
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from tests.qd import stand_in
from tests.qd.stand_in import open_stand_in

CFG = SearchCfg(
    **robot_identity(get_robot("anymal")),
    robot="anymal",
    preset="small",
    policy="shipped",
    policy_sha256=None,
    seed=3,
    iterations=2,
    replicas=4,
    intervals=10,
    collision_bit=False,
    fitness=FitnessCfg(penalties=stand_in.PENALTIES, scales=stand_in.SCALES),
    scheduler=SchedulerCfg(method="cma_mae+map_elites", emitters=2, batch_size=6, sigma0=0.5, restart_rule="3"),
)


def make_job(path: Path, *, resumes: bool = False, reproduce: bool = False, confirm: bool = False, **changes) -> Job:
    cfg = dataclasses.replace(CFG, **changes)
    evaluator = EvaluatorCfg(
        robot="anymal", policy="p", num_terrains=cfg.scheduler.num_terrains, num_replicas=cfg.replicas, workers="1"
    )
    begun = {**provenance("cpu", cfg.seed), "sessions": []}
    origin = origin_in(RunDirectory(path).read_config()) if resumes else begun
    return Job(
        cfg=cfg,
        path=path,
        resumes=resumes,
        evaluator=evaluator,
        reproduce=reproduce,
        confirm=confirm,
        origin=origin,
        session={"command": f"to {cfg.iterations}", "commit": "c", "device": "d"},
        resume_command=f"faultline archive --resume {path}",
        reevaluate_command=f"faultline reevaluate --run {path}",
        confirm_command=f"faultline confirm --run {path}",
    )


SHIPPED = {"policy": "shipped", "policy_sha256": controller_hash(get_robot("anymal").policy_file)}
"""Settings of a search against the robot's own controller, which has a file."""


def run(path: Path, **settings):
    return run_search(make_job(path, **settings), open_evaluator=open_stand_in)


def found_and_fresh(folder: Path) -> Path:
    """Two runs of one search, without figures: ``found`` as it ended, ``fresh`` with fresh episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "write_figures", lambda folder, archive, metrics: [])
        run(folder / "found", iterations=6, **SHIPPED)
        shutil.copytree(folder / "found", folder / "fresh")
        reevaluate_run(Reevaluate(run=folder / "fresh", device="cpu"), open_evaluator=open_stand_in)
    return folder


TIMES = ("wall_s", "episodes_per_s", "search_s")
"""What differs between two searches that are the same."""


def rows_of(path: Path, *, timed: bool = False) -> list[dict]:
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if timed or k not in TIMES} for row in rows]
