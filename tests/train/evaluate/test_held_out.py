"""No controller is evaluated on elites that it was trained on without anybody noticing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qd.archive import write_archive
from tests.train.archives import make_archive
from tests.train.test_finetune import PPO, write_actor
from train.evaluate.evaluate import Evaluate, evaluate_tables
from train.evaluate.sets import TRAINED_ON, check_held_out, marks_of, recorded_marks, split_elites
from train.finetune import Finetune
from train.tuning import job_of

ARCHIVE = make_archive(20)


def write_trained(folder: Path, genes: np.ndarray) -> Path:
    path = write_actor(folder / "tuned.pt")
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: marks_of(genes)}))
    return path


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
        policy=write_actor(tmp_path / "start.pt"), archive=tmp_path / "archive.npz", device="cpu", ppo=PPO,
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
    later = job_of(replace(cfg, policy=left, archive=tmp_path / "other.npz", run_dir=tmp_path / "later"), 0.0)
    assert later.settings["trained_before"] == sorted(trained)
    assert set(trained) < set(later.trained_on)


def test_a_fine_tuning_records_what_it_and_those_before_it_were_trained_on(tmp_path):
    first, second = make_archive(10, seed=1), make_archive(10, seed=2)
    write_archive(tmp_path / "second.npz", second)
    policy = write_trained(tmp_path, first.genes)
    cfg = replace(
        Finetune.defaults([]),
        policy=policy,
        archive=tmp_path / "second.npz",
        device="cpu",
        run_dir=tmp_path / "run",
        num_envs=12,
        terrains=4,
    )
    expected = {*marks_of(first.genes), *marks_of(second.genes[split_elites(second, "anymal").train])}
    assert job_of(cfg, 0.0).trained_on == sorted(expected)
    assert not expected & set(marks_of(second.genes[split_elites(second, "anymal").test]))
