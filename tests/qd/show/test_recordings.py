"""Recordings are found again by all that they depend on, and made where they are missing."""

import dataclasses

import numpy as np
import pytest

from qd.show.recordings import Recordings, on_elite
from sim.terrains.ground import GroundMaps
from tests.builders import small_archive
from tests.qd.recordings import stand_in_cross


@pytest.fixture
def wanted(anymal):
    return on_elite(small_archive(5), 4, policy=str(anymal.policy_file), replicas=2)


@pytest.fixture
def recording(wanted):
    return stand_in_cross([])([wanted], lambda share: None)[0]


def test_what_was_recorded_is_found_by_the_next_command_and_nothing_else_is(anymal, wanted, recording, tmp_path):
    assert Recordings(anymal, folder=tmp_path).read(wanted) is None
    Recordings(anymal, folder=tmp_path).keep(wanted, recording)
    again = Recordings(anymal, folder=tmp_path)
    named = again.read(dataclasses.replace(wanted, label="a hill"))
    np.testing.assert_array_equal(named.base_position, recording.base_position)
    assert named.labels == ("a hill",)
    changes = ({"terrain_seed": 5}, {"replicas": 1}, {"terrain": -wanted.terrain}, {"policy": __file__},
               {"space": "course"}, {"ground": GroundMaps.plain(1)})  # fmt: skip
    assert [again.read(dataclasses.replace(wanted, **change)) for change in changes] == [None] * 6
    assert Recordings(anymal, device="cuda:0", folder=tmp_path).read(wanted) is None  # whose last bits are others
    changed = dataclasses.replace(anymal, action_scale=anymal.action_scale * 2)
    assert Recordings(changed, folder=tmp_path).read(wanted) is None


def test_a_damaged_file_counts_as_none_and_is_written_again(anymal, wanted, recording, tmp_path):
    Recordings(anymal, folder=tmp_path).keep(wanted, recording)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-9])
    again = Recordings(anymal, folder=tmp_path)
    assert again.read(wanted) is None
    again.keep(wanted, recording)
    assert Recordings(anymal, folder=tmp_path).read(wanted) is not None


def test_what_is_missing_is_crossed_in_batches_of_one_controller(anymal, tmp_path):
    archive = small_archive(5)
    policies = (str(anymal.policy_file), __file__)
    wanted = [on_elite(archive, k, policy=policies[k % 2], replicas=4) for k in range(5)]
    batches = []

    def cross(batch, progress):
        batches.append([crossing.label for crossing in batch])
        return stand_in_cross([])(batch, progress)

    def record(device, wanted):
        recordings = Recordings(anymal, device=device, folder=tmp_path, cross=cross).all_of(wanted)
        return [recording.labels[0] for recording in recordings]

    labels = [f"elite {k} of anymal" for k in range(5)]
    assert record("cuda:0", wanted) == labels and batches == [labels[::2], labels[1::2]]
    more = [*wanted[3:], on_elite(archive, 0, policy=policies[0], replicas=4, seed=1)]
    assert record("cuda:0", more) == [*labels[3:], labels[0]] and batches[2:] == [labels[:1]]
    record("cpu", wanted)  # one at a time, controller by controller
    assert batches[3:] == [[labels[k]] for k in (0, 2, 4, 1, 3)]
