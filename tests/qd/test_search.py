"""The search over the stand-in evaluator: what it finds, what it leaves behind, and what a kill costs."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive
from qd.search import run_search
from qd.show import figures
from qd.workers.evaluator import EvaluatorCfg, EvaluatorError, Pipeline, open_evaluator
from qd.workers.invalid import AllInvalidError
from sim.files import atomic as files
from sim.files.command import Interrupted
from sim.files.records import provenance
from tests.qd import crossers, stand_in
from tests.qd.searches import CFG, make_job, rows_of, run

KEPT = ("archive.json", "archive.npz", "archive.png", "checkpoint.bin", "config.json", "curves.png", "metrics.jsonl",
        "spread.png")  # fmt: skip


@pytest.fixture
def plain_figures(monkeypatch):
    """Figures take longer to draw than a search over the stand-in takes."""

    def write_figures(folder, archive, metrics):
        files.write_atomically(folder / "archive.png", b"a figure")
        return [folder / "archive.png"]

    monkeypatch.setattr(figures, "write_figures", write_figures)


@pytest.mark.parametrize("method", ["cma_mae", "cma_mae+map_elites"])
def test_golden_search(tmp_path, capsys, method):
    archive = run(tmp_path / "run", scheduler=dataclasses.replace(CFG.scheduler, method=method))
    assert sorted(os.listdir(tmp_path / "run")) == sorted(KEPT)
    assert (len(archive), archive.iterations) == (GOLDEN[method]["elites"], 2)
    assert archive.cell[:5].tolist() == GOLDEN[method]["cells"]
    assert archive.fitness[:5] == pytest.approx(GOLDEN[method]["fitness"], abs=1e-4)
    output = capsys.readouterr().out
    assert "2 iterations of 12 terrains x 4 episodes of up to 20 s" in output
    assert f"replay --robot anymal --run {tmp_path / 'run'} --elite 0" in output


GOLDEN = {
    "cma_mae": {
        "elites": 24,
        "cells": [3904, 2497, 3149, 3449, 1009],
        "fitness": [3.23625, 3.04963, 2.86269, 2.72434, 2.58613],
    },
    "cma_mae+map_elites": {
        "elites": 19,
        "cells": [2753, 1452, 933, 761, 1471],
        "fitness": [5.15655, 4.97512, 4.70702, 4.56382, 3.88451],
    },
}


def test_files_agree_with_each_other(tmp_path):
    path = tmp_path / "run"
    archive = run(path, iterations=4)
    on_disk = read_archive(path)
    assert np.array_equal(on_disk.genes, archive.genes)
    numbers = json.loads((path / "archive.json").read_text())
    last = rows_of(path, timed=True)[-1]
    assert [row["iteration"] for row in rows_of(path)] == [1, 2, 3, 4]
    for key in ("elites", "reachable_coverage", "qd_score", "mean_fitness"):
        assert numbers[key] == last[key]
    assert numbers["terrains_evaluated"] == 4 * 12
    assert numbers["episodes"] == 4 * 12 * 4
    assert numbers["reachable_cells"] == 4795
    assert numbers["elites_reproduced"] is None
    assert numbers["gpus"] == 0
    for key in ("command", "commit", "device", "versions", "seed", "date", "wall_s", "invalid_episodes"):
        assert key in numbers
    assert on_disk.qd_score == pytest.approx(numbers["qd_score"])


def test_seed_decides(tmp_path, plain_figures):
    first, again, other = (run(tmp_path / name, seed=seed) for name, seed in (("a", 3), ("b", 3), ("c", 4)))
    assert (tmp_path / "a/archive.npz").read_bytes() == (tmp_path / "b/archive.npz").read_bytes()
    assert np.array_equal(first.genes, again.genes)
    assert not np.array_equal(first.genes, other.genes)


def test_a_finished_run_is_extended_as_if_it_had_been_longer_from_the_start(tmp_path, plain_figures):
    run(tmp_path / "whole", iterations=9)
    run(tmp_path / "pieces", iterations=4)
    run(tmp_path / "pieces", iterations=9, resumes=True)
    assert (tmp_path / "whole/archive.npz").read_bytes() == (tmp_path / "pieces/archive.npz").read_bytes()
    assert json.loads((tmp_path / "pieces/config.json").read_text())["iterations"] == 9


GROUPS = {
    "iterations": 5,
    "reevaluate_every": 2,
    "scheduler": dataclasses.replace(CFG.scheduler, emitters=5, batch_size=3, method="cma_mae+map_elites"),
}


def in_groups(path, count, *, open_evaluator=stand_in.open_stand_in, iterations=5, resumes=False):
    settings = {**GROUPS, "iterations": iterations, "scheduler": dataclasses.replace(GROUPS["scheduler"], groups=count)}
    return run_search(make_job(path, resumes=resumes, **settings), open_evaluator=open_evaluator)


def by_two_processes(cfg: EvaluatorCfg):
    return open_evaluator(dataclasses.replace(cfg, workers="2"), build=crossers.Crosser)


class Lost(Pipeline):
    """Lots crossed by the stand-in; it is lost when so many were taken."""

    def __init__(self, left, lots):
        super().__init__(1000)  # a look at the elites is one lot
        self.left, self.lots, self.most = left, lots, 0

    def put(self, terrains, seeds):
        self.lots.append((terrains, seeds))
        self.most = max(self.most, len(self.lots))

    def take(self, progress=None):
        self.left -= 1
        if self.left < 0:
            raise EvaluatorError("a worker process died")
        return stand_in.evaluate(*self.lots.pop(0))

    def clear(self):
        assert not self.lots  # whatever is crossed anew finds nothing under way


@pytest.mark.slow
@pytest.mark.parametrize("groups", [2, 3])
def test_a_search_in_groups_that_is_lost_at_any_lot_goes_on_as_if_it_had_not_been(tmp_path, plain_figures, groups):
    """Five emitters make groups of two and three, or of one, two and two; elites are looked at again."""
    whole = in_groups(tmp_path / "whole", groups)
    assert whole.iterations == 5 and len(whole) > 10
    expected = (tmp_path / "whole/archive.npz").read_bytes(), rows_of(tmp_path / "whole")
    # Lost within the second iteration, at the look at its end, and within the third, of five.
    for lots in (groups + 1, 2 * groups, 2 * groups + 2):
        path = tmp_path / f"lost-{lots}"

        @contextmanager
        def losing(cfg, left=lots):
            yield Lost(left, [])

        with pytest.raises(EvaluatorError, match="a worker process died"):
            in_groups(path, groups, open_evaluator=losing)
        in_groups(path, groups, resumes=(path / "checkpoint.bin").exists() or (path / "config.json").exists())
        assert ((path / "archive.npz").read_bytes(), rows_of(path)) == expected, lots


def test_groups_are_put_in_ahead(tmp_path, plain_figures):
    lots = []
    pipeline = Lost(99, lots)

    @contextmanager
    def opened(cfg):
        yield pipeline

    in_groups(tmp_path / "run", 3, open_evaluator=opened)
    assert pipeline.most == 3 and not lots


@pytest.mark.slow
@pytest.mark.parametrize("groups", [1, 2, 3])
def test_who_crosses_the_lots_of_groups_changes_nothing(tmp_path, plain_figures, groups):
    in_groups(tmp_path / "whole", groups)
    for iterations in (1, 3, 5):  # extended twice
        path = tmp_path / "pieces"
        in_groups(path, groups, open_evaluator=by_two_processes, iterations=iterations, resumes=path.exists())
    assert (tmp_path / "whole/archive.npz").read_bytes() == (tmp_path / "pieces/archive.npz").read_bytes()


def test_every_session_of_a_run_is_told_with_what_it_came_to(tmp_path, plain_figures):
    path = tmp_path / "run"
    for iterations in (2, 5):
        run(path, iterations=iterations, resumes=path.exists())
    numbers, config = (json.loads((path / name).read_text()) for name in ("archive.json", "config.json"))
    assert [(one["command"], one["iterations"]) for one in numbers["sessions"]] == [("to 2", 2), ("to 5", 5)]
    assert config["sessions"] == numbers["sessions"]
    assert config["command"] == numbers["command"] == provenance("cpu", 0)["command"]  # of the run's beginning
    stopped = [{**numbers["sessions"][0], "iterations": 9}]  # asked for 9, killed after 5
    (path / "config.json").write_text(json.dumps({**config, "sessions": stopped}))
    run(path, iterations=6, resumes=True)
    sessions = json.loads((path / "archive.json").read_text())["sessions"]
    assert [one["iterations"] for one in sessions] == [5, 6]


def test_resuming_a_finished_run_evaluates_nothing_and_writes_its_results_again(tmp_path, plain_figures, capsys):
    path = tmp_path / "run"
    run(path)
    before = (path / "archive.npz").read_bytes()
    for name in ("archive.npz", "archive.json", "metrics.jsonl"):
        (path / name).unlink()

    def never(cfg):
        raise AssertionError("nothing is left to evaluate")

    run_search(make_job(path, resumes=True), open_evaluator=never)
    assert (path / "archive.npz").read_bytes() == before
    assert json.loads((path / "archive.json").read_text())["iterations"] == 2
    assert "All 2 iterations" in capsys.readouterr().out


def test_fewer_iterations_than_done_are_refused(tmp_path, plain_figures):
    run(tmp_path / "run", iterations=3)
    with pytest.raises(ValueError, match=r"iterations must be at least 3, as many as .* has done, got 2"):
        run(tmp_path / "run", iterations=2, resumes=True)


def test_an_interrupt_says_how_to_go_on(tmp_path, plain_figures):
    path = tmp_path / "run"

    @contextmanager
    def interrupted(cfg: EvaluatorCfg):
        def evaluate(genes, seeds, progress=None):
            if (path / "checkpoint.bin").exists():
                raise KeyboardInterrupt
            return stand_in.evaluate(genes, seeds)

        yield evaluate

    with pytest.raises(Interrupted, match=f"Go on with:  faultline archive --resume {path}"):
        run_search(make_job(path, iterations=3), open_evaluator=interrupted)
    assert len(rows_of(path)) == 1
    run(path, iterations=3, resumes=True)
    run(tmp_path / "whole", iterations=3)
    assert (path / "archive.npz").read_bytes() == (tmp_path / "whole/archive.npz").read_bytes()


def test_a_lost_worker_says_how_to_go_on(tmp_path):
    @contextmanager
    def lost(cfg: EvaluatorCfg):
        def evaluate(genes, seeds, progress=None):
            raise EvaluatorError("a worker process died (signal SIGKILL)")

        yield evaluate

    with pytest.raises(EvaluatorError, match=r"SIGKILL.*Go on with:  faultline archive --resume "):
        run_search(make_job(tmp_path / "run"), open_evaluator=lost)


def test_a_simulation_that_cannot_be_built_leaves_no_directory(tmp_path):
    @contextmanager
    def refusing(cfg: EvaluatorCfg):
        raise ValueError("policy 'x' does not fit")
        yield

    with pytest.raises(ValueError, match="does not fit"):
        run_search(make_job(tmp_path / "run"), open_evaluator=refusing)
    assert not (tmp_path / "run").exists()


def test_a_checkpoint_of_another_run_is_refused_and_left_alone(tmp_path, plain_figures):
    run(tmp_path / "a")
    run(tmp_path / "b", seed=4, scheduler=dataclasses.replace(CFG.scheduler, sigma0=0.25))
    strayed = (tmp_path / "b/checkpoint.bin").read_bytes()
    (tmp_path / "a/checkpoint.bin").write_bytes(strayed)
    before = {name: (tmp_path / "a" / name).read_bytes() for name in os.listdir(tmp_path / "a")}
    with pytest.raises(
        ValueError, match=r"other settings: scheduler\.sigma0 \(0\.25 there, 0\.5 wanted\), seed \(4 there, 3"
    ):
        run(tmp_path / "a", resumes=True, iterations=5)
    assert {name: (tmp_path / "a" / name).read_bytes() for name in os.listdir(tmp_path / "a")} == before


def test_two_searches_do_not_share_a_directory(tmp_path):
    path = tmp_path / "run"

    @contextmanager
    def intruding(cfg: EvaluatorCfg):
        with pytest.raises(ValueError, match="another command works in"):
            run(path)
        yield lambda genes, seeds, progress=None: stand_in.evaluate(genes, seeds)

    run_search(make_job(path), open_evaluator=intruding)
    assert len(rows_of(path)) == 2


@pytest.mark.parametrize("target", ["/dev/null/run", "/proc/run"])
def test_a_directory_that_cannot_be_written_to(target):
    with pytest.raises(ValueError, match=r"cannot be made: .*: give another --run-dir"):
        run(Path(target))


SLOW_SEARCH = """
import signal, sys, time
from pathlib import Path
from qd.search import run_search
from sim.files.command import run_command
from tests.qd import searches, stand_in
from contextlib import contextmanager
from dataclasses import dataclass

@contextmanager
def slow(cfg):
    def evaluate(genes, seeds, progress=None):
        time.sleep(0.3)
        return stand_in.evaluate(genes, seeds)
    yield evaluate

@dataclass
class Slow:
    path: Path

    def execute(self):
        run_search(searches.make_job(self.path, iterations=500), open_evaluator=slow)

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits that it is ignored
sys.exit(run_command(Slow, sys.argv[1:], name="slow"))
"""


def stopped_by(signum: int, path: Path, **environment: str) -> tuple[int, str]:
    """Exit code and error output of a search that gets a signal after two iterations."""
    program = subprocess.Popen(
        [sys.executable, "-c", SLOW_SEARCH, "--path", str(path)],
        stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2], env={**os.environ, **environment},
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not ((path / "metrics.jsonl").exists() and len(rows_of(path)) >= 2):
        time.sleep(0.05)
    program.send_signal(signum)
    errors = program.communicate(timeout=30)[1]
    return program.returncode, errors


def test_ctrl_c_ends_without_a_traceback_and_says_how_to_go_on(tmp_path):
    path = tmp_path / "run"
    code, errors = stopped_by(signal.SIGINT, path, NUMBA_DISABLE_JIT="1")  # spares compiling for a look at the messages
    assert code == 130
    assert "Traceback" not in errors
    assert f"Go on with:  faultline archive --resume {path}" in errors


def invalid_from(iteration, share, crossed):
    """Opens a stand-in whose episodes are invalid from an iteration on: so large a share of each terrain's."""

    @contextmanager
    def opened(cfg):
        def evaluate(genes, seeds, progress=None):
            crossed.append(len(genes))
            result = stand_in.evaluate(genes, seeds, cfg.num_replicas)
            if len(crossed) < iteration:
                return result
            invalid = np.zeros(result.invalid.shape, bool)
            invalid[:, : round(share * cfg.num_replicas)] = True
            return stand_in.make_result(result.penalties, invalid=invalid)

        yield evaluate

    return opened


def test_an_iteration_of_invalid_episodes_alone_stops_the_search_with_those_before_saved(tmp_path, plain_figures):
    path = tmp_path / "run"
    with pytest.raises(AllInvalidError, match=r"all 48 episodes .*48 non-finite state.*--resume") as error:
        run_search(make_job(path, iterations=4), open_evaluator=invalid_from(3, 1.0, []))
    assert error.value.status == 1
    assert [row["iteration"] for row in rows_of(path)] == [1, 2]
    run(path, iterations=4, resumes=True)  # with what it was mended by
    run(tmp_path / "whole", iterations=4)
    assert (path / "archive.npz").read_bytes() == (tmp_path / "whole/archive.npz").read_bytes()


def test_many_invalid_episodes_are_told_in_the_progress_line_and_at_the_end(tmp_path, plain_figures, capsys):
    # One of four episodes of each of 12 terrains, in the second iteration of two.
    run_search(make_job(tmp_path / "run"), open_evaluator=invalid_from(2, 0.25, []))
    said = capsys.readouterr()
    assert "25% invalid (12 non-finite state)" in said.err
    assert "Warning: In 1 of 2 iterations" in said.out and "12 of 48 episodes" in said.out
    assert [row["invalid_reasons"] for row in rows_of(tmp_path / "run")] == [{}, {"state": 12}]
    assert "replay" in said.out


def test_an_archive_without_elites_names_no_elite_to_look_at(tmp_path, plain_figures, capsys):
    # Two of four episodes of each terrain: over a quarter, so that every terrain is invalid.
    archive = run_search(make_job(tmp_path / "run"), open_evaluator=invalid_from(1, 0.5, []))
    assert len(archive) == 0 and "replay" not in capsys.readouterr().out
