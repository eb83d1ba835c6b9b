"""What the timing of the search refuses, before anything is timed; the timing itself needs a GPU."""

from dataclasses import replace
from pathlib import Path

import pytest

from qd.run.directory import RunDirectory
from qd.studies import scale
from qd.studies import speed as speed_module
from qd.studies.scale import Scale
from qd.studies.speed import Speed, read_iterations, search_share, time_iterations, wide_numbers
from tests.qd.searches import CFG, make_job, run
from tests.qd.stand_in import open_stand_in

SHIPPED_RUN = Path(__file__).parents[3] / "results" / "anymal" / "archive"


def fail(*_):
    raise ZeroDivisionError


@pytest.mark.parametrize("out", ["/proc/nowhere/speed.json", "{folder}"])
@pytest.mark.parametrize(("module", "command"), [(speed_module, Speed), (scale, Scale)])
def test_where_to_write_is_tried_before_the_timing(tmp_path, monkeypatch, module, command, out):
    monkeypatch.setattr(module, "measure", fail)
    with pytest.raises(ValueError, match=r"cannot write to|is a directory"):
        command(device="cpu", out=tmp_path if out == "{folder}" else Path(out)).execute()


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (Speed(iterations=0), "iterations must be at least 1, got 0"),
        (Speed(steps=0), "steps must be at least 1, got 0"),
        (Speed(curve=(1024, 0)), r"curve must be at least 1, got \(1024, 0\)"),
        (Scale(counts=(2, 1)), "counts must be numbers of workers that rise"),
        (Scale(counts=(0, 1)), "counts must be at least 1"),
        (Scale(rounds=0), "rounds must be at least 1, got 0"),
    ],
)
def test_numbers_that_make_no_sense_are_refused_before_the_timing(command, says):
    with pytest.raises(ValueError, match=says):
        command.execute()


def test_a_run_of_another_device_is_not_timed_against_this_one(tmp_path):
    with pytest.raises(ValueError, match="was made on NVIDIA H200, the rates beside it would be those of NVIDIA H100"):
        read_iterations(SHIPPED_RUN, 5, "NVIDIA H100")
    run(tmp_path / "run", iterations=4)
    here = RunDirectory(tmp_path / "run").read_config()["device"]
    cfg, metrics, terrains = read_iterations(tmp_path / "run", 2, here)
    assert ([row["iteration"] for row in metrics], len(terrains)) == ([3, 4], cfg.scheduler.num_terrains)


def test_a_wide_run_is_told_in_numbers(tmp_path):
    run(tmp_path, iterations=3)
    with pytest.raises(ValueError, match="must be a run of preset wide, got one of"):
        wide_numbers(tmp_path, "any")
    with pytest.raises(ValueError, match=r"--wide .* was made on NVIDIA H200"):
        wide_numbers(SHIPPED_RUN, "NVIDIA H100")
    found = wide_numbers(SHIPPED_RUN, "NVIDIA H200")
    assert found["iterations"] == 123 and found["search_share"] is None  # it was made before that was counted


def test_a_search_is_timed_from_its_start(monkeypatch):
    monkeypatch.setattr(speed_module, "open_evaluator", open_stand_in)
    cfg = replace(CFG, iterations=2)
    metrics, terrains = time_iterations(cfg, make_job(Path("unused")).evaluator)
    assert len(metrics) == 2 and len(terrains) == cfg.scheduler.num_terrains
    shares = sorted(row["search_s"] / row["wall_s"] for row in metrics)
    assert shares[0] > 0.0 and shares[1] < 1.0 and search_share(metrics) == sum(shares) / 2
