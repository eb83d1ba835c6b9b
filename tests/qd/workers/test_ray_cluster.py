"""The real thing: a cluster of several Ray nodes on this host, and a search whose workers are killed under it."""

import contextlib
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

from tests.qd import stand_in
from tests.qd.cluster_run import GENES, SEEDS

pytest.importorskip("ray")

ROOT = Path(__file__).parents[3]
PATIENCE_S = 240.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


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
        time.sleep(5.0)  # the head must listen
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
        stranger = subprocess.run(
            [sys.executable, "-m", "qd.search", "--workers", "auto"], cwd=ROOT, text=True, capture_output=True,
            env={**os.environ, "RAY_ADDRESS": environment["RAY_ADDRESS"]}, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert stranger.returncode == 2 and "wants its token: set RAY_AUTH_MODE=token" in stranger.stderr
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


def test_no_cluster_at_the_address_is_said_in_one_line():
    flags = ["--robot", "anymal", "--device", "cpu", "--workers", "2"]
    environment = {**os.environ, "RAY_ADDRESS": f"127.0.0.1:{free_port()}"}
    done = subprocess.run(
        [sys.executable, "-m", "qd.search", *flags], cwd=ROOT, env=environment, capture_output=True, text=True,
        timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "error: no Ray cluster at RAY_ADDRESS=127.0.0.1:" in done.stderr


def workers_at_work(mark: str) -> list[int]:
    """Ray workers of the search with a mark in its environment that cross a shard at this moment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            at_work = (folder / "cmdline").read_bytes().startswith(b"ray::RayWorker.cross")
            if at_work and mark.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
    return found


def test_three_workers_killed_in_one_search_change_nothing(tmp_path):
    size = ["--device", "cpu", "--emitters", "2", "--batch-size", "4", "--replicas", "2", "--iterations", "3"]
    command = [sys.executable, "-m", "qd.search", "--robot", "anymal", *size]
    quiet = {"cwd": ROOT, "stdout": subprocess.DEVNULL}
    undisturbed = subprocess.Popen([*command, "--processes", "1", "--run-dir", str(tmp_path / "whole")], **quiet)
    assert undisturbed.wait(PATIENCE_S) == 0
    mark = f"FAULTLINE_TEST={uuid.uuid4()}"
    environment = {**os.environ, "FAULTLINE_TEST": mark.partition("=")[2]}
    log = (tmp_path / "log").open("w+")
    search = subprocess.Popen(
        [*command, "--workers", "2", "--run-dir", str(tmp_path / "killed")], env=environment, stderr=log, **quiet
    )
    killed: set[int] = set()
    end = time.monotonic() + PATIENCE_S
    while len(killed) < 3:
        assert time.monotonic() < end and search.poll() is None, log.name
        for pid in set(workers_at_work(mark)) - killed:
            time.sleep(1.0)  # into the shard
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
            break
        time.sleep(0.2)
    assert search.wait(PATIENCE_S) == 0, (tmp_path / "log").read_text()
    said = (tmp_path / "log").read_text()
    assert said.count("are crossed again by another") == 3, said
    whole, found = (np.load(tmp_path / name / "archive.npz") for name in ("whole", "killed"))
    for name in whole.files:
        np.testing.assert_array_equal(found[name], whole[name])
