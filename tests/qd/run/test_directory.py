import itertools
import os

import pytest

from qd.run.directory import RunDirectory, claimed, numbered


def test_numbered_directories(tmp_path):
    assert [path.name for path in itertools.islice(numbered(tmp_path, "a"), 3)] == ["a", "a-2", "a-3"]


def test_a_claimed_directory_that_stays_empty_goes_away(tmp_path):
    with claimed(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
    assert not (tmp_path / "a" / "b").exists()
    (tmp_path / "mine").mkdir()
    with claimed(tmp_path / "mine"):
        pass
    assert (tmp_path / "mine").exists()


def test_a_claim_ends_with_its_context(tmp_path):
    with claimed(tmp_path), pytest.raises(ValueError, match="another command works in"), claimed(tmp_path):
        pass
    with claimed(tmp_path):
        pass


@pytest.mark.parametrize("name", ["a\nb", "a\tb", os.fsdecode(b"\xff"), "\x1b[31m"])
def test_a_name_that_no_command_can_take_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="must have a name of printable characters"), claimed(tmp_path / name):
        pass
    assert not any(tmp_path.iterdir())


def test_a_name_that_is_too_long_is_refused(tmp_path):
    with pytest.raises(ValueError, match="cannot be made: File name too long"), claimed(tmp_path / ("a" * 300)):
        pass


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "must be a JSON file"),
        ("[]", "must hold a JSON object, got list"),
        ('{"seed": 1}', "must hold settings, iterations, device and sessions, got seed"),
    ],
)
def test_damaged_config(tmp_path, content, message):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        RunDirectory(tmp_path).read_config()


def test_no_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no run at .*: it has no config\.json"):
        RunDirectory(tmp_path).read_config()
