"""Settings by annotation, provenance, files that are whole or absent, intervals by hand, and figures."""

import io
import json
import math
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.special import ndtr, stdtrit

from sim.files.atomic import read_json, to_json, write_atomically
from sim.files.figures import as_png, new_figure
from sim.files.intervals import DIFFERENCES, RATES, bootstrap_interval, format_rate, format_value, wilson_interval
from sim.files.npz import array_names, check_shapes, npz_bytes, read_arrays
from sim.files.provenance import code_fingerprint, provenance
from sim.files.settings import Interval, NonNegativeFloat, PositiveInt, Share, check_settings, from_builtins, problems


@dataclass(frozen=True, kw_only=True)
class Inner:
    share: Share = 0.5
    span: Interval = (0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Outer:
    count: PositiveInt = 1
    length: float = 0.0
    maybe: NonNegativeFloat | None = None
    names: tuple[str, ...] = ()
    gains: tuple[NonNegativeFloat, ...] | None = None
    file: Path = Path("x")
    inner: Inner = field(default_factory=Inner)


def test_values_within_their_ranges_pass_and_all_problems_are_named_at_once():
    inner, gains = Inner(share=1, span=(2.0, 2.0)), (0.0, np.float64(2.0))
    check_settings(Outer(count=3, length=np.float64(2), maybe=0.0, names=("a",), gains=gains, inner=inner))
    wrong = Outer(count=0, length=math.inf, gains=(1.0, math.nan), inner=Inner(share=2.0, span=(1.0, 0.0)))
    named = [line.partition(" = ")[0] for line in problems(wrong)]
    assert named == ["count", "length", "gains", "inner.share", "inner.span"]
    with pytest.raises(ValueError, match=r"count = 0: .*; inner = 3: "):
        check_settings(Outer(count=0, inner=3))


def test_settings_come_back_from_json():
    inner = {"share": 0, "span": [1, 2]}
    values = {"count": 2, "length": 3, "names": ["a"], "file": "y", "inner": inner, "maybe": None}
    settings = from_builtins(Outer, values, "outer")
    assert settings == Outer(count=2, length=3, names=("a",), file=Path("y"), inner=Inner(share=0, span=(1, 2)))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        (7, "outer"),
        ({"inner": {"colour": 3}}, r"inner\.colour.* share, span"),
        ({"inner": {"span": [1, "a"]}}, r"inner\.span\[1\]"),
        ({"count": 0}, "count"),
        ({"maybe": "x"}, "maybe"),
        ({"inner": {"span": [2, 1]}}, "span"),
    ],
    ids=str,
)
def test_what_json_holds_is_checked(values, field):
    with pytest.raises(ValueError, match=field):
        from_builtins(Outer, values, "outer")


def test_provenance_has_its_keys(monkeypatch):
    monkeypatch.setenv("FAULTLINE_COMMIT", "abc123")
    origin = provenance("cpu", 7)
    assert list(origin) == ["command", "commit", "sources_sha256", "dirty", "device", "versions", "seed", "date"]
    assert origin["commit"] == "abc123" and origin["seed"] == 7
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", origin["date"])
    assert all(re.match(r"\d+\.", number) for number in origin["versions"].values())
    json.dumps(origin, allow_nan=False)
    monkeypatch.delenv("FAULTLINE_COMMIT")
    assert re.fullmatch(r"[0-9a-f]{40}|None", str(provenance("cpu", 0)["commit"]))


def test_json_comes_back_and_a_failed_write_leaves_the_old_file(tmp_path):
    content = {"a": [0.1, -2e-30, None], "b": {"c": "\u00e9", "d": [[1, 2], []]}}
    write_atomically(tmp_path / "a.json", to_json(content))
    with pytest.raises(ValueError, match="JSON"):
        write_atomically(tmp_path / "a.json", to_json({"x": float("nan")}))
    assert read_json(tmp_path / "a.json") == content
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write_atomically(tmp_path / "folder", b"")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.json", "folder"]


@pytest.mark.parametrize("text", ["{", "[1]", '{"a": NaN}', "\xff", "[" * 100_000])
def test_what_is_no_json_object_is_refused(tmp_path, text):
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=r"a\.json"):
        read_json(tmp_path / "a.json")
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "b.json")


def test_a_fingerprint_follows_the_code(monkeypatch, tmp_path):
    monkeypatch.setattr("sim.files.provenance.ROOT", tmp_path)
    for room in ("one", "two"):
        (tmp_path / room).mkdir()
        (tmp_path / room / "a.py").write_text("x = 1")
    before = code_fingerprint(["one"])
    (tmp_path / "two" / "a.py").write_text("x = 2")
    (tmp_path / "one" / "notes.txt").write_text("nothing that runs")
    assert code_fingerprint(["one"]) == before != code_fingerprint(["one", "two"])
    (tmp_path / "one" / "robot.xml").write_text("<mujoco/>")
    with_robot = code_fingerprint(["one"])
    monkeypatch.setattr("sim.files.provenance.versions", lambda: {"torch": "0"})
    assert len({before, with_robot, code_fingerprint(["one"])}) == 3


def test_the_command_recorded_is_the_one_to_type(monkeypatch, tmp_path):
    def recorded(name, *argv):
        monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__spec__=SimpleNamespace(name=name)))
        monkeypatch.setattr(sys, "argv", ["x", *argv])
        return provenance("cpu", 1)["command"]

    assert recorded("tests.kills.__main__", "--seed", "1") == "python -m tests.kills --seed 1"
    monkeypatch.chdir(tmp_path)
    given = ("bench", "--out", str(tmp_path / "a" / "b.json"), "--run=/home/me/runs/x")
    assert recorded("faultline", *given) == "faultline bench --out a/b.json --run=x"


def test_arrays_are_read_by_name_and_their_shapes_agree(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(npz_bytes({"a": np.zeros((2, 3)), "b": np.arange(3)}))
    arrays = read_arrays(path, ["a", "b"])
    assert sorted(array_names(path)) == ["a", "b"] and arrays["b"].tolist() == [0, 1, 2]
    check_shapes(arrays, {"a": ("rows", "columns"), "b": ("columns",), "absent": (7,)})
    for shapes in ({"a": ("n", "n")}, {"a": ("n",)}, {"b": ("n",), "a": ("n", 3)}, {"b": (4,)}):
        with pytest.raises(ValueError, match=r"[ab] must have shape"):
            check_shapes(arrays, shapes)
    with pytest.raises(ValueError, match="c"):
        read_arrays(path, ["a", "c"])
    with pytest.raises(ValueError, match="a of "):
        read_arrays(path, ["a", "b"], max_bytes=160)


def test_wilson_interval_by_hand():
    # 10 of 20: centre 0.5, half width 1.96 sqrt(0.0125 + 0.0480) / (1 + 0.192) = 0.2007 (Wilson 1927).
    np.testing.assert_allclose(wilson_interval(10, 20), [0.2993, 0.7007], atol=1e-4)
    # 0 of 20: from 0 to z^2 / (n + z^2) = 3.841 / 23.841.
    np.testing.assert_allclose(wilson_interval(0, 20), [0.0, 0.1611], atol=1e-4)
    assert wilson_interval(20, 20)[1] == 1.0 and wilson_interval(0, 0) == (0.0, 1.0)
    for hits, count in ((3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="hits"):
            wilson_interval(hits, count)


def test_rates_and_values_as_text():
    assert format_rate(3, 4) == "3 of 4 (75%, 30 to 95%)"
    assert format_rate(3, 4, short=True) == "75% (30 to 95%)"
    assert format_rate(0, 0) == "no valid episode"
    assert format_value(0.012, (-0.1, 0.1), "+.2f") == "+0.01 (-0.10 to +0.10)"
    assert format_value(2.0, None, ".1f") == "2.0"
    assert format_value(None, None) == "-"


def test_the_bootstrap_resamples_terrains_or_families():
    values, rng = np.random.default_rng(1).random(80), np.random.default_rng(3)
    means = [values[rng.integers(80, size=80)].mean() for _ in range(10_000)]
    tail = ndtr(-stdtrit(79, 0.975) * np.sqrt(80 / 79))  # .0222: 80 families are a sample, too
    assert bootstrap_interval(values, 3) == pytest.approx(np.quantile(means, [tail, 1 - tail]).tolist(), abs=1e-12)
    assert bootstrap_interval(values, 4) != pytest.approx(bootstrap_interval(values, 3), abs=1e-6)
    # Two families of three and one terrain, drawn together: a mean of all is 0, 3/4 or 1.
    assert bootstrap_interval(np.array([1.0, 1.0, 1.0, 0.0]), 0, families=np.array([5, 5, 5, 7])) == [0.0, 1.0]
    assert bootstrap_interval(np.array([0.4]), 0) is None
    assert bootstrap_interval(np.array([0.2, 0.9]), 0, families=np.array([5, 5])) is None


@pytest.mark.parametrize("colours", [None, "viridis"])
def test_lines_have_few_colours_and_maps_all(colours):
    figure = new_figure(3.0, 2.0)
    heights = np.random.default_rng(0).random((20, 20))
    axes = figure.subplots()
    axes.imshow(heights, cmap=colours) if colours else axes.plot(heights, alpha=0.5)
    image = Image.open(io.BytesIO(as_png(figure))).convert("RGB")
    assert image.size == (450, 300) and image.getpixel((1, 1)) == (255, 255, 255)
    assert (len(image.getcolors(10**6)) <= 256) == (colours is None)


@pytest.mark.parametrize(("share", "families"), [(0.003, 300), (0.1, 300), (0.5, 6)])
@pytest.mark.slow
def test_intervals_of_rates_cover_what_is_rare_and_what_few_families_say(share, families):
    # A share of the terrains stops half of the episodes, the others stop none.
    rng, covered, repetitions = np.random.default_rng(5), 0, 200
    for _ in range(repetitions):
        rates = rng.binomial(20, np.where(rng.random(families) < share, 0.5, 1.0)) / 20
        low, high = bootstrap_interval(rates, 0, bounds=RATES)
        covered += low <= 1.0 - share / 2 <= high
    assert covered >= 0.92 * repetitions


def test_where_all_rates_are_alike_the_interval_is_wilsons():
    assert bootstrap_interval(np.ones(300), 0, bounds=RATES) == pytest.approx(wilson_interval(300, 300))
    assert bootstrap_interval(np.zeros(300), 0, bounds=RATES) == pytest.approx(wilson_interval(0, 300))
    low, high = bootstrap_interval(np.zeros(300), 0, bounds=DIFFERENCES)
    assert -low == high == pytest.approx(wilson_interval(0, 300)[1])
    few = np.zeros(300)
    few[:9] = 0.5  # of nine families, each a gain
    least, most = bootstrap_interval(few, 0, bounds=DIFFERENCES)
    assert least < bootstrap_interval(few, 0)[0] and most > few.mean() + 0.01
    few[9] = 0.5
    assert bootstrap_interval(few, 0, bounds=DIFFERENCES) == bootstrap_interval(few, 0)
