import dataclasses

import numpy as np
import pytest

from qd.search.archive import Archive, FreshValues, goal_rates, read_archive, write_archive
from tests.builders import fresh_values, judged_archive, small_archive


def grouped_archive():
    """Judged elites with families and causes."""
    causes = np.array(["ridge", "", "oblique rise", "drop", ""])
    return dataclasses.replace(judged_archive(), family=np.array([0, 1, 0, 2, 3]), cause=causes)


@pytest.mark.parametrize("archive", [small_archive(0), small_archive(3), grouped_archive()], ids=["0", "3", "judged"])
def test_an_archive_comes_back_whole_and_equal_ones_have_equal_files(tmp_path, archive):
    for name in ("archive.npz", "again.npz"):
        write_archive(tmp_path / name, archive)
    assert (tmp_path / "archive.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    stored = read_archive(tmp_path)
    for field in dataclasses.fields(Archive):
        if field.name != "fresh":
            assert np.array_equal(getattr(stored, field.name), getattr(archive, field.name)), field.name
    assert (stored.fresh is None) == (archive.fresh is None)
    for field in dataclasses.fields(FreshValues) if archive.fresh else ():
        assert np.array_equal(getattr(stored.fresh, field.name), getattr(archive.fresh, field.name)), field.name
    with np.load(tmp_path / "archive.npz") as arrays:
        assert "confirmed" not in arrays or arrays["confirmed"].tolist() == archive.confirmed.tolist()


def test_corrected_elites_are_in_order_of_fresh_fitness_and_the_invalid_last():
    archive = small_archive(4)
    # 11 invalid of 40 are more than a quarter, and -20 is what an invalid terrain has; -30 is worse, but valid
    fresh = dataclasses.replace(
        fresh_values(archive), fitness=np.array([1.0, -20.0, 5.0, -30.0]), invalid_episodes=np.array([0, 11, 10, 0])
    )
    corrected = archive.corrected_by(fresh)
    order = [2, 0, 3, 1]
    assert corrected.cell.tolist() == order
    assert np.array_equal(corrected.genes, archive.genes[order])
    assert corrected.fresh.fitness.tolist() == [5.0, 1.0, -30.0, -20.0]
    assert corrected.fresh.reproduced.tolist() == [True, True, False, False]
    assert corrected.rows(np.array([3, 0])).fresh.fitness.tolist() == [-20.0, 5.0]
    some = grouped_archive().rows(np.array([3, 0]))
    assert (some.family.tolist(), some.cause.tolist()) == ([2, 0], ["drop", "ridge"])


def changed_file(folder, archive, **changes):
    """The file of an archive with other arrays, or without those that are None."""
    write_archive(folder / "archive.npz", archive)
    with np.load(folder / "archive.npz") as stored:
        arrays = {name: changes.get(name, stored[name]) for name in stored}
    np.savez(folder / "archive.npz", **{name: array for name, array in arrays.items() if array is not None})


@pytest.mark.parametrize("name", ["cell", "fresh_reproduced", "certifiers"])
def test_a_file_that_lacks_an_array_is_refused_by_its_name(tmp_path, name):
    with pytest.raises(FileNotFoundError, match=r"archive\.npz"):
        read_archive(tmp_path / "archive.npz")
    changed_file(tmp_path, judged_archive(), **{name: None})
    with pytest.raises(ValueError, match=name):
        read_archive(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("genes", np.zeros((4, 64), np.float32)),
        ("certifier_outcomes", np.zeros((5, 1, 4), int)),
        ("robot", np.array(["anymal"])),
        ("fitness", np.array(list("abcde"))),
        ("fitness", np.full(5, np.nan)),
    ],
)
def test_arrays_of_another_shape_or_kind_are_refused_by_name(tmp_path, name, value):
    changed_file(tmp_path, judged_archive(), **{name: value})
    with pytest.raises(ValueError, match=name):
        read_archive(tmp_path)


def test_confirmed_and_certified_by_hand():
    archive = judged_archive()
    assert archive.failing.tolist() == [True, True, True, True, False]
    # under half with contact resolved; the last does not fail, whatever it does there
    assert archive.confirmed.tolist() == [True, True, False, False, False]
    # one controller reaches the goal in half of both kinds, not one here and the other there
    assert archive.certified.tolist() == [True, False, True, False, False]
    assert archive.certificates[:3].tolist() == [[False, True], [False, False], [True, False]]
    # an invalid elite fails nothing
    fresh = dataclasses.replace(archive.fresh, invalid_episodes=np.array([11, 10, 0, 0, 0]))
    assert dataclasses.replace(archive, fresh=fresh).failing.tolist() == [False, True, True, True, False]


def test_goal_rates_by_hand():
    counts = np.array([[0, 0, 0, 0], [9, 6, 5, 0], [9, 6, 0, 5], [8, 6, 0, 6], [0, 0, 0, 20]])
    # not crossed; 9 of 20; 9 of the 15 valid; 6 of 20 are more than a quarter
    np.testing.assert_array_equal(goal_rates(counts), [np.nan, 0.45, 0.6, np.nan, np.nan])
