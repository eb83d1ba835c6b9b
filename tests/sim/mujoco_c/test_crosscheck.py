"""Comparing two simulators: intervals by hand, agreement of known rates, and what the command refuses."""

import json

import numpy as np
import pytest

from kernels.episode import Outcome
from sim.commands import Crosscheck
from sim.files.command import run_command
from sim.mujoco_c.crosscheck import Comparison, Pair, summarise
from sim.space import SUPER_GAUSSIAN


def outcomes(goal, collision, time_out, invalid=0):
    kinds = (Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.INVALID)
    return np.repeat(np.uint8(kinds), (goal, collision, time_out, invalid))


def test_rates_and_bias_by_hand():
    pairs = [
        # 15 of 20 succeed and 10 arrive; 150 of 200, 100 of 200: no difference.
        Pair(index=3, first=0.7, ours=outcomes(10, 5, 5), plain=outcomes(100, 50, 50)),
        # 4 of 20 (two more are invalid) against 180 of 200: far outside.
        Pair(index=3, first=0.4, ours=outcomes(4, 16, 0, invalid=2), plain=outcomes(180, 20, 0)),
    ]
    report = summarise(pairs, seed=0)
    assert report["success"]["inside"] == report["goal"]["inside"] == 1
    assert [row["success"]["inside"] for row in report["terrains"]] == [True, False]
    np.testing.assert_allclose(report["success"]["ours"], (0.75 + 0.2) / 2)
    np.testing.assert_allclose(report["success"]["mujoco_c"], (0.75 + 0.9) / 2)
    np.testing.assert_allclose(report["success"]["bias"], 0.35)
    np.testing.assert_allclose(report["goal"]["bias"], 0.35)
    np.testing.assert_allclose(report["success"]["bias_interval"], [0.0, 0.7], atol=1e-9)
    assert report["invalid"] == {"ours": 2, "mujoco_c": 0}
    json.dumps(report, allow_nan=False)


def test_a_terrain_without_valid_episodes_is_left_out_and_named():
    lost = Pair(index=7, first=0.5, ours=outcomes(0, 0, 0, invalid=3), plain=outcomes(1, 1, 1))
    with pytest.raises(ValueError, match="no terrain has a valid episode"):
        summarise([lost], seed=0)
    fine = Pair(index=3, first=0.5, ours=outcomes(1, 1, 0), plain=outcomes(1, 1, 0))
    report = summarise([lost, fine], seed=0)
    assert report["left_out"] == [7] and len(report["terrains"]) == 1 and report["invalid"]["ours"] == 3


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["--terrains", "0", "--episodes", "0"], "terrains must be at least 1, got 0; episodes must"),
        (["--between", "0.9", "0.3"], "between must rise"),
        (["--between", "0", "1.5"], "between must be at least 0 and at most 1"),
        (["--workers", "-1", "--seed", "-1"], "workers must be at least 1, got -1; seed must"),
    ],
)
def test_numbers_without_sense_are_refused(flags, reason, capsys):
    assert run_command(Crosscheck, ["--device", "cpu", *flags], name="crosscheck") == 2
    assert reason in capsys.readouterr().err


@pytest.mark.slow
def test_a_pool_without_middling_terrains_says_how_many_it_has(tmp_path):
    np.savez(tmp_path / "flat.npz", genes=np.zeros((2, 64), np.float32))  # all bumps of height 0
    check = Comparison(Crosscheck(device="cpu", genes=tmp_path / "flat.npz", terrains=1, episodes=1))
    with pytest.raises(ValueError, match="only 0 of 2 terrains"):
        check.choose()


def test_terrains_of_a_pool_can_be_named_whatever_their_rates(tmp_path):
    pool = tmp_path / "pool.npz"
    genes = np.arange(5, dtype=np.float32)[:, None].repeat(64, axis=1)
    np.savez(pool, genes=genes)
    choice = Comparison(Crosscheck(device="cpu", genes=pool, elite="4 1")).choose()
    assert choice.index == [4, 1] and choice.first == [None, None]
    np.testing.assert_array_equal(choice.genes, genes[[4, 1]])
    with pytest.raises(ValueError, match=r"pool\.npz has no elite 5: expected all, or numbers of 0 to 4"):
        Comparison(Crosscheck(device="cpu", genes=pool, elite="5"))
    with pytest.raises(ValueError, match="give the pool"):
        Comparison(Crosscheck(device="cpu", elite="all"))


@pytest.mark.slow
def test_named_terrains_are_crossed_in_both_simulators(tmp_path):
    genes = np.zeros((3, 64), np.float32)  # flat, but for the last
    genes[2] = SUPER_GAUSSIAN.hard_random(1, np.random.default_rng(3))[0]
    np.savez(tmp_path / "pool.npz", genes=genes)
    counts = {"episodes": 1, "plain_episodes": 1, "workers": 1}
    report = Comparison(Crosscheck(device="cpu", genes=tmp_path / "pool.npz", elite="2 0", **counts)).run()
    assert [row["index"] for row in report["terrains"]] == [2, 0] and report["left_out"] == []
    assert [row["episodes"] for row in report["terrains"]] == [[1, 1], [1, 1]]
    flat = report["terrains"][1]
    assert flat["first_success"] is None and flat["goal"]["ours"] == flat["goal"]["mujoco_c"] == 1.0


def test_the_command_refuses_in_one_line(tmp_path, capsys):
    missing = tmp_path / "none.npz"
    assert run_command(Crosscheck, ["--device", "cpu", "--genes", str(missing)], name="crosscheck") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: --genes") and "none.npz" in error and error.count("\n") == 1
