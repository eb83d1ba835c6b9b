"""The sets that controllers are evaluated on, and the elites that are held out."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from qd.evaluate.labels import SETS
from qd.evaluate.sets import (
    TRAINED_ON,
    generated_set,
    hash_elites,
    make_sets,
    nearest_distance,
    random_elites,
    read_independent,
    read_trained_on,
    set_rng,
    split_elites,
)
from qd.search.settings import as_settings
from sim.terrains.bank import make_heights
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import judged_archive, make_archive, write_run
from tests.qd.searches import CFG
from tests.train.conftest import write_actor, write_trained

PARTS = ("test", "validation")
GENES = make_archive(20).genes


@pytest.mark.parametrize(
    ("robot", "elites", "train", "validation", "test"),
    [
        ("anymal", 1129, 750, 75, 300),  # the paper's; 79 are left over, of which 75 are for validation
        ("cassie", 930, 675, 75, 180),  # none is left over: training has so many fewer
        ("anymal", 1049, 755, 84, 210),  # one too few: 80 % and 20 %
        ("anymal", 5, 3, 1, 1),
    ],
)
def test_sizes_of_the_parts(robot, elites, train, validation, test):
    split = split_elites(make_archive(elites, robot=robot))
    assert (len(split.train), len(split.validation), len(split.test)) == (train, validation, test)
    together = np.concatenate([split.train, split.validation, split.test])
    assert len(np.unique(together)) == len(together) and together.min() >= 0 and together.max() < elites


def test_a_split_follows_from_the_elites_alone():
    archive = make_archive(60)
    split = split_elites(archive)
    assert split.test.tolist() == [10, 38, 31, 54, 32, 52, 26, 40, 55, 6, 47, 45]  # whatever machine, today and later
    assert split.train[:5].tolist() == [59, 48, 1, 16, 50]
    # The same elites in another order, as after judging them again: the same ones are held out, in the same order.
    order = np.random.default_rng(0).permutation(60)
    shuffled = split_elites(archive.rows(order))
    for part in ("train", "validation", "test"):
        np.testing.assert_array_equal(order[getattr(shuffled, part)], getattr(split, part))
    with pytest.raises(ValueError, match="got 4"):
        split_elites(make_archive(4))


def test_sets_have_random_numbers_of_their_own():
    names = ("hand_crafted", "hard_random", "flat", "generated", "generated_independent", "pack", "dose")
    draws = [set_rng(name, seed, part).integers(2**63) for name in names for seed in (0, 1) for part in PARTS]
    draws += [np.random.default_rng(seed).integers(2**63) for seed in range(3)]
    assert len(set(draws)) == 31


def test_sets_are_what_they_were():
    hand_crafted, hard_random = make_sets(["hand_crafted", "hard_random"], 3, 0).values()
    assert hand_crafted.terrains.seeds.tolist() == [1984838927, 1048230665, 2803271684]
    assert hard_random.terrains.seeds.tolist() == [2055184588, 2981959608, 3748095775]
    assert hard_random.terrains.values[0, :4].tolist() == pytest.approx([0.2931203, 0.7102386, 0.6253537, -0.7938088])
    archive = make_archive(60)
    generated = generated_set(archive, 2, 0)
    assert generated.numbers.tolist() == [10, 38] and generated.terrains.seeds.tolist() == [1519996775, 4170185451]
    independent = random_elites("generated_independent", archive, 2, 0)
    assert independent.numbers.tolist() == [48, 42] and independent.terrains.seeds.tolist() == [2023635066, 1145927465]


def test_a_set_is_the_same_whenever_it_is_made():
    given = {"archive": make_archive(20), "independent": make_archive(20, seed=1)}
    all_at_once, other = make_sets((), 4, 0, **given), make_sets((), 4, 1, **given)
    assert list(all_at_once) == list(SETS)
    for name in SETS:
        alone = make_sets([name], 4, 0, **given)[name]
        terrains, others = all_at_once[name].terrains, other[name].terrains
        assert alone.terrains.digests() == terrains.digests()
        np.testing.assert_array_equal(alone.numbers, all_at_once[name].numbers)
        assert (others.seeds != terrains.seeds).all()
        # Which elites are held out does not depend on the seed of the sets.
        held_out = name in ("generated", "generated_far")
        assert np.array_equal(others.values, terrains.values) == held_out
    for names, field in ((["easy"], "easy"), (["flat"], "flat"), (["generated"], "generated")):  # flat: of base.json
        with pytest.raises(ValueError, match=field):
            make_sets(names, 6, 0)


def test_generated_terrains_are_those_held_out_with_the_families_of_their_kin():
    archive = make_archive(10)
    many = generated_set(archive, 300, 0)
    assert many.numbers.tolist() == split_elites(archive).test.tolist() and many.families.tolist() == [0, 1]
    np.testing.assert_array_equal(many.terrains.genes, archive.genes[many.numbers])
    alike = replace(archive, genes=np.repeat(archive.genes[:2], 5, axis=0))
    assert np.unique(random_elites("elites", alike, 9, 0).families).tolist() == [0, 1]
    # Elites that somebody was trained on are left out.
    left = random_elites("elites", archive, 9, 0, {*hash_elites(archive.genes[:7])})
    assert sorted(left.numbers) == [7, 8, 9]


def test_elites_carry_the_certificates_of_their_rows():
    archive = judged_archive().rows(np.array([2, 2, 3, 3] * 6))
    generated = generated_set(archive, 300, 0)
    certified = archive.certified[generated.numbers]
    assert generated.certified.tolist() == certified.tolist() and len(set(certified)) == 2
    np.testing.assert_array_equal(generated.rows(np.array([1, 3])).certified, certified[[1, 3]])
    assert generated_set(make_archive(30), 300, 0).certified is None


def test_the_far_third_is_the_farthest():
    training = SUPER_GAUSSIAN.hard_random(60, 0)  # more than are compared at once
    genes = SUPER_GAUSSIAN.hard_random(4, 1)
    genes[2] = training[58]  # trained on: distance 0
    distance = nearest_distance(genes, training)
    maps, others = (make_heights(some, SUPER_GAUSSIAN).astype(np.float64) for some in (genes, training))
    by_hand = [min(np.sqrt(((terrain - other) ** 2).mean()) for other in others) for terrain in maps]
    np.testing.assert_allclose(distance, by_hand, atol=1e-6)
    # Of seven that are held out, the farthest three, with the same episodes.
    archive = make_archive(35)
    sets = make_sets(("generated", "generated_far"), 300, 0, archive=archive)
    whole, far = sets.values()
    chosen = np.sort(
        np.argsort(nearest_distance(whole.terrains.genes, archive.genes[split_elites(archive).train]))[-3:]
    )
    assert far.numbers.tolist() == whole.numbers[chosen].tolist()
    assert far.terrains.digests() == whole.terrains[chosen].digests()


def test_an_independent_archive_is_of_another_search(tmp_path, anymal):
    archive, kin, first = make_archive(20), make_archive(20, seed=4), as_settings(replace(CFG, seed=0))
    kin.genes[3] = archive.genes[5]
    trained = write_run(tmp_path / "trained", archive, first)
    other = write_run(tmp_path / "other", make_archive(20, seed=1), as_settings(CFG))
    for path, archive_path in ((other, trained), (other / "archive.npz", trained), (trained, None)):
        assert len(read_independent(path, archive_path, anymal)) == 20
    course = replace(make_archive(9), space="course", genes=COURSE.hard_random(9, 0))
    for path, field in (
        (write_run(tmp_path / "kin", kin, as_settings(CFG)), "1 elites in both"),
        (write_run(tmp_path / "same-seed", make_archive(20, seed=2), first), "seed 0"),
        (write_run(tmp_path / "cassie", make_archive(9, robot="cassie")), "cassie"),
        (write_run(tmp_path / "empty", make_archive(0)), "empty"),
        (write_run(tmp_path / "course", course), "course"),
    ):
        with pytest.raises(ValueError, match=field):
            read_independent(path, trained, anymal)


def test_the_records_of_all_files_of_a_controller_are_read(tmp_path):
    path = write_trained(tmp_path, GENES[:3])
    marks = hash_elites(GENES[:3])
    assert len(set(marks)) == 3 and hash_elites(GENES[2::-1].astype(np.float64)) == marks[::-1]
    for policy in (str(path), str(tmp_path / "tuned.onnx"), f"some.module:adapter@{path}"):
        assert read_trained_on(policy) == set(marks)
    assert read_trained_on("some.module:walk") == set() == read_trained_on(str(tmp_path / "other.pt"))
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: 5}))
    with pytest.raises(ValueError, match=TRAINED_ON):
        read_trained_on(str(path))


def test_marks_in_the_file_itself_count_where_no_record_lies_beside_it(tmp_path):
    path = write_actor(tmp_path / "policy.pt")
    torch.save(torch.load(path, weights_only=True) | {TRAINED_ON: hash_elites(GENES)}, path)
    assert read_trained_on(str(path)) == read_trained_on(f"some.module:adapter@{path}") == set(hash_elites(GENES))
