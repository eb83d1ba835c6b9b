import dataclasses
import zipfile

import numpy as np
import pytest

from qd.show.view.crossings import Crossings, Wanted
from sim.policy.spec import controller_hash
from sim.recording.file import write_recording
from tests.qd.show.view.made import make_recording


@pytest.fixture
def wanted(anymal):
    rng = np.random.default_rng(1)
    genes = rng.uniform(-1, 1, (1, 64)).astype(np.float32)
    return Wanted(elite=4, controller="base", policy=str(anymal.policy_file), replicas=2, genes=genes)


@pytest.fixture
def recording(anymal, wanted):
    sha = controller_hash(wanted.policy)
    return make_recording(anymal, wanted.genes, seeds=wanted.seeds, policy_sha256=sha, replicas=2)


def opened(anymal, folder):
    return Crossings(anymal, cache=folder / "cache", published=folder / "published")


def test_what_was_recorded_is_found_by_the_next_viewer(anymal, wanted, recording, tmp_path):
    assert opened(anymal, tmp_path).read(wanted) is None
    opened(anymal, tmp_path).write(wanted, recording)
    found = opened(anymal, tmp_path).read(wanted)
    np.testing.assert_array_equal(found.base_position, recording.base_position)
    for other in (
        dataclasses.replace(wanted, elite=5),
        dataclasses.replace(wanted, replicas=1),
        dataclasses.replace(wanted, genes=-wanted.genes),
        dataclasses.replace(wanted, policy=__file__),
    ):
        assert opened(anymal, tmp_path).read(other) is None


@pytest.mark.parametrize("damage", [b"", b"no npz", "cut", "flip"])
def test_a_damaged_file_is_as_good_as_none_and_written_again(anymal, wanted, recording, tmp_path, damage):
    crossings = opened(anymal, tmp_path)
    crossings.write(wanted, recording)
    file = crossings.cache_file(wanted)
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
    again.write(wanted, recording)
    assert opened(anymal, tmp_path).read(wanted) is not None


def test_a_recording_under_another_name_is_not_taken_for_it(anymal, wanted, recording, tmp_path):
    crossings = opened(anymal, tmp_path)
    for strange in (
        dataclasses.replace(recording, genes=-recording.genes),
        dataclasses.replace(recording, seeds=recording.seeds + np.uint32(1)),
        dataclasses.replace(recording, robot="cassie"),
        dataclasses.replace(recording, origin={"policy_sha256": "another"}),
    ):
        write_recording(crossings.cache_file(wanted), strange)
        assert opened(anymal, tmp_path).read(wanted) is None


def test_published_recordings_are_found_with_any_code(anymal, wanted, recording, tmp_path):
    crossings = opened(anymal, tmp_path)
    assert crossings.published_file(wanted) != crossings.cache_file(wanted)
    crossings.published_file(wanted).parent.mkdir()
    write_recording(crossings.published_file(wanted), recording)
    assert crossings.read(wanted) is not None
    assert Crossings(anymal, cache=tmp_path / "cache").read(wanted) is None


def test_of_code_without_a_file_only_the_last_recording_is_known(anymal, wanted, recording, tmp_path):
    wanted = dataclasses.replace(wanted, policy="builtins:abs")
    crossings = opened(anymal, tmp_path)
    crossings.write(wanted, recording)
    assert crossings.read(wanted) is recording
    assert opened(anymal, tmp_path).read(wanted) is None
    assert not list((tmp_path / "cache").iterdir())


def test_a_cache_that_cannot_be_written_to_is_named(anymal, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"cannot write to .*file"):
        Crossings(anymal, cache=tmp_path / "file" / "cache")


def test_the_published_recording_is_that_of_the_published_archive(anymal, tmp_path):
    from qd.archive import read_archive
    from qd.run.directory import RESULTS

    archive = read_archive(RESULTS.resolve() / "anymal" / "archive")
    crossings = Crossings(anymal, cache=tmp_path, published=RESULTS.resolve() / "anymal" / "view")
    policy = str(anymal.policy_file)
    found = crossings.read(Wanted(elite=0, controller="", policy=policy, replicas=20, genes=archive.genes[:1]))
    assert found is not None and found.num_episodes == 20
