"""A run's elites again: at the end of its search, and by the command, over the stand-in evaluator."""

import json
import os
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive
from qd.fresh import Reevaluate, reevaluate_run
from qd.search import run_search
from qd.show import figures
from qd.workers.evaluator import EvaluatorError
from sim.files.command import Interrupted
from sim.policy.spec import controller_hash
from tests.qd import stand_in
from tests.qd.searches import SHIPPED, make_job, rows_of, run
from tests.qd.stand_in import open_stand_in

POLICY = "tests.sim.policies:stand"


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    monkeypatch.setattr(figures, "write_figures", lambda folder, archive, metrics: [])


def again(path, **arguments):
    return reevaluate_run(Reevaluate(run=path, device="cpu", **arguments), open_evaluator=open_stand_in)


def numbers_in(path):
    return json.loads((path / "archive.json").read_text())


def watching(configs, seeds_seen):
    """The stand-in, noting how it was opened and what seeds it got."""

    @contextmanager
    def opened(cfg):
        configs.append(cfg)

        def evaluate(genes, seeds, progress=None):
            seeds_seen.append(seeds)
            return stand_in.evaluate(genes, seeds, cfg.num_replicas)

        yield evaluate

    return opened


def ended_in_fresh_episodes(error):
    """The stand-in, but for an error half way through the fresh episodes."""

    @contextmanager
    def opened(cfg):
        def evaluate(genes, seeds, progress=None):
            if cfg.num_replicas == 40:
                progress(0.5)
                raise error
            return stand_in.evaluate(genes, seeds, cfg.num_replicas)

        yield evaluate

    return opened


STOPS = [
    (KeyboardInterrupt(), Interrupted, "Stopped; the archive is saved as found. "),
    (EvaluatorError("a worker process died"), EvaluatorError, "a worker process died. "),
]


def test_a_search_ends_with_forty_fresh_episodes_of_each_elite(tmp_path, capsys):
    configs, seeds_seen, path = [], [], tmp_path / "run"
    archive = run_search(make_job(path, reproduce=True), open_evaluator=watching(configs, seeds_seen))
    found = run(tmp_path / "found")
    assert [cfg.num_replicas for cfg in configs] == [4, 40]
    assert len(seeds_seen[-1]) == len(archive)
    assert not set(seeds_seen[-1].tolist()) & set(np.concatenate(seeds_seen[:-1]).tolist())
    # The same elites, in the order of what is confirmed.
    assert sorted(archive.cell.tolist()) == sorted(found.cell.tolist())
    assert (np.diff(archive.fresh.fitness) <= 0).all() and (np.diff(archive.fitness) > 0).any()
    assert archive.fresh.episodes.tolist() == [40] * len(archive)
    assert np.array_equal(read_archive(path).fresh.fitness, archive.fresh.fitness)
    numbers = numbers_in(path)
    # The stand-in's noise of 10 % moves a mean of 40 episodes by under 2 %: all land in their cell or beside it.
    assert numbers["elites_reproduced"] == numbers["reevaluated"] == len(archive)
    assert numbers["corrected_mean_fitness"] == pytest.approx(archive.fresh.fitness.mean())
    assert numbers["qd_score"] == pytest.approx(found.qd_score)
    assert numbers["reproduced_by"]["seed"] == 3
    output = capsys.readouterr()
    assert "fresh episodes [" in output.err and "ETA" in output.err


@pytest.mark.parametrize(("error", "kind", "message"), STOPS, ids=["Ctrl-C", "a lost worker"])
def test_stopped_in_the_fresh_episodes_a_search_leaves_what_it_found_and_the_command_goes_on(
    tmp_path, error, kind, message
):
    path = tmp_path / "run"
    with pytest.raises(kind) as raised:
        job = make_job(path, reproduce=True, **SHIPPED)
        run_search(job, open_evaluator=ended_in_fresh_episodes(error))
    assert str(raised.value) == f"{message}Go on with:  faultline reevaluate --run {path}"
    found = run(tmp_path / "found", **SHIPPED)
    assert (path / "archive.npz").read_bytes() == (tmp_path / "found/archive.npz").read_bytes()
    assert numbers_in(path)["elites_reproduced"] is None
    again(path)
    run_search(make_job(tmp_path / "whole", reproduce=True, **SHIPPED), open_evaluator=open_stand_in)
    assert (path / "archive.npz").read_bytes() == (tmp_path / "whole/archive.npz").read_bytes()
    assert numbers_in(path)["elites_reproduced"] == len(found)


def test_the_command_adds_fresh_values_to_a_run_and_another_seed_gives_others(tmp_path):
    path = tmp_path / "run"
    found = run(path, **SHIPPED)
    metrics = rows_of(path, timed=True)
    first = again(path)
    assert first.fresh.fitness.tolist() != found.fitness.tolist()
    assert numbers_in(path)["reproduced_by"]["seed"] == 3
    assert numbers_in(path)["elites"] == len(found)
    before = (path / "archive.npz").read_bytes()
    again(path)  # from the checkpoint, so that fresh values never add up
    assert (path / "archive.npz").read_bytes() == before
    other = again(path, seed=7)
    assert numbers_in(path)["reproduced_by"]["seed"] == 7
    assert set(other.fresh.fitness.tolist()).isdisjoint(first.fresh.fitness.tolist())
    assert rows_of(path, timed=True) == metrics


@pytest.mark.parametrize("error", [KeyboardInterrupt(), EvaluatorError("no worker came")])
def test_stopped_the_command_leaves_the_run_as_it_was_and_says_how_to_start_again(tmp_path, error):
    path = tmp_path / "run"
    run(path, **SHIPPED)
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    args = Reevaluate(run=path, device="cpu", seed=7)
    with pytest.raises((Interrupted, EvaluatorError)) as raised:
        reevaluate_run(args, open_evaluator=ended_in_fresh_episodes(error))
    state = f"Stopped; {path} is as it was" if isinstance(error, KeyboardInterrupt) else "no worker came"
    assert str(raised.value).startswith(f"{state}. Start again with:  ")
    assert str(raised.value).endswith(f"reevaluate --robot anymal --run {path} --seed 7 --device cpu")
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before


def test_fresh_values_stay_while_the_elites_are_the_same(tmp_path, capsys):
    path = tmp_path / "run"
    run(path, **SHIPPED)
    again(path, seed=7)
    kept, numbers = (path / "archive.npz").read_bytes(), numbers_in(path)
    run(path, **SHIPPED, resumes=True)  # nothing is left to do but to write its results again
    assert (path / "archive.npz").read_bytes() == kept
    assert {**numbers_in(path), "date": 0} == {**numbers, "date": 0}
    assert numbers["reproduced_by"]["seed"] == 7
    assert "drops those values" not in capsys.readouterr().out
    # Searched again at the end, they are those of the run's own seed.
    run_search(make_job(path, **SHIPPED, resumes=True, reproduce=True), open_evaluator=open_stand_in)
    assert numbers_in(path)["reproduced_by"]["seed"] == 3


def test_a_run_that_grows_says_that_its_fresh_values_go(tmp_path, capsys):
    path = tmp_path / "run"
    run(path, **SHIPPED)
    assert "drops those values" not in capsys.readouterr().out
    again(path)
    run(path, **SHIPPED, resumes=True, iterations=4)
    output = capsys.readouterr().out
    assert f"the first new iteration drops those values. Afterwards:  faultline reevaluate --run {path}" in output
    assert read_archive(path).fresh is None
    assert numbers_in(path)["reproduced_by"] is None
    run(tmp_path / "whole", **SHIPPED, iterations=4)
    assert (path / "archive.npz").read_bytes() == (tmp_path / "whole/archive.npz").read_bytes()


def test_fresh_values_of_other_elites_or_of_a_damaged_file_are_not_taken(tmp_path):
    path, other = tmp_path / "run", tmp_path / "other"
    run(path, **SHIPPED)
    run(other, **SHIPPED, seed=4)
    found = (path / "archive.npz").read_bytes()
    again(other)
    for strayed in ((other / "archive.npz").read_bytes(), b"PK and no more"):
        (path / "archive.npz").write_bytes(strayed)
        (path / "archive.json").write_text("{")
        run(path, **SHIPPED, resumes=True)
        assert (path / "archive.npz").read_bytes() == found
        assert numbers_in(path)["elites_reproduced"] is None


def test_the_newest_run_of_the_robot_is_taken_and_another_robots_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(tmp_path / "runs/older", **SHIPPED)
    run(tmp_path / "runs/newer", **SHIPPED)
    os.utime(tmp_path / "runs/older/archive.npz", (0, 0))
    reevaluate_run(Reevaluate(device="cpu"), open_evaluator=open_stand_in)
    assert read_archive("runs/older").fresh is None
    assert read_archive("runs/newer").fresh is not None
    with pytest.raises(ValueError, match=r"runs/newer is of anymal, got --robot cassie: give that robot or another"):
        reevaluate_run(Reevaluate(robot="cassie", run=Path("runs/newer"), device="cpu"))
    with pytest.raises(FileNotFoundError, match="no archive of cassie under runs/"):
        reevaluate_run(Reevaluate(robot="cassie", device="cpu"))


def test_a_controller_that_is_another_now_is_refused_unless_it_is_given(tmp_path, capsys):
    path, policy = tmp_path / "run", tmp_path / "policy.pt"
    run(path, policy=str(policy), policy_sha256="0" * 64)
    with pytest.raises(ValueError, match=rf"the controller in {policy}, which is lost .* with --policy"):
        again(path)
    policy.write_bytes(b"another")
    with pytest.raises(ValueError, match=rf"the controller in {policy}, which is another one now"):
        again(path)
    assert numbers_in(path)["reproduced_by"] is None
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    again(path, policy=POLICY)
    assert f"With another controller than was searched, {POLICY}: the run's own files stay" in capsys.readouterr().out
    after = {file.name: file.read_bytes() for file in path.iterdir()}
    own = "archive-tests.sim.policies-stand"
    assert {name: after.pop(name) for name in before} == before and set(after) == {f"{own}.npz", f"{own}.json"}
    by = json.loads(after[f"{own}.json"])["reproduced_by"]
    assert (by["policy"], by["policy_sha256"]) == (POLICY, controller_hash(POLICY))
    assert read_archive(path / f"{own}.npz").fresh is not None and read_archive(path).fresh is None


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no run at .*: it has no config\.json"):
        again(tmp_path)
    run(tmp_path / "run", **SHIPPED)
    with pytest.raises(ValueError, match="seed must be at least 0, got -1"):
        again(tmp_path / "run", seed=-1)
    for name in ("checkpoint.bin", "metrics.jsonl", "archive.npz"):
        (tmp_path / "run" / name).unlink()
    with pytest.raises(ValueError, match="has no finished iteration"):
        again(tmp_path / "run")


def test_a_run_of_code_is_asked_for_it_again(tmp_path):
    path = tmp_path / "run"
    run(path, policy=POLICY)
    with pytest.raises(ValueError, match=r"searched with the controller tests\.sim\.policies:stand, which is code"):
        again(path)
    again(path, policy=POLICY)
    assert numbers_in(path)["reproduced_by"]["policy"] == POLICY
