import dataclasses
import multiprocessing
import os
import signal
import threading
import time

import numpy as np
import pytest

from qd.workers import evaluator
from qd.workers.evaluator import EvaluatorCfg, EvaluatorError, Workers, open_evaluator, parse_workers, resolve_device
from qd.workers.process import _serve
from tests.qd import crossers, stand_in

CFG = EvaluatorCfg(robot="anymal", policy="p", num_terrains=6, num_replicas=4, device="cpu", workers="1")
GENES = np.random.default_rng(0).uniform(-1, 1, (15, 64)).astype(np.float32)
SEEDS = np.arange(100, 115, dtype=np.uint32)


class Crosser(crossers.Crosser):
    """Evaluates by the stand-in, and does what the policy's name says."""

    def __init__(self, cfg: EvaluatorCfg, num_terrains: int) -> None:
        if cfg.policy == "refuse to build":
            raise ValueError("policy 'x' does not fit:\nuse another")
        super().__init__(cfg, num_terrains)

    def evaluate(self, terrains, seeds, *, progress=None):
        if self.cfg.policy == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.cfg.policy == "fail":
            raise RuntimeError("the solver is broken")
        if self.cfg.policy == "sleep":
            time.sleep(60)
        result = super().evaluate(terrains, seeds, progress=progress)
        return dataclasses.replace(result, wall_s=float(seeds[0]), physics_steps=int(seeds[0]))


def same(a, b) -> bool:
    arrays = [field.name for field in dataclasses.fields(a) if isinstance(getattr(a, field.name), np.ndarray)]
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in arrays)


@pytest.mark.parametrize(
    ("text", "workers"),
    [
        (None, Workers(on_ray=False, count=None)),
        ("4", Workers(on_ray=False, count=4)),
        ("ray", Workers(on_ray=True, count=None)),
        ("ray:16", Workers(on_ray=True, count=16)),
    ],
)
def test_workers_as_the_command_line_names_them(text, workers):
    assert parse_workers(text) == workers


@pytest.mark.parametrize("text", ["", "0", "-1", "1.5", "auto", "ray:0", "ray:", "ray4", "4 ", "ray:-1", "9999999"])
def test_workers_that_are_no_number_and_not_on_ray(text):
    with pytest.raises(ValueError, match=f"number of processes from 1 on, ray, or ray:N, got '{text}'"):
        resolve_device("cpu", text)


@pytest.mark.parametrize("num_processes", [1, 2, 4])
def test_how_terrains_are_spread_changes_nothing(num_processes):
    cfg = dataclasses.replace(CFG, workers=str(num_processes))
    assert cfg.num_workers == num_processes
    with open_evaluator(cfg, build=Crosser) as evaluate:
        for count in (1, 6, 15):
            result = evaluate(GENES[:count], SEEDS[:count])
            assert result.penalties.shape == (count, 4, 6)
            assert same(result, stand_in.evaluate(GENES[:count], SEEDS[:count], 4))


def test_shards_run_at_the_same_time_and_turns_one_after_the_other():
    with open_evaluator(dataclasses.replace(CFG, workers="2"), build=Crosser) as evaluate:
        assert evaluate(GENES[:6], SEEDS[:6]).wall_s == 103.0  # shards begin at seeds 100 and 103
        # Twelve, of which six fit, go in lots of three, each as parts of two and one: the second begin at 102, 105, ...
        assert evaluate(GENES[:12], SEEDS[:12]).physics_steps == 102 + 105 + 108 + 111


def test_progress_rises_to_one():
    seen = []
    with open_evaluator(dataclasses.replace(CFG, workers="2"), build=Crosser) as evaluate:
        evaluate(GENES, SEEDS, seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert len(seen) >= 9  # three turns of at least a result and a half-way mark


def test_on_cuda_everything_stays_in_this_process():
    cfg = dataclasses.replace(CFG, device="cuda:0", policy=str(os.getpid()))
    seen = []
    with open_evaluator(cfg, build=Crosser) as evaluate:
        assert same(evaluate(GENES, SEEDS, seen.append), stand_in.evaluate(GENES, SEEDS, 4))
    assert seen == sorted(seen)


@pytest.mark.parametrize(
    ("num_terrains", "num_replicas", "workers", "expected"),
    [
        (8, 4, "2", 2),
        (3, 4, "8", 3),  # no more than terrains
        (8, 1, "8", 2),  # no fewer than 4 rows each
        (1, 1, "8", 1),
    ],
)
def test_number_of_processes(num_terrains, num_replicas, workers, expected):
    cfg = dataclasses.replace(CFG, num_terrains=num_terrains, num_replicas=num_replicas, workers=workers)
    assert cfg.num_workers == expected


def test_one_a_core_by_default(monkeypatch):
    monkeypatch.setattr(evaluator, "available_cores", lambda: 3)
    assert dataclasses.replace(CFG, workers=None).num_workers == 3


def test_a_refusal_arrives_as_it_was_said():
    cfg = dataclasses.replace(CFG, policy="refuse to build")
    with pytest.raises(ValueError, match="policy 'x' does not fit"), open_evaluator(cfg, build=Crosser):
        pass


def test_a_failure_in_a_worker_names_its_reason():
    cfg = dataclasses.replace(CFG, policy="fail")
    with (
        open_evaluator(cfg, build=Crosser) as evaluate,
        pytest.raises(EvaluatorError, match="RuntimeError: the solver is broken"),
    ):
        evaluate(GENES, SEEDS)


@pytest.mark.parametrize(("policy", "error"), [("refuse to build", ValueError), ("fail", EvaluatorError)])
def test_for_debugging_an_error_of_a_worker_brings_its_traceback(monkeypatch, policy, error):
    monkeypatch.setenv("FAULTLINE_DEBUG", "1")
    cfg = dataclasses.replace(CFG, policy=policy)
    with (
        pytest.raises(error, match=r"(?s)Traceback .*test_evaluator\.py\", line \d+"),
        open_evaluator(cfg, build=Crosser) as evaluate,
    ):
        evaluate(GENES, SEEDS)


def test_a_dead_worker_is_noticed():
    cfg = dataclasses.replace(CFG, policy="die", workers="2")
    with (
        open_evaluator(cfg, build=Crosser) as evaluate,
        pytest.raises(EvaluatorError, match=r"a worker process died \(signal SIGKILL\)"),
    ):
        evaluate(GENES, SEEDS)


def test_leaving_ends_workers_in_the_midst_of_work():
    began = time.monotonic()

    class EnoughError(Exception):
        pass

    def interrupt(*_: object) -> None:
        raise EnoughError

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with (
            pytest.raises(EnoughError),
            open_evaluator(dataclasses.replace(CFG, policy="sleep", workers="2"), build=Crosser) as evaluate,
        ):
            signal.setitimer(signal.ITIMER_REAL, 0.3)
            evaluate(GENES, SEEDS)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - began < 15


def test_seeds_must_be_one_a_terrain():
    with (
        open_evaluator(CFG, build=Crosser) as evaluate,
        pytest.raises(ValueError, match=r"seeds must have shape \(15,\)"),
    ):
        evaluate(GENES, SEEDS[:3])


def test_a_worker_whose_parent_was_killed_with_unread_messages_leaves_quietly(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # put back after the worker's function has set it
    ours, theirs = multiprocessing.Pipe()

    def die() -> None:
        assert ours.poll(10)  # "ready" is there and stays unread: the worker's next read is a reset, no end of file
        ours.close()

    parent = threading.Thread(target=die)
    parent.start()
    with pytest.raises(SystemExit) as exit:
        _serve(theirs, None, 1, lambda cfg, num_terrains: None)
    parent.join()
    assert exit.value.code == 0
