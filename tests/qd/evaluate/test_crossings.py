"""Crossings kept on disk: found again by what they depend on, and by nothing else."""

import dataclasses
import os
from contextlib import contextmanager

import numpy as np
import pytest

from qd.evaluate.crossings import KeptCrossings, cross_all, take_terrains
from qd.evaluate.sets import plain_set
from qd.workers.evaluator import EvaluatorCfg
from sim.policy.spec import controller_hash
from tests.train.results import BAD, GOAL, HIT, LATE, result_of

TERRAINS = plain_set("hard_random", 3, 0)
RESULT = result_of([[GOAL, HIT], [LATE, BAD], [GOAL, GOAL]], reward=[[20.0, 2.0], [8.0, 0.0], [21.0, 22.0]], vel_x=0.5)


@pytest.fixture
def policy(tmp_path):
    file = tmp_path / "policy.pt"
    file.write_bytes(b"weights")
    return str(file)


def keeper(tmp_path, **changes):
    values = {"robot": "anymal", "policy": "", "num_terrains": 3, "num_replicas": 2, "device": "cpu"} | changes
    return KeptCrossings(tmp_path / "crossings", EvaluatorCfg(**values))


def same(one, other):
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
    return True


def test_what_is_kept_is_found_again(tmp_path, policy):
    kept = keeper(tmp_path)
    assert kept.read(policy, TERRAINS) is None
    kept.write(policy, TERRAINS, RESULT)
    assert same(keeper(tmp_path).read(policy, TERRAINS), RESULT)
    assert [file.suffix for file in kept.folder.iterdir()] == [".npz"]
    moved = tmp_path / "elsewhere.pt"
    os.rename(policy, moved)
    assert same(kept.read(str(moved), TERRAINS), RESULT)  # the same controller under another name


def test_whatever_changes_the_numbers_is_looked_at(tmp_path, policy, monkeypatch):
    keeper(tmp_path).write(policy, TERRAINS, RESULT)
    others = [
        keeper(tmp_path, robot="cassie"),
        keeper(tmp_path, num_replicas=3),
        keeper(tmp_path, device="cuda:0"),
    ]
    assert all(other.read(policy, TERRAINS) is None for other in others)
    assert same(keeper(tmp_path, device="cpu").read(policy, TERRAINS), RESULT)
    fresh_seeds = dataclasses.replace(TERRAINS, seeds=TERRAINS.seeds + 1)
    other_terrains = dataclasses.replace(TERRAINS, terrains=TERRAINS.terrains * 0.5)
    assert keeper(tmp_path).read(policy, fresh_seeds) is None
    assert keeper(tmp_path).read(policy, other_terrains) is None
    with monkeypatch.context() as patch:
        patch.setattr("qd.workers.kept.code_fingerprint", lambda rooms: "other code")
        assert keeper(tmp_path).read(policy, TERRAINS) is None
    with open(policy, "wb") as file:
        file.write(b"other weights")
    assert keeper(tmp_path).read(policy, TERRAINS) is None


def test_callables_are_told_apart_by_module_and_name():
    one, other = controller_hash("tests.sim.policies:stand"), controller_hash("tests.sim.scenes:stand")
    assert one is not None and one != other
    assert controller_hash("no.such.module:stand") is None
    assert controller_hash("nosuchfile.pt") is None


def test_an_adapter_and_what_it_adapts_are_both_in_the_hash(tmp_path):
    code, file = tmp_path / "mine.py", tmp_path / "model.pt"
    file.write_bytes(b"weights")
    specs = [
        "tests.sim.policies:stand",
        f"tests.sim.policies:stand@{file}",
        f"{code}:adapt@{file}",
        f"{code}:other@{file}",
    ]
    code.write_text("x = 1")
    before = [controller_hash(spec) for spec in specs]
    assert None not in before and len(set(before)) == 4
    file.write_bytes(b"other weights")
    assert [old == controller_hash(spec) for old, spec in zip(before, specs, strict=True)] == [
        True,
        False,
        False,
        False,
    ]


def test_callables_of_one_module_are_kept_apart(tmp_path):
    kept = keeper(tmp_path)
    files = {kept.file(f"tests.sim.policies:{name}", TERRAINS) for name in ("stand", "stretch")}
    assert len(files) == 2


@pytest.mark.parametrize("damage", ["cut", "shape", "nan", "empty"])
def test_a_damaged_file_is_crossed_again(tmp_path, policy, capsys, damage):
    kept = keeper(tmp_path)
    kept.write(policy, TERRAINS, RESULT)
    file = kept.file(policy, TERRAINS)
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:800])
    elif damage == "empty":
        file.write_bytes(b"")
    elif damage == "shape":
        kept.write(policy, TERRAINS, dataclasses.replace(RESULT, reward=RESULT.reward[:2]))
    else:
        kept.write(policy, TERRAINS, dataclasses.replace(RESULT, reward=np.full((3, 2), np.nan)))
    assert kept.read(policy, TERRAINS) is None
    assert f"{file} is damaged" in capsys.readouterr().out


def test_a_flipped_bit_is_noticed_or_changes_nothing(tmp_path, policy):
    kept = keeper(tmp_path)
    kept.write(policy, TERRAINS, RESULT)
    file = kept.file(policy, TERRAINS)
    content, noticed = file.read_bytes(), 0
    for place in range(0, len(content), 11):
        flipped = bytearray(content)
        flipped[place] ^= 0x10
        file.write_bytes(flipped)
        found = kept.read(policy, TERRAINS)
        noticed += found is None
        assert found is None or same(found, RESULT)
    assert noticed > 100


def test_some_terrains_can_be_taken():
    part = take_terrains(RESULT, np.array([2, 0]))
    assert part.outcome.tolist() == [[GOAL, GOAL], [GOAL, HIT]]
    assert part.reward.tolist() == [[21.0, 22.0], [20.0, 2.0]]
    assert part.penalties.shape == (2, 2, 2) and part.penalty_names == RESULT.penalty_names


def test_a_controller_with_two_names_crosses_once(tmp_path, policy, capsys):
    other, crossed = tmp_path / "other.pt", []
    other.write_bytes(b"other weights")

    @contextmanager
    def opened(cfg):
        def evaluate(terrains, seeds, progress=None):
            crossed.append(cfg.policy)
            return RESULT if cfg.policy == policy else take_terrains(RESULT, np.array([2, 1, 0]))

        yield evaluate

    controllers = {"a": policy, "b": str(other), "again": policy}
    cfg = EvaluatorCfg(robot="anymal", policy="", num_terrains=3, num_replicas=2, device="cpu")
    for _ in range(2):
        sets = {"hard_random": TERRAINS}
        row = cross_all(controllers, sets, cfg, tmp_path / "all", open_evaluator=opened)["hard_random"]
        assert list(row) == ["a", "b", "again"] and same(row["a"], RESULT) and same(row["again"], RESULT)
        assert crossed == [policy, str(other)]  # the second time all is kept
    assert "2 of 2 crossings of a set are kept" in capsys.readouterr().out
