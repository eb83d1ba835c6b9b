"""Provenance, and files that are whole or absent."""

import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from sim.files.atomic import to_json, write_atomically
from sim.files.records import code_fingerprint, provenance


def test_provenance_has_its_keys(monkeypatch):
    monkeypatch.setenv("FAULTLINE_COMMIT", "abc123")
    origin = provenance("cpu", 7)
    assert list(origin) == ["command", "commit", "sources_sha256", "dirty", "device", "versions", "seed", "date"]
    assert origin["commit"] == "abc123" and origin["seed"] == 7
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", origin["date"])
    assert all(re.match(r"\d+\.", number) for number in origin["versions"].values())
    json.dumps(origin, allow_nan=False)


def test_commit_comes_from_git_otherwise(monkeypatch):
    monkeypatch.delenv("FAULTLINE_COMMIT", raising=False)
    commit = provenance("cpu", 0)["commit"]
    assert commit is None or re.fullmatch(r"[0-9a-f]{40}", commit)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    write_atomically(path, to_json({"x": 1}))
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_atomically(path, to_json({"x": float("nan")}))
    assert json.loads(path.read_text()) == {"x": 1}
    with pytest.raises(OSError, match="absent"):
        write_atomically(tmp_path / "absent" / "a", b"")
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_what_fits_a_line_takes_one_and_means_what_it_meant():
    content = {
        "a": [0.1, -2e-30, None], "b": [[1, 2], []], "c": ["[\n 1,  2]", "x" * 90, "\u00e9"],
        "e": [{"f": [3], "g": {}}],
        "many": [k / 7 for k in range(50)], 3: (True, ()), "deep": [{"name": "x" * 50, "rate": [0.5, 1.0]}] * 3,
    }  # fmt: skip
    text = to_json(content).decode()
    assert json.loads(text) == json.loads(json.dumps(content))
    rows = text.splitlines()
    assert {' "a": [0.1, -2e-30, null],', ' "e": [{"f": [3], "g": {}}],', ' "3": [true, []],'} <= set(rows)
    assert all(len(row) <= 120 for row in rows if not row.startswith(' "many": ['))
    assert sum(row.startswith('  {"name": ') for row in rows) == 3 and rows[-1] == "}"


@pytest.mark.parametrize("content", [{(1, 2): 3}, {"a": np.zeros(2)}, {"a": {1, 2}}])
def test_what_json_does_not_know_is_refused(content):
    with pytest.raises(TypeError):
        to_json(content)


def test_a_fingerprint_follows_the_code(monkeypatch, tmp_path):
    monkeypatch.setattr("sim.files.records._ROOT", tmp_path)
    for room in ("one", "two"):
        (tmp_path / room).mkdir()
        (tmp_path / room / "a.py").write_text("x = 1")
    before = code_fingerprint(["one"])
    (tmp_path / "two" / "a.py").write_text("x = 2")
    (tmp_path / "one" / "notes.txt").write_text("nothing that runs")
    assert code_fingerprint(["one"]) == before != code_fingerprint(["one", "two"])
    (tmp_path / "one" / "robot.xml").write_text("<mujoco/>")
    with_robot = code_fingerprint(["one"])
    monkeypatch.setattr("sim.files.records.versions", lambda: {"torch": "0"})
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
