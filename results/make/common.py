"""Flags of the scripts, the file that each writes, and means over seeds with their intervals.

As a command, ``python -m results.make.common FILE ...`` exits with 0 if today's sources made the files, all that are
published if none is named (``make release-check``).
"""

import argparse
import filecmp
import json
import math
import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from qd.faults.judge import judge
from qd.search.archive import Archive
from qd.search.crossed import usual_crossed
from qd.search.directory import RunDirectory, read_robot_archive
from qd.search.loop import search
from qd.search.settings import SearchCfg, preset
from qd.workers.compute import Compute
from sim.controllers.spec import controller_identity
from sim.device import resolve_device
from sim.files.atomic import prepare_output, read_json, to_json, write_atomically
from sim.files.provenance import provenance, sources_sha256
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.terrains.conditions.kinds import CONDITIONS

SEEDS = (0, 1, 2)
"""Seeds of repeated trainings and searches."""
ONCE = {"replicas": 20, "batch_size": 20, "again": 0, "candidates": 20}
"""Changes of preset wide: every terrain is crossed once, in the paper's 20 episodes."""
FRESH_COUNTS = (
    "episodes", "elites", "elites_same_cell", "corrected_elites", "failing", "families", "failing_families",
    "failing_distinct",
)  # fmt: skip
"""What archive.json counts once fresh episodes are crossed."""
COUNTS = (
    *FRESH_COUNTS, "confirmed", "certified", "faults", "faults_panel", "faults_controllers", "faults_witness",
    "fault_families", "faults_distinct", "strong", "faults_fdr",
)  # fmt: skip
"""... once contact is resolved and others have crossed what fails, too."""
ARCHIVE_FILES = ("archive.npz", "archive.json", "config.json")
CURVE_FILE = "curve.json"
"""File of a run: counts after each step of its search."""
PAPER_SIZE = {**ONCE, "emitters": 10, "groups": 1}
"""Changes of preset wide: the paper's iterations, of ten emitters and 20 terrains each."""


@dataclass(frozen=True, kw_only=True)
class Script:
    """A script's robot, device, seed and file."""

    robot: RobotCfg
    device: str
    seed: int
    small: bool
    """A trial of about a minute on a CPU; its numbers mean nothing."""
    out: Path
    origin: dict[str, Any]
    """Provenance, robot and controller of the numbers, and ``small`` for a trial."""
    parts: tuple[str, ...] = ()
    """Parts of the work to do; all if empty."""
    against: Path | None = None
    """Another checkout to measure beside this one."""

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
        """Folder of the robot's unpublished runs."""
        return self.out.parent / "runs" if self.small else runs_of_today() / self.robot.name

    def search_cfg(
        self,
        iterations: int | None = None,
        *,
        episodes: int | None = None,
        crossed: float | None = None,
        **changes: Any,
    ) -> SearchCfg:
        """Settings of a search of preset wide; a trial has four terrains, too few to train a specialist on.

        Args:
            iterations: Iterations; without them ``episodes`` or the preset decide.
            episodes: Episodes, rounded to whole iterations.
            crossed: How much less what nobody crosses is worth; as the command has it if None.
            changes: Values of settings or of the scheduler's settings by name, and ``policy`` and ``space``.
        """
        searched = {name: changes.pop(name) for name in ("policy", "space") if name in changes}
        cfg = preset("small" if self.small else "wide", self.robot, **searched)
        scheduler = {name: changes.pop(name) for name in list(changes) if hasattr(cfg.scheduler, name)}
        if self.small:
            iterations = 1
            scheduler |= {"emitters": 2, "batch_size": 2, "groups": 1}
            changes["replicas"] = 1
        cfg = replace(cfg, scheduler=replace(cfg.scheduler, **scheduler), **changes)
        if crossed is None:
            crossed = usual_crossed(cfg.scheduler, self.robot, cfg.terrain_space)
        cfg = replace(cfg, fitness=replace(cfg.fitness, crossed=crossed))
        if episodes is not None:
            (iterations,) = self.count_iterations(cfg, episodes)
        return replace(cfg, iterations=iterations or cfg.iterations)

    def count_iterations(self, cfg: SearchCfg, *episodes: int) -> list[int]:
        """Whole iterations of a search nearest to each number of episodes, without its labels; one in a trial."""
        return [1] if self.small else [round(count / cfg.episodes_per_iteration) for count in episodes]

    def publish(self, run: Path, folder: Path, patterns: Sequence[str]) -> None:
        """Copies files of a run into a published folder; files of another archive that the run lacks are removed."""
        if not is_same_file(run / "archive.npz", folder / "archive.npz"):
            for old in (file for pattern in patterns for file in folder.glob(pattern)):
                if not (run / old.relative_to(folder)).exists():
                    old.unlink()
        for file in (file for pattern in patterns for file in run.glob(pattern)):
            target = folder / file.relative_to(run)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)

    def read_archive(self, name: str = "archive") -> Archive:
        """A published archive of archive.py."""
        return read_robot_archive(self.robot, self.results / name)

    def read_dose(self, *, conditions: bool) -> list[dict[str, Any]]:
        """The base's rows of dose.json beside the file, of conditions or of obstacles."""
        file = self.out.with_name("dose.json")
        content = read_alike(file, self.origin, "sources_sha256", "seed", "robot_sha256", "penalty_definition")
        if not content and not self.small:
            raise ValueError(f"{file} must be of today's sources: run results.make.dose first")
        rows = [row for row in content.get("dose", ()) if row["controller"] == "base"]
        return [row for row in rows if (row["parameter"] in CONDITIONS) == conditions]

    def run_of_archive(self, name: str = "archive") -> Path:
        """The run of a published archive to work in, or a copy of the published files if the run is gone."""
        run = self.runs / name
        published = self.results / name
        if self.small or not is_same_file(run / "archive.npz", published / "archive.npz"):
            run = self.runs / "copy" / name
            if not all(is_same_file(run / file, published / file) for file in ARCHIVE_FILES):
                shutil.rmtree(run, ignore_errors=True)
                shutil.copytree(published, run)
        return run

    def read_so_far(self, file: Path, *alike: str) -> dict[str, Any]:
        """Content of a file that today's sources made of this robot, controller and seed; else empty.

        ``alike`` are further keys of its origin that must be equal.
        """
        names = ("sources_sha256", "small", "seed", "robot_sha256", "penalty_definition", "policy_sha256", *alike)
        return read_alike(file, self.origin, *names)

    def write(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Prints the numbers and writes them behind their origin; returns the file's content."""
        print(json.dumps(numbers, indent=1)[:4000])
        return self.add(self.origin, numbers)

    def add(self, report: Mapping[str, Any], numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Writes a report and numbers behind it, unless the sources have changed; returns the file's content."""
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
    certifiers: Mapping[str, str] | None = None,
) -> list[dict[str, Any]]:
    """Extends a search to each number of iterations of ``points``, where its elites cross fresh episodes.

    At the last point the search is judged by ``last_stages``, and by ``certifiers`` if not by the robot's panel alone.
    Returns ``counts`` of each point. The run's curve.json has them too, and its points are not searched again.
    """
    rows = {row["iterations"]: row for row in script.read_so_far(run / CURVE_FILE).get("curve", [])}
    for iterations in points:
        if iterations not in rows:
            search(replace(cfg, iterations=iterations), run, script.compute)
            stages = last_stages if iterations == points[-1] else ("fresh",)
            judge(run, stages=stages, compute=script.compute, certifiers=certifiers)
            numbers = RunDirectory(run).read_summary()
            rows[iterations] = {"iterations": iterations, **{count: numbers.get(count) for count in counts}}
            write_atomically(run / CURVE_FILE, to_json({**script.origin, "curve": [*rows.values()]}))
    return [rows[iterations] for iterations in points]


def origin_of(script: Script, run: Path) -> dict[str, Any]:
    """Where and when a search that :func:`follow_search` follows was made."""
    origin = script.read_so_far(run / CURVE_FILE)
    return {key: origin[key] for key in ("commit", "device", "date")}


def measure_once(script: Script, file: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Numbers of a part with where and when they were made; those that today's sources made are read from the file."""
    made = script.read_so_far(file)
    if not made:
        prepare_output(file)
        made = {**script.origin, "numbers": measure()}
        write_atomically(file, to_json(made))
    return {key: made[key] for key in ("command", "commit", "device", "versions", "date")} | made["numbers"]


def is_same_file(first: Path, second: Path) -> bool:
    """Whether two files exist and are equal."""
    return first.exists() and second.exists() and filecmp.cmp(first, second, shallow=False)


def file_name(label: str) -> str:
    """A label as a name of a file or folder."""
    return re.sub(r"\W+", "-", label)


def parse(
    doc: str | None,
    argv: Sequence[str] | None,
    file: str,
    *,
    published: str = "results",
    parts: Sequence[str] = (),
    against: str = "",
) -> Script:
    """Reads the flags of a script, and checks that its file can be written.

    Args:
        doc: The script's docstring.
        argv: Arguments; those of the process if None.
        file: Name of the file written, in ``<published>/<robot>``.
        published: Folder of published files.
        parts: Values of ``--parts``, for a script that can do a part of its work.
        against: Help of ``--against``, for a script that can measure another checkout too.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="anymal")
    parser.add_argument("--device", help="a CUDA device if there is one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--small", action="store_true", help="a trial of a minute or so; it publishes nothing")
    parser.add_argument("--out", type=Path, help=f"file to write; {published}/<robot>/{file} if left out")
    if parts:
        parser.add_argument("--parts", nargs="+", choices=parts, help="all if left out; each may run on a GPU")
    if against:
        parser.add_argument("--against", type=Path, help=against)
    args = parser.parse_args(argv)
    robot = get_robot(args.robot)
    out = args.out or Path("runs/make/small" if args.small else published) / robot.name / file
    prepare_output(out)
    device = resolve_device(args.device)
    trial = {"small": True} if args.small else {}
    return Script(
        robot=robot,
        device=device,
        seed=args.seed,
        small=args.small,
        out=out,
        origin={**provenance(device, args.seed), **controller_identity(robot, str(robot.policy_file)), **trial},
        parts=tuple(getattr(args, "parts", None) or ()),
        against=getattr(args, "against", None),
    )


def publish_controller(script: Script, policy: Path, name: str) -> None:
    """Copies a trained controller and its training record to ``results/<robot>/<name>``."""
    for suffix in (".pt", ".train.json"):
        shutil.copyfile(policy.with_suffix(suffix), script.results / f"{name}{suffix}")


def published_controllers(script: Script) -> dict[str, str]:
    """The shipped controller as ``base``, and those of ``results/<robot>`` by name."""
    files = {name: script.results / f"{name}.pt" for name in ("C-HC", "C-HR", "C-G", "hardened")}
    return {"base": script.policy, **{name: str(file) for name, file in files.items() if file.exists()}}


def t_interval(values: NDArray[np.floating]) -> list[float] | None:
    """Interval of the mean of a few independent measurements (Student 1908); None for a single one."""
    count = len(values)
    if count < 2:
        return None
    half = float(stdtrit(count - 1, 0.975)) * float(values.std(ddof=1)) / math.sqrt(count)
    return [float(values.mean()) - half, float(values.mean()) + half]


def mean_over_seeds(name: str, values: Sequence[float | None]) -> dict[str, Any]:
    """``name`` and ``name_interval``: mean and 95 % t interval over seeds; None where a seed has no value."""
    if not values or any(value is None for value in values):
        return {name: None, f"{name}_interval": None}
    numbers = np.asarray(values, np.float64)
    return {name: float(numbers.mean()), f"{name}_interval": t_interval(numbers)}


def mean_counts(rows: Sequence[Mapping[str, Any]], counts: Sequence[str]) -> dict[str, Any]:
    """Mean and interval of each count over searches that differ in their seeds, a row each."""
    means = [mean_over_seeds(count, [row.get(count) for row in rows]) for count in counts]
    return {name: value for mean in means for name, value in mean.items()}


def read_made(file: Path) -> dict[str, Any]:
    """Content of a JSON file; empty if it is missing or damaged, since a script makes it again."""
    try:
        return read_json(file)
    except (FileNotFoundError, ValueError):
        return {}


def runs_of_today() -> Path:
    """Folder of unpublished runs of today's sources; runs of other sources do not go on."""
    return Path("runs/make") / sources_sha256()[:12]


def read_alike(file: Path, origin: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Content of a JSON file whose keys ``names`` have the origin's values; else empty."""
    content = read_made(file)
    return content if all(content.get(name) == origin.get(name) for name in names) else {}


def is_current(file: Path) -> bool:
    """Whether a file was made by today's sources, whole, and not in a trial."""
    content = read_made(file)
    return content.get("sources_sha256") == sources_sha256() and not (content.get("small") or content.get("lacks"))


def find_older(files: Sequence[Path]) -> list[Path]:
    """Files that today's sources did not make whole, of all below results/ where none is named; says what made each."""
    named = files or [file for file in sorted(Path("results").rglob("*.json")) if "sources_sha256" in read_made(file)]
    older = [file for file in named if not is_current(file)]
    for file in older:
        commit = str(read_made(file).get("commit") or "no commit")[:8]
        print(f"{file} is of {commit}: it is of other sources, a trial, or not whole")
    return older


if __name__ == "__main__":
    sys.exit(bool(find_older([*map(Path, sys.argv[1:])])))
