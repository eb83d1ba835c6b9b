"""Runs every command of README and docs/ once, small, on the CPU: ``python -m tests.run_docs``; some 20 minutes.

It works in a folder of its own with a copy of results/, and says which commands it leaves out and why. ``--only WORD
...`` runs those of some words, after the runs that the pages go on with. Name what a word needs too: a search
of a robot of one's own is ``--only train calibrate archive``.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from faultline import COMMANDS
from qd.archive import ARCHIVE_FILE, read_archive, write_archive
from qd.fitness import FAILING_GOAL_RATE
from tests.builders import fresh_values
from tests.docs import PAGES, ROOT, Line, code_of, commands_of, run_by_make
from tests.sim.dogs import write_dog

CPU = {"--device": "cpu"}
HARD = "runs/anymal-hard"
"""A run of some elites that fail, from the published archive: a search as small as the others finds none."""
CERTIFIER = "C-G=results/anymal/C-G.pt"
NUM_HARD = 1
ON_HARD: dict[str, str | None] = {**CPU, "--workers": "2", "--run": HARD}
JUDGING = ("reevaluate", "confirm", "certify", "minimise", "pack")
"""Words that are run before all others, in this order, since pages show what they leave before they show them."""
SMALL: dict[str, dict[str, str | None]] = {
    "archive": {
        **CPU,
        "--preset": "small",
        "--scheduler.emitters": "2",
        "--scheduler.batch-size": "6",
        "--iterations": "2",
        "--replicas": "2",
        "--workers": "2",
    },
    "reevaluate": {**CPU, "--workers": "2"},
    "confirm": {**ON_HARD, "--mujoco-c": "0"},
    "certify": {**ON_HARD, "--by": CERTIFIER},
    "minimise": {**ON_HARD, "--elite": "0", "--how": "greedy", "--certify": None},
    "pack": {**ON_HARD, "--controllers": CERTIFIER, "--episodes": "2"},
    "evaluate": {**CPU, "--terrains": "6", "--episodes": "2", "--workers": "2"},
    "dose": {
        **CPU,
        "--terrains": "1",
        "--episodes": "2",
        "--workers": "2",
        "--elements": "ditch",
        "--values": None,
        "--at": None,
    },
    "cross": {**CPU, "--episodes": "2"},
    "replay": {**CPU, "--replicas": "2"},
    "view": {"--port": "8765"},
    "report": {**CPU, "--elites": "1", "--episodes": "2"},
    "film": {**CPU, "--replicas": "2", "--no-shadows": "", "--elite": "0"},
    "export": {"--elite": "0"},
    "train": {**CPU, "--num-envs": "8", "--iterations": "2"},
    "finetune": {**CPU, "--iterations": "2"},
    "harden": {
        **CPU,
        "--workers": "2",
        "--rounds": "1",
        "--run-dir": "runs/anymal-hardened",
        "--search-episodes": "48",
        "--scheduler.emitters": "1",
        "--scheduler.batch-size": "6",
        "--replicas": "2",
        "--tune-iterations": "2",
        "--terrains": "4",
        "--episodes": "2",
        "--by": CERTIFIER,
    },
    "export-policy": {},
    "stand": {**CPU, "--drops": "2"},
    "calibrate": {**CPU, "--terrains": "20", "--most-terrains": "20", "--replicas": "4", "--workers": "2"},
    "compare": {**CPU, "--preset": "small", "--iterations": "1", "--seeds": "1", "--workers": "2"},
    "ablation": {**CPU, "--preset": "small", "--iterations": "2", "--workers": "2"},
    "beside": {},
    "penalty-ratios": {**CPU, "--terrains": "2", "--replicas": "4"},
    "agreement": {**CPU, "--terrains": "2", "--elites": "1", "--episodes": "2", "--mujoco-c": "1", "--workers": "1"},
    "distances": {},
    "tables": {"--check": ""},
}
"""What makes a command small, in place of the page's own values: an empty value is a bare flag, None takes one away."""
CHANGED: dict[str, dict[str, str | None]] = {
    "--workers ray": {"--workers": "ray:2"},
    "--resume runs/anymal-1": {
        "--iterations": "3",
        "--preset": None,
        "--replicas": None,
        "--scheduler.emitters": None,
        "--scheduler.batch-size": None,
    },
    "--resume runs/anymal-generated-1": {"--iterations": "3"},
    "--genes": {"--terrains": None},
    "--mujoco-c 60": {"--mujoco-c": "1", "--terrains": "2"},
    "--recording": {"--replicas": None, "--elite": None},
    "--certificate": {"--run": HARD, "--replicas": None},
    "--only uncertified": {"--archive": HARD},
    "--pack anymal": {"--pack": "runs/anymal-pack"},
    "--terrain": {"--elite": None},
    "calibrate --robot mine/dog.py": {"--policy": "mine/kick.py:act"},  # one that two iterations train touches nothing
}
"""What differs where a command has these words."""
LEFT_OUT = {
    "faultline harden .* --against": "trains and searches three times as much",
    "faultline bench": "compiles torch kernels for minutes; tests/sim/bench runs it small",
    "faultline train-speed": "measures a GPU",
    "faultline solver-options": "measures a GPU",
    "faultline train --robot anymal": "by torchrun, needs several GPUs",
    "make test": "runs tests",
    "make lint": "checks style",
    "make setup": "installs",
}
"""Why commands that match so from their beginning are not run."""


KICK = """import torch


def act(observation):
    kick = torch.tensor([3.0, -3.0] * 4, device=observation.device)
    return kick * torch.sign(observation[:, 6:7] + 1e-3)  # to the other side as the base tilts
"""
"""A controller whose robot collides, so that each penalty has a scale."""


def prepare(folder: Path) -> None:
    """What the pages take for granted: robot, controllers, a map, and runs."""
    for name in ("results", "docs"):
        shutil.copytree(ROOT / name, folder / name)
    write_dog(folder / "mine")
    (walk,) = [code for code in code_of("README.md", "python") if "def act" in code]
    (folder / "mine" / "walk.py").write_text(walk)
    (folder / "mine" / "kick.py").write_text(KICK)
    (ridges,) = code_of("docs/own-space.md", "python")
    (folder / "mine" / "ridges.py").write_text(ridges)
    for name in ("mine/model.pt", "a.pt", "b.pt", "c.pt"):
        shutil.copy(ROOT / "results" / "anymal" / "C-G.pt", folder / name)
    Image.fromarray(np.tile(np.linspace(0, 200, 64, dtype=np.uint8), (32, 1))).save(folder / "hill.png")
    published = folder / "results" / "anymal" / "archive"
    shutil.copytree(published, folder / HARD)
    archive = read_archive(published)
    failing = np.flatnonzero(archive.goal_rate < FAILING_GOAL_RATE)
    hard = archive.rows(failing[:NUM_HARD])  # the episodes of the search stand for fresh ones, which take long
    write_archive(folder / HARD / ARCHIVE_FILE, replace(hard, fresh=fresh_values(hard)))


def first_commands() -> list[list[str]]:
    """The runs that the pages go on with."""
    return [
        ["archive", "--robot", "anymal", "--run-dir", "runs/anymal-1", "--seed", "1"],
        ["film", "--robot", "anymal", "--run", "runs/anymal-1"],
        ["finetune", "--robot", "anymal", "--run-dir", "runs/anymal-generated-1"],
    ]


def small(words: list[str]) -> list[str]:
    """A command with the values that make it small."""
    flags = dict(SMALL[words[0]])
    for given, other in CHANGED.items():
        if given in " ".join(words):
            flags.update(other)
    kept, skips = [words[0]], False
    for word in words[1:]:
        skips = word in flags if word.startswith("--") else skips
        if not skips:
            kept.append(word)
    return kept + [part for flag, value in flags.items() if value is not None for part in (flag, value) if part]


def run(words: list[str], folder: Path) -> str:
    """Runs a command in a folder; returns what was wrong, or nothing."""
    command = [sys.executable, "-m", "faultline", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with (folder / "log.txt").open("w+") as log:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=subprocess.STDOUT)
        try:
            status = process.wait(timeout=30 if words[0] == "view" else 1200)
        except subprocess.TimeoutExpired:
            process.terminate()
            status = process.wait()
            status = 0 if words[0] == "view" and status in (0, 130) else status
        log.seek(0)
        text = log.read()
    return "" if status == 0 else f"exit status {status}: {text.strip()[-1500:]}"


def faultline_words(line: Line) -> list[str]:
    """The words after ``faultline``, of a make target those that it calls."""
    return (run_by_make(line.words) if line.words[0] == "make" else list(line.words))[1:]


def main() -> int:
    """Runs them all; returns the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=(), metavar="WORD", help="words to run; all if left out")
    only = parser.parse_args().only
    lines = {str(line): line for page in PAGES for line in commands_of(page)}
    left = {name: why for name in lines for pattern, why in LEFT_OUT.items() if re.match(pattern, name)}
    shown = [faultline_words(line) for name, line in lines.items() if name not in left]
    jobs = first_commands() + sorted(shown, key=lambda words: [*JUDGING, words[0]].index(words[0]))
    unnamed = {word for group in COMMANDS.values() for word in group} - {words[0] for words in jobs}
    unnamed -= {name.split()[1] for name in left}
    assert not unnamed, f"no page shows {', '.join(sorted(unnamed))}"
    failed, done, start = 0, set(), time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        prepare(folder := Path(name))
        for number, words in enumerate(map(small, jobs)):
            if str(words) in done or (only and words[0] not in only and number >= len(first_commands())):
                continue
            done.add(str(words))
            if words[0] == "beside":
                for copy in ("a", "b", "anymal-2"):
                    shutil.copytree(folder / "runs" / "anymal-1", folder / "runs" / copy, dirs_exist_ok=True)
            began = time.monotonic()
            wrong = run(words, folder)
            failed += bool(wrong)
            print(f"{'FAILED' if wrong else 'ok':<7}{time.monotonic() - began:5.0f} s  {' '.join(words)}", flush=True)
            if wrong:
                print(wrong, flush=True)
    for command, why in left.items():
        print(f"left out        {command}: {why}")
    minutes = (time.monotonic() - start) / 60
    print(f"{len(done)} commands run in {minutes:.0f} minutes, {failed} failed, {len(left)} left out")
    return failed


if __name__ == "__main__":
    sys.exit(main())
