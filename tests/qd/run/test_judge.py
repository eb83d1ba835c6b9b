"""Confirm and certify on a run of the stand-in: what they write, what goes on, and what they refuse."""

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.run.judge import Certify, Confirm, certify_run, confirm_run
from qd.show import figures
from qd.show.evidence import evidence_file, read_evidence
from qd.show.replay import ReplayElite, describe, replay
from sim.files.command import Interrupted
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from tests.qd.recordings import stand_in_cross
from tests.qd.stand_in import make_result

RESULTS = Path(__file__).parents[3] / "results"
OTHER = f"C-G={RESULTS}/anymal/C-G.pt"


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    monkeypatch.setattr(figures, "write_figures", lambda folder, archive, metrics: [])


def crosses(policy, resolved, genes):
    """Whether all robots arrive: a gene decides, another one for each controller and setting."""
    gene, above = {
        ("searched", False): (9, 2.0),
        ("searched", True): (9, 0.3),
        ("C-G", False): (10, -0.2),
        ("C-G", True): (11, -0.4),
    }[("C-G" if "C-G" in policy else "searched", resolved)]
    return genes[:, gene] > above


def judges(seeds=None, stop_after=None):
    """Crosses terrains so, noting the seeds; Ctrl-C after so many terrains."""
    seen = [] if seeds is None else seeds

    @contextmanager
    def opened(cfg):
        def evaluate(genes, terrain_seeds, progress=None):
            if stop_after is not None and len(seen) >= stop_after:
                raise KeyboardInterrupt
            seen.extend(terrain_seeds.tolist())
            arrived = np.repeat(crosses(cfg.policy, cfg.resolved, genes)[:, None], cfg.num_replicas, axis=1)
            return make_result(np.ones((*arrived.shape, 6)), base_collision=~arrived)

        yield evaluate

    return opened


def confirmed(path, *, opened=None, **arguments):
    return confirm_run(Confirm(run=path, device="cpu", workers="1", **arguments), open_evaluator=opened or judges())


def certified(path, *, opened=None, by=(OTHER,), **arguments):
    args = Certify(run=path, device="cpu", workers="1", by=by, **arguments)
    return certify_run(args, open_evaluator=opened or judges(), cross=stand_in_cross([]))


def numbers_in(path):
    return json.loads((path / "archive.json").read_text())


def test_a_run_is_confirmed_and_certified_from_end_to_end(path, capsys):
    before = read_archive(path)
    failing = before.failing
    seeds = []
    confirmed(path, opened=judges(seeds))
    archive = certified(path, opened=judges(seeds))
    again = ~crosses("searched", True, archive.genes)
    other = crosses("C-G", False, archive.genes) & crosses("C-G", True, archive.genes)
    assert archive.confirmed.tolist() == (failing & again).tolist()
    assert archive.certified.tolist() == (failing & other).tolist()
    faults = int((failing & again & other).sum())
    assert 0 < faults < (failing & again).sum() < failing.sum() < len(archive)
    numbers, there = numbers_in(path), read_archive(path)
    assert (numbers["failing"], numbers["confirmed"]) == (failing.sum(), (failing & again).sum())
    assert (numbers["certified"], numbers["faults"]) == ((failing & other).sum(), faults)
    assert numbers["panel"] == ["C-G"]
    assert numbers["elites"] == len(before) and numbers["reproduced_by"]["seed"] == 3
    assert numbers["confirmed_by"]["seed"] == numbers["certified_by"]["C-G"]["seed"] == 3
    assert numbers["certified_by"]["C-G"]["policy_sha256"] == controller_hash(OTHER.removeprefix("C-G="))
    assert there.confirmed.tolist() == archive.confirmed.tolist()
    assert there.certified.tolist() == archive.certified.tolist()
    assert len(set(seeds)) == len(seeds)
    said = capsys.readouterr().out
    assert f"{faults} faults: terrains that C-G crosses and this controller does not." in said
    assert "not known to be passable" in said and "impassable" not in said


def test_stopped_it_keeps_what_was_crossed_and_the_same_command_goes_on(path, made, tmp_path):
    with pytest.raises(Interrupted, match=r"Stopped; what was crossed is kept\. The same command goes on"):
        confirmed(path, opened=judges(stop_after=2))
    assert read_archive(path).faults.resolved_outcomes.any(axis=1).sum() == 2
    assert numbers_in(path)["crossed_resolved"] == 2
    rest = []
    confirmed(path, opened=judges(rest))
    assert len(rest) == read_archive(path).failing.sum() - 2
    whole = Path(shutil.copytree(made / "fresh", tmp_path / "whole"))
    confirmed(whole)
    assert (whole / "archive.npz").read_bytes() == (path / "archive.npz").read_bytes()
    confirmed(path, opened=judges(stop_after=0))  # nothing is left to be crossed


def test_some_elites_alone(path):
    archive = read_archive(path)
    number = int(np.flatnonzero(archive.failing)[1])
    judged = confirmed(path, elite=str(number))
    assert np.flatnonzero(judged.faults.resolved_outcomes.any(axis=1)).tolist() == [number]


def test_certificates_are_recorded_once_and_replayed(path, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    confirmed(path)
    archive = certified(path, record=True)
    number = int(np.flatnonzero(archive.certified)[0])
    file = evidence_file(path, archive, number, "C-G")
    assert len(list((path / "recordings").iterdir())) == archive.certified.sum()
    kept = read_evidence(path, archive, number, "C-G")
    assert kept.num_episodes == 1 and kept.result().reached_goal.all()
    before = file.stat().st_mtime_ns
    certified(path, record=True)
    assert file.stat().st_mtime_ns == before
    done = replay(ReplayElite(run=path, elite=str(number), certificate="C-G"))
    assert done.out == path / f"elite-{number}-C-G.png"
    text = describe(done)
    assert "C-G.pt" in text and "a terrain that C-G crosses and this controller does not." in text
    uncertified = str(int(np.flatnonzero(~archive.certified)[0]))
    with pytest.raises(
        FileNotFoundError, match=f"no crossing of elite {uncertified} by C-G is kept at .*certify --record"
    ):
        replay(ReplayElite(run=path, elite=uncertified, certificate="C-G"))
    file.write_bytes(evidence_file(path, archive, int(np.flatnonzero(archive.certified)[1]), "C-G").read_bytes())
    with pytest.raises(ValueError, match=f"must be of elite {number}, got another terrain"):
        replay(ReplayElite(run=path, elite=str(number), certificate="C-G"))


def test_what_cannot_be_judged_is_refused_before_anything_is_crossed(path, made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    archive, nobody = read_archive(path), judges(stop_after=0)
    with pytest.raises(ValueError, match=r"must have fresh episodes .*, got none: run `.*reevaluate --robot anymal"):
        confirmed(made / "found", opened=nobody)
    fine = int(np.flatnonzero(~archive.failing)[0])
    rate = round(float(archive.fresh.goal_rate[fine]) * 40)
    with pytest.raises(ValueError, match=f"elite {fine} of .* does not fail: {rate} of 40"):
        confirmed(path, elite=str(fine), opened=nobody)
    with pytest.raises(ValueError, match="has no elite 999"):
        certified(path, elite="999", opened=nobody)
    with pytest.raises(ValueError, match="must be confirmed with the controller that was searched, shipped, got"):
        confirmed(path, policy=OTHER.removeprefix("C-G="), opened=nobody)
    with pytest.raises(ValueError, match=r"certifier me .* a controller cannot certify itself"):
        certified(path, by=("me=shipped",), opened=nobody)
    with pytest.raises(ValueError, match="certifier C-G does not fit anymal"):
        certified(path, by=(f"C-G={RESULTS}/cassie/C-G.pt",), opened=nobody)
    with pytest.raises(ValueError, match=r"by must be NAME=FILE each.*, got 'C-G.pt'"):
        certified(path, by=("C-G.pt",), opened=nobody)
    with pytest.raises(ValueError, match=r"is of anymal, got --robot cassie"):
        certified(path, robot="cassie", opened=nobody)
    with pytest.raises(ValueError, match=r"results/anymal/panel must hold certifiers .* name some, for example --by"):
        certified(path, by=(), opened=nobody)
    with pytest.raises(FileNotFoundError, match="no run at gone"):
        confirmed(Path("gone"), opened=nobody)
    assert not Path("gone").exists()


def test_the_panel_leaves_out_the_controller_that_was_searched(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    panel = Path("results/anymal/panel")
    panel.mkdir(parents=True)
    shutil.copy(get_robot("anymal").policy_file, panel / "base.pt")
    with pytest.raises(ValueError, match="other than the controller that was searched"):
        certified(path, by=())
    shutil.copy(RESULTS / "anymal" / "C-G.pt", panel / "C-G.pt")
    assert certified(path, by=()).faults.certifiers == ("C-G",)


def test_an_elite_whose_fresh_episodes_are_invalid_does_not_fail(path):
    archive = read_archive(path)
    number = int(np.flatnonzero(archive.failing)[0])
    invalid = archive.fresh.invalid_episodes.copy()
    invalid[number] = 11
    write_archive(path / "archive.npz", replace(archive, fresh=replace(archive.fresh, invalid_episodes=invalid)))
    with pytest.raises(
        ValueError, match=f"elite {number} of .* does not fail: 11 of its 40 fresh episodes are invalid"
    ):
        confirmed(path, elite=str(number))
    write_archive(path / "archive.npz", replace(archive, scales=(1.0,) * 6))
    with pytest.raises(ValueError, match=r"must be the archive of config\.json beside it"):
        confirmed(path)


def test_a_robot_that_has_changed_is_refused(path):
    config = json.loads((path / "config.json").read_text())
    config["settings"]["robot_sha256"] = "0" * 64
    (path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="its settings, model or meshes have changed since"):
        confirmed(path)


@pytest.mark.parametrize("damaged", [b"{", b"[]"])
def test_damaged_numbers_are_refused_not_replaced_by_some_of_them(path, damaged):
    (path / "archive.json").write_bytes(damaged)
    for judge in (confirmed, certified):
        with pytest.raises(ValueError, match=r"archive\.json must .*: put a copy of .* back|put a copy of the right"):
            judge(path, opened=judges(stop_after=0))
    assert (path / "archive.json").read_bytes() == damaged
