"""Pages and runs for the tests of the report."""

import dataclasses
import html
import json
import re

import numpy as np

from qd.search.archive import read_archive
from qd.search.settings import as_settings, preset
from qd.show.report import report
from sim.files.atomic import to_json
from sim.robots.find import get_robot
from tests.builders import fresh_values, small_archive, write_run
from tests.qd.recordings import stand_in_cross
from tests.qd.show.test_figures import rows


def grouped_archive(sizes=(6, 9, 5)):
    """Elites of three kinds: robots get stuck, collide, and arrive."""
    return dataclasses.replace(
        small_archive(sum(sizes)),
        goal_rate=np.repeat([0.0, 0.0, 1.0], sizes),
        collision_rate=np.repeat([0.0, 1.0, 0.0], sizes),
        fallen_rate=np.zeros(sum(sizes)),
    )


def text_of(content: bytes) -> str:
    """What a page shows, in one line."""
    words = re.sub(r"<(style|script)>.*?</\1>|<[^>]*>", " ", content.decode(), flags=re.DOTALL)
    return " ".join(html.unescape(words).split())


def make_run(root):
    """A whole run of 20 elites with fresh values."""
    archive = dataclasses.replace(grouped_archive(), iterations=4)
    archive = archive.corrected_by(fresh_values(archive))
    folder = write_run(root / "run", archive)
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows(4)))
    small = preset("small", get_robot("anymal"))
    fitness = dataclasses.replace(small.fitness, penalties=archive.penalties, scales=archive.scales)
    settings = as_settings(dataclasses.replace(small, fitness=fitness))
    origin = {"command": "python <script>alert(1)</script>", "commit": "abc", "device": "CPU", "seed": 0,
              "versions": {"numpy": "2"}, "date": "today"}  # fmt: skip
    (folder / "config.json").write_bytes(to_json({"settings": settings, "iterations": 4, "sessions": [], **origin}))
    return folder


def reporter(run, patch):
    """Makes a report in a folder without published tables; returns the page and what was crossed."""
    patch.chdir(run.parent)
    patch.setattr(report, "check_policy", lambda policy, robot, device: None)

    def make(**changes):
        crossed = []
        patch.setattr("qd.show.recordings.RecordingCrosser", lambda robot, device: stand_in_cross(crossed))
        return report.write_report(**{"run": run, "device": "cpu", "num_elites": 1, **changes}), crossed

    return make


def minimal_of(run, count=1):
    """The first failing elites of a run, each with its first part alone as the minimal terrain."""
    archive = read_archive(run)
    numbers = np.flatnonzero(archive.failing)[:count].tolist()
    np.savez(run / "minimal.npz", elite=np.array(numbers), genes=archive.genes[numbers])
    entries = [
        {"elite": n, "cell": int(archive.cell[n]), "iteration": int(archive.iteration[n]), "bumps": [0],
         "words": ["bump of <0.24> m"], "of": 2, "goal_rate": 0.0, "goal_interval": [0.0, 0.088],
         "cause": {"bump": 0, "kind": "rise"}, "margin_m": 0.12, "verdict": "failing"}
        for n in numbers
    ]  # fmt: skip
    (run / "minimal.json").write_bytes(to_json({"elites": entries}))
    return numbers, entries
