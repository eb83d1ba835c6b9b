"""How near test terrains are to what was trained on."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive
from sim.bank import heights_of
from train.evaluate.distances import Distances, distances
from train.evaluate.sets import split_elites

ARCHIVE = Path("results/cassie/archive")


def test_the_nearest_is_found_among_all_elites_trained_on():
    report = distances(Distances(robot="cassie", terrains=3))
    archive = read_archive(ARCHIVE)
    split = split_elites(archive, "cassie")
    held, trained = (heights_of(archive.genes[rows]).astype(np.float64) for rows in (split.test[:3], split.train))
    by_hand = [min(np.sqrt(((mine - other) ** 2).mean()) for other in trained) for mine in held]
    found = report["nearest_m"]["generated"]
    assert found["terrains"] == 3 and report["trained_on"] == len(split.train)
    assert found["median"] == pytest.approx(np.median(by_hand), rel=1e-4)
    assert (found["least"], found["largest"]) == pytest.approx((min(by_hand), max(by_hand)), rel=1e-4)
    far = report["nearest_m"]["generated_far"]
    assert far["terrains"] == 1 and far["median"] == pytest.approx(found["largest"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"terrains": 0}, "terrains must be at least 1"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"split_seed": -1}, "split_seed must be at least 0"),
        ({"robot": "anymal", "archive": ARCHIVE}, "got one of 'cassie'"),
    ],
)
def test_what_makes_no_sense_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        distances(Distances(**{"robot": "cassie", **settings}))


def test_the_command_writes_what_it_prints(tmp_path):
    def call(*flags):
        command = [sys.executable, "-m", "faultline", "distances", *flags]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    assert "--split-seed" in call("--help").stdout
    done = call("--robot", "cassie", "--terrains", "2", "--out", str(tmp_path / "distances.json"))
    assert done.returncode == 0 and "generated_far" in done.stdout
    assert json.loads((tmp_path / "distances.json").read_bytes())["nearest_m"]["generated"]["terrains"] == 2
    refused = call("--robot", "cassie", "--archive", str(tmp_path))
    assert refused.returncode == 2 and "no archive at" in refused.stderr and "Traceback" not in refused.stderr
