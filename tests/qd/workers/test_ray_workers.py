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

from kernels.episode import Outcome
from qd.workers.evaluator import EvaluatorCfg, EvaluatorError, open_evaluator, resolve_device
from qd.workers.shards import flaw_of
from tests.builders import free_port
from tests.qd import cluster_run, crossers, stand_in
from tests.qd.workers.test_evaluator import same

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


def expected(count):
    return stand_in.evaluate(GENES[:count], SEEDS[:count], 4)


@pytest.mark.parametrize("name", ["{}/model.pt", "{}/mine.py:act", "{}/mine.py:adapt@{}/model.pt", "os.path:join"])
def test_the_files_of_a_controller_travel(tmp_path, name):
    from qd.workers.ray_workers import PackedCode

    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    content = {"model.pt": b"weights", "mine.py": b"x = 1"}
    for file, text in content.items():
        (here / file).write_bytes(text)
    assert PackedCode.of(name.format(here, here)).unpacked(there) == name.format(there, there)
    sent = {file.name: file.read_bytes() for file in there.iterdir()}
    assert sent == {file: text for file, text in content.items() if file in name}


@pytest.mark.parametrize("workers", [1, 3])
def test_how_terrains_are_spread_changes_nothing(cluster, workers):
    with open_evaluator(dataclasses.replace(CFG, workers=f"ray:{workers}"), build=crossers.Crosser) as evaluate:
        for count in (1, 8, 21):
            seen = []
            assert same(evaluate(GENES[:count], SEEDS[:count], seen.append), expected(count))
            assert seen == sorted(seen) and seen[-1] == 1.0
        assert evaluate.status().retries == 0


def test_lots_come_out_in_the_order_that_they_were_put_in(cluster):
    with open_evaluator(CFG, build=crossers.Crosser) as evaluate:
        for lot in (slice(0, 5), slice(5, 7), slice(7, 21)):
            evaluate.put(GENES[lot], SEEDS[lot])
        sizes = [len(evaluate.take().outcome) for _ in range(3)]
    assert sizes == [5, 2, 14]


@pytest.mark.parametrize("how", ["die", "raise", "nan", "short", "nonsense"])
def test_terrains_of_a_worker_that_failed_are_crossed_again(cluster, tmp_path, capsys, how):
    cfg = dataclasses.replace(CFG, policy=f"{how}:{tmp_path}:3")
    with open_evaluator(cfg, build=crossers.Failing) as evaluate:
        for _ in range(3):
            assert same(evaluate(GENES, SEEDS), expected(21))
        assert evaluate.status().retries == 3
    assert capsys.readouterr().err.count("crossed again") == 3


@pytest.mark.parametrize(("how", "error"), [("refuse", ValueError), ("nan", EvaluatorError)])
def test_terrains_that_fail_everywhere_end_the_evaluation(cluster, tmp_path, how, error):
    cfg = dataclasses.replace(CFG, policy=f"{how}:{tmp_path}:99")
    with open_evaluator(cfg, build=crossers.Failing) as evaluate, pytest.raises(error, match=r"5 times|another kind"):
        evaluate(GENES[:8], SEEDS[:8])


def test_a_refusal_to_build_comes_before_any_work_and_for_debugging_with_its_traceback(cluster, monkeypatch):
    monkeypatch.setenv("FAULTLINE_DEBUG", "1")
    with (
        pytest.raises(ValueError, match=r"(?s)policy 'x' does not fit.*crossers\.py\", line \d+"),
        open_evaluator(CFG, build=crossers.Refusing),
    ):
        pass


def test_a_worker_of_other_code_is_refused(cluster, monkeypatch):
    monkeypatch.setattr("qd.workers.ray_workers.code_fingerprint", lambda rooms: "of this machine")
    with pytest.raises(ValueError, match="other code"), open_evaluator(CFG, build=crossers.Crosser):
        pass


def test_what_an_interrupted_evaluation_had_under_way_is_of_no_later_one(cluster):
    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    with open_evaluator(CFG, build=crossers.Crosser) as evaluate:
        with pytest.raises(KeyboardInterrupt):
            evaluate(GENES[:8], SEEDS[:8], interrupt)
        part = slice(13, 21)
        assert same(evaluate(GENES[part], SEEDS[part]), stand_in.evaluate(GENES[part], SEEDS[part], 4))


def test_leaving_ends_the_workers(cluster):
    with open_evaluator(CFG, build=crossers.Identified) as evaluate:
        pids = set(evaluate(GENES[:2], SEEDS[:2]).final_position[..., 0].astype(int).ravel().tolist())
    end = time.monotonic() + 20
    while any(os.path.exists(f"/proc/{pid}") for pid in pids):
        assert time.monotonic() < end, "a worker outlives its evaluator"
        time.sleep(0.1)


def test_devices_that_cannot_be_had(cluster, monkeypatch):
    with pytest.raises(ValueError, match="device"):
        resolve_device("cuda:1", "ray:2")
    monkeypatch.setattr("qd.workers.ray_workers.num_devices", lambda device: 0)
    with pytest.raises(ValueError, match="GPU"):
        resolve_device("cuda", "ray")


@pytest.mark.parametrize(
    "changes",
    [
        {"penalties": np.ones((2, 4, 6))},
        {"penalties": np.ones((3, 4, 5))},
        {"penalties": np.full((3, 4, 6), -1.0)},
        {"penalties": np.full((3, 4, 6), np.inf)},
        {"outcome": np.full((3, 4), Outcome.INVALID, np.uint8)},  # without a reason
        {"duration_s": np.zeros((3, 4), np.float32)},
        {"physics_steps": 0},
        {"reward": np.full((3, 4), np.nan)},
        {"reward": np.zeros((3, 3))},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_result_that_cannot_be_true_is_known(changes):
    assert flaw_of(expected(3), 3, 4) is None
    assert flaw_of(dataclasses.replace(expected(3), **changes), 3, 4)


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


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


def test_a_cluster_is_used_as_it_grows_and_shrinks():
    port = free_port()
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": uuid.uuid4().hex * 2}  # Ray's nodes ask each other for one
    nodes = [Node({**os.environ, **token}, "--head", f"--port={port}", "--include-dashboard=false")]
    environment = {**os.environ, **token, "RAY_ADDRESS": f"127.0.0.1:{port}"}
    total = repr(float(stand_in.evaluate(cluster_run.GENES, cluster_run.SEEDS, 4).penalties.sum()))
    try:
        end = time.monotonic() + PATIENCE_S
        while not listens(port):
            assert time.monotonic() < end
            time.sleep(0.1)
        run = subprocess.Popen(
            [sys.executable, "-m", "tests.qd.cluster_run"], cwd=ROOT, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip

        def ask(workers: int) -> list[str]:
            run.stdin.write(f"{workers}\n")
            run.stdin.flush()
            for line in run.stdout:  # Ray says this and that in between
                if line.startswith("found "):
                    return line.split()[1:]
            return []

        assert ask(1) == ["1", total]
        nodes.append(Node({**os.environ, **token}, f"--address=127.0.0.1:{port}"))
        assert ask(2) == ["2", total]
        nodes.pop().kill()
        assert ask(1) == ["1", total]
        _, errors = run.communicate(timeout=60)
        assert run.returncode == 0, errors
        assert "Traceback" not in errors
    finally:
        for node in nodes:
            node.kill()


def test_no_cluster_at_the_address_is_an_error(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{free_port()}")
    monkeypatch.setattr("ray.is_initialized", lambda: False)  # other tests have a Ray of their own
    with pytest.raises(OSError, match=r"no Ray cluster at RAY_ADDRESS=127.0.0.1:\d+"):
        resolve_device("cpu", "ray:2")
