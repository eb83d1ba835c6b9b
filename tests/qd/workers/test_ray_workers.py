"""Ray workers: how terrains are spread changes nothing, and no failure of a worker loses or alters a result."""

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.workers.compute import Compute, choose_device
from qd.workers.crosser import open_pipeline
from qd.workers.pipeline import PipelineCfg
from sim.terrains.terrains import Terrains
from tests.builders import free_port
from tests.qd import stand_in

pytestmark = pytest.mark.ray

ray = pytest.importorskip("ray")
Cluster = pytest.importorskip("ray.cluster_utils").Cluster

ROOT = Path(__file__).parents[3]
PATIENCE_S = 120.0
CFG = PipelineCfg(robot="anymal", policy="p", num_terrains=8, replicas=4, compute=Compute(workers="ray:2"))
GENES = np.random.default_rng(0).uniform(-1, 1, (21, 64)).astype(np.float32)
SEEDS = np.arange(100, 121, dtype=np.uint32)
TERRAINS = Terrains(genes=GENES, seeds=SEEDS)


@pytest.fixture(scope="module")
def cluster():
    """One Ray for the tests of the file, ended after them."""
    choose_device("cpu", "ray:4")
    yield
    ray.shutdown()


def assert_crossed(result, terrains):
    stand_in.assert_same(result, stand_in.evaluate(GENES[terrains], SEEDS[terrains], 4))


def test_how_terrains_are_spread_changes_nothing_even_after_a_stop(cluster):
    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    with open_pipeline(replace(CFG, compute=Compute(workers="ray:3")), build=stand_in.Crosser) as evaluate:
        for count in (1, 8, 21):
            assert_crossed(evaluate(TERRAINS[:count]), slice(count))
        with pytest.raises(KeyboardInterrupt):
            evaluate(TERRAINS[:8], interrupt)
        evaluate.clear()
        for lot in (slice(0, 5), slice(5, 7), slice(7, 21)):
            evaluate.put(TERRAINS[lot])
        for lot in (slice(0, 5), slice(5, 7), slice(7, 21)):
            assert_crossed(evaluate.take(), lot)
        until = time.monotonic() + PATIENCE_S
        while evaluate.status() != (3, 0) and time.monotonic() < until:  # on a busy machine one began later
            evaluate(TERRAINS[:1])
        assert evaluate.status() == (3, 0)


@pytest.mark.parametrize("how", ["die", "raise", "nan"])
def test_terrains_of_a_worker_that_failed_are_crossed_again(cluster, tmp_path, how):
    with open_pipeline(replace(CFG, policy=f"{how}:{tmp_path}:3"), build=stand_in.Failing) as evaluate:
        for _ in range(3):
            assert_crossed(evaluate(TERRAINS), slice(21))
        assert evaluate.status().retries == 3


def test_what_every_worker_refuses_ends_the_evaluation(cluster, tmp_path):
    cfg = replace(CFG, policy=f"refuse:{tmp_path}:99")
    with pytest.raises(ValueError, match="terrains"), open_pipeline(cfg, build=stand_in.Failing) as evaluate:
        evaluate(TERRAINS[:8])


def test_a_worker_of_other_code_is_refused(cluster, monkeypatch):
    monkeypatch.setattr("qd.workers.ray_workers.code_fingerprint", lambda rooms: "of this machine")
    with pytest.raises(ValueError, match="code"), open_pipeline(CFG, build=stand_in.Crosser):
        pass


GROWING_RUN = """
import sys, time
from tests.qd import stand_in
from tests.qd.workers.test_ray_workers import CFG, TERRAINS, open_pipeline
from qd.workers.compute import Compute, choose_device
choose_device("cpu", "ray")
cfg = CFG.__class__(**{**vars(CFG), "compute": Compute(workers="ray")})
with open_pipeline(cfg, build=stand_in.Crosser) as evaluate:
    for line in sys.stdin:  # how many workers to wait for
        while True:
            total = evaluate(TERRAINS).penalties.sum()
            if evaluate.status().workers == int(line):
                break
            time.sleep(0.1)
        print("crossed", int(line), repr(float(total)), flush=True)
"""


def test_a_cluster_is_used_as_it_grows_and_shrinks():
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    environment = {**os.environ, "RAY_ADDRESS": nodes.address, "PYTHONPATH": str(ROOT)}
    total = repr(float(stand_in.evaluate(GENES, SEEDS, 4).penalties.sum()))
    try:
        run = subprocess.Popen(
            [sys.executable, "-c", GROWING_RUN], cwd=ROOT, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )  # fmt: skip

        def ask(workers: int) -> list[str]:
            run.stdin.write(f"{workers}\n")
            run.stdin.flush()
            return next((line.split()[1:] for line in run.stdout if line.startswith("crossed ")), [])

        assert ask(1) == ["1", total]
        node = nodes.add_node(num_cpus=1)
        assert ask(2) == ["2", total]
        nodes.remove_node(node, allow_graceful=False)  # as a machine that loses its power
        assert ask(1) == ["1", total]
        _, errors = run.communicate(timeout=60)
        assert run.returncode == 0 and "Traceback" not in errors, errors
    finally:
        nodes.shutdown()


def test_no_cluster_at_the_address_is_an_error(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{free_port()}")
    monkeypatch.setattr("ray.is_initialized", lambda: False)  # other tests have a Ray of their own
    with pytest.raises(OSError, match="RAY_ADDRESS"):
        choose_device("cpu", "ray:2")
