"""Recordings are found again by all that they depend on, and made where they are missing."""

import dataclasses

import numpy as np
import pytest

from qd.show.recordings import Recordings, request_elite
from sim.terrains.spaces.registry import get_space
from sim.terrains.terrains import GroundMaps, Terrains
from tests.builders import small_archive
from tests.qd.recordings import stand_in_cross


@pytest.fixture
def request_4(anymal):
    return request_elite(small_archive(5), 4, policy=str(anymal.policy_file), replicas=2)


@pytest.fixture
def recording(request_4):
    return stand_in_cross([])([request_4], lambda share: None)[0]


def test_only_the_recording_of_an_equal_request_is_read(anymal, request_4, recording, tmp_path):
    assert Recordings(anymal, folder=tmp_path).read(request_4) is None
    Recordings(anymal, folder=tmp_path).store(request_4, recording)
    again = Recordings(anymal, folder=tmp_path)
    named = again.read(dataclasses.replace(request_4, label="a hill"))
    np.testing.assert_array_equal(named.base_position, recording.base_position)
    assert named.labels == ("a hill",)
    terrain = request_4.terrain
    heights = Terrains(heights=np.zeros((1, 161, 321), np.float32), seeds=terrain.seeds)
    terrains = [
        dataclasses.replace(terrain, seeds=terrain.seeds + 1), dataclasses.replace(terrain, genes=-terrain.genes),
        dataclasses.replace(terrain, space=get_space("course")), heights,
        dataclasses.replace(heights, ground=GroundMaps.plain(1)),
    ]  # fmt: skip
    changes = [{"replicas": 1}, {"policy": __file__}, *({"terrain": changed} for changed in terrains)]
    changed = [dataclasses.replace(request_4, **change) for change in changes]
    assert len({request_4, *changed}) == 8  # no two requests are equal
    assert [again.read(request) for request in changed] == [None] * 7
    assert Recordings(anymal, device="cuda:0", folder=tmp_path).read(request_4) is None  # whose last bits are others
    other = dataclasses.replace(anymal, action_scale=anymal.action_scale * 2)
    assert Recordings(other, folder=tmp_path).read(request_4) is None


def test_a_damaged_file_counts_as_none_and_is_written_again(anymal, request_4, recording, tmp_path):
    recordings = Recordings(anymal, folder=tmp_path)
    recordings.store(request_4, recording)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-9])
    assert recordings.read(request_4) is None
    recordings.store(request_4, recording)
    assert recordings.read(request_4) is not None


def test_missing_recordings_are_crossed_in_lots_of_one_controller(anymal, tmp_path, monkeypatch):
    archive = small_archive(5)
    policies = (str(anymal.policy_file), __file__)
    requests = [request_elite(archive, k, policy=policies[k % 2], replicas=4) for k in range(5)]
    lots = []

    def cross(lot, progress):
        lots.append([request.label for request in lot])
        return stand_in_cross([])(lot, progress)

    def record(device, requests):
        recordings = Recordings(anymal, device=device, folder=tmp_path).record(requests)
        return [recording.labels[0] for recording in recordings]

    monkeypatch.setattr("qd.show.recordings.RecordingCrosser", lambda robot, device: cross)
    labels = [f"elite {k} of anymal" for k in range(5)]
    assert record("cuda:0", requests) == labels and lots == [labels[::2], labels[1::2]]
    more = [*requests[3:], request_elite(archive, 0, policy=policies[0], replicas=4, seed=1)]
    assert record("cuda:0", more) == [*labels[3:], labels[0]] and lots[2:] == [labels[:1]]
    record("cpu", requests)  # one at a time, controller by controller
    assert lots[3:] == [[labels[k]] for k in (0, 2, 4, 1, 3)]
