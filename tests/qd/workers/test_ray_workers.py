"""Ray workers: how terrains are spread changes nothing, and no failure of a worker loses or alters a result."""

import contextlib
import dataclasses
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from qd.workers.evaluator import EvaluatorCfg, open_evaluator, resolve_device
from tests.builders import free_port
from tests.qd import crossers, stand_in

pytestmark = pytest.mark.ray

ray = pytest.importorskip("ray")

ROOT = Path(__file__).parents[3]
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
    stand_in.assert_same(result, stand_in.evaluate(GENES[terrains], SEEDS[terrains], 4))


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
        until = time.monotonic() + PATIENCE_S
        while evaluate.status() != (3, 0) and time.monotonic() < until:  # on a busy machine one began later
            evaluate(GENES[:1], SEEDS[:1])
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


class Node:
    """A Ray node of one core, in a process group of its own."""

    def __init__(self, environment: dict[str, str], *flags: str) -> None:
        command = [str(Path(sys.executable).parent / "ray"), "start", *flags, "--block", "--num-cpus=1"]
        command += ["--object-store-memory=100000000", "--disable-usage-stats"]
        self._process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment, start_new_session=True
        )

    def kill(self) -> None:
        """As a machine that loses its power."""
        for process in [self._process.pid, *children(self._process.pid)]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        self._process.wait()


def children(pid: int) -> list[int]:
    """Processes begotten by one, at any remove."""
    parent_of = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent_of[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    direct = [child for child, parent in parent_of.items() if parent == pid]
    return direct + [further for child in direct for further in children(child)]


GROWING_RUN = """
import sys, time
from tests.qd import crossers
from tests.qd.workers.test_ray_workers import CFG, GENES, SEEDS, open_evaluator, resolve_device
resolve_device("cpu", "ray")
with open_evaluator(CFG.__class__(**{**vars(CFG), "workers": "ray"}), build=crossers.Crosser) as evaluate:
    for line in sys.stdin:  # how many workers to wait for
        while True:
            total = evaluate(GENES, SEEDS).penalties.sum()
            if evaluate.status().workers == int(line):
                break
            time.sleep(0.1)
        print("crossed", int(line), repr(float(total)), flush=True)
"""


def test_a_cluster_is_used_as_it_grows_and_shrinks():
    port = free_port()
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": uuid.uuid4().hex * 2}  # Ray's nodes ask each other for one
    nodes = [Node({**os.environ, **token}, "--head", f"--port={port}", "--include-dashboard=false")]
    environment = {**os.environ, **token, "RAY_ADDRESS": f"127.0.0.1:{port}", "PYTHONPATH": str(ROOT)}
    total = repr(float(stand_in.evaluate(GENES, SEEDS, 4).penalties.sum()))
    try:
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        run = subprocess.Popen(
            [sys.executable, "-c", GROWING_RUN], cwd=ROOT, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip

        def ask(workers: int) -> list[str]:
            run.stdin.write(f"{workers}\n")
            run.stdin.flush()
            return next((line.split()[1:] for line in run.stdout if line.startswith("crossed ")), [])

        assert ask(1) == ["1", total]
        nodes.append(Node({**os.environ, **token}, f"--address=127.0.0.1:{port}"))
        assert ask(2) == ["2", total]
        nodes.pop().kill()
        assert ask(1) == ["1", total]
        _, errors = run.communicate(timeout=60)
        assert run.returncode == 0 and "Traceback" not in errors, errors
    finally:
        for node in nodes:
            node.kill()


def test_no_cluster_at_the_address_is_an_error(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{free_port()}")
    monkeypatch.setattr("ray.is_initialized", lambda: False)  # other tests have a Ray of their own
    with pytest.raises(OSError, match="RAY_ADDRESS"):
        resolve_device("cpu", "ray:2")
