import queue
import time

import numpy as np
import pytest

from qd.show.recordings import CrossingRequest
from qd.show.view.recorder import Recorder
from sim.terrains.terrains import Terrains


class Instant:
    """A simulation that names what it would cross; elite 13 breaks it, and policy `slow` takes its time."""

    def __init__(self, drop):
        self.wanted, self.drop = [], drop

    def put(self, wanted, robot):
        self.wanted.append((wanted, robot))

    def take(self, progress):
        wanted, robot = self.wanted.pop(0)
        if wanted.policy == "refused":
            return ValueError("no such controller")
        if int(wanted.terrain.seeds[0]) == 13:
            raise RuntimeError("broken")
        progress(0.5)
        if wanted.policy == "slow" and self.drop.wait(1.0):
            return None
        return f"{robot}: {wanted.policy} on {wanted.terrain.seeds[0]}"


def build(drop, num_terrains):
    return Instant(drop)


def wish(number, policy="fast"):
    terrain = Terrains(genes=np.zeros((1, 64), np.float32), seeds=np.array([number]))
    return CrossingRequest(label="", terrain=terrain, policy=policy, replicas=1)


@pytest.fixture(scope="module")
def reports():
    return queue.SimpleQueue()


@pytest.fixture(scope="module")
def recorder(reports):
    """One for all tests, since its process takes seconds to begin."""
    recorder = Recorder(build=build)
    recorder.robot, recorder.report = "spot", reports.put
    yield recorder
    recorder.stop()


def last_of(reports):
    """Reports up to the one that ends a recording."""
    received = []
    while not received or not (received[-1].result or received[-1].failed):
        received.append(reports.get(timeout=60))
    return received


def begin_slowly(recorder, reports):
    """Asks for a recording that takes its time, and waits until it is crossing."""
    recorder.request(task := wish(1, "slow"))
    while reports.get(timeout=60).share == 0.0:
        pass
    return task


def test_progress_comes_before_the_recording(recorder, reports):
    recorder.request(wish(2))
    received = last_of(reports)
    assert [report.share for report in received] == [0.0, 0.5, 1.0]
    assert "built" in received[0].text and received[-1].result == "spot: fast on 2"
    recorder.request(wish(3))
    assert [report.share for report in last_of(reports)] == [0.5, 1.0]  # it is built once


@pytest.mark.slow
def test_of_several_wishes_the_last_one_counts(recorder, reports):
    begin_slowly(recorder, reports)
    for number in (2, 3, 4):
        recorder.request(wish(number, "slow"))
    assert last_of(reports)[-1].result == "spot: slow on 1"
    assert last_of(reports)[-1].result == "spot: slow on 4"
    recorder.request(wish(5))
    recorder.request(None)
    time.sleep(0.5)
    assert all(reports.get().task.terrain.seeds == [5] for _ in range(reports.qsize()))


def test_a_failure_is_told_and_the_next_recording_works(recorder, reports):
    recorder.request(wish(13))
    failed = last_of(reports)[-1]
    assert failed.failed and "RuntimeError: broken" in failed.text
    recorder.request(wish(14))
    assert last_of(reports)[-1].result == "spot: fast on 14"
    recorder.request(wish(1, "refused"))
    assert last_of(reports)[-1].text == "no such controller"


def test_what_is_worked_on_can_be_cancelled(recorder, reports):
    task, began = begin_slowly(recorder, reports), time.perf_counter()
    recorder.cancel(task)
    recorder.request(wish(2))
    assert last_of(reports)[-1].result == "spot: fast on 2" and time.perf_counter() - began < 0.9


def test_stopping_does_not_wait_for_a_recording(recorder, reports):
    begin_slowly(recorder, reports)
    began = time.perf_counter()
    recorder.stop()
    assert time.perf_counter() - began < 0.9
