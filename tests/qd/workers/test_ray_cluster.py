"""A cluster of several Ray nodes on this host, which grows and loses a node under an evaluation."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from qd.workers.evaluator import resolve_device
from tests.builders import free_port
from tests.qd import stand_in
from tests.qd.cluster_run import GENES, SEEDS

pytestmark = pytest.mark.ray

pytest.importorskip("ray")

ROOT = Path(__file__).parents[3]
PATIENCE_S = 120.0


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
    found = [child for child, parent in parent_of.items() if parent == pid]
    return found + [further for child in found for further in children(child)]


def test_a_cluster_is_used_as_it_grows_and_shrinks():
    port = free_port()
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": uuid.uuid4().hex * 2}  # Ray's nodes ask each other for one
    nodes = [Node({**os.environ, **token}, "--head", f"--port={port}", "--include-dashboard=false")]
    environment = {**os.environ, **token, "RAY_ADDRESS": f"127.0.0.1:{port}"}
    expected = repr(float(stand_in.evaluate(GENES, SEEDS, 4).penalties.sum()))
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

        assert ask(1) == ["1", expected]
        nodes.append(Node({**os.environ, **token}, f"--address=127.0.0.1:{port}"))
        assert ask(2) == ["2", expected]
        nodes.pop().kill()
        assert ask(1) == ["1", expected]
        _, errors = run.communicate(timeout=60)
        assert run.returncode == 0, errors
        assert "Traceback" not in errors
    finally:
        for node in nodes:
            node.kill()


def test_no_cluster_at_the_address_is_said_in_one_line(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{free_port()}")
    monkeypatch.setattr("ray.is_initialized", lambda: False)  # other tests have a Ray of their own
    with pytest.raises(OSError, match=r"no Ray cluster at RAY_ADDRESS=127.0.0.1:\d+: .* start one with"):
        resolve_device("cpu", "ray:2")


def test_a_cluster_that_wants_its_token_says_how_to_give_it(monkeypatch):
    def refuse(**options):
        raise RuntimeError("rejected") from Exception("AuthenticationError: no token")  # as Ray does, after 20 s

    with socket.socket() as cluster:
        cluster.bind(("127.0.0.1", 0))
        cluster.listen()
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{cluster.getsockname()[1]}")
        monkeypatch.setattr("ray.is_initialized", lambda: False)
        monkeypatch.setattr("ray.init", refuse)
        with pytest.raises(OSError, match="wants its token: set RAY_AUTH_MODE=token"):
            resolve_device("cpu", "ray")
