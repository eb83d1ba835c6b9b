"""Controllers of one kind from several seeds."""

import pytest

from sim.policy.spec import firsts
from train.evaluate.tables import check_seeds, over_seeds

TABLES = {
    "success": {"near": {"base": 0.5, "C-G": 0.8, "C-G@1": 0.9, "C-G@2": 1.0, "C-HC@7": 0.4}},
    "goal": {"near": {"base": 0.5, "C-G": 0.7, "C-G@1": None, "C-G@2": 0.9, "C-HC@7": 0.4}},
}


def test_the_first_of_each_kind():
    assert firsts(TABLES["success"]["near"]) == ["base", "C-G", "C-HC@7"]


def test_mean_and_interval_of_a_kind_with_several():
    found = over_seeds(TABLES, ["success", "goal"])
    assert found["success"]["near"].keys() == {"C-G"}
    kind = found["success"]["near"]["C-G"]
    assert kind["mean"] == pytest.approx(0.9) and kind["values"] == [0.8, 0.9, 1.0]
    # Standard deviation .1, so .1 / sqrt(3) * 4.303 either way; a rate is at most 1.
    assert kind["interval"] == pytest.approx([0.9 - 0.2484, 1.0], abs=1e-4)
    rewards = over_seeds({"reward": {"near": {"C-G": 8.0, "C-G@1": 9.0, "C-G@2": 10.0}}}, ["reward"])
    assert rewards["reward"]["near"]["C-G"]["interval"] == pytest.approx([9.0 - 2.484, 9.0 + 2.484], abs=1e-3)
    assert found["goal"]["near"]["C-G"]["mean"] is None


def test_one_training_is_not_several(tmp_path):
    for name, content in (("a.pt", b"1"), ("b.pt", b"1"), ("c.pt", b"2")):
        (tmp_path / name).write_bytes(content)
    a, b, c = (str(tmp_path / name) for name in ("a.pt", "b.pt", "c.pt"))
    check_seeds({"base": a, "C-G": c, "C-G@1": b})  # of different kinds, the same may stand twice
    with pytest.raises(ValueError, match=r"C-G and C-G@2 must be of one kind from different seeds, got the same"):
        check_seeds({"C-G": a, "C-G@1": c, "C-G@2": b})
    with pytest.raises(ValueError, match=r"C-G@1 and C-G@2 must be"):
        check_seeds({"C-G@1": "no.such:code", "C-G@2": "no.such:code"})


@pytest.mark.parametrize("name", ["@1", "C-G@", "C-G@1@2", "@"])
def test_a_name_is_a_kind_and_at_most_one_seed(name):
    with pytest.raises(ValueError, match=f"a controller is named KIND or KIND@SEED, as C-G@1, got '{name}'"):
        check_seeds({"base": "no.such:code", name: "no.other:code"})


def test_more_than_an_interval_is_known_for():
    row = {f"C-G@{k}": 0.5 for k in range(11)}
    assert over_seeds({"goal": {"near": row}}, ["goal"])["goal"]["near"]["C-G"]["interval"] is None
