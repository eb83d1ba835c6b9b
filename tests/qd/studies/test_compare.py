"""The comparison over the stand-in evaluator: its runs are those of the search, whatever stops it in between."""

import json
import math
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive
from qd.fresh import Reevaluate, reevaluate_run
from qd.run.arguments import Archive, job_of
from qd.run.directory import RunDirectory, claimed
from qd.search import run_search
from qd.studies.compare import AGAIN, LABELS, METHODS, Compare, draw_comparison, report_of, show
from sim.files.command import Interrupted
from sim.robots.robot import RobotCfg
from tests.qd import stand_in
from tests.qd.run.test_arguments import fine_policy
from tests.qd.searches import rows_of
from tests.qd.stand_in import open_stand_in

POLICY = "shipped"
TWO = ("uniform_random", "cma_mae_narrow")
ASKED = {
    "methods": TWO,
    "seeds": 2,
    "seed": 5,
    "iterations": 3,
    "reevaluate_every": 2,
    "device": "cpu",
    "policy": POLICY,
}


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RobotCfg, "read_penalty_scales", lambda self, policy=None: stand_in.SCALES)
    monkeypatch.setattr("sim.files.figures.as_png", lambda figure: b"a figure")
    monkeypatch.setattr("qd.show.figures.write_figures", lambda folder, archive, metrics: [])


@contextmanager
def never(cfg):
    raise AssertionError("nothing may be evaluated")
    yield


def run(path: str, *, open_evaluator=open_stand_in, **changes) -> Path:
    Compare(run_dir=Path(path), **{**ASKED, **changes}).execute(open_evaluator=open_evaluator)
    return Path(path)


def numbers_of(path: Path) -> dict:
    """The report, but for when and how fast."""
    report = json.loads((path / "compare.json").read_text())
    for method in report["methods"].values():
        del method["wall_s"]
    if report["judged_by"] is not None:
        del report["judged_by"]["date"]
    return {name: value for name, value in report.items() if name not in ("date", "command")}


def corrected_at(path: Path) -> list[int]:
    """Terrains after which the elites of every method crossed fresh episodes."""
    return sorted(
        set.intersection(*(set(method["curves"]["corrected_at"]) for method in numbers_of(path)["methods"].values()))
    )


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
        asked = Archive(
            preset="small", device="cpu", policy=POLICY, iterations=3, seed=int(seed), reevaluate_every=0,
            run_dir=Path("alone", name), **settings[method],
        )  # fmt: skip
        alone = vars(run_search(job_of(asked), open_evaluator=open_stand_in))
        together = vars(read_archive(path / name))
        for key in alone.keys() | together.keys():
            assert np.array_equal(together[key], alone[key]), key


@pytest.mark.slow
def test_surrogates_are_compared_and_stopped_as_all_others_are():
    few = "training-steps=1,candidates=1,generations=1"
    methods = (f"surrogate:crossover-share=0.6,{few}", f"surrogate:method=surrogate+map_elites,{few}")
    changes = {"methods": methods, "seeds": 1}
    whole = run("whole", **changes)
    shares = [method["settings"]["crossover_share"] for method in numbers_of(whole)["methods"].values()]
    assert shares == [0.6, 0.3]
    run("a", **changes, iterations=2)
    again = run("a", **changes)
    assert runs_of(again) == runs_of(whole)
    for name in runs_of(whole):
        assert (again / name / "archive.npz").read_bytes() == (whole / name / "archive.npz").read_bytes()
        assert len(rows_of(again / name)) == 3


@pytest.mark.slow
def test_corrected_rows_are_at_the_iterations_asked_for():
    path = run("a", iterations=5)
    for name in runs_of(path):
        corrected = [row["iteration"] for row in rows_of(path / name) if "corrected_qd_score" in row]
        assert corrected == [2, 4, 5]
    # 4 emitters x 8 terrains an iteration.
    for method in numbers_of(path)["methods"].values():
        assert method["curves"]["terrains"] == [32, 64, 96, 128, 160]
    assert corrected_at(path) == [64, 128, 160]


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

    with pytest.raises(Interrupted, match="The same command goes on"):
        run("a", open_evaluator=interrupted)
    assert calls == [4 * 2 * 16] * 2  # both groups of four searches together
    assert [len(rows_of(Path("a", name))) for name in runs_of(Path("a"))] == [1] * 4
    assert_same(run("a"), whole)


def test_searches_of_other_widths_have_as_many_terrains_and_are_those_of_a_search_alone():
    wide = "mixed:emitters=16,groups=4"
    path = run("a", methods=("mixed@1", wide), iterations=4, seeds=2)
    assert runs_of(path) == ["mixed-5", f"{wide}-5", f"{wide}-6"]
    narrow, broad = (numbers_of(path)["methods"][name] for name in ("mixed", wide))
    assert narrow["curves"]["terrains"] == [32, 64, 96, 128] and broad["curves"]["terrains"] == [128]
    assert narrow["curves"]["corrected_at"] == [64, 128] and broad["curves"]["corrected_at"] == [128]
    assert (narrow["iterations"], broad["iterations"]) == ([4], [1, 1])
    assert (narrow["seeds"], broad["seeds"]) == (1, 2) and narrow["episodes"] == broad["episodes"] == 128 * 4
    assert len(broad["curves"]["failing"][-1]["seeds"]) == 2
    asked = Archive(
        preset="small", device="cpu", policy=POLICY, iterations=1, seed=6, reevaluate_every=1, emitters=16, groups=4,
        method="cma_mae+map_elites", run_dir=Path("alone"),
    )  # fmt: skip
    alone, together = (
        vars(run_search(job_of(asked), open_evaluator=open_stand_in)),
        vars(read_archive(path / f"{wide}-6")),
    )
    for key in ("genes", "fitness", "ratios", "cell"):
        assert np.array_equal(together[key], alone[key]), key
    assert_same(run("a", methods=("mixed@1", wide), iterations=4, seeds=2, open_evaluator=never), path)


def interrupt_at_save(monkeypatch, number: int) -> None:
    """Ctrl-C before a run's state is saved, counted over all runs."""
    save, calls = RunDirectory.save, []

    def interrupted(*args):
        calls.append(args)
        if len(calls) == number:
            raise KeyboardInterrupt
        save(*args)

    monkeypatch.setattr(RunDirectory, "save", interrupted)


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 6, 11], ids=["the first", "with corrected rows", "the last"])
def test_runs_behind_the_others_catch_up(monkeypatch, number):
    whole = run("whole")
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        interrupt_at_save(patch, number)
        run("a")
    done = [RunDirectory(Path("a", name)).iterations_done() for name in runs_of(Path("a"))]
    # Of 4 runs an iteration, number - 1 saves were made.
    assert (sum(done), len(set(done))) == (number - 1, 2)
    assert_same(run("a"), whole)


@pytest.mark.slow
def test_it_is_extended_and_keeps_its_corrected_rows():
    path, whole = run("a"), run("whole", iterations=4)
    assert run("a", iterations=4) == path
    assert corrected_at(path) == [64, 96, 128]  # 3 was the last iteration once
    assert corrected_at(whole) == [64, 128]
    for name in runs_of(path):
        assert (path / name / "archive.npz").read_bytes() == (whole / name / "archive.npz").read_bytes()
        assert json.loads((path / name / "config.json").read_text())["iterations"] == 4


@pytest.mark.slow
def test_stopped_in_its_last_iteration_and_extended_only_what_all_runs_have_is_compared(monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        interrupt_at_save(patch, 11)
        run("a")
    assert corrected_at(run("a", iterations=4)) == [64, 128]


def test_resuming_a_finished_one_evaluates_nothing_and_writes_its_numbers_again():
    before = numbers_of(run("a"))
    Path("a/compare.json").unlink()
    assert numbers_of(run("a", open_evaluator=never)) == before


def test_numbers_for_which_nothing_is_crossed_come_from_where_the_searches_ran():
    path = run("a", iterations=1)
    for name in runs_of(path):
        config = json.loads((path / name / "config.json").read_text())
        (path / name / "config.json").write_text(json.dumps({**config, "device": "another", "date": "2026-01-01"}))
    report = json.loads((run("a", iterations=1, open_evaluator=never) / "compare.json").read_text())
    assert (report["device"], report["date"]) == ("another", "2026-01-01")
    report = json.loads((run("a", iterations=2) / "compare.json").read_text())
    assert report["device"] != "another" and report["date"] > "2026-01-01"


def search_alone(path: Path, **given):
    asked = Archive(resume=path, device="cpu", reproduce="no", **given)
    return run_search(job_of(asked), open_evaluator=open_stand_in)


@pytest.mark.slow
def test_a_run_is_extended_alone_and_the_others_follow():
    path, whole, name = run("a"), run("whole", iterations=5), "cma_mae_narrow-6"
    search_alone(path / name, iterations=5)
    assert (path / name / "archive.npz").read_bytes() == (whole / name / "archive.npz").read_bytes()
    assert numbers_of(run("a"))["iterations"] == 3  # the first three of all are compared
    assert RunDirectory(path / name).read_cfg().iterations == 5
    run("a", iterations=5)
    for name in runs_of(path):
        assert (path / name / "archive.npz").read_bytes() == (whole / name / "archive.npz").read_bytes()
    # Alone it had some of its elites looked at, not all: the common looks are those at iterations 2 and 3.
    assert corrected_at(path) == [64, 96]


def test_a_search_and_a_comparison_do_not_share_a_run():
    path = run("a", iterations=1)

    @contextmanager
    def intruding(cfg):
        with pytest.raises(ValueError, match="another command works in a/uniform_random-5"):
            search_alone(path / "uniform_random-5", iterations=2)
        yield lambda genes, seeds, progress=None: stand_in.evaluate(genes, seeds, cfg.num_replicas)

    run("a", open_evaluator=intruding, iterations=2)
    with (
        claimed(path / "uniform_random-6"),
        pytest.raises(ValueError, match="another command works in a/uniform_random-6"),
    ):
        run("a", open_evaluator=never, iterations=3)
    run("a", iterations=3)


def test_a_comparison_killed_before_it_wrote_anything_is_begun_again():
    Path("a/uniform_random-5").mkdir(parents=True)
    Path("a/uniform_random-5/.write-test").touch()
    run("a", iterations=1)
    Path("b/uniform_random-5").mkdir(parents=True)
    Path("b/uniform_random-5/thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="b/uniform_random-5 is not empty and holds no run: give another --run-dir"):
        run("b", iterations=1)


def test_fresh_values_of_a_run_stay_while_it_does_not_grow():
    path = run("a", iterations=1) / "cma_mae_narrow-5"
    reevaluate_run(Reevaluate(run=path, device="cpu"), open_evaluator=open_stand_in)
    kept = (path / "archive.npz").read_bytes()
    run("a", iterations=1, open_evaluator=never)
    assert (path / "archive.npz").read_bytes() == kept
    run("a", iterations=2)
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
        ({"methods": ("cma_mae:learning-rate=7",)}, "learning_rate must be"),
        ({"methods": ("cma_mae:sigma0=1:alpha=0",)}, "sigma0 must be float, got '1:alpha=0'"),
        ({"methods": ("cma_mae:sigma0=1,sigma0=2",)}, "sigma0 is given twice in cma_mae:sigma0=1,sigma0=2"),
        ({"methods": ("cma_mae:",)}, "no setting named  in cma_mae:"),
        ({"methods": ("cma_mae:sigma0=1\n",)}, r"without spaces, got 'cma_mae:sigma0=1\\n'"),
        ({"methods": (f"cma_mae:sigma0=1.{200 * '0'}",)}, "a name must be up to 200 letters"),
        ({"methods": ("mixed:method=../../x",)}, "a name must be up to 200 letters"),
        ({"methods": ("cma_mae", "cma_mae_sep:es=cma_es")}, "cma_mae and cma_mae_sep:es=cma_es are the same search"),
        ({"methods": ("map_elites", "map_elites:generations=5")}, "map_elites:generations=5 are the same search"),
        (
            {"methods": ("cma_mae", "cma_mae:emitters=8")},
            "iterations of cma_mae:emitters=8 must make up the 96 terrains of the others, got 64 terrains an iteration",
        ),
        ({"methods": ("mixed", "mixed")}, "each once, got mixed, mixed"),
        ({"methods": ("mixed", "mixed@1")}, "each once, got mixed, mixed@1"),
        ({"methods": ("mixed@3",)}, "behind @ there must be a number of seeds from 1 to 2, got mixed@3"),
        ({"methods": ("mixed@one",)}, "behind @ there must be a number of seeds from 1 to 2, got mixed@one"),
        ({"methods": ()}, "methods must be some of"),
        ({"seeds": 0}, "seeds must be at least 1 and at most 10, got 0"),
        ({"seeds": 11}, "seeds must be at least 1 and at most 10, got 11"),
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"reevaluate_every": 0}, "reevaluate_every must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"preset": "huge"}, "unknown preset 'huge'"),
        ({"robot": "dog"}, "unknown robot 'dog'"),
    ],
)
def test_what_cannot_be_compared(changes, message):
    with pytest.raises(ValueError, match=message):
        run("a", open_evaluator=never, **changes)
    assert not Path("a").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"reevaluate_every": 3}, r"reevaluate_every \(2 there, 3 wanted\)"),
        ({"preset": "paper"}, r'preset \("small" there, "paper" wanted\)'),
        ({"policy": f"{fine_policy.__module__}:{fine_policy.__name__}"}, r"policy \(.* there, .* wanted\)"),
    ],
)
def test_it_goes_on_only_as_it_was_asked_for(given, message):
    path = run("a", iterations=2)
    before = (path / "uniform_random-5" / "config.json").read_bytes()
    with pytest.raises(ValueError, match=message):
        run("a", open_evaluator=never, **{"iterations": 2, **given})
    assert (path / "uniform_random-5" / "config.json").read_bytes() == before
    run("a", open_evaluator=never, iterations=2)


def test_methods_and_seeds_may_be_added():
    whole = run("whole", iterations=2)
    run("a", iterations=2, methods=TWO[:1], seeds=1)
    assert_same(run("a", iterations=2), whole)


# The numbers of a comparison by hand, and what its figure shows of them.


def row(qd_score: float, *, corrected: float | None = None, collision_rate: float = 0.0) -> dict:
    """Metrics of one iteration of 10 terrains x 4 episodes."""
    again = {} if corrected is None else {**dict.fromkeys(AGAIN, 1.0), "corrected_qd_score": corrected}
    return {
        "qd_score": qd_score, "reachable_coverage": 0.25, "elites": 5, "mean_fitness": -1.0, "batch_fitness": 2.0,
        "batch_collision_rate": collision_rate, "batch_goal_rate": 0.5, "terrains": 10, "episodes": 40,
        "invalid_episodes": 1, "wall_s": 1.5, **again,
    }  # fmt: skip


RUNS = {
    "cma_mae": [[row(score), row(10 * score, corrected=5 * score, collision_rate=0.5)] for score in (1.0, 2.0, 3.0)],
    "hard_random": [[row(4.0), row(8.0, corrected=6.0)] for _ in range(3)],
}
HALF = 4.303 / math.sqrt(3)  # of 1, 2, 3: standard deviation 1, Student's quantile of 2 degrees of freedom


def reported(runs: dict) -> dict:
    seeds = list(range(len(next(iter(runs.values())))))
    return {"robot": "anymal", "seeds": seeds, **report_of(runs, {name: {"method": name} for name in runs})}


def test_report_by_hand():
    report = reported(RUNS)
    found = report["methods"]["cma_mae"]
    curves = found["curves"]
    assert (found["iterations"], curves["terrains"], curves["corrected_at"]) == ([2] * 3, [10, 20], [20])
    assert (found["settings"], found["seeds"], found["episodes"]) == ({"method": "cma_mae"}, 3, 80)
    assert curves["episodes"] == [40, 80]
    assert [point["mean"] for point in curves["qd_score"]] == [2.0, 20.0]
    assert curves["qd_score"][0]["interval"] == pytest.approx([2.0 - HALF, 2.0 + HALF])
    assert curves["qd_score"][1]["seeds"] == [10.0, 20.0, 30.0]
    assert found["qd_score"] == 20.0 and found["qd_score_interval"] == pytest.approx([20 - 10 * HALF, 20 + 10 * HALF])
    assert [point["mean"] for point in curves["corrected_qd_score"]] == [found["corrected_qd_score"]] == [10.0]
    assert found["corrected_qd_score_interval"] == pytest.approx([10.0 - 5 * HALF, 10.0 + 5 * HALF])
    assert found["faults"] is found["faults_interval"] is None  # nobody judged the elites
    assert found["batch_collision_rate"]["mean"] == 0.25  # 0 in the first iteration, .5 in the second
    assert (found["invalid_episodes"], found["wall_s"]) == (3 * 2, 3 * 2 * 1.5)
    assert report["methods"]["hard_random"]["curves"]["qd_score"][1] == {
        "mean": 8.0,
        "interval": [8.0, 8.0],
        "seeds": [8.0] * 3,
    }


def test_a_seed_without_a_value_leaves_the_mean_out():
    runs = {"mixed": [[{**row(1.0, corrected=1.0), "mean_std": value}] for value in (0.5, None)]}
    found = reported(runs)["methods"]["mixed"]
    assert found["mean_std"] is None
    assert found["curves"]["mean_std"][0] == {"mean": None, "interval": None, "seeds": [0.5, None]}


def test_corrected_rows_that_some_runs_lack_are_left_out():
    runs = {"mixed": [[row(1.0, corrected=1.0), row(2.0, corrected=2.0)], [row(1.0), row(2.0, corrected=2.0)]]}
    curves = reported(runs)["methods"]["mixed"]["curves"]
    assert curves["corrected_at"] == [20]
    assert [point["mean"] for point in curves["corrected_qd_score"]] == [2.0]


def test_what_not_all_elites_were_looked_at_for_is_not_counted_in_the_end():
    runs = {"mixed": [[row(1.0, corrected=1.0), row(2.0)]]}
    found = reported(runs)["methods"]["mixed"]
    assert found["qd_score"] == 2.0
    assert found["corrected_qd_score"] is found["failing"] is found["failing_interval"] is None
    assert found["curves"]["corrected_qd_score"][0]["mean"] == 1.0


def test_the_table_begins_with_the_most_failing_elites(capsys):
    counts = {"few": 3.0, "many": 20.0, "uncounted": None}
    runs = {
        name: [[row(1.0) if count is None else {**row(1.0, corrected=1.0), "failing": count}]]
        for name, count in counts.items()
    }
    show(reported(runs))
    lines = capsys.readouterr().out.splitlines()[-3:]
    assert [line.split() for line in lines] == [
        ["many", "1", "40", "5", "1", "20", "-"],
        ["few", "1", "40", "5", "1", "3", "-"],
        ["uncounted", "1", "40", "5", "-", "-", "-"],
    ]


def test_figure_has_a_line_a_method_and_panel_with_bands():
    runs = {
        name: [[{**rows[0], "elites": k + 1}, {**rows[1], "corrected_elites": k + 1}] for k, rows in enumerate(seeds)]
        for name, seeds in RUNS.items()
    }
    figure = draw_comparison(reported(runs))
    elites, corrected, failing = figure.axes
    assert [len(axes.lines) for axes in figure.axes] == [2, 2, 2]
    assert elites.lines[0].get_xydata().tolist() == [[40, 2], [80, 5]]
    assert corrected.lines[0].get_xydata().tolist() == [[80, 2]]
    assert failing.lines[0].get_xydata().tolist() == [[80, 1]]
    band = elites.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(2 - HALF)
    bar = corrected.collections[1].get_segments()[0]  # there one point alone shows its interval
    assert bar.tolist() == [[80, pytest.approx(2 - HALF)], [80, pytest.approx(2 + HALF)]]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["CMA-MAE", "hard-random"]
    assert "80 episodes a run, 3 seeds a method at most" in figure.get_suptitle()


def test_figure_of_one_seed_has_lines_without_bands(tmp_path):
    report = reported({name: seeds[:1] for name, seeds in RUNS.items()})
    curves = report["methods"]["cma_mae"]["curves"]
    assert curves["elites"][0] == {"mean": 5.0, "interval": None, "seeds": [5.0]}
    figure = draw_comparison(report)
    assert figure.axes[0].lines[0].get_xydata().tolist() == [[40, 5], [80, 5]]
    figure.savefig(tmp_path / "figure.png")


def test_every_method_has_a_look_of_its_own():
    assert LABELS.keys() == METHODS.keys()
    assert len({look[1:] for look in LABELS.values()}) == len(METHODS)


CERTIFIER = "me=tests.qd.run.test_arguments:fine_policy"


@contextmanager
def crossed_by_certifiers(cfg):
    """The stand-in; a certifier crosses everything."""

    def evaluate(genes, seeds, progress=None):
        result = stand_in.evaluate(genes, seeds, cfg.num_replicas)
        if cfg.policy == CERTIFIER.partition("=")[2]:
            never = np.zeros(result.invalid.shape, bool)
            return stand_in.make_result(result.penalties, base_collision=never)
        return result

    yield evaluate


def test_a_search_for_certified_failures_ends_with_as_many_episodes(capsys):
    changes = {"methods": ("mixed", "gated"), "certified_by": (CERTIFIER,), "iterations": 6, "seeds": 1}
    changes |= {"certify": True, "by": (CERTIFIER,), "open_evaluator": crossed_by_certifiers}
    path = run("a", **changes)
    report = numbers_of(path)
    mixed, gated = (report["methods"][name] for name in ("mixed", "gated"))
    # 4 emitters x 8 terrains x 4 episodes an iteration, and 10 a terrain that is not crossed
    assert mixed["iterations"] == [6] and mixed["episodes"] == 6 * 128 and mixed["certifier_episodes"] == 0
    done = gated["iterations"][0]
    assert done < 6 and gated["certifier_episodes"] > 0
    assert gated["episodes"] == done * 128 + gated["certifier_episodes"] > 5 * 128
    last = rows_of(path / "gated-5")[-1]
    assert gated["episodes"] - last["episodes"] - last["certifier_episodes"] <= 5 * 128
    curves = gated["curves"]
    assert len(curves["elites"]) == done and curves["terrains"][-1] == curves["corrected_at"][-1] == done * 32
    for method in (mixed, gated):  # the judge crosses all that fails
        assert method["faults"] == method["certified"] == method["confirmed"]
        assert 0 < method["faults"] <= method["failing"]
    assert report["panel"] == ["me"] and [*report["certified_by"]] == ["me"]
    confirmed = json.loads((path / "mixed-5" / "archive.json").read_text())["confirmed_by"]
    assert report["judged_by"] == {name: confirmed[name] for name in ("commit", "device", "versions")}
    assert "faults" in capsys.readouterr().out
    again = run("a", **{**changes, "open_evaluator": never})  # all of it is kept
    assert numbers_of(again) == report
    assert_same(path, run("b", **changes))
    other = f"C-G={Path(__file__).parents[3]}/results/anymal/C-G.pt"
    later = numbers_of(run("a", **{**changes, "by": (other,)}))
    assert later["panel"] == ["C-G"]  # who was asked before does not count
    for name in ("mixed", "gated"):
        found = read_archive(path / f"{name}-5")
        assert found.faults.certifiers == ("me", "C-G")
        by_other = found.confirmed & found.failing & found.faults.certificates()[:, 1]
        assert later["methods"][name]["faults"] == by_other.sum() < report["methods"][name]["faults"]


def test_a_certifier_may_be_moved_and_not_changed(tmp_path):
    own, moved = Path(__file__).parents[3] / "results" / "anymal" / "C-G.pt", tmp_path / "another place.pt"
    shutil.copy(own, moved)
    changes = {"methods": ("mixed", "gated"), "iterations": 2, "seeds": 1}
    report = numbers_of(run("a", certified_by=(f"C-G={own}",), **changes, open_evaluator=crossed_by_certifiers))
    assert numbers_of(run("a", certified_by=(f"C-G={moved}",), **changes, open_evaluator=never)) == report
    for another in (f"S={moved}", f"C-G={own.parent / 'panel' / 'S.pt'}"):
        with pytest.raises(ValueError, match="gated-5 holds a run of other settings: certifie"):
            run("a", certified_by=(another,), **changes, open_evaluator=never)


def test_gated_and_its_certifiers_need_each_other():
    for changes in ({"methods": ("gated",)}, {"certified_by": (CERTIFIER,)}):
        with pytest.raises(ValueError, match="gated and --certified-by need each other"):
            run("a", open_evaluator=never, **changes)
    assert not Path("a").exists()
