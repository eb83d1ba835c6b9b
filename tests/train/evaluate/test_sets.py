"""The sets that controllers are evaluated on, and the elites that are held out."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from qd.archive import Archive
from sim.space import SUPER_GAUSSIAN
from tests.train.archives import make_archive
from train.evaluate.sets import (
    SETS,
    far_part,
    generated_set,
    make_sets,
    nearest_distance,
    paper_terrains,
    part_of,
    plain_set,
    set_rng,
    split_elites,
)


def genes_in(archive: Archive, rows: np.ndarray) -> set[bytes]:
    return {genes.tobytes() for genes in archive.genes[rows]}


@pytest.mark.parametrize(
    ("robot", "elites", "train", "test"),
    [
        ("anymal", 1129, 750, 300),  # the paper's
        ("cassie", 930, 750, 180),  # the paper's: none is left over
        ("anymal", 1050, 750, 300),
        ("anymal", 1049, 839, 210),  # one too few: 80 % and 20 %
        ("anymal", 391, 313, 78),
        ("anymal", 5, 4, 1),
    ],
)
def test_sizes_of_the_parts(robot, elites, train, test):
    split = split_elites(make_archive(elites, robot=robot), robot)
    assert (len(split.train), len(split.test)) == (train, test)
    together = np.concatenate([split.train, split.test])
    assert len(np.unique(together)) == train + test and together.min() >= 0 and together.max() < elites


def test_a_split_follows_from_the_elites_and_the_seed_alone():
    archive = make_archive(60)
    first = split_elites(archive, "anymal")
    make_sets(SETS, 3, 0, archive=archive, split=first)  # nor from what was drawn before
    again = split_elites(archive, "anymal")
    np.testing.assert_array_equal(first.test, again.test)
    np.testing.assert_array_equal(first.train, again.train)
    # The same elites in another order, as after evaluating them again: the same ones are held out, in the same order.
    order = np.random.default_rng(0).permutation(60)
    shuffled = archive.rows(order)
    other = split_elites(shuffled, "anymal")
    np.testing.assert_array_equal(order[other.test], first.test)
    np.testing.assert_array_equal(order[other.train], first.train)


def test_another_seed_or_archive_is_another_draw():
    archive = make_archive(60)
    draws = [split_elites(archive, "anymal", seed).test for seed in range(3)]
    draws.append(split_elites(make_archive(60, seed=1), "anymal").test)
    assert all((one != other).any() for one, other in itertools.combinations(draws, 2))
    # Every elite has the same chance: of 200 draws of 12 of 60, each is held out in 40, give or take 4 x 5.7.
    counts = np.zeros(60)
    for seed in range(200):
        counts[split_elites(archive, "anymal", seed).test] += 1
    assert counts.min() > 40 - 4 * 5.7 and counts.max() < 40 + 4 * 5.7


@pytest.mark.parametrize(
    ("archive", "seed", "message"),
    [
        (make_archive(60, robot="cassie"), 0, "must be of robot 'anymal', got one of 'cassie'.*make archive"),
        (make_archive(0), 0, "at least 5 elites, got 0: let its search go on"),
        (make_archive(4), 0, "at least 5 elites, got 4"),
        (make_archive(60), -1, "must not be negative, got -1"),
    ],
)
def test_archives_that_cannot_be_split_are_refused(archive, seed, message):
    with pytest.raises(ValueError, match=message):
        split_elites(archive, "anymal", seed)


def test_sets_have_random_numbers_of_their_own():
    names = ("hand_crafted", "hard_random", "flat", "generated")
    draws = [set_rng(name, seed).integers(2**63) for name in names for seed in range(3)]
    draws += [np.random.default_rng(seed).integers(2**63) for seed in range(3)]
    assert len(set(draws)) == 15


def test_a_set_is_the_same_whenever_it_is_made():
    archive = make_archive(60)
    split = split_elites(archive, "anymal")
    all_at_once = make_sets(SETS, 6, 0, archive=archive, split=split)
    assert tuple(all_at_once) == SETS
    for name in SETS:
        alone = make_sets([name], 6, 0, archive=archive, split=split)[name]
        np.testing.assert_array_equal(alone.terrains, all_at_once[name].terrains)
        np.testing.assert_array_equal(alone.seeds, all_at_once[name].seeds)
        np.testing.assert_array_equal(alone.numbers, all_at_once[name].numbers)
    other = make_sets(SETS, 6, 1, archive=archive, split=split)
    assert (other["hand_crafted"].terrains != all_at_once["hand_crafted"].terrains).any()
    assert (other["hard_random"].terrains != all_at_once["hard_random"].terrains).any()
    np.testing.assert_array_equal(
        other["generated"].terrains, all_at_once["generated"].terrains
    )  # held out all the same
    assert (other["generated"].seeds != all_at_once["generated"].seeds).all()


def test_generated_terrains_are_those_held_out():
    archive = make_archive(60)
    split = split_elites(archive, "anymal")
    few, many = (generated_set(archive, split, count, 0) for count in (5, 300))
    assert (len(few), len(many)) == (5, 12)
    np.testing.assert_array_equal(few.seeds, many.seeds[:5])
    np.testing.assert_array_equal(many.terrains, archive.genes[many.numbers])
    assert not genes_in(archive, many.numbers) & genes_in(archive, split.train)
    assert len(np.unique(many.seeds)) == 12


def test_the_far_third_is_the_farthest():
    training = SUPER_GAUSSIAN.hard_random(4, 0)
    genes = SUPER_GAUSSIAN.hard_random(7, 1)
    genes[2], genes[5] = training[1], training[3]  # trained on: distance 0
    distance = nearest_distance(genes, training)
    np.testing.assert_allclose(distance[[2, 5]], 0.0, atol=1e-6)
    assert (np.delete(distance, [2, 5]) > 0.02).all()
    whole = replace(plain_set("hard_random", 7, 0), name="generated", terrains=genes, numbers=np.arange(100, 107))
    far = far_part(distance)  # a third of seven, rounded up
    assert far.tolist() == sorted(np.argsort(-distance)[:3])
    part = part_of(whole, far, "generated_far")
    assert part.numbers.tolist() == (100 + far).tolist()
    np.testing.assert_array_equal(part.seeds, whole.seeds[far])


def test_distance_is_the_root_mean_square_over_all_nodes(monkeypatch):
    # Maps of 2 x 2 nodes; (0, 0, 0, 0) lies sqrt((1 + 1 + 1 + 1) / 4) = 1 from one and sqrt(.36 / 4) = .3 from another.
    maps = {0: [0, 0, 0, 0], 1: [1, -1, 1, -1], 2: [0, 0.6, 0, 0]}
    monkeypatch.setattr("train.evaluate.sets._heights", lambda genes: np.array([maps[int(row[0])] for row in genes], float))
    training = np.repeat([[1], [2]], 60, axis=0)  # more than are compared at once
    np.testing.assert_allclose(nearest_distance(np.array([[0], [1]]), training), [0.3, 0.0], atol=1e-9)
    np.testing.assert_allclose(nearest_distance(np.array([[0]]), training[:60]), [1.0])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["hand_crafted", "easy"], "sets must be some of hand_crafted, .* got easy"),
        (["flat"], "got flat"),  # of base.json alone
        ([], "got none"),
        (["hard_random", "hard_random"], "named once, got hard_random, hard_random"),
        (["hand_crafted", "generated"], r"generated is made of elites: give the run that found them \(--archive RUN\)"),
    ],
)
def test_sets_that_cannot_be_had_are_refused(names, message):
    with pytest.raises(ValueError, match=message):
        make_sets(names, 6, 0)


def test_the_papers_sizes():
    assert (paper_terrains("anymal"), paper_terrains("cassie"), paper_terrains("mine")) == (300, 180, 300)
