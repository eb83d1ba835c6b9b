"""A map of one's own: rates and costs by hand, its files, and what is refused."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kernels.episode import Invalidity, Outcome
from qd.show.commands import Cross
from qd.show.cross import cross_map, numbers_of, read_own_terrain
from qd.show.crossed import crossed_of, penalties_by_place
from sim.files.command import run_command
from tests.qd.recordings import NAMES, recording_of


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_rates_of_ones_own_terrain_with_their_intervals():
    gray = np.zeros((81, 161), np.uint8)
    gray[:, 100:] = 200  # a wall of 2 m before the goal
    Image.fromarray(gray).save("wall.png")
    flags = "--terrain wall.png --size 16 8 --scale 0.01 --policy tests.sim.policies:stand --device cpu --episodes 4"
    assert run_command(Cross, flags.split(), name="cross") == 0
    stem = "runs/terrains/wall.png-anymal-tests.sim.policies-stand"
    report = json.loads(Path(f"{stem}.json").read_text())
    # It stands where it starts: no collision, no goal. Wilson of 4 of 4: 1 / (1 + 3.8415 / 4) = .5101
    assert report["rates"]["success"] == {"rate": 1.0, "hits": 4, "interval": [pytest.approx(0.5101, abs=1e-4), 1.0]}
    assert report["rates"]["goal"] == {"rate": 0.0, "hits": 0, "interval": [0.0, pytest.approx(0.4899, abs=1e-4)]}
    assert report["outcomes"] == {"goal": 0, "base_collision": 0, "time_out": 4, "out": 0, "invalid": 0}
    assert report["heights_m"] == [0.0, 2.0] and report["duration_s"] == 20.0
    # 20 s at rest against 0.75 m/s: 20 * 0.75^2
    assert report["penalties"]["vel_x"]["mean"] == pytest.approx(11.25, rel=0.1)
    keys = {"command", "commit", "device", "versions", "seed", "date", "policy_sha256", "terrain_sha256"}
    assert keys <= report.keys()
    assert Image.open(f"{stem}-paths.png").size[0] > 1000


def test_invalid_episodes_are_left_out_of_the_rates():
    ends = [Outcome.BASE_COLLISION, Outcome.GOAL, Outcome.INVALID]
    sums = np.repeat([[1.0], [3.0], [np.nan]], 6, axis=1)
    made = recording_of(ends, [4.0, 14.0, 3.0], penalties=sums, fallen=[False, False, True])
    made = dataclasses.replace(
        made, duration_s=np.array([[4.0, 16.0, 1.0]]), invalidity=np.array([[0, 0, Invalidity.SPEED]], np.uint8)
    )
    numbers = numbers_of(crossed_of(made, NAMES, (1.0,) * 6))
    assert {name: rate["hits"] for name, rate in numbers["rates"].items()} == {"success": 1, "goal": 1, "fallen": 0}
    assert numbers["penalties"]["vel_x"] == {"mean": 2.0, "std": 1.0, "unit": "(m/s)^2 s"}  # of 1 and 3
    assert numbers["duration_s"] == 10.0  # of 4 and 16
    assert (numbers["invalid_episodes"], numbers["invalid_reasons"]) == (1, {"speed": 1})


def test_crossings_in_numbers_by_hand():
    outcomes = [Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.BASE_COLLISION, Outcome.INVALID]
    sums = np.arange(24.0).reshape(4, 6)
    recording = recording_of(outcomes, [14.0, 5.0, 7.0, 3.0], penalties=sums, fallen=[False, True, False, True])
    crossed = crossed_of(recording, ("vel_x", "stumble"), (2.0, 4.0))
    assert crossed.chosen.tolist() == [0, 1, 2]
    assert crossed.scaled.tolist() == [[0.5, 1.0], [3.5, 2.5], [6.5, 4.0]]
    assert str(crossed.rates["reached the goal"]) == "1 of 3 (33%, 6 to 79%)"
    hits = {label: rate.hits for label, rate in crossed.rates.items()}
    assert hits == {"reached the goal": 1, "base collision": 2, "out of time": 0, "left the terrain": 0, "fallen": 1}
    np.testing.assert_allclose(crossed.ends[:, 0], [14.0, 5.0, 7.0])
    assert crossed.failed_at == pytest.approx(6.0)


def test_penalties_by_place_add_up():
    recording = recording_of([Outcome.GOAL, Outcome.TIME_OUT], [12.0, 2.0], penalties=np.full((2, 6), 10.0))
    edges = np.array([0.0, 3.0, 16.0])
    amounts = penalties_by_place(crossed_of(recording, NAMES, (1.0,) * 6), NAMES, edges)
    # the first robot makes a step of 0.5 m twenty times, of which one ends below x = 3; the second stays at 2
    np.testing.assert_allclose(amounts[:, 0], [(0.5 + 10.0) / 2, 9.5 / 2], rtol=1e-5)
    np.testing.assert_allclose(amounts.sum(axis=0), 10.0, rtol=1e-5)


def test_mistakes_are_refused_and_the_map_is_never_overwritten(anymal):
    for folder in ("a", "b"):  # two maps of one name have files of their own
        Path(folder).mkdir()
        np.savez(f"{folder}/hill.npz", heights=np.zeros((3, 5)))
        with pytest.raises(ValueError, match="size"):
            read_own_terrain(Path(folder) / "hill.npz")
        assert read_own_terrain(Path(folder) / "hill.npz", (16.0, 8.0)).name == f"{folder}-hill.npz"
    Image.fromarray(np.zeros((3, 5), np.uint8)).save("hill.png")
    Path("hill.json").write_text('{"scale_m": 0.01, "size_m": [16, 8]}')
    before = {path.name: path.read_bytes() for path in Path().glob("hill.*")}
    terrain = read_own_terrain(Path("hill.png"))
    with pytest.raises(ValueError, match="out"):
        cross_map(terrain, anymal, out=Path("hill.json"))
    with pytest.raises(ValueError, match=r"none\.pt"):
        cross_map(terrain, anymal, "none.pt")
    assert {path.name: path.read_bytes() for path in Path().glob("hill.*")} == before
    assert not list(Path().rglob("*-paths.png"))
