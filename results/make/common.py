"""What the scripts share: their five flags, the file that each writes, and means over seeds with their intervals."""

import argparse
import filecmp
import json
import os
import queue
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels.episode import Outcome
from qd.faults.judge import judge
from qd.search.archive import Archive
from qd.search.directory import RunDirectory, read_archive_of
from qd.search.loop import search
from qd.search.settings import SearchCfg, preset
from qd.workers.evaluator import Compute
from sim.controllers.spec import controller_identity
from sim.device import resolve_device
from sim.files.atomic import prepare_output, read_json, to_json, write_atomically
from sim.files.intervals import DIFFERENCES, bootstrap_interval, t_interval
from sim.files.provenance import provenance, sources_sha256
from sim.rates import counted_episodes, terrain_means
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.terrains.conditions.base import CONDITIONS

SEEDS = (0, 1, 2)
"""Seeds of everything that is done several times."""
ONCE = {"replicas": 20, "batch_size": 20, "again": 0, "candidates": 20}
"""Changes of preset wide: each terrain is crossed once, in the paper's 20 episodes."""
CURVE_FILE = "curve.json"
"""File of a run: counts after each step of its search."""
PAPER_SIZE = {**ONCE, "emitters": 10, "groups": 1}
"""Changes of preset wide: the paper's iterations, of ten emitters and 20 terrains each."""


@dataclass(frozen=True, kw_only=True)
class Script:
    """One script at work: for which robot, where, and which file it writes."""

    robot: RobotCfg
    device: str
    seed: int
    small: bool
    """Whether this is a trial on a CPU, of a minute or so, whose numbers mean nothing."""
    out: Path
    origin: dict[str, Any]
    """Where the numbers come from, as every file says it: with robot and controller, and whether it is a trial."""
    parts: tuple[str, ...] = ()
    """Those asked for, of a script that has parts; none is all."""

    @property
    def policy(self) -> str:
        """The robot's shipped controller."""
        return str(self.robot.policy_file)

    @property
    def compute(self) -> Compute:
        """Where terrains are crossed."""
        return Compute(self.device)

    @property
    def results(self) -> Path:
        """Folder of the robot's published files."""
        return Path("results") / self.robot.name

    @property
    def runs(self) -> Path:
        """Folder for the robot's runs that are not published."""
        return self.out.parent / "runs" if self.small else runs_of_today() / self.robot.name

    def search_cfg(self, iterations: int | None = None, *, episodes: int | None = None, **changes: Any) -> SearchCfg:
        """Settings of a search of preset wide; in a trial of four terrains, which no specialist can be trained on.

        Args:
            iterations: As many as make ``episodes``, if these are given; else the preset's if None.
            episodes: Rounded to whole iterations.
            changes: Of its settings or its scheduler's, by name, and ``policy`` and ``space``.
        """
        named = {name: changes.pop(name) for name in ("policy", "space") if name in changes}
        cfg = preset("small" if self.small else "wide", self.robot, **named)
        of_scheduler = {name: changes.pop(name) for name in list(changes) if hasattr(cfg.scheduler, name)}
        if self.small:
            iterations, of_scheduler = 1, {**of_scheduler, "emitters": 2, "batch_size": 2, "groups": 1}
            changes["replicas"] = 1
        cfg = replace(cfg, scheduler=replace(cfg.scheduler, **of_scheduler), **changes)
        if episodes is not None:
            (iterations,) = self.iterations_of(cfg, episodes)
        return replace(cfg, iterations=iterations or cfg.iterations)

    def iterations_of(self, cfg: SearchCfg, *episodes: int) -> list[int]:
        """Whole iterations of a search that make so many episodes, each as near as can be; one in a trial."""
        return [1] if self.small else [round(count / cfg.episodes_per_iteration) for count in episodes]

    def publish(self, run: Path, folder: Path, patterns: Sequence[str]) -> None:
        """Copies files of a run into a folder of what is published; of another archive it takes away what it lacks."""
        of_another = not is_same_file(run / "archive.npz", folder / "archive.npz")
        for old in (file for pattern in patterns for file in folder.glob(pattern) if of_another):
            if not (run / old.relative_to(folder)).exists():
                old.unlink()
        for file in (file for pattern in patterns for file in run.glob(pattern)):
            target = folder / file.relative_to(run)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)

    def read_archive(self, name: str = "archive") -> Archive:
        """A published archive of archive.py; in a trial too."""
        return read_archive_of(self.robot, self.results / name)

    def read_dose(self, *, conditions: bool) -> list[dict[str, Any]]:
        """The base's rows of dose.json beside the file, of conditions or of obstacles; in a trial none without it."""
        file = self.out.with_name("dose.json")
        content = read_alike(file, self.origin, "sources_sha256", "seed", "robot_sha256", "penalty_definition")
        if not content and not self.small:
            raise ValueError(f"{file} must be of today's sources: run results.make.dose first")
        rows = [row for row in content.get("dose", ()) if row["controller"] == "base"]
        return [row for row in rows if (row["parameter"] in CONDITIONS) == conditions]

    def run_of_archive(self, name: str = "archive") -> Path:
        """The run of a published archive to work in; a copy of what is published where the run itself is gone."""
        run, published = self.runs / name, self.results / name
        if self.small or not is_same_file(run / "archive.npz", published / "archive.npz"):
            run = self.runs / "copy" / name
            if not all(
                is_same_file(run / file, published / file) for file in ("archive.npz", "archive.json", "config.json")
            ):
                shutil.rmtree(run, ignore_errors=True)
                shutil.copytree(published, run)
        return run

    def read_so_far(self, file: Path, *alike: str) -> dict[str, Any]:
        """What a file says if today's sources made it of this robot, controller and seed, or in a trial; else nothing.

        ``alike`` are further names of its origin that must be as they are now.
        """
        names = ("sources_sha256", "small", "seed", "robot_sha256", "penalty_definition", "policy_sha256", *alike)
        return read_alike(file, self.origin, *names)

    def write(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Writes the file, with its origin first, and prints it without that; returns its content."""
        print(json.dumps(numbers, indent=1)[:4000])
        return self.add(self.origin, numbers)

    def add(self, report: Mapping[str, Any], numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Writes a report with numbers behind it, unless the sources have changed meanwhile; returns its content."""
        if sources_sha256() != self.origin["sources_sha256"]:
            raise RuntimeError("the sources were changed meanwhile: leave them as they are, and measure again")
        content = {**report, **numbers}
        write_atomically(self.out, to_json(content))
        print(f"Written to {self.out}.")
        return content


def follow_search(
    script: Script,
    run: Path,
    cfg: SearchCfg,
    points: Sequence[int],
    counts: Sequence[str],
    last_stages: Sequence[str] = ("fresh",),
) -> list[dict[str, Any]]:
    """Extends a search to so many iterations one by one, and lets its elites cross fresh episodes after each.

    Returns ``counts`` of each point, which the run's curve.json keeps: what is in it is not searched again. At the last
    point it is judged by ``last_stages``.
    """
    rows = {row["iterations"]: row for row in script.read_so_far(run / CURVE_FILE).get("curve", [])}
    for iterations in points:
        if iterations not in rows:
            search(replace(cfg, iterations=iterations), run, script.compute)
            judge(run, stages=last_stages if iterations == points[-1] else ("fresh",), compute=script.compute)
            numbers = RunDirectory(run).read_summary()
            rows[iterations] = {"iterations": iterations, **{count: numbers.get(count) for count in counts}}
            write_atomically(run / CURVE_FILE, to_json({**script.origin, "curve": [*rows.values()]}))
    return [rows[iterations] for iterations in points]


def is_same_file(first: Path, second: Path) -> bool:
    """Whether two files are there and alike."""
    return first.exists() and second.exists() and filecmp.cmp(first, second, shallow=False)


def file_name(words: str) -> str:
    """Words as a name of a file or folder."""
    return re.sub(r"\W+", "-", words)


def run_parts(words: Sequence[str], parts: Sequence[str], at_once: int) -> None:
    """Runs a script's parts, ``at_once`` on each GPU, each in a process of its own with a log under runs/make/logs.

    ``words`` are the script's command line without its flags on parts. A RuntimeError names the parts that failed.
    """
    module, logs = sys.modules["__main__"].__spec__, Path("runs/make/logs")
    assert module is not None
    logs.mkdir(parents=True, exist_ok=True)
    gpus = queue.SimpleQueue[int]()
    for gpu in [*range(len(wp.get_cuda_devices()))] * at_once:
        gpus.put(gpu)

    def run(part: str) -> int:
        gpu, name = gpus.get(), file_name(f"{module.name} {' '.join(words)} {part}")
        try:
            print(f"{part} on GPU {gpu}: {logs / name}.log", flush=True)
            command = [sys.executable, "-m", module.name, *words, "--parts", part]
            with (logs / f"{name}.log").open("wb") as log:
                environment = {**os.environ, "CUDA_VISIBLE_DEVICES": str(gpu)}
                return subprocess.run(command, env=environment, stdout=log, stderr=log, check=False).returncode
        finally:
            gpus.put(gpu)

    with ThreadPoolExecutor(gpus.qsize()) as threads:
        failed = [part for part, status in zip(parts, threads.map(run, parts), strict=True) if status]
    if failed:
        raise RuntimeError(f"{', '.join(failed)} failed; their logs under {logs} say why. What is done stays done")


def parse(
    doc: str | None, argv: Sequence[str] | None, file: str, *, published: str = "results", parts: Sequence[str] = ()
) -> Script:
    """Reads the flags that every script has, and finds out whether its file can be written.

    Args:
        doc: Says what the script does.
        argv: Words of the command line; those of the process if None.
        file: Name of the file written, in ``<published>/<robot>``.
        published: Folder of what is published.
        parts: Words that may be named, of a script that can be asked for a part of its work.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="anymal")
    parser.add_argument("--device", help="a CUDA device if there is one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--small", action="store_true", help="a trial of a minute or so; it publishes nothing")
    parser.add_argument("--out", type=Path, help=f"file to write; {published}/<robot>/{file} if left out")
    if parts:
        parser.add_argument("--parts", nargs="+", choices=parts, help="all that this device can measure if left out")
        parser.add_argument("--at-once", type=int, help="first run all parts, so many side by side on each GPU")
    args = parser.parse_args(argv)
    if getattr(args, "at_once", None):
        if args.small or args.out or not wp.get_cuda_devices():
            parser.error("--at-once is for published numbers on GPUs, got a trial, another file, or no GPU")
        run_parts([f"--robot={args.robot}", f"--seed={args.seed}"], args.parts or parts, args.at_once)
    robot = get_robot(args.robot)
    out = args.out or Path("runs/make/small" if args.small else published) / robot.name / file
    prepare_output(out)
    device, trial = resolve_device(args.device), {"small": True} if args.small else {}
    return Script(
        robot=robot,
        device=device,
        seed=args.seed,
        small=args.small,
        out=out,
        origin={**provenance(device, args.seed), **controller_identity(robot, str(robot.policy_file)), **trial},
        parts=tuple(getattr(args, "parts", None) or ()),
    )


def publish_controller(script: Script, policy: Path, name: str) -> None:
    """Copies a trained controller and its training record to ``results/<robot>/<name>``."""
    for suffix in (".pt", ".train.json"):
        shutil.copyfile(policy.with_suffix(suffix), script.results / f"{name}{suffix}")


def published_controllers(script: Script) -> dict[str, str]:
    """The shipped controller as ``base``, and those of ``results/<robot>`` by name."""
    files = {name: script.results / f"{name}.pt" for name in ("C-HC", "C-HR", "C-G", "hardened")}
    return {"base": script.policy, **{name: str(file) for name, file in files.items() if file.exists()}}


def mean_over_seeds(name: str, values: Sequence[float | None]) -> dict[str, Any]:
    """``name`` and ``name_interval``: mean and 95 % t interval over seeds; None where a seed has no value."""
    if not values or any(value is None for value in values):
        return {name: None, f"{name}_interval": None}
    numbers = np.asarray(values, np.float64)
    return {name: float(numbers.mean()), f"{name}_interval": t_interval(numbers)}


def read_made(file: Path) -> dict[str, Any]:
    """What a file says; nothing if it is not there or broken, since it is made anew then."""
    try:
        return read_json(file)
    except (FileNotFoundError, ValueError):
        return {}


def runs_of_today() -> Path:
    """Folder for runs that are not published, by today's sources; runs of other sources are not gone on with."""
    return Path("runs/make") / sources_sha256()[:12]


def read_alike(file: Path, origin: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """What a file says if it is of an origin, by these names of it; else nothing."""
    content = read_made(file)
    return content if all(content.get(name) == origin.get(name) for name in names) else {}


def is_current(file: Path) -> bool:
    """Whether a file was made by today's sources, and not in a trial."""
    content = read_made(file)
    return content.get("sources_sha256") == sources_sha256() and not content.get("small")


if __name__ == "__main__":
    sys.exit(not is_current(Path(sys.argv[1])))


def crossing_rates(outcome: NDArray[np.uint8], kind: str) -> NDArray[np.float64]:
    """Rate of ``success`` (no base collision) or ``goal`` on each terrain, NaN if it is invalid, shape (num_terrains,).

    Outcomes (:class:`kernels.episode.Outcome`) have shape (num_terrains, num_episodes); one that still runs is invalid.
    """
    hit = outcome != Outcome.BASE_COLLISION if kind == "success" else outcome == Outcome.GOAL
    return terrain_means(hit, counted_episodes((outcome == Outcome.INVALID) | (outcome == Outcome.RUNNING)))


def agreement(
    ours: NDArray[np.uint8], theirs: NDArray[np.uint8], seed: int, families: NDArray[np.int64] | None = None
) -> dict[str, Any]:
    """How far rates of terrains lie from those of other crossings of the same terrains.

    Args:
        ours: Outcomes, shape (num_terrains, num_episodes).
        theirs: Outcomes of the other crossings, shape (num_terrains, any number of episodes).
        seed: Draws the resamples.
        families: Of terrains that are not independent, shape (num_terrains,).

    Returns:
        ``terrains``, those that are valid in both; of each kind the mean of our rate minus theirs
        (``success_bias``) with its 95 % bootstrap interval over families (``success_bias_interval``), and the mean of
        its size (``success_difference``), None without terrains.
    """
    numbers: dict[str, Any] = {}
    for kind in ("success", "goal"):
        apart = crossing_rates(ours, kind) - crossing_rates(theirs, kind)
        known = np.isfinite(apart)
        apart, kin = apart[known], None if families is None else families[known]
        numbers |= {
            "terrains": len(apart),
            f"{kind}_bias": float(apart.mean()) if len(apart) else None,
            f"{kind}_bias_interval": bootstrap_interval(apart, seed, families=kin, bounds=DIFFERENCES),
            f"{kind}_difference": float(np.abs(apart).mean()) if len(apart) else None,
        }
    return numbers
