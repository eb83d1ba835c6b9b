"""The command minimise on a run of the stand-in: what it writes, what goes on, and what it refuses."""

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.run.minimise import Minimise, minimise_run
from sim.files.command import Interrupted
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from tests.qd.stand_in import make_result

RESULTS = Path(__file__).parents[3] / "results"
OTHER = f"C-G={RESULTS}/anymal/C-G.pt"
NOT_OF_THE_WORK = ("date", "command")


@pytest.fixture
def elites(path):
    """Numbers of two failing elites, as the command line has them."""
    return " ".join(map(str, np.flatnonzero(read_archive(path).failing)[:2]))


def judges(seen=None, stop_after=None):
    """Nobody crosses bump 4 where it is higher than .1 m; C-G crosses everything."""
    rows = [] if seen is None else seen

    @contextmanager
    def opened(cfg):
        def evaluate(genes, seeds, progress=None):
            if stop_after is not None and len(rows) >= stop_after:
                raise KeyboardInterrupt
            rows.extend(seeds.tolist())
            fails = (np.abs(genes[:, 4 * 8 + 7]) > 0.4) & ("C-G" not in cfg.policy)
            fails = np.repeat(fails[:, None], cfg.num_replicas, axis=1)
            return make_result(np.ones((*fails.shape, 6)), base_collision=fails)

        yield evaluate

    return opened


@pytest.fixture
def bump_4(path):
    """Numbers of two elites that fail for bump 4, which is .24 m high."""
    archive = read_archive(path)
    numbers = np.flatnonzero(archive.failing)[:2]
    genes = archive.genes.copy()
    genes[numbers, 4 * 8 : 5 * 8] = (0.0, 0.0, -0.5, 1.0, 1.0, 1.0, 0.0, 0.96)  # in the middle of the way, across it
    write_archive(path / "archive.npz", replace(archive, genes=genes))
    return " ".join(map(str, numbers))


def minimised(path, *, opened=None, **arguments):
    args = Minimise(run=path, device="cpu", workers="1", **arguments)
    return minimise_run(args, open_evaluator=opened or judges())


def written(path):
    content = json.loads((path / "minimal.json").read_text())
    return {name: value for name, value in content.items() if name not in NOT_OF_THE_WORK}


@pytest.mark.parametrize("how", ["greedy", "exhaustive"])
def test_minimal_terrains_from_end_to_end(path, bump_4, how, capsys):
    numbers = minimised(path, elite=bump_4, how=how)
    assert written(path) == {name: value for name, value in numbers.items() if name not in NOT_OF_THE_WORK}
    assert numbers["seed"] == 3 and numbers["robot"] == "anymal" and numbers["space"] == "super_gaussian"
    assert (numbers["minimal"], numbers["bumps_histogram"], numbers["bumps_median"]) == (2, {"1": 2}, 1.0)
    first = numbers["elites"][0]
    assert first["elite"] == int(bump_4.split()[0]) and first["bumps"] == [4]
    assert (first["goal_rate"], first["valid_episodes"], first["without"]) == (0.0, 40, {"4": 1.0})
    assert first["of"] == 8 and first["how"] == how and first["words"][0].startswith("bump of 0.24 m at (8.0, 4.0) m")
    # .96 * .4375 = .42 fails, .96 * .40625 = .39 does not; the highest point moves by .24 m * (1 - .4375).
    assert (first["scale"], first["passing_scale"], first["margin_m"]) == (0.4375, 0.40625, 0.135)
    assert first["height_m"] == 0.24
    # Half widths of .5 m + .25 * 2.5 m = 1.125 m along the way: the bump's half is longer than 1 m.
    assert first["cause"]["bump"] == 4 and first["cause"]["kind"] == "rise" and first["cause"]["height_m"] == 0.24
    assert numbers["causes"] == {"rise": 2} and first["verdict"] == "failing" and first["resolved"] is None
    with np.load(path / "minimal.npz") as content:
        genes = content["genes"]
        assert (genes.shape, str(content["space"])) == ((2, 64), "super_gaussian")
    assert not np.delete(genes[:, 7::8], 4, axis=1).any() and genes[:, 39].tolist() == pytest.approx([0.96] * 2)
    with np.load(path / "minimal.npz") as content:
        assert content["scaled_genes"][:, 39].tolist() == pytest.approx([0.42] * 2)
    assert (path / "minimal.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "1 of 8 parts (4), 0 of 40 (0%, 0 to 9%); cause: rise (part 4)" in said
    assert "heights at 44% still fail, at 41% the robot passes: margin 13.5 cm" in said
    assert "What a failure takes: 1 part in 2; median 1." in said and "Causes: rise 2." in said


def test_stopped_it_goes_on_and_gives_the_same_files(path, bump_4, tmp_path):
    whole = Path(shutil.copytree(path, tmp_path / "whole"))
    every, rest = [], []
    minimised(whole, elite=bump_4, opened=judges(every))
    for stop_after in (9, 40):
        with pytest.raises(Interrupted, match=r"Stopped; what was crossed is kept\. The same command goes on"):
            minimised(path, elite=bump_4, opened=judges(stop_after=stop_after))
        assert (path / "minimal.npz").exists() and written(path)["asked"] == 2
    minimised(path, elite=bump_4, opened=judges(rest))
    assert 0 < len(rest) < len(every)
    assert (path / "minimal.npz").read_bytes() == (whole / "minimal.npz").read_bytes()
    assert written(path) == written(whole)
    minimised(path, elite=bump_4, opened=judges(stop_after=0))  # nothing is left to be crossed


def test_results_of_several_calls_add_up(path, bump_4):
    first, second = bump_4.split()
    minimised(path, elite=second, how="exhaustive")
    numbers = minimised(path, elite=first)
    assert [(one["elite"], one["how"]) for one in numbers["elites"]] == [
        (int(first), "greedy"), (int(second), "exhaustive"),
    ]  # fmt: skip
    again = minimised(path, elite=first, how="exhaustive")
    assert [one["how"] for one in again["elites"]] == ["exhaustive"] * 2


def test_minimal_terrains_are_confirmed_and_certified_like_elites(path, bump_4, capsys):
    seen = []
    minimised(path, elite=bump_4, confirm=True, opened=judges(seen))
    numbers = minimised(path, elite=bump_4, by=(OTHER,), opened=judges(seen))
    assert (numbers["confirmed"], numbers["certified"], numbers["faults"]) == (2, 2, 2)
    first = numbers["elites"][0]
    assert first["verdict"] == "fault" and first["resolved"]["goal_rate"] == 0.0
    (certificate,) = first["certificates"]
    assert certificate["controller"] == "C-G" and certificate["searched"]["goal_rate"] == 1.0
    assert certificate["policy_sha256"] == controller_hash(OTHER.removeprefix("C-G="))
    assert "2 faults: terrains that C-G crosses and this controller does not." in capsys.readouterr().out
    kept = minimised(path, elite=bump_4, confirm=True, by=(OTHER,), opened=judges(stop_after=0))
    assert kept["faults"] == 2
    assert read_archive(path).faults is None  # the elites' own counts are another thing


def test_elites_that_are_left_out_are_the_worst_known(path):
    archive = read_archive(path)
    numbers = minimised(path)
    assert [one["elite"] for one in numbers["elites"]] == np.flatnonzero(archive.failing)[:3].tolist()


def test_what_cannot_be_minimised_is_refused_before_anything_is_crossed(path, made, elites, monkeypatch):
    archive, nobody = read_archive(path), judges(stop_after=0)
    with pytest.raises(ValueError, match=r"must have fresh episodes .*, got none: run `.*reevaluate --robot anymal"):
        minimised(made / "found", opened=nobody)
    fine = int(np.flatnonzero(~archive.failing)[0])
    rate = round(float(archive.fresh.goal_rate[fine]) * 40)
    with pytest.raises(ValueError, match=f"elite {fine} of .* does not fail: {rate} of 40"):
        minimised(path, elite=str(fine), opened=nobody)
    with pytest.raises(ValueError, match="must be minimised with the controller that was searched"):
        minimised(path, elite=elites, policy=OTHER.removeprefix("C-G="), opened=nobody)
    with pytest.raises(ValueError, match="a controller cannot certify itself"):
        minimised(path, by=(f"same={get_robot('anymal').policy_file}",), opened=nobody)
    monkeypatch.setattr("sim.spaces.super_gaussian.SuperGaussian.parts", lambda self, genes: ())
    with pytest.raises(ValueError, match=r"have no parts that can be taken away, .*: give the space parts\(genes\)"):
        minimised(path, elite=elites, opened=nobody)
    assert not (path / "minimal.json").exists()


def test_more_parts_than_subsets_can_be_crossed_of(path, elites, monkeypatch):
    monkeypatch.setattr("qd.run.minimise.MOST_PARTS", 7)
    with pytest.raises(ValueError, match=r"must have at most 7 parts .*, got 8: give --how greedy"):
        minimised(path, elite=elites, how="exhaustive", opened=judges(stop_after=0))


def test_a_damaged_file_is_refused_and_says_what_to_do(path, elites):
    (path / "minimal.npz").write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=r"minimal\.npz must be minimal terrains, .*: move it away"):
        minimised(path, elite=elites, opened=judges(stop_after=0))


def test_a_space_without_scales_has_no_margin(path, bump_4, monkeypatch):
    monkeypatch.setattr("sim.spaces.super_gaussian.SuperGaussian.scaled", lambda self, genes, scale: None)
    (first, _) = minimised(path, elite=bump_4)["elites"]
    assert (first["bumps"], first["scale"], first["margin_m"], first["scales"]) == ([4], None, None, [])


def test_counts_of_terrains_that_are_gone_do_not_stop_it(path, bump_4):
    first, second = bump_4.split()
    minimised(path, elite=first, by=(OTHER,))
    archive = read_archive(path)
    assert archive.fresh is not None
    rates = archive.fresh.goal_rate.copy()
    rates[int(first)] = 1.0  # by new fresh episodes it does not fail
    write_archive(path / "archive.npz", replace(archive, fresh=replace(archive.fresh, goal_rate=rates)))
    with pytest.raises(Interrupted):
        minimised(path, elite=second, opened=judges(stop_after=20))
    numbers = minimised(path, elite=second, by=(OTHER,))
    assert (numbers["minimal"], numbers["certified"], numbers["panel"]) == (1, 1, ["C-G"])
