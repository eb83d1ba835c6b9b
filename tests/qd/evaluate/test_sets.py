"""The sets that controllers are evaluated on, and the elites that are held out."""

import itertools
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qd.archive import Archive, read_archive, write_archive
from qd.evaluate.distances import Distances, distances
from qd.evaluate.evaluate import Evaluate, evaluate_tables
from qd.evaluate.sets import (
    SETS,
    TRAINED_ON,
    check_held_out,
    far_part,
    generated_set,
    independent_set,
    make_sets,
    marks_of,
    nearest_distance,
    paper_terrains,
    part_of,
    plain_set,
    read_independent,
    recorded_marks,
    set_rng,
    split_elites,
)
from sim.bank import heights_of
from sim.space import SUPER_GAUSSIAN
from sim.spaces.course import COURSE
from tests.train.archives import certified_archive, make_archive
from tests.train.starts import PPO, write_actor, write_trained
from train.finetune import Finetune
from train.tuning import job_of


def genes_in(archive: Archive, rows: np.ndarray) -> set[bytes]:
    return {genes.tobytes() for genes in archive.genes[rows]}


@pytest.mark.parametrize(
    ("robot", "elites", "train", "validation", "test"),
    [
        ("anymal", 1129, 750, 75, 300),  # the paper's; 79 are left over, of which 75 are for validation
        ("cassie", 930, 675, 75, 180),  # none is left over: training has so many fewer
        ("anymal", 1050, 675, 75, 300),
        ("anymal", 1080, 705, 75, 300),  # 30 are left over
        ("anymal", 1049, 755, 84, 210),  # one too few: 80 % and 20 %
        ("anymal", 391, 282, 31, 78),
        ("anymal", 5, 3, 1, 1),
    ],
)
def test_sizes_of_the_parts(robot, elites, train, validation, test):
    split = split_elites(make_archive(elites, robot=robot), robot)
    assert (len(split.train), len(split.validation), len(split.test)) == (train, validation, test)
    together = np.concatenate([split.train, split.validation, split.test])
    assert len(np.unique(together)) == len(together) and together.min() >= 0 and together.max() < elites


def test_the_test_part_is_what_it_was_before_there_was_a_validation_part():
    split = split_elites(make_archive(60), "anymal")
    assert split.test.tolist() == [10, 38, 31, 54, 32, 52, 26, 40, 55, 6, 47, 45]  # as versions without it had it
    assert split.train[:5].tolist() == [59, 48, 1, 16, 50]
    older = split_elites(make_archive(60), "anymal", keep_validation=False)
    np.testing.assert_array_equal(older.test, split.test)
    np.testing.assert_array_equal(older.train, np.concatenate([split.train, split.validation]))
    assert len(older.train) == 48 and not len(older.validation)


def test_a_split_follows_from_the_elites_and_the_seed_alone():
    archive = make_archive(60)
    first = split_elites(archive, "anymal")
    make_sets(SETS[:4], 3, 0, archive=archive, split=first)  # nor from what was drawn before
    again = split_elites(archive, "anymal")
    np.testing.assert_array_equal(first.test, again.test)
    np.testing.assert_array_equal(first.train, again.train)
    np.testing.assert_array_equal(first.validation, again.validation)
    # The same elites in another order, as after evaluating them again: the same ones are held out, in the same order.
    order = np.random.default_rng(0).permutation(60)
    shuffled = archive.rows(order)
    other = split_elites(shuffled, "anymal")
    np.testing.assert_array_equal(order[other.test], first.test)
    np.testing.assert_array_equal(order[other.train], first.train)
    np.testing.assert_array_equal(order[other.validation], first.validation)


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
        (make_archive(60, robot="cassie"), 0, "must be of robot 'anymal', got one of 'cassie'.*archive --robot anymal"),
        (make_archive(0), 0, "at least 5 elites, got 0: let its search go on"),
        (make_archive(4), 0, "at least 5 elites, got 4"),
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


def test_hard_random_terrains_are_of_the_space_that_is_named():
    sets = make_sets(["hand_crafted", "hard_random"], 4, 0, space=COURSE)
    assert sets["hard_random"].terrains.shape == (4, 36) and sets["hard_random"].space == "course"
    usual = make_sets(["hand_crafted", "hard_random"], 4, 0)
    assert usual["hard_random"].terrains.shape == (4, 64) and usual["hard_random"].space == "super_gaussian"
    np.testing.assert_array_equal(sets["hand_crafted"].terrains, usual["hand_crafted"].terrains)


def test_a_set_is_the_same_whenever_it_is_made():
    archive = make_archive(60)
    given = {"archive": archive, "split": split_elites(archive, "anymal"), "independent": make_archive(20, seed=1)}
    all_at_once = make_sets(SETS, 6, 0, **given)
    assert tuple(all_at_once) == SETS
    for name in SETS:
        alone = make_sets([name], 6, 0, **given)[name]
        np.testing.assert_array_equal(alone.terrains, all_at_once[name].terrains)
        np.testing.assert_array_equal(alone.seeds, all_at_once[name].seeds)
        np.testing.assert_array_equal(alone.numbers, all_at_once[name].numbers)
    other = make_sets(SETS, 6, 1, **given)
    for name in ("hand_crafted", "hard_random", "generated_independent"):
        assert (other[name].terrains != all_at_once[name].terrains).any()
    np.testing.assert_array_equal(
        other["generated"].terrains, all_at_once["generated"].terrains
    )  # held out all the same
    assert (other["generated"].seeds != all_at_once["generated"].seeds).all()


def test_validation_sets_have_other_terrains_and_starts():
    archive = make_archive(60)
    split = split_elites(archive, "anymal")
    test, validation = (
        make_sets(SETS[:4], 6, 0, archive=archive, split=split, part=part) for part in ("test", "validation")
    )
    assert validation["generated"].numbers.tolist() == split.validation.tolist()
    assert not genes_in(archive, validation["generated"].numbers) & genes_in(archive, split.train)
    for name in SETS[:4]:
        assert not {one.tobytes() for one in test[name].terrains} & {one.tobytes() for one in validation[name].terrains}
        assert not set(test[name].seeds.tolist()) & set(validation[name].seeds.tolist())
        assert len(validation[name])


def test_independent_terrains_are_drawn_from_all_elites_whatever_their_order():
    other = make_archive(20, seed=1)
    few, all_ = (independent_set(other, count, 0) for count in (6, 300))
    assert sorted(all_.numbers.tolist()) == list(range(20)) and all_.families.shape == (20,)
    np.testing.assert_array_equal(few.numbers, all_.numbers[:6])
    np.testing.assert_array_equal(few.seeds, all_.seeds[:6])
    order = np.random.default_rng(0).permutation(20)
    np.testing.assert_array_equal(independent_set(other.rows(order), 6, 0).terrains, few.terrains)


def write_run(folder: Path, archive: Archive, seed: int | None = None) -> Path:
    """A run with its config, as far as it is read for the seed."""
    folder.mkdir()
    write_archive(folder / "archive.npz", archive)
    if seed is not None:
        settings = {"seed": seed, "robot_sha256": archive.robot_sha256}
        own = {"settings": settings, "iterations": 3, "device": "CPU", "sessions": []}
        (folder / "config.json").write_text(json.dumps(own))
    return folder


def test_an_independent_archive_is_of_another_search(tmp_path, anymal):
    archive = make_archive(20)
    trained = write_run(tmp_path / "trained", archive, seed=0)
    other = write_run(tmp_path / "other", make_archive(20, seed=1), seed=1)

    def read(path):
        return read_independent(anymal, path, archive=archive, archive_path=trained)

    assert len(read(other)) == 20
    assert len(read(other / "archive.npz")) == 20
    assert len(read(write_run(tmp_path / "unknown", make_archive(9, seed=3)))) == 9  # nothing says its seed
    assert len(read_independent(anymal, trained)) == 20  # of nothing that was trained on
    same_seed = write_run(tmp_path / "same-seed", make_archive(20, seed=2), seed=0)
    grown = make_archive(20, seed=4)
    grown.genes[3] = archive.genes[5]
    for path, message in (
        (trained, r"share no elite with --archive .*trained, got .*trained with 20 of its 20 in both"),
        (write_run(tmp_path / "kin", grown, seed=5), r"got .*kin with 1 of its 20 in both: give the run of a search"),
        (same_seed, r"of another search seed than --archive .*, got seed 0 in both .*same-seed and there"),
        (write_run(tmp_path / "cassie", make_archive(9, robot="cassie")), "robot 'anymal', got one of 'cassie'"),
        (write_run(tmp_path / "empty", make_archive(0)), "must be a search that found something, got .*empty"),
        (
            write_run(tmp_path / "course", replace(make_archive(9), space="course", genes=COURSE.hard_random(9, 0))),
            "of the terrain space of --archive .*, super_gaussian, got .*course of course",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            read(path)


def test_elites_carry_the_certificates_of_their_rows():
    archive = certified_archive(30, 20, {"C-G": "a" * 64})
    split = split_elites(archive, "anymal")
    given = generated_set(archive, split, 300, 0).certificates
    np.testing.assert_array_equal(given.certified, split.test < 20)
    assert (given.certifiers, given.searched_sha256) == (("C-G",), "f" * 64)
    part = part_of(generated_set(archive, split, 300, 0), np.array([2, 0]), "generated_far")
    np.testing.assert_array_equal(part.certificates.certified, split.test[[2, 0]] < 20)
    assert generated_set(make_archive(30), split, 300, 0).certificates is None


def test_generated_terrains_are_those_held_out():
    archive = make_archive(60)
    split = split_elites(archive, "anymal")
    few, many = (generated_set(archive, split, count, 0) for count in (5, 300))
    assert (len(few), len(many)) == (5, 12)
    np.testing.assert_array_equal(few.seeds, many.seeds[:5])
    np.testing.assert_array_equal(many.terrains, archive.genes[many.numbers])
    assert not genes_in(archive, many.numbers) & genes_in(archive, split.train)
    assert len(np.unique(many.seeds)) == 12


def test_generated_terrains_have_the_families_of_their_kin():
    archive = make_archive(10)
    genes = archive.genes.copy()
    split = split_elites(archive, "anymal")
    genes[split.test[1]] = genes[split.test[0]]  # the two that are held out are one terrain
    kin = replace(archive, genes=genes)
    assert generated_set(archive, split, 300, 0).families.tolist() == [0, 1]
    assert generated_set(kin, split, 300, 0).families.tolist() == [0, 0]
    assert plain_set("hard_random", 3, 0).families is None


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
    monkeypatch.setattr(
        "qd.evaluate.sets._heights", lambda genes, space: np.array([maps[int(row[0])] for row in genes], float)
    )
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
        (["generated_independent"], r"elites of another search than the one trained on.*\(--independent RUN\)"),
    ],
)
def test_sets_that_cannot_be_had_are_refused(names, message):
    with pytest.raises(ValueError, match=message):
        make_sets(names, 6, 0)


def test_the_papers_sizes():
    assert (paper_terrains("anymal"), paper_terrains("cassie"), paper_terrains("mine")) == (300, 180, 300)


ARCHIVE = make_archive(20)


def test_marks_are_of_the_genes_alone():
    marks = marks_of(ARCHIVE.genes)
    assert len(set(marks)) == 20 and all(len(mark) == 12 for mark in marks)
    assert marks_of(ARCHIVE.genes[::-1].astype(np.float64)) == marks[::-1]


def test_the_records_of_all_files_of_a_controller_are_read(tmp_path):
    path = write_trained(tmp_path, ARCHIVE.genes[:3])
    assert recorded_marks(str(path)) == set(marks_of(ARCHIVE.genes[:3]))
    assert recorded_marks(str(tmp_path / "tuned.onnx")) == set(marks_of(ARCHIVE.genes[:3]))
    assert recorded_marks(f"some.module:adapter@{path}") == set(marks_of(ARCHIVE.genes[:3]))
    assert recorded_marks("some.module:walk") == set() == recorded_marks(str(tmp_path / "other.pt"))
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: 5}))
    with pytest.raises(ValueError, match=r"tuned.train.json is damaged at trained_on"):
        recorded_marks(str(path))


def test_elites_of_the_own_split_are_held_out_and_those_of_another_are_not(tmp_path):
    split, other = split_elites(ARCHIVE, "anymal", 0), split_elites(ARCHIVE, "anymal", 1)
    controllers = {"base": "some.module:walk", "C-G": str(write_trained(tmp_path, ARCHIVE.genes[split.train]))}
    check_held_out(controllers, ARCHIVE.genes[split.test], 0)
    common = np.isin(other.test, split.train).sum()
    assert common > 0
    with pytest.raises(ValueError, match=f"C-G was trained on {common} of the 4 elites that split seed 1 holds out"):
        check_held_out(controllers, ARCHIVE.genes[other.test], 1)


@pytest.mark.parametrize("sets", [("generated",), ("generated_far",), ()])
def test_tables_refuse_a_controller_trained_on_what_they_hold_out(sets, tmp_path):
    write_archive(tmp_path / "archive.npz", ARCHIVE)
    policy = write_trained(tmp_path, ARCHIVE.genes)
    cfg = Evaluate(
        policies=(f"C-G={policy}",), archive=tmp_path / "archive.npz", sets=sets, device="cpu", run_dir=tmp_path / "run"
    )
    with pytest.raises(ValueError, match=r"C-G was trained on . of the . elites"):
        evaluate_tables(cfg, open_evaluator=None)  # pyright: ignore[reportArgumentType] - nothing is crossed


@pytest.mark.parametrize("inside", ["checkpoint", "controller"])
def test_marks_in_the_file_itself_count_where_no_record_lies_beside_it(inside, tmp_path):
    marks = marks_of(ARCHIVE.genes)
    path = write_actor(tmp_path / "checkpoint.pt")
    part = {TRAINED_ON: marks}
    content = torch.load(path, weights_only=True) | ({"extra": part} if inside == "checkpoint" else part)
    torch.save(content, path)
    assert recorded_marks(str(path)) == recorded_marks(f"some.module:adapter@{path}") == set(marks)
    with pytest.raises(ValueError, match=r"C-G was trained on 4 of the 4 elites"):
        check_held_out({"C-G": str(path)}, ARCHIVE.genes[:4], 0)
    (content["extra"] if inside == "checkpoint" else content)[TRAINED_ON] = [5]
    torch.save(content, path)
    with pytest.raises(ValueError, match=r"checkpoint.pt is damaged at trained_on"):
        recorded_marks(str(path))


def test_a_file_of_another_kind_has_no_marks(tmp_path):
    torch.jit.script(torch.nn.Linear(2, 3)).save(tmp_path / "script.pt")
    torch.save([1, 2], tmp_path / "list.pt")
    torch.save({"extra": 5}, tmp_path / "number.pt")
    (tmp_path / "text.pt").write_text("no weights")
    for file in tmp_path.iterdir():
        assert recorded_marks(str(file)) == set()


@pytest.mark.parametrize("name", ["checkpoint.pt", "policy.pt"])
def test_what_a_fine_tuning_leaves_says_what_it_was_trained_on(name, tmp_path):
    write_archive(tmp_path / "archive.npz", ARCHIVE)
    cfg = replace(Finetune.defaults([]),
        policy=write_actor(tmp_path / "start.pt"), archive=(tmp_path / "archive.npz",), device="cpu", ppo=PPO,
        run_dir=tmp_path / "run", num_envs=6, terrains=4, swap_every=2, iterations=1,
    )  # fmt: skip
    assert cfg.execute() == 0
    left = (tmp_path / "run" / name).rename(tmp_path / name)  # away from the record
    trained = marks_of(ARCHIVE.genes[split_elites(ARCHIVE, "anymal").train])
    assert recorded_marks(str(left)) == set(trained)
    tables = Evaluate(
        policies=(f"C-G={left}",), archive=tmp_path / "archive.npz", split_seed=1, device="cpu", run_dir=tmp_path / "t"
    )
    with pytest.raises(ValueError, match=r"C-G was trained on . of the 4 elites that split seed 1 holds out"):
        evaluate_tables(tables, open_evaluator=None)  # pyright: ignore[reportArgumentType] - nothing is crossed
    write_archive(tmp_path / "other.npz", make_archive(10, seed=2))
    later = job_of(replace(cfg, policy=left, archive=(tmp_path / "other.npz",), run_dir=tmp_path / "later"), 0.0)
    assert later.settings["trained_before"] == sorted(trained)
    assert set(trained) < set(later.trained_on)


def test_a_fine_tuning_records_what_it_and_those_before_it_were_trained_on(tmp_path):
    first, second = make_archive(10, seed=1), make_archive(10, seed=2)
    write_archive(tmp_path / "second.npz", second)
    policy = write_trained(tmp_path, first.genes)
    cfg = replace(
        Finetune.defaults([]),
        policy=policy,
        archive=(tmp_path / "second.npz",),
        device="cpu",
        run_dir=tmp_path / "run",
        num_envs=12,
        terrains=4,
    )
    expected = {*marks_of(first.genes), *marks_of(second.genes[split_elites(second, "anymal").train])}
    assert job_of(cfg, 0.0).trained_on == sorted(expected)
    assert not expected & set(marks_of(second.genes[split_elites(second, "anymal").test]))


@pytest.mark.slow
def test_the_nearest_is_found_among_all_elites_trained_on(published):
    run = published / "cassie" / "archive"
    report = distances(Distances(robot="cassie", archive=run, terrains=3))
    archive = read_archive(run)
    split = split_elites(archive, "cassie")
    held, trained = (heights_of(archive.genes[rows]).astype(np.float64) for rows in (split.test[:3], split.train))
    by_hand = [min(np.sqrt(((mine - other) ** 2).mean()) for other in trained) for mine in held]
    found = report["nearest_m"]["generated"]
    assert found["terrains"] == 3 and report["trained_on"] == len(split.train)
    assert found["median"] == pytest.approx(np.median(by_hand), rel=1e-4)
    assert (found["least"], found["largest"]) == pytest.approx((min(by_hand), max(by_hand)), rel=1e-4)
    assert "generated_independent" not in report["nearest_m"]
    far = report["nearest_m"]["generated_far"]
    assert far["terrains"] == 1 and far["median"] == pytest.approx(found["largest"])


def test_elites_of_another_search_have_their_distance_too(tmp_path):
    archive, other = make_archive(20), make_archive(6, seed=1)
    write_archive(tmp_path / "archive.npz", archive)
    write_archive(tmp_path / "other.npz", other)
    report = distances(Distances(archive=tmp_path / "archive.npz", independent=tmp_path / "other.npz", terrains=3))
    train = archive.genes[split_elites(archive, "anymal").train]
    expected = nearest_distance(independent_set(other, 3, 0).terrains, train)
    found = report["nearest_m"]["generated_independent"]
    assert (found["terrains"], found["median"]) == (3, pytest.approx(np.median(expected)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"terrains": 0}, "terrains must be at least 1"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"split_seed": -1}, "split_seed must be at least 0"),
        ({"robot": "anymal"}, "got one of 'cassie'"),
    ],
)
def test_what_makes_no_sense_is_refused(settings, message, published):
    with pytest.raises(ValueError, match=message):
        distances(Distances(**{"robot": "cassie", "archive": published / "cassie" / "archive", **settings}))


def test_the_command_writes_what_it_prints(tmp_path, published):
    def call(*flags):
        command = [sys.executable, "-m", "faultline", "distances", *flags]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    assert "--split-seed" in call("--help").stdout
    done = call(
        "--robot", "cassie", "--archive", str(published / "cassie" / "archive"), "--terrains", "2",
        "--out", str(tmp_path / "distances.json"),
    )  # fmt: skip
    assert done.returncode == 0 and "generated_far" in done.stdout
    assert json.loads((tmp_path / "distances.json").read_bytes())["nearest_m"]["generated"]["terrains"] == 2
    refused = call("--robot", "cassie", "--archive", str(tmp_path))
    assert refused.returncode == 2 and "no archive at" in refused.stderr and "Traceback" not in refused.stderr
