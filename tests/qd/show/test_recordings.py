"""Recordings are found again by all that they depend on, and made where they are missing."""

import dataclasses

import numpy as np
import pytest

from qd.show.recordings import Recordings, on_elite
from sim.policy.spec import controller_hash
from tests.builders import small_archive
from tests.qd.recordings import stand_in_cross
from tests.qd.show.view.made import make_recording


@pytest.fixture
def wanted(anymal):
    rng = np.random.default_rng(1)
    archive = dataclasses.replace(small_archive(5), genes=rng.uniform(-1, 1, (5, 64)).astype(np.float32))
    return on_elite(archive, 4, policy=str(anymal.policy_file), replicas=2)


@pytest.fixture
def recording(anymal, wanted):
    sha = controller_hash(wanted.policy)
    seeds = np.array([wanted.terrain_seed], np.uint32)
    return make_recording(anymal, wanted.terrain[None], seeds=seeds, policy_sha256=sha, replicas=2)


def test_what_was_recorded_is_found_by_the_next_command_and_nothing_else_is(anymal, wanted, recording, tmp_path):
    assert Recordings(anymal, folder=tmp_path).may_keep(wanted)
    Recordings(anymal, folder=tmp_path).keep(wanted, recording)
    again = Recordings(anymal, folder=tmp_path)
    assert not again.may_keep(wanted)
    named = again.read(dataclasses.replace(wanted, label="a hill"))
    np.testing.assert_array_equal(named.base_position, recording.base_position)
    assert named.labels == ("a hill",)
    for other in (
        dataclasses.replace(wanted, terrain_seed=5),
        dataclasses.replace(wanted, replicas=1),
        dataclasses.replace(wanted, terrain=-wanted.terrain),
        dataclasses.replace(wanted, policy=__file__),
        dataclasses.replace(wanted, space="course"),
    ):
        assert again.read(other) is None
    assert Recordings(anymal, device="cuda:0", folder=tmp_path).read(wanted) is None  # whose last bits are others
    changed = dataclasses.replace(anymal, action_scale=anymal.action_scale * 2)
    assert Recordings(changed, folder=tmp_path).read(wanted) is None


@pytest.mark.parametrize("damage", ["empty", "cut", "flip"])
def test_a_damaged_file_counts_as_none_and_is_written_again(anymal, wanted, recording, tmp_path, damage):
    Recordings(anymal, folder=tmp_path).keep(wanted, recording)
    (file,) = tmp_path.iterdir()
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0xFF
    file.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "flip": data}[damage])
    again = Recordings(anymal, folder=tmp_path)
    assert again.read(wanted) is None
    again.keep(wanted, recording)
    assert Recordings(anymal, folder=tmp_path).read(wanted) is not None


def test_of_code_without_a_file_only_the_last_recording_is_known(anymal, wanted, recording, tmp_path):
    wanted = dataclasses.replace(wanted, policy="builtins:abs")
    recordings = Recordings(anymal, folder=tmp_path / "none")
    recordings.keep(wanted, recording)
    assert recordings.read(wanted) is recording
    assert recordings.read(dataclasses.replace(wanted, terrain=-wanted.terrain)) is None
    assert Recordings(anymal, folder=tmp_path / "none").read(wanted) is None
    assert not (tmp_path / "none").exists()


def test_what_is_missing_is_crossed_in_batches_of_one_controller(anymal, tmp_path):
    archive = small_archive(5)
    policies = (str(anymal.policy_file), __file__)
    wanted = [on_elite(archive, k, policy=policies[k % 2], replicas=4) for k in range(5)]
    crossed, sizes = [], []
    stand_in = stand_in_cross(crossed)

    def cross(batch, progress):
        sizes.append(len(batch))
        assert len({crossing.policy for crossing in batch}) == 1
        return stand_in(batch, progress)

    recordings = Recordings(anymal, device="cuda:0", folder=tmp_path, cross=cross).all_of(wanted)
    assert sizes == [3, 2] and [one.labels[0] for one in recordings] == [f"elite {k} of anymal" for k in range(5)]
    more = [*wanted[3:], on_elite(archive, 0, policy=policies[0], replicas=4, seed=1)]
    again = Recordings(anymal, device="cuda:0", folder=tmp_path, cross=cross).all_of(more)
    assert len(crossed) == 6 and [one.labels[0] for one in again] == [f"elite {k} of anymal" for k in (3, 4, 0)]
    Recordings(anymal, device="cpu", folder=tmp_path, cross=cross).all_of(wanted)
    assert sizes == [3, 2, 1, *[1] * 5]


@pytest.mark.parametrize("changes", [{"replicas": 0}, {"seed": -1}])
def test_numbers_of_no_episodes_are_refused(changes):
    with pytest.raises(ValueError, match=r"episodes|seed"):
        on_elite(small_archive(), 0, policy="p", **{"replicas": 2} | changes)
