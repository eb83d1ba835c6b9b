import dataclasses
import zipfile

import numpy as np
import pytest

from qd.show.recordings import Recordings, on_elite
from sim.policy.spec import controller_hash
from sim.recording.file import write_recording
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


def opened(anymal, folder):
    return Recordings(anymal, folder=folder / "cache")


def test_what_was_recorded_is_found_by_the_next_viewer(anymal, wanted, recording, tmp_path):
    assert opened(anymal, tmp_path).read(wanted) is None
    opened(anymal, tmp_path).keep(wanted, recording)
    found = opened(anymal, tmp_path).read(wanted)
    np.testing.assert_array_equal(found.base_position, recording.base_position)
    for other in (
        dataclasses.replace(wanted, terrain_seed=5),
        dataclasses.replace(wanted, replicas=1),
        dataclasses.replace(wanted, terrain=-wanted.terrain),
        dataclasses.replace(wanted, policy=__file__),
    ):
        assert opened(anymal, tmp_path).read(other) is None


@pytest.mark.parametrize("damage", [b"", b"no npz", "cut", "flip"])
def test_a_damaged_file_is_as_good_as_none_and_written_again(anymal, wanted, recording, tmp_path, damage):
    recordings = opened(anymal, tmp_path)
    recordings.keep(wanted, recording)
    file = recordings.file_of(wanted)
    data = bytearray(file.read_bytes())
    if damage == "cut":
        damage = data[: len(data) // 2]
    elif damage == "flip":
        with zipfile.ZipFile(file) as members:  # in what is read: a zip file has idle bytes too
            data[members.getinfo("base_position.npy").header_offset + 100] ^= 0xFF
        damage = data
    file.write_bytes(bytes(damage))
    again = opened(anymal, tmp_path)
    assert again.read(wanted) is None
    again.keep(wanted, recording)
    assert opened(anymal, tmp_path).read(wanted) is not None


def test_a_recording_under_another_name_is_not_taken_for_it(anymal, wanted, recording, tmp_path):
    recordings = opened(anymal, tmp_path)
    for strange in (
        dataclasses.replace(recording, genes=-recording.genes),
        dataclasses.replace(recording, seeds=recording.seeds + np.uint32(1)),
        dataclasses.replace(recording, robot="cassie"),
        dataclasses.replace(recording, origin=recording.origin | {"policy_sha256": "another"}),
    ):
        (tmp_path / "cache").mkdir(exist_ok=True)
        write_recording(recordings.file_of(wanted), strange)
        assert opened(anymal, tmp_path).read(wanted) is None


def test_of_code_without_a_file_only_the_last_recording_is_known(anymal, wanted, recording, tmp_path):
    wanted = dataclasses.replace(wanted, policy="builtins:abs")
    recordings = opened(anymal, tmp_path)
    recordings.keep(wanted, recording)
    assert recordings.read(wanted) is recording
    assert opened(anymal, tmp_path).read(wanted) is None
    assert not (tmp_path / "cache").exists()


def test_where_nothing_can_be_kept_that_is_said(anymal, wanted, recording, tmp_path, capsys):
    (tmp_path / "cache").touch()
    recordings = opened(anymal, tmp_path)
    recordings.keep(wanted, recording)
    assert "not kept" in capsys.readouterr().out and recordings.read(wanted) is recording


def test_what_is_missing_is_crossed_in_batches_of_one_controller(anymal, tmp_path):
    archive = small_archive(5)
    policies = (str(anymal.policy_file), __file__)
    wanted = [on_elite(archive, k, policy=policies[k % 2], replicas=4) for k in range(5)]
    crossed, sizes = [], []
    stand_in = stand_in_cross(crossed)

    def cross(batch, progress):
        sizes.append(len(batch))
        assert len({one.policy for one in batch}) == 1
        return stand_in(batch, progress)

    found = Recordings(anymal, device="cuda:0", folder=tmp_path, cross=cross).all_of(wanted)
    assert sizes == [3, 2] and [one.labels[0] for one in found] == [f"elite {k} of anymal" for k in range(5)]
    (tmp_path / Recordings(anymal, device="cuda:0", folder=tmp_path).file_of(wanted[1]).name).unlink()
    named = [dataclasses.replace(one, label=f"elite {k} again") for k, one in enumerate(wanted)]
    again = Recordings(anymal, device="cuda:0", folder=tmp_path, cross=cross).all_of(named)
    assert crossed[5:] == ["elite 1 again"] and again[4].labels == ("elite 4 again",)
    Recordings(anymal, device="cpu", folder=tmp_path, cross=cross).all_of(wanted)  # whose last bits are others
    assert sizes == [3, 2, 1, *[1] * 5]
