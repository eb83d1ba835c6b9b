"""Ray workers: how terrains are spread changes nothing, and no failure of a worker loses or alters a result."""

import dataclasses
import time

import numpy as np
import pytest

from qd.workers.evaluator import EvaluatorCfg, open_evaluator, resolve_device
from tests.builders import free_port
from tests.qd import crossers, stand_in

pytestmark = pytest.mark.ray

ray = pytest.importorskip("ray")
Cluster = pytest.importorskip("ray.cluster_utils").Cluster

NODE = {"num_cpus": 1, "object_store_memory": 100_000_000}
PATIENCE_S = 120.0
CFG = EvaluatorCfg(robot="anymal", policy="p", num_terrains=8, num_replicas=4, device="cpu", workers="ray:2")
GENES = np.random.default_rng(0).uniform(-1, 1, (21, 64)).astype(np.float32)
SEEDS = np.arange(100, 121, dtype=np.uint32)


@pytest.fixture(scope="module")
def cluster():
    """One Ray for the tests of the file, ended after them."""
    resolve_device("cpu", "ray:4")
    yield
    ray.shutdown()


def assert_crossed(result, terrains):
    expected = stand_in.evaluate(GENES[terrains], SEEDS[terrains], 4)
    np.testing.assert_array_equal(result.penalties, expected.penalties)
    np.testing.assert_array_equal(result.outcome, expected.outcome)


def test_how_terrains_are_spread_changes_nothing_even_after_a_stop(cluster):
    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    with open_evaluator(dataclasses.replace(CFG, workers="ray:3"), build=crossers.Crosser) as evaluate:
        for count in (1, 8, 21):
            assert_crossed(evaluate(GENES[:count], SEEDS[:count]), slice(count))
        with pytest.raises(KeyboardInterrupt):
            evaluate(GENES[:8], SEEDS[:8], interrupt)
        evaluate.clear()
        for lot in (slice(0, 5), slice(5, 7), slice(7, 21)):
            evaluate.put(GENES[lot], SEEDS[lot])
        for lot in (slice(0, 5), slice(5, 7), slice(7, 21)):
            assert_crossed(evaluate.take(), lot)
        assert evaluate.status() == (3, 0)


@pytest.mark.parametrize("how", ["die", "raise", "nan"])
def test_terrains_of_a_worker_that_failed_are_crossed_again(cluster, tmp_path, how):
    cfg = dataclasses.replace(CFG, policy=f"{how}:{tmp_path}:3")
    with open_evaluator(cfg, build=crossers.Failing) as evaluate:
        for _ in range(3):
            assert_crossed(evaluate(GENES, SEEDS), slice(21))
        assert evaluate.status().retries == 3


def test_what_every_worker_refuses_ends_the_evaluation(cluster, tmp_path):
    cfg = dataclasses.replace(CFG, policy=f"refuse:{tmp_path}:99")
    with pytest.raises(ValueError, match="terrains"), open_evaluator(cfg, build=crossers.Failing) as evaluate:
        evaluate(GENES[:8], SEEDS[:8])


def test_a_worker_of_other_code_is_refused(cluster, monkeypatch):
    monkeypatch.setattr("qd.workers.ray_workers.code_fingerprint", lambda rooms: "of this machine")
    with pytest.raises(ValueError, match="code"), open_evaluator(CFG, build=crossers.Crosser):
        pass


def test_no_cluster_at_the_address_is_an_error(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{free_port()}")
    monkeypatch.setattr("ray.is_initialized", lambda: False)  # other tests have a Ray of their own
    with pytest.raises(OSError, match="RAY_ADDRESS"):
        resolve_device("cpu", "ray:2")


def test_a_cluster_is_used_as_it_grows_and_shrinks(monkeypatch):
    ray.shutdown()  # the Ray of the other tests
    cluster = Cluster(initialize_head=True, head_node_args=NODE)
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    try:
        resolve_device("cpu", "ray")
        with open_evaluator(dataclasses.replace(CFG, workers="ray"), build=crossers.Crosser) as evaluate:

            def cross_until(workers: int) -> None:
                end = time.monotonic() + PATIENCE_S
                while evaluate.status().workers != workers:
                    assert time.monotonic() < end
                    assert_crossed(evaluate(GENES, SEEDS), slice(21))
                    time.sleep(0.1)
                assert_crossed(evaluate(GENES, SEEDS), slice(21))

            cross_until(1)
            node = cluster.add_node(**NODE)
            cross_until(2)
            cluster.remove_node(node, allow_graceful=False)  # as a machine that loses its power
            cross_until(1)
    finally:
        ray.shutdown()
        cluster.shutdown()
