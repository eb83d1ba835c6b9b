"""The comparison over the stand-in evaluator: its runs are those of the search, whatever stops it in between."""

import json
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from qd import search
from qd.archive import read_archive
from qd.fresh import Reevaluate, reevaluate_run
from qd.run import arguments
from qd.run.arguments import job_of
from qd.run.cli import Interrupted
from qd.run.directory import RunDirectory, claimed
from qd.search import run_search
from qd.studies import compare
from qd.studies.compare import Arguments
from sim.robots.robot import RobotCfg
from tests.qd import stand_in
from tests.qd.run.test_arguments import fine_policy
from tests.qd.stand_in import open_stand_in

POLICY = "shipped"
METHODS = ("uniform_random", "cma_mae_narrow")
ASKED = {"methods": METHODS, "seeds": 2, "seed": 5, "iterations": 3, "reevaluate_every": 2, "device": "cpu"}


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RobotCfg, "read_penalty_scales", lambda self: stand_in.SCALES)
    monkeypatch.setattr(compare, "save_figure", lambda path, figure: path.write_bytes(b"a figure"))
    monkeypatch.setattr(search, "write_figures", lambda folder, archive, metrics: [])


@contextmanager
def never(cfg):
    raise AssertionError("nothing may be evaluated")
    yield


def run(path: str, *, open_evaluator=open_stand_in, **changes) -> Path:
    args = Arguments(run_dir=Path(path), policy=POLICY, **{**ASKED, **changes})
    compare.compare(args, open_evaluator=open_evaluator)
    return Path(path)


def go_on(path: str, *, open_evaluator=open_stand_in, **given) -> Path:
    compare.compare(Arguments(resume=Path(path), device="cpu", **given), open_evaluator=open_evaluator)
    return Path(path)


def numbers_of(path: Path) -> dict:
    """The report, but for when and how fast."""
    report = json.loads((path / "compare.json").read_text())
    for method in report["methods"].values():
        del method["wall_s"]
    return {name: value for name, value in report.items() if name not in ("date", "command")}


def rows_of(run: Path) -> list[dict]:
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name not in ("wall_s", "episodes_per_s")} for row in rows]


def runs_of(path: Path) -> list[str]:
    return sorted(run.name for run in path.iterdir() if run.is_dir())


def assert_same(path: Path, other: Path) -> None:
    """Two comparisons found the same, to the last bit."""
    assert numbers_of(path) == numbers_of(other)
    assert runs_of(path) == runs_of(other)
    for name in runs_of(path):
        assert (path / name / "archive.npz").read_bytes() == (other / name / "archive.npz").read_bytes()
        assert rows_of(path / name) == rows_of(other / name)


def test_every_run_is_the_searchs_own():
    path = run("a")
    assert runs_of(path) == ["cma_mae_narrow-5", "cma_mae_narrow-6", "uniform_random-5", "uniform_random-6"]
    settings = {"cma_mae_narrow": {"method": "cma_mae", "sigma0": 0.5}, "uniform_random": {"method": "uniform_random"}}
    for name in runs_of(path):
        method, seed = name.rsplit("-", 1)
        asked = arguments.Arguments(
            preset="small", device="cpu", policy=POLICY, iterations=3, seed=int(seed), reevaluate_every=0,
            run_dir=Path("alone", name), **settings[method],
        )  # fmt: skip
        alone = vars(run_search(job_of(asked), open_evaluator=open_stand_in))
        together = vars(read_archive(path / name))
        for key in alone.keys() | together.keys():
            assert np.array_equal(together[key], alone[key]), key


def test_corrected_rows_are_at_the_iterations_asked_for():
    path = run("a", iterations=5)
    for name in runs_of(path):
        corrected = [row["iteration"] for row in rows_of(path / name) if "corrected_qd_score" in row]
        assert corrected == [2, 4, 5]
    # 4 emitters x 8 terrains an iteration.
    assert numbers_of(path)["terrains_evaluated"] == [32, 64, 96, 128, 160]
    assert numbers_of(path)["corrected_at"] == [64, 128, 160]


def test_interrupted_and_resumed_it_finds_the_same():
    whole, calls = run("whole"), []

    @contextmanager
    def interrupted(cfg):
        def evaluate(genes, seeds, progress=None):
            calls.append(len(genes))
            if len(calls) == 2:
                raise KeyboardInterrupt
            return stand_in.evaluate(genes, seeds, cfg.num_replicas)

        yield evaluate

    with pytest.raises(Interrupted, match="Go on with:  make compare ROBOT=anymal RESUME=a DEVICE=cpu"):
        run("a", open_evaluator=interrupted)
    assert calls == [4 * 32, 4 * 32]
    assert [len(rows_of(Path("a", name))) for name in runs_of(Path("a"))] == [1] * 4
    assert_same(go_on("a"), whole)


def interrupt_at_save(monkeypatch, number: int) -> None:
    """Ctrl-C before a run's state is saved, counted over all runs."""
    save, calls = RunDirectory.save, []

    def interrupted(*args):
        calls.append(args)
        if len(calls) == number:
            raise KeyboardInterrupt
        save(*args)

    monkeypatch.setattr(RunDirectory, "save", interrupted)


@pytest.mark.parametrize("number", [2, 6, 11], ids=["the first", "with corrected rows", "the last"])
def test_runs_behind_the_others_catch_up(monkeypatch, number):
    whole = run("whole")
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        interrupt_at_save(patch, number)
        run("a")
    done = [RunDirectory(Path("a", name)).iterations_done() for name in runs_of(Path("a"))]
    # Of 4 runs an iteration, number - 1 saves were made.
    assert (sum(done), len(set(done))) == (number - 1, 2)
    assert_same(go_on("a"), whole)


def test_it_is_extended_and_keeps_its_corrected_rows():
    path, whole = run("a"), run("whole", iterations=4)
    assert go_on("a", iterations=4) == path
    assert numbers_of(path)["corrected_at"] == [64, 96, 128]  # 3 was the last iteration once
    assert numbers_of(whole)["corrected_at"] == [64, 128]
    for name in runs_of(path):
        assert (path / name / "archive.npz").read_bytes() == (whole / name / "archive.npz").read_bytes()
        assert json.loads((path / name / "config.json").read_text())["iterations"] == 4


def test_stopped_in_its_last_iteration_and_extended_only_what_all_runs_have_is_compared(monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        interrupt_at_save(patch, 11)
        run("a")
    assert numbers_of(go_on("a", iterations=4))["corrected_at"] == [64, 128]


def test_resuming_a_finished_one_evaluates_nothing_and_writes_its_numbers_again():
    before = numbers_of(run("a"))
    Path("a/compare.json").unlink()
    assert numbers_of(go_on("a", open_evaluator=never)) == before


def search_alone(path: Path, **given):
    asked = arguments.Arguments(resume=path, device="cpu", reproduce="no", **given)
    return run_search(job_of(asked), open_evaluator=open_stand_in)


def test_a_run_is_extended_alone_and_the_others_follow():
    path, whole, name = run("a"), run("whole", iterations=5), "cma_mae_narrow-6"
    search_alone(path / name, iterations=5)
    assert (path / name / "archive.npz").read_bytes() == (whole / name / "archive.npz").read_bytes()
    with pytest.raises(ValueError, match=f"iterations must be at least 5, as many as a/{name} has done, got 3"):
        go_on("a", open_evaluator=never)
    go_on("a", iterations=5)
    for name in runs_of(path):
        assert (path / name / "archive.npz").read_bytes() == (whole / name / "archive.npz").read_bytes()
    # Alone it had some of its elites looked at, not all: the common looks are those at iterations 2 and 3.
    assert numbers_of(path)["corrected_at"] == [64, 96]


def test_a_search_and_a_comparison_do_not_share_a_run():
    path = run("a", iterations=1)

    @contextmanager
    def intruding(cfg):
        with pytest.raises(ValueError, match="another search works in a/uniform_random-5"):
            search_alone(path / "uniform_random-5", iterations=2)
        yield lambda genes, seeds, progress=None: stand_in.evaluate(genes, seeds, cfg.num_replicas)

    go_on("a", open_evaluator=intruding, iterations=2)
    with (
        claimed(path / "uniform_random-6"),
        pytest.raises(ValueError, match="another search works in a/uniform_random-6"),
    ):
        go_on("a", open_evaluator=never, iterations=3)
    go_on("a", iterations=3)


def test_a_comparison_killed_before_it_wrote_anything_is_begun_again():
    Path("a/uniform_random-5").mkdir(parents=True)
    Path("a/uniform_random-5/.write-test").touch()
    run("a", iterations=1)
    Path("b/mine").mkdir(parents=True)
    Path("b/mine/thesis.tex").touch()
    with pytest.raises(ValueError, match="b is not empty and holds no comparison"):
        run("b", iterations=1)


def test_fresh_values_of_a_run_stay_while_it_does_not_grow():
    path = run("a", iterations=1) / "cma_mae_narrow-5"
    reevaluate_run(Reevaluate(run=path, device="cpu"), open_evaluator=open_stand_in)
    kept = (path / "archive.npz").read_bytes()
    go_on("a", open_evaluator=never)
    assert (path / "archive.npz").read_bytes() == kept
    go_on("a", iterations=2)
    assert read_archive(path).fresh is None


def test_numbers_go_where_they_are_asked_for():
    run("a", out=Path("there/numbers.json"), methods=("hard_random",), seeds=1, iterations=1)
    assert sorted(path.name for path in Path("there").iterdir()) == ["numbers.json", "numbers.png"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": ("cma_mae", "annealing")}, "methods must be some of .* each once, got cma_mae, annealing"),
        ({"methods": ("cma_mae:colour=3",)}, "no setting named colour in cma_mae:colour=3: expected some of method"),
        ({"methods": ("cma_mae:sigma0=wide",)}, "sigma0 must be float, got 'wide'"),
        ({"methods": ("cma_mae:learning-rate=7",)}, "learning_rate must lie in"),
        ({"methods": ("cma_mae:sigma0=1:alpha=0",)}, "sigma0 must be float, got '1:alpha=0'"),
        ({"methods": ("cma_mae:sigma0=1,sigma0=2",)}, "sigma0 is given twice in cma_mae:sigma0=1,sigma0=2"),
        ({"methods": ("cma_mae:",)}, "no setting named  in cma_mae:"),
        ({"methods": ("cma_mae:sigma0=1\n",)}, r"without spaces, got 'cma_mae:sigma0=1\\n'"),
        ({"methods": (f"cma_mae:sigma0=1.{200 * '0'}",)}, "a name must be up to 200 letters"),
        ({"methods": ("mixed:method=../../x",)}, "a name must be up to 200 letters"),
        ({"methods": ("cma_mae", "cma_mae_sep:es=cma_es")}, "cma_mae and cma_mae_sep:es=cma_es are the same search"),
        (
            {"methods": ("cma_mae", "cma_mae:emitters=8")},
            "emitters times batch_size must be 32 as in all runs of the comparison, got 64 in cma_mae:emitters=8",
        ),
        ({"methods": ("mixed", "mixed")}, "each once, got mixed, mixed"),
        ({"methods": ()}, "methods must be some of"),
        ({"seeds": 0}, "seeds must be 1 to 10, got 0"),
        ({"seeds": 11}, "seeds must be 1 to 10, got 11"),
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"reevaluate_every": 0}, "reevaluate_every must be at least 1, got 0"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        ({"preset": "huge"}, "unknown preset 'huge'"),
        ({"robot": "dog"}, "unknown robot 'dog'"),
        ({"resume": Path("b")}, "give --resume for a comparison that is there or --run-dir for a new one, not both"),
    ],
)
def test_what_cannot_be_compared(changes, message):
    with pytest.raises(ValueError, match=message):
        run("a", open_evaluator=never, **changes)
    assert not Path("a").exists()


def test_directories_that_hold_no_comparison_or_one_already():
    Path("empty").mkdir()
    for path in ("empty", "nowhere"):
        with pytest.raises(FileNotFoundError, match=f"no comparison at {path}: it has no compare.config.json"):
            go_on(path, open_evaluator=never)
    assert not Path("nowhere").exists()
    Path("full").mkdir()
    Path("full/thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="full is not empty and holds no comparison: give another --run-dir"):
        run("full", open_evaluator=never)
    run("a", iterations=1)
    with pytest.raises(ValueError, match="a holds a comparison already: go on with --resume a"):
        run("a", open_evaluator=never)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"methods": ("mixed",)}, r'methods \(\["uniform_random", "cma_mae_narrow"\] there, \["mixed"\] wanted\)'),
        ({"seeds": 1}, r"seeds \(2 there, 1 wanted\)"),
        ({"seed": 0}, r"seed \(5 there, 0 wanted\)"),
        ({"reevaluate_every": 3}, r"reevaluate_every \(2 there, 3 wanted\)"),
        ({"preset": "paper"}, r'preset \("small" there, "paper" wanted\)'),
        ({"policy": f"{fine_policy.__module__}:{fine_policy.__name__}"}, r"policy \(.* there, .* wanted\)"),
        ({"iterations": 1}, "iterations must be at least 2, as many as a/uniform_random-5 has done, got 1"),
    ],
)
def test_it_goes_on_only_as_it_was_asked_for(given, message):
    path = run("a", iterations=2)
    before = (path / "compare.config.json").read_bytes()
    with pytest.raises(ValueError, match=message):
        go_on("a", open_evaluator=never, **given)
    assert (path / "compare.config.json").read_bytes() == before
    go_on("a", open_evaluator=never, methods=METHODS, seeds=2, seed=5, policy=POLICY)


def test_a_damaged_config_is_named():
    file = run("a", iterations=1) / "compare.config.json"
    whole = json.loads(file.read_text())
    for content, message in (
        (
            {**whole, "settings": {**whole["settings"], "methods": 3}},
            "a/compare.config.json: methods and seeds must be",
        ),
        ({**whole, "settings": {}}, "a/compare.config.json: methods and seeds must be"),
        ({"settings": whole["settings"]}, "must hold settings and iterations of a comparison"),
    ):
        file.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=message):
            go_on("a", open_evaluator=never)


def test_a_simulation_that_cannot_be_built_leaves_no_directory():
    @contextmanager
    def refusing(cfg):
        raise ValueError("no room on the device")
        yield

    with pytest.raises(ValueError, match="no room on the device"):
        run("a", open_evaluator=refusing)
    assert not Path("a").exists()
