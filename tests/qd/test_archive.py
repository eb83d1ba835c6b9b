import dataclasses

import numpy as np
import pytest

from qd.archive import Archive, read_archive, write_archive


def small_archive(num_elites: int = 3) -> Archive:
    rng = np.random.default_rng(num_elites)
    columns = rng.random((num_elites, 2))
    rows = rng.random(num_elites)
    return Archive(
        robot="anymal",
        penalties=("yaw_rate", "vel_x"),
        scales=(0.5, 2.0),
        intervals=10,
        collision_bit=False,
        iterations=7,
        genes=rng.uniform(-1, 1, (num_elites, 64)).astype(np.float32),
        ratios=columns,
        cell=np.arange(num_elites),
        fitness=np.sort(rows)[::-1] - 1.0,
        penalty_mean=columns,
        penalty_std=columns,
        collision_rate=rows,
        goal_rate=rows,
        fallen_rate=rows,
        invalid_episodes=np.zeros(num_elites, int),
        episodes=np.full(num_elites, 4),
        iteration=np.arange(num_elites) + 1,
    )


@pytest.mark.parametrize("num_elites", [0, 3])
def test_round_trip(tmp_path, num_elites):
    archive = small_archive(num_elites)
    write_archive(tmp_path / "archive.npz", archive)
    for path in (tmp_path, tmp_path / "archive.npz", str(tmp_path)):
        back = read_archive(path)
        for field in dataclasses.fields(Archive):
            assert np.array_equal(getattr(back, field.name), getattr(archive, field.name)), field.name
    assert (back.robot, back.penalties, back.intervals, back.collision_bit) == (
        "anymal",
        ("yaw_rate", "vel_x"),
        10,
        False,
    )


def test_equal_archives_are_equal_bytes(tmp_path):
    write_archive(tmp_path / "a.npz", small_archive())
    write_archive(tmp_path / "b.npz", small_archive())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_scores_by_hand():
    archive = dataclasses.replace(small_archive(), fitness=np.array([5.0, 1.0, -3.0]))
    assert archive.qd_score == 25.0 + 21.0 + 17.0
    assert archive.mean_fitness == 1.0
    assert archive.reachable_coverage == 3 / 10  # two ratios have 10 reachable cells


def test_an_empty_archive_has_scores_too():
    archive = small_archive(0)
    assert (archive.qd_score, archive.mean_fitness, archive.reachable_coverage) == (0.0, 0.0, 0.0)


def test_missing_archive(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no archive at .*archive\.npz: give a run directory"):
        read_archive(tmp_path)


def test_damage_is_reported_not_raised_raw(tmp_path):
    file = tmp_path / "archive.npz"
    write_archive(file, small_archive(50))
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    for size in rng.integers(0, len(whole), 30):
        file.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="damaged or another file"):
            read_archive(file)
    for foreign in (b"", b"hello", b"PK\x03\x04", np.zeros(3).tobytes()):
        file.write_bytes(foreign)
        with pytest.raises(ValueError, match="damaged or another file"):
            read_archive(file)


def test_flipped_bytes_never_raise_anything_but_a_value_error(tmp_path):
    file = tmp_path / "archive.npz"
    write_archive(file, small_archive(5))
    whole = file.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for position in rng.integers(0, len(whole), 200):
        file.write_bytes(whole[:position] + bytes([whole[position] ^ 0xFF]) + whole[position + 1 :])
        try:
            read_archive(file)
        except ValueError:
            refused += 1
    assert refused > 100  # the rest hit fields of the zip format that nobody reads


def test_another_npz_is_refused(tmp_path):
    np.savez(tmp_path / "archive.npz", genes=np.zeros((3, 64)))
    with pytest.raises(ValueError, match="damaged or another file"):
        read_archive(tmp_path)
    write_archive(tmp_path / "archive.npz", dataclasses.replace(small_archive(), genes=np.zeros((3, 32), np.float32)))
    with pytest.raises(ValueError, match=r"genes must have shape \(3, 64\), got \(3, 32\)"):
        read_archive(tmp_path)
    np.savez(tmp_path / "archive.npz", allow_pickle=True, genes=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="damaged or another file"):
        read_archive(tmp_path)
