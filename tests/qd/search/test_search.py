"""The search over the stand-in evaluator: what it finds, leaves behind and says; and over the real simulation."""

import dataclasses
import json
import os
import re
import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from qd.faults.judge import judge
from qd.search import crossed as labels
from qd.search import progress
from qd.search.archive import read_archive, write_archive
from qd.search.checkpoint import load_checkpoint, save_checkpoint
from qd.search.fitness import FitnessCfg, evaluate_rollout
from qd.search.presets import SchedulerCfg
from qd.search.progress import Bar
from qd.search.surrogate import surrogate
from qd.workers.compute import Compute
from qd.workers.crosser import open_pipeline
from qd.workers.invalid import AllInvalidError
from sim.crossing import CrossingCfg
from sim.files.command import Interrupted
from sim.robots.find import get_robot
from sim.rollout import Rollout
from tests.builders import fresh_values
from tests.qd import stand_in
from tests.qd.robots import Robots
from tests.qd.searches import CFG, rows_of, run
from tests.qd.stand_in import compute_by, open_stand_in

FILES = ["archive.json", "archive.npz", "checkpoint.bin", "config.json", "metrics.jsonl"]
FIGURES = ["archive.png", "curves.png"]


def test_golden_search(tmp_path):
    archive = run(tmp_path / "run")
    assert sorted(os.listdir(tmp_path / "run")) == FILES
    assert (len(archive), archive.iterations) == (19, 2)
    assert archive.cell[:5].tolist() == [2753, 1452, 933, 761, 1471]
    assert archive.fitness[:5] == pytest.approx([5.15655, 4.97512, 4.70702, 4.56382, 3.88451], abs=1e-4)


def test_files_agree_with_each_other(tmp_path, monkeypatch):
    monkeypatch.undo()  # with figures
    path = tmp_path / "run"
    archive = run(path, iterations=4)
    assert sorted(os.listdir(path)) == sorted(FILES + FIGURES)
    stored = read_archive(path)
    assert np.array_equal(stored.genes, archive.genes)
    numbers = json.loads((path / "archive.json").read_text())
    rows = rows_of(path, timed=True)
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    for key in ("elites", "reachable_coverage", "qd_score", "mean_fitness"):
        assert numbers[key] == rows[-1][key]
    counts = {"terrains_evaluated": 4 * 12, "episodes": 4 * 12 * 4, "reachable_cells": 4795, "gpus": 0}
    assert numbers | counts | {"invalid_episodes": 0} == numbers
    assert numbers["wall_s"] == pytest.approx(sum(row["wall_s"] for row in rows))
    assert numbers["with_collision"] == (archive.collision_rate > 0.0).sum()
    assert numbers["with_collision"] + numbers["without_collision"] == numbers["elites"]
    assert numbers["elites_reproduced"] is numbers["failing"] is numbers["faults"] is None
    assert set(numbers) >= {"command", "commit", "device", "versions", "seed", "date", "wall_s", "invalid_episodes"}
    assert stored.qd_score == pytest.approx(numbers["qd_score"])


def test_a_search_of_four_penalties_and_five_intervals_is_extended_as_if_it_had_been_longer_from_the_start(tmp_path):
    columns = [0, 1, 3, 5]  # without vel_y and stumble
    fitness = CFG.fitness.with_penalties(("yaw_rate", "vel_x", "contact_force", "collision"))
    settings = {"fitness": fitness, "intervals": 5}
    archive = run(tmp_path / "whole", iterations=5, **settings)
    for iterations in (2, 5):
        run(tmp_path / "pieces", iterations=iterations, **settings)
    assert (tmp_path / "whole/archive.npz").read_bytes() == (tmp_path / "pieces/archive.npz").read_bytes()
    # Of 4 indices of 0 to 4, those that sum to 2, 3 and 4: C(5, 3) + C(6, 3) + C(7, 3) = 10 + 20 + 35.
    assert json.loads((tmp_path / "whole/archive.json").read_text())["reachable_cells"] == 65
    assert archive.ratios.sum(axis=1) == pytest.approx(np.ones(len(archive)))
    assert np.array_equal(archive.cells.find_cells(archive.ratios), archive.cell)
    # The stand-in's penalties are scale * 4 * hardness^3 of genes k, k + 6, ..., but for noise of 10 %.
    hardness = np.stack([np.abs(archive.genes[:, k::6]).mean(axis=1) for k in columns], axis=1)
    assert archive.penalty_mean == pytest.approx(4.0 * hardness**3, rel=0.1)


def test_a_search_in_groups_that_is_stopped_at_any_lot_says_how_to_go_on_as_if_it_had_not_been(tmp_path):
    """Five emitters make groups of one, two and two, which are put in ahead."""
    scheduler = dataclasses.replace(CFG.scheduler, emitters=5, batch_size=3, groups=3)
    settings, robots = {"scheduler": scheduler, "iterations": 5}, Robots()
    whole = run(tmp_path / "whole", **settings, opener=robots)
    assert robots.pipeline.most_lots == 3 and not robots.pipeline.lots
    assert whole.iterations == 5 and len(whole) > 10
    expected = (tmp_path / "whole/archive.npz").read_bytes(), rows_of(tmp_path / "whole")
    # Stopped within the second iteration, at its end, and within the third, of five, each of 3 + 6 + 6 terrains.
    for count in (18, 30, 39):
        path = tmp_path / f"stopped-{count}"
        with pytest.raises(Interrupted, match=f"--resume {path}"):
            run(path, **settings, opener=Robots(stop_after=count))
        assert len(rows_of(path)) == count // 15
        run(path, **settings)
        assert ((path / "archive.npz").read_bytes(), rows_of(path)) == expected, count


def never(cfg):
    raise AssertionError("nothing is left to evaluate")


def test_a_finished_search_crosses_nothing_writes_what_is_lost_and_keeps_what_was_judged(tmp_path):
    path = tmp_path / "run"
    archive = run(path)
    before = {name: (path / name).read_bytes() for name in ("archive.npz", "metrics.jsonl")}
    for name in ("archive.npz", "archive.json", "metrics.jsonl"):
        (path / name).unlink()
    run(path, opener=never)
    assert {name: (path / name).read_bytes() for name in before} == before
    assert json.loads((path / "archive.json").read_text())["iterations"] == 2
    fresh = dataclasses.replace(fresh_values(archive), fitness=-archive.fitness)  # the elites in another order
    write_archive(path / "archive.npz", archive.corrected_by(fresh))
    judged = (path / "archive.npz").read_bytes()
    assert run(path, opener=never).fresh is not None
    assert (path / "archive.npz").read_bytes() == judged
    (path / "checkpoint.bin").rename(tmp_path / "saved")  # the largest file by far, which only more iterations need
    assert run(path, opener=never).fresh is not None
    for name, changes in ((r"checkpoint\.bin", {"iterations": 3}), ("seed", {"seed": 4})):
        with pytest.raises(ValueError, match=name):
            run(path, **changes)
    (tmp_path / "saved").rename(path / "checkpoint.bin")
    assert run(path, iterations=3).fresh is None  # there are other elites now


def test_a_search_that_was_stopped_is_judged_as_far_as_it_is(tmp_path):
    run(tmp_path / "run")
    with pytest.raises(Interrupted):
        run(tmp_path / "run", iterations=5, opener=Robots(stop_after=18))
    rows = rows_of(tmp_path / "run")
    archive = judge(tmp_path / "run", compute=compute_by(open_stand_in), stages=("fresh",))
    numbers = json.loads((tmp_path / "run/archive.json").read_text())
    assert 2 < numbers["iterations"] == len(rows) < 5 and numbers["episodes"] == sum(row["episodes"] for row in rows)
    assert numbers["elites"] == numbers["reevaluated"] == len(archive)


def test_what_a_run_is_not_gone_on_with_leaves_it_alone(tmp_path):
    path = tmp_path / "run"
    run(path, iterations=3)
    run(tmp_path / "other", seed=4)
    before = {name: (path / name).read_bytes() for name in os.listdir(path)}

    def refused(match, **changes):
        with pytest.raises(ValueError, match=match):
            run(path, **changes)
        assert {name: (path / name).read_bytes() for name in os.listdir(path)} == before

    refused("iterations", iterations=2)
    refused("wobble", fitness=FitnessCfg(penalties=("yaw_rate", "wobble"), scales=(1.0, 1.0)))
    state = load_checkpoint(path / "checkpoint.bin")
    for name in state:
        save_checkpoint(path / "checkpoint.bin", {key: value for key, value in state.items() if key != name})
        before["checkpoint.bin"] = (path / "checkpoint.bin").read_bytes()
        refused(name, iterations=5)
    before["checkpoint.bin"] = (tmp_path / "other/checkpoint.bin").read_bytes()
    shutil.copy(tmp_path / "other/checkpoint.bin", path)  # one that strayed here
    refused(r"checkpoint\.bin.*seed", iterations=5)
    del before["checkpoint.bin"]
    (path / "checkpoint.bin").unlink()
    refused(r"checkpoint\.bin", iterations=5)


def invalid_from(iteration, share):
    """The stand-in, whose episodes are invalid from an iteration on: so large a share of each terrain's."""

    def rule(cfg, genes, seeds):
        result = stand_in.evaluate(genes, seeds)
        if len(robots.crossed) < 12 * iteration:
            return result
        invalid = np.zeros(result.invalid.shape, bool)
        invalid[:, : round(share * result.invalid.shape[1])] = True
        return stand_in.make_result(result.penalties, invalid=invalid)

    robots = Robots(rule)
    return robots


def test_an_iteration_of_invalid_episodes_alone_stops_the_search_with_those_before_saved(tmp_path):
    path = tmp_path / "run"
    with pytest.raises(AllInvalidError, match=r"48 episodes"):
        run(path, iterations=4, opener=invalid_from(3, 1.0))
    assert [row["iteration"] for row in rows_of(path)] == [1, 2]


def test_invalid_episodes_are_counted_and_many_of_them_reported(tmp_path, capsys):
    # One of four episodes of each of 12 terrains, in the second iteration of two.
    run(tmp_path / "run", opener=invalid_from(2, 0.25))
    assert "12 of 48 episodes" in capsys.readouterr().out
    assert [row["invalid_reasons"] for row in rows_of(tmp_path / "run")] == [{}, {"state": 12}]


def test_elites_are_counted_by_a_collision_in_any_episode(tmp_path):
    def rule(cfg, genes, seeds):
        penalties = stand_in.evaluate(genes, seeds, 40).penalties
        return stand_in.make_result(penalties, base_collision=np.arange(40) < np.ones((len(genes), 1)))

    archive = run(tmp_path / "run", replicas=40, opener=Robots(rule))
    numbers = json.loads((tmp_path / "run/archive.json").read_text())
    assert not archive.collides.any()  # one of 40 is less than one expected in 20
    assert numbers["with_collision"] == numbers["elites"] > 0 == numbers["without_collision"]


AGAIN = dataclasses.replace(CFG.scheduler, method="map_elites", again=6, settling=2)


def test_the_last_iterations_settle_what_was_found(tmp_path):
    path = tmp_path / "run"
    archive = run(path, scheduler=AGAIN, iterations=6)
    assert [(row["terrains"], row["episodes"]) for row in rows_of(path)] == [(12, 48), *[(12, 96)] * 3, *[(0, 96)] * 2]
    assert json.loads((path / "archive.json").read_text())["terrains_evaluated"] == 48
    assert archive.iteration.max() <= 4 and np.median(archive.episodes) > 8
    run(path, scheduler=AGAIN, iterations=10)  # begins with new terrains again
    assert [row["terrains"] for row in rows_of(path)][6:] == [12, 12, 0, 0]


CROSSED = {
    "scheduler": dataclasses.replace(CFG.scheduler, method="surrogate", batch_size=8, again=4, groups=2,
                                     training_steps=2, candidates=2, generations=1),
    "fitness": dataclasses.replace(CFG.fitness, crossed=0.8), "iterations": 4,
}  # fmt: skip


def partly_late(cfg, genes, seeds):
    """Genes say where the controller passes, where those of the panel do, and where it does so steered."""
    passes = {"C-G": genes[:, 8] > 0.2, "S": genes[:, 17] > 0.0}.get(Path(cfg.policy).stem, genes[:, 0] > 0.5)
    passes = passes | (genes[:, 24] > 0.2) if cfg.with_steering else passes
    penalties = stand_in.evaluate(genes, seeds, cfg.replicas).penalties
    return stand_in.make_result(penalties, late=np.repeat(~passes[:, None], cfg.replicas, axis=1))


@pytest.mark.slow
def test_a_search_asks_who_crosses_what_stops_the_robot_and_goes_on_as_if_never_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "MOST", 6)
    monkeypatch.setattr(surrogate, "BATCH", 4)
    robots = Robots(partly_late)
    run(tmp_path / "whole", **CROSSED, opener=robots)
    rows = rows_of(tmp_path / "whole")
    assert [row["labelled"] for row in rows] == [6, 6, 0, 6]
    assert 0 < sum(row["labelled_crossed"] for row in rows) < 18
    tried = Counter("steered" if cfg.with_steering else Path(cfg.policy).stem for cfg, _ in robots.crossed)
    first, second, steered = (tried[name] for name in ("C-G", "S", "steered"))
    assert 18 == first > second > steered > 0 and len(tried) == 4  # each tries what those before do not cross
    assert sum(row["label_episodes"] for row in rows) == 4 * (first + second) + 8 * steered
    assert sum(row["episodes"] for row in rows) == 4 * (len(robots.crossed) - first - second - steered)
    everything = 4 * len(robots.crossed) + 4 * steered
    assert json.loads((tmp_path / "whole/archive.json").read_text())["episodes"] == everything
    for count in (50, len(robots.crossed) - 3):  # in an iteration, and while the last ones are asked about
        with pytest.raises(Interrupted, match="--resume"):
            run(tmp_path / str(count), **CROSSED, opener=Robots(partly_late, stop_after=count))
        with monkeypatch.context() as patch, pytest.raises(ValueError, match="panel"):
            patch.setattr(labels, "controllers_in", lambda folder: {})  # it would be asked no more
            run(tmp_path / str(count), **CROSSED, opener=Robots(partly_late))
        run(tmp_path / str(count), **CROSSED, opener=Robots(partly_late))
        assert rows_of(tmp_path / str(count)) == rows
        assert (tmp_path / str(count) / "archive.npz").read_bytes() == (tmp_path / "whole/archive.npz").read_bytes()


@pytest.mark.slow
def test_a_search_ends_where_its_last_tenth_brings_little(tmp_path, capsys):
    """The same if it is stopped before that is found out, behind it, or while it settles, and goes on."""
    path, settings = tmp_path / "run", {"scheduler": AGAIN, "iterations": 60, "until": 0.05}
    archive = run(path, **settings)
    rows = rows_of(path)
    assert [row["last_tenth"] for row in rows[:19]] == [None] * 19
    little = next(row["iteration"] for row in rows if row["last_tenth"] and row["last_tenth"] < 0.05)
    # What was asked for when it was found out is crossed, then all settles for two iterations.
    assert 20 < little == archive.iterations - 3 < 57
    assert [bool(row["terrains"]) for row in rows] == [*[True] * (little + 1), False, False]
    ended = f"Ended by --until 0.05 after {little + 3} of 60 iterations."
    assert ended in capsys.readouterr().out
    run(path, **settings, opener=never)
    assert (out := capsys.readouterr().out).count(ended) == 1 and f"0 of {little + 3} iterations to go" in out
    for done in range(little - 1, little + 3):
        stopped = tmp_path / f"stopped-{done}"
        with pytest.raises(Interrupted, match=r"--until 0\.05"):
            run(stopped, **settings, opener=Robots(stop_after=12 + 24 * (done - 1)))
        assert len(rows_of(stopped)) == done
        run(stopped, **settings)
        assert rows_of(stopped) == rows
        assert (stopped / "archive.npz").read_bytes() == (path / "archive.npz").read_bytes()
    capsys.readouterr()
    run(path, **settings | {"until": None, "iterations": little + 5})
    assert [row["terrains"] for row in rows_of(path)][little + 3 :] == [12, 0]
    assert "Ended by" not in capsys.readouterr().out


def test_a_search_of_few_iterations_or_without_elites_has_no_last_tenth(tmp_path, capsys):
    run(tmp_path / "few", iterations=4, until=0.99)
    assert len(run(tmp_path / "none", iterations=21, until=0.99, opener=invalid_from(0, 0.5))) == 0
    assert (len(rows_of(tmp_path / "few")), len(rows_of(tmp_path / "none"))) == (4, 21)
    assert "last tenth" not in capsys.readouterr().out


@pytest.mark.slow
def test_elites_that_are_crossed_again_are_there_again_more_often(tmp_path):
    """Over robots whose penalties differ by half from episode to episode, at equally many episodes."""

    def noisy(genes, seeds, count):
        hardness = np.stack([np.abs(genes[:, k::6]).mean(axis=1) for k in range(6)], axis=1) ** 6
        draws = [np.random.default_rng(int(seed)).lognormal(0.0, 0.5, (count, 6)) for seed in seeds]
        return stand_in.make_result(400.0 * hardness[:, None] * np.stack(draws) * stand_in.SCALES)

    opener = Robots(lambda cfg, genes, seeds: noisy(genes, seeds, cfg.replicas))
    scheduler = dataclasses.replace(CFG.scheduler, method="map_elites", emitters=4, batch_size=15)
    once = run(tmp_path / "once", opener=opener, scheduler=scheduler, iterations=20)
    scheduler = dataclasses.replace(scheduler, batch_size=8, again=7, settling=3)
    again = run(tmp_path / "again", opener=opener, scheduler=scheduler, iterations=20)

    def share_in_the_same_cell(archive):
        fresh = evaluate_rollout(noisy(archive.genes, np.arange(len(archive)), 40), CFG.cells, CFG.fitness)
        return (fresh.cell == archive.cell).mean()

    assert share_in_the_same_cell(again) > 1.3 * share_in_the_same_cell(once)


def test_a_terminal_has_one_line_that_fits_with_the_time_left_first(monkeypatch, capsys):
    for name, value in {"FORCE_COLOR": "1", "NO_COLOR": "1", "COLUMNS": "50", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    with Bar("crossing" + 30 * " terrains", total=4, done=2) as bar:
        bar.move_to(3)
    text = capsys.readouterr().err
    assert "\x1b[36m" not in text  # no colour where NO_COLOR is set
    lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text))
    assert any(re.match(r" +\d+ s left  75% ━━━━━━━━── crossing terrains .*…$", line) for line in lines)
    assert max(map(len, lines)) == 50


def test_elsewhere_a_plain_line_every_half_minute(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with Bar("iteration 3/4", total=4, done=2) as bar:
        for now[0], share in ((10, 0.2), (60, 0.5), (80, 0.9)):
            bar.within(2, 1)(share)
    # Half an iteration took a minute: one and a half take three.
    assert capsys.readouterr().err == " 3 min left  62% ━━━━━━──── iteration 3/4\n"
    with Bar("quick") as bar:
        bar.move_to(1.0)
    assert capsys.readouterr().err == ""


ROBOT = get_robot("anymal")


def short_rollout(cfg, num_terrains):
    return Rollout(
        dataclasses.replace(ROBOT, max_duration_s=1.6),
        cfg.policy, num_terrains=num_terrains, replicas=cfg.replicas, num_envs=4, device=cfg.compute.device,
        cfg=CrossingCfg(start=(12.5, 4.0), poll_every_s=0.2),
    )  # fmt: skip


@pytest.mark.slow
def test_a_search_in_groups_that_is_extended_equals_the_one_in_one_go_by_any_number_of_processes(tmp_path, device):
    """Robots go on with the terrains of other groups; three emitters make groups of one and two."""
    settings = {
        "replicas": 3,
        "fitness": FitnessCfg(penalties=ROBOT.penalties, scales=(1.0, 2.0, 1.0, 300.0, 0.05, 0.3)),
        "scheduler": SchedulerCfg(method="cma_mae+map_elites", emitters=3, batch_size=2, sigma0=1.0, groups=2),
    }

    def searched(path, iterations, *, workers="1"):
        def opened(cfg):
            compute = Compute(device, workers=workers if device == "cpu" else None)
            return open_pipeline(dataclasses.replace(cfg, compute=compute), build=short_rollout)

        return run(path, iterations=iterations, **settings, opener=opened)

    whole = searched(tmp_path / "whole", 3)
    searched(tmp_path / "pieces", 1, workers="2")
    pieces = searched(tmp_path / "pieces", 3, workers="1")
    assert len(whole) > 1
    assert all(0.0 <= row["idle_share"] <= 1.0 for row in rows_of(tmp_path / "pieces"))
    if device == "cpu":  # a GPU adds in any order
        for name in ("genes", "cell", "fitness", "iteration", "ratios"):
            np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)
