"""Terrains again: elites of a run, or a map of one's own; their numbers and their figures."""

import hashlib
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kernels.episode import Outcome
from qd.faults.numbers import elite_words
from qd.search.descriptors import Cells
from qd.search.directory import RUNS, folder_for
from qd.search.fitness import Evaluation, FitnessCfg, evaluation_of
from qd.show.crossed import draw_crossing, title_of
from qd.show.elites import OpenedRun, Terrain
from qd.show.figures import label_of, look_of
from qd.show.recordings import Recordings, Wanted, on_elite, on_heights
from qd.workers.invalid import invalid_reasons, reason_words, refuse_all_invalid
from sim.controllers.spec import ControllerSpec, crosser_name
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.figures import as_png
from sim.files.intervals import format_rate, wilson_interval
from sim.recording.recorder import Recording
from sim.robots.find import read_penalty_scales
from sim.robots.robot import RobotCfg
from sim.terrains.maps.heightmap import as_terrain, fitted, read_heightmap

OWN_FOLDER = RUNS / "terrains"
"""Where what is made of a user's own terrains goes."""
_LONGEST_NAME = 120  # characters of a map's path; with robot, controller and ending a file may have 255


@dataclass(frozen=True, kw_only=True)
class Source:
    """Terrains to show, and who crosses them."""

    robot: RobotCfg
    fitness: FitnessCfg
    """Penalties, and the scales that make them comparable."""
    folder: Path
    """Where files about them go."""
    stems: Sequence[str]
    """What files about each terrain are called, without their ending."""
    about: Sequence[dict[str, Any]]
    """What is known of each terrain, for the file of its numbers."""
    wanted: Sequence[Wanted]
    inputs: tuple[Path, ...] = ()
    """Files of the user, which are never overwritten."""
    by: str = ""
    """Name of the controller, where it is not the usual one."""
    opened_run: OpenedRun | None = None
    """The run of elites, which are ``terrains``."""
    terrains: Sequence[Terrain] = ()

    @property
    def scales(self) -> dict[str, float]:
        """What each penalty is divided by."""
        return dict(zip(self.fitness.penalties, self.fitness.scales, strict=True))

    def record(self, device: str, policy: str | None = None) -> list[Recording]:
        """The recording of each terrain, by another controller if one is named; what is not stored is crossed."""
        wanted = [replace(crossing, policy=policy or crossing.policy) for crossing in self.wanted]
        return Recordings(self.robot, device=device).all_of(wanted)

    def files(self, ending: str, out: Path | None) -> list[Path]:
        """The file of each terrain: in its folder, in a folder ``out``, or ``out``; refused before long work."""
        files = [self.folder / f"{stem}{ending}" for stem in self.stems]
        if out is not None:
            files = [out / file.name for file in files] if len(files) > 1 or out.is_dir() else [out]
        if files[0].suffix != ending:
            raise ValueError(f"out must be a file named *{ending}, got {out}")
        given = {file.resolve() for file in self.inputs}
        if given & {other.resolve() for file in files for other in (file, file.with_suffix(".json"))}:
            raise ValueError(f"out {out} would overwrite {self.inputs[0]} or its scale: name another file")
        prepare_output(files[0])
        return files


def source_of_run(
    opened_run: OpenedRun, elite: str = "", minimal: str | None = None, *, policy: str | None = None, **crossing: Any
) -> Source:
    """Elites of a run or their minimal terrains, as :meth:`qd.show.elites.OpenedRun.terrains` takes them.

    ``crossing`` may have ``replicas`` and ``seed``.
    """
    controller, terrains = opened_run.policy(policy), opened_run.terrains(elite, minimal)
    suffix, path = opened_run.suffix(controller), opened_run.path
    about = [(terrain, {"label": terrain.label, "minimal": terrain.genes if minimal else None}) for terrain in terrains]
    return Source(
        robot=opened_run.robot,
        fitness=opened_run.as_searched()[1],
        folder=folder_for(path, opened_run.robot.name),
        stems=[f"{terrain.stem}{suffix}" for terrain in terrains],
        by=suffix[1:],
        about=[{"run": str(path), "elite": terrain.number, "minimal": terrain.minimal} for terrain in terrains],
        wanted=[on_elite(opened_run.archive, t.number, policy=controller, **how, **crossing) for t, how in about],
        opened_run=opened_run,
        terrains=terrains,
    )


def source_of_map(
    file: Path,
    robot: RobotCfg,
    *,
    size_m: tuple[float, float] | None = None,
    scale_m: float | None = None,
    offset_m: float | None = None,
    policy: str | None = None,
    **crossing: Any,
) -> Source:
    """A height map of one's own, as :func:`sim.terrains.maps.heightmap.read_heightmap` takes it."""
    heightmap = read_heightmap(file, size_m=size_m, scale_m=scale_m, offset_m=offset_m)
    print(f"{file}: {fitted(heightmap)}", flush=True)
    heights, controller = as_terrain(heightmap), policy or str(robot.policy_file)
    path, here = file.resolve(), Path.cwd()  # its path from here: two maps of one name have files of their own
    name = "-".join(path.relative_to(here if path.is_relative_to(here) else path.anchor).parts)[-_LONGEST_NAME:]
    about = {
        "terrain": str(file),
        "terrain_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "map": fitted(heightmap),
        "heights_m": [float(heights.min()), float(heights.max())],
    }
    how: dict[str, Any] = {"label": file.name, "policy": controller, "ground": heightmap.ground}
    return Source(
        robot=robot,
        fitness=fitness_of(robot, policy),
        folder=OWN_FOLDER,
        stems=[f"{name}-{crosser_name(robot, controller)}"],
        by=crosser_name(robot, controller).removeprefix(robot.name)[1:],
        about=[about],
        wanted=[on_heights(heights, **how, **crossing)],
        inputs=(file, file.with_suffix(".json")),
    )


def fitness_of(robot: RobotCfg, policy: str | None) -> FitnessCfg:
    """The robot's penalties with their scales; 1 each, and so raw sums, where they were never measured."""
    try:
        scales = read_penalty_scales(robot, policy)
    except ValueError as error:
        print(f"{error}; penalties are compared as they are, unscaled", flush=True)
        scales = (1.0,) * len(robot.penalties)
    return FitnessCfg(penalties=robot.penalties, scales=scales)


def replay(source: Source, *, device: str = "cpu", out: Path | None = None) -> list[dict[str, Any]]:
    """Crosses terrains again, prints numbers, writes them and a figure of each; returns the numbers."""
    figures, reports = source.files(".png", out), []
    for k, (recording, figure) in enumerate(zip(source.record(device), figures, strict=True)):
        refuse_all_invalid(recording.result())
        policy = ControllerSpec.parse(str(recording.origin["policy"])).label
        reports.append({**recording.origin, "policy": policy, **source.about[k], **numbers_of(recording)})
        print(describe(source, k, recording))
        save(figure.with_suffix(".json"), to_json(reports[-1]), "Numbers")
        save(figure, as_png(draw_crossing(recording, title_of(recording, source.by))), "Figure")
    return reports


def save(file: Path, data: bytes, what: str) -> None:
    """Writes a file, and says where and whether there was one before."""
    replaced = " (replaced)" if file.exists() else ""
    write_atomically(file, data)
    print(f"{what}: {file}{replaced}", flush=True)


def numbers_of(recording: Recording) -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson), ends and raw penalties of one terrain, of valid episodes; at least one is."""
    valid = recording.outcome[0] != Outcome.INVALID
    count, fallen = int(valid.sum()), int(recording.fallen[0, valid].sum())
    ended = {o.name.lower(): int((recording.outcome[0] == o).sum()) for o in Outcome if 0 < o < Outcome.TILT}
    hits = {"success": count - ended["base_collision"], "goal": ended["goal"], "fallen": fallen}
    names, sums = recording.penalty_names, recording.result().penalties[0, valid]
    return {
        "episodes": recording.num_episodes,
        "invalid_episodes": recording.num_episodes - count,
        "invalid_reasons": invalid_reasons(recording.result()),
        "rates": {
            name: {"rate": number / count, "hits": number, "interval": list(wilson_interval(number, count))}
            for name, number in hits.items()
        },
        "outcomes": ended,
        "duration_s": float(recording.duration_s[0, valid].mean()),
        "penalties": {
            name: {"mean": float(column.mean()), "std": float(column.std()), "unit": look_of(name).unit}
            for name, column in zip(names, sums.T, strict=True)
        },
    }


def describe(source: Source, k: int, recording: Recording) -> str:
    """How robots crossed a terrain and what it cost them; an elite's numbers as found and as corrected beside."""
    run, names, scales = source.opened_run, source.fitness.penalties, source.fitness.scales
    cells = Cells(len(names)) if run is None else run.archive.cells
    now = evaluation_of(recording.result(), cells, source.fitness)
    columns: list[tuple[str, Evaluation, int]] = [("now", now, 0)]
    if run is not None:
        n, whole = source.terrains[k].number, "whole, " if source.terrains[k].minimal else ""
        stored = {"as found": run.archive, "fresh": run.archive.fresh}
        columns[:0] = [(f"{whole}{label}", values, n) for label, values in stored.items() if values is not None]
    rows = {"": [label for label, _, _ in columns]}
    rows["episodes"] = [str(values.episodes[row]) for _, values, row in columns]
    valid = [int(v.counted[row]) if v.valid[row] else 0 for _, v, row in columns]
    for label, rate in (("goal reached", "goal_rate"), ("base collision", "collision_rate"), ("fallen", "fallen_rate")):
        shares = [getattr(values, rate)[row] for _, values, row in columns]
        counted = zip(shares, valid, strict=True)
        words = [format_rate(round(share * count) if count else 0, count, short=True) for share, count in counted]
        rows[label] = [text.replace("% to ", "-").replace(" to ", "-") for text in words]
    for p, (name, scale) in enumerate(zip(names, scales, strict=True)):
        rows[label_of(name)] = [
            f"{_spread(scale * values.penalty_mean[row, p], scale * values.penalty_std[row, p])}, "
            f"{values.ratios[row, p]:.0%}"
            for _, values, row in columns
        ]
    if run is not None:
        rows["fitness"] = [f"{values.fitness[row]:.2f}" for _, values, row in columns]
    widest = max(map(len, rows))
    width = max(len(text) for row in rows.values() for text in row)
    lines = [f"{label:{widest}}" + "".join(f"  {text:>{width}}" for text in row) for label, row in rows.items()]
    units = ", ".join(f"{label_of(name)} [{look_of(name).unit}]" for name in names)
    lines += [
        "Rates have 95 % intervals (Wilson). A robot that stands still has no base collision either.",
        f"Below them are raw penalties, mean±standard deviation over episodes, and the share of all. Units: {units}.",
    ]
    if reasons := invalid_reasons(recording.result()):
        lines.append(f"{sum(reasons.values())} invalid episodes are left out: {reason_words(reasons)}.")
    if run is not None:
        lines += _about_elite(run, source.terrains[k], source.by, now)
    how: dict[str, Any] = {"initial_indent": "  ", "subsequent_indent": "    ", "break_on_hyphens": False}
    return "\n".join([title_of(recording, source.by), *(textwrap.fill(line, 80, **how) for line in lines)])


def _spread(mean: float, std: float) -> str:
    digits = 2 if max(mean, std) < 100 else 0
    return f"{mean:.{digits}f}±{std:.{digits}f}"


def _about_elite(run: OpenedRun, terrain: Terrain, by: str, now: Evaluation) -> list[str]:
    """What the run knows of an elite, and whether what was crossed now agrees."""
    archive, n = run.archive, terrain.number
    parts, about = run.space.describe(terrain.genes).splitlines(), elite_words(archive, n)
    if terrain.minimal:
        parts = terrain.minimal["words"]
        known = f"Of the minimal terrain: {run.minima().words(n)}; {terrain.minimal.get('verdict', 'not judged')}."
        about[:0] = ["Of the whole terrain of the elite:"] if about else []
    elif by:
        known = f"Now it was crossed with {by}; all else is of the controller that was searched."
    else:
        near = bool(now.valid[0]) and bool(archive.cells.are_neighbours(archive.cell[n : n + 1], now.cell)[0])
        known = f"It {'lands in its cell or beside it' if near else 'does not land in its cell or beside it'} again."
    return [
        f"Of {run.path}: one of {len(archive):,} elites, found in iteration {archive.iteration[n]}, with ratios in "
        f"{archive.cells.describe(int(archive.cell[n]))}. Its terrain:",
        *(f"- {line}" for line in parts),
        *[known, *about],
    ]
