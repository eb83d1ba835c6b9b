"""Pages of evidence: what they say of a controller, what they refuse, and that a changed byte is found."""

import json
from pathlib import Path

import pytest

from qd.show.commands import ReportCommand
from qd.show.report.evidence import verify_evidence, write_evidence
from sim.files.command import run_command
from sim.robots.robot import ROBOTS, robot_identity

ABOUT = {
    **robot_identity(ROBOTS["anymal"]),
    "robot": "anymal",
    "command": "faultline x",
    "commit": "abc",
    "dirty": False,
}
ABOUT |= {"sources_sha256": "0" * 64, "device": "CPU", "seed": 0, "date": "2026-11-30", "versions": {"python": "3.11"}}


def write(name, **content):
    file = Path(name)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({**ABOUT, **content}))
    return file


def dose_row(value, low, controller="base", element="step_up"):
    rates = {"goal_rate": low + 0.02, "interval": [low, 1.0], "unit": "m"}
    return {"element": element, "parameter": "height", "value": value, "controller": controller, **rates}


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rates = {"goal_rate": 0.97, "goal_rate_interval": [0.95, 0.98], "terrains": 300}
    sizes = [dose_row(0.1, 0.95), dose_row(0.2, 0.93), dose_row(0.3, 0.5), dose_row(0.4, 0.95)]
    falling = [dose_row(value, low, element="friction") for value, low in ((0.4, 0.95), (0.2, 0.92))]
    controllers = {"base": {"sha256": "aa"}, "C-G": {"sha256": "bb"}}
    titles = {"step_up": "kerb", "friction": "level ground"}
    others = [dose_row(0.1, 0.2, "C-G"), dose_row(0.4, 0.2, "C-G", "friction")]
    dose = {"dose": [*sizes, *falling, *others], "titles": titles, "controllers": controllers, "resolved": False}
    search = {
        "reachable_cells": 9,
        "space": "super_gaussian+lag",
        "elites": 12,
        "failing": 3,
        "judged_by": {"fresh": {}},
    }
    return [
        write("numbers/rates.json", policy_sha256="aa", hand_crafted=rates, hard_random=rates, flat={}),
        write("numbers/dose.json", **dose),
        write("archive.json", policy_sha256="aa", **search),
    ]


def test_a_page_has_limits_of_use_where_each_number_comes_from_and_what_was_not_tested(files):
    page = write_evidence(files, out=Path("evidence.html"))
    evidence = json.loads(Path("evidence.json").read_text())
    limits = {
        row[0]: row[1] for part in evidence["parts"] if "Limits" in part["title"] for row in part["table"]["rows"]
    }
    assert limits["kerb, height"].startswith("up to 0.2 m: 0.950") and "last" not in limits["kerb, height"]
    assert limits["level ground, height"].startswith("down to 0.2 m, the last that was tried")
    untested = " ".join(evidence["not_tested"])
    assert "real robot" in untested and "no gate" in untested and "stairs_up" in untested and "mujoco_c" in untested
    assert "lag" not in evidence["not_tested"][-2].split("conditions: ")[1].split(", ")
    text = page.read_text()
    assert "faultline x" in text and "numbers/dose.json" in text and "0.970 (0.950 to 0.980)" in text
    assert verify_evidence(Path("evidence.sha256")) == 5


@pytest.mark.parametrize("name", ["evidence.html", "evidence.json", "numbers/dose.json"])
def test_a_changed_byte_is_found(files, name, capsys):
    write_evidence(files, out=Path("evidence.html"))
    content = bytearray(Path(name).read_bytes())
    content[-3] ^= 1
    Path(name).write_bytes(content)
    assert run_command(ReportCommand, ["--verify", "evidence.sha256"], name="report") == 2
    assert f"{name} was changed" in capsys.readouterr().err
    Path(name).unlink()
    with pytest.raises(ValueError, match=f"{name} is gone"):
        verify_evidence(Path("evidence.sha256"))


def test_evidence_is_about_one_controller(files):
    with pytest.raises(ValueError, match="bb"):
        write_evidence(files, controller="C-G")
    with pytest.raises(ValueError, match=r"other\.json"):
        write_evidence([*files, write("other.json", policy_sha256="aa")])
    with pytest.raises(ValueError, match="not shipped"):  # no code runs that only a file names
        write_evidence([write("evil.json", policy_sha256="aa", robot="evil.py", hand_crafted={})])
    with pytest.raises(ValueError, match="one controller"):
        write_evidence([write("none.json", policy_sha256=None, hand_crafted={})])
    with pytest.raises(ValueError, match="replace"):
        write_evidence(files, out=Path("archive.html"))
    assert not Path("numbers/evidence.html").exists()
    Path("list").write_text("no hashes\n")
    with pytest.raises(ValueError, match="SHA-256"):
        verify_evidence(Path("list"))
