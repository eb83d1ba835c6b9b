"""Crosses elites of a run or a user's height map again, and writes their numbers and figures."""

import hashlib
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kernels.episode import Outcome
from kernels.penalties import PENALTIES
from qd.faults.numbers import SEARCHED, describe_judgement
from qd.faults.searches import CERTIFIERS_FOLDER
from qd.search.descriptors import Cells
from qd.search.directory import RUNS, output_folder
from qd.search.fitness import Evaluation, FitnessCfg, evaluate_rollout
from qd.show.crossed import count_rates, draw_crossing, make_title
from qd.show.elites import EliteTerrain, OpenedRun
from qd.show.recordings import CrossingRequest, Recordings, request_elite
from qd.workers.invalid import format_reasons, invalid_reasons, refuse_all_invalid
from qd.workers.seeds import Stream, episode_seeds
from sim.controllers.spec import ControllerSpec, crosser_name
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.figures import as_png
from sim.files.intervals import format_rate, wilson_interval
from sim.files.templates import open_templates
from sim.rates import rate_labels
from sim.recording.recorder import Recording
from sim.robots.find import read_penalty_scales
from sim.robots.robot import RobotCfg
from sim.terrains.maps.heightmap import as_terrain, fitted, read_heightmap
from sim.terrains.terrains import Terrains, asked_of

_TEMPLATES = open_templates(Path(__file__).parent / "templates")
WITNESS = "witness"
"""In place of a controller's name: the one that crosses an elite where it is steered."""
_MAX_NAME = 120  # characters of a map's path; with robot, controller and ending a file may have 255


@dataclass(frozen=True, kw_only=True)
class ReplayTerrain:
    """A terrain to cross, and what is written about it."""

    request: CrossingRequest
    stem: str  # name of its files, without their ending
    about: dict[str, Any]  # facts for the file of its numbers
    elite: EliteTerrain | None = None  # None of a map


@dataclass(frozen=True, kw_only=True)
class ReplaySource:
    """Terrains to cross, and the controller that crosses them."""

    robot: RobotCfg
    fitness: FitnessCfg  # penalties, and the scales that make them comparable
    folder: Path  # default folder of files about the terrains
    terrains: Sequence[ReplayTerrain]
    inputs: tuple[Path, ...] = ()  # files of the user, which are never overwritten
    by: str = ""  # name of the controller, where it is not the usual one
    opened_run: OpenedRun | None = None  # the run of elites

    @property
    def scales(self) -> dict[str, float]:
        """Scale of each penalty."""
        return dict(zip(self.fitness.penalties, self.fitness.scales, strict=True))

    def requests(self, policy: str | None = None) -> list[CrossingRequest]:
        """The crossings of each terrain, by another controller if one is named."""
        return [replace(each.request, policy=policy or each.request.policy) for each in self.terrains]

    def steered_requests(self) -> list[CrossingRequest]:
        """The crossings of each elite by its witness, the controller that crosses it where it is steered."""
        run, requests = self.opened_run, []
        witnesses = None if run is None else run.archive.witnesses
        for terrain in self.terrains:
            elite = terrain.elite
            if run is None or witnesses is None or elite is None or elite.minimal or not witnesses.kind[elite.number]:
                rule = f"{WITNESS} needs elites for which `faultline judge --stages steered` found a way"
                raise ValueError(f"{rule}, got {terrain.request.label}: name another controller")
            walker = str(witnesses.walker[elite.number])
            searched = run.policy() if self.by else terrain.request.policy
            policy = searched if walker == SEARCHED else run.certifiers().get(walker)
            if policy is None:
                what = f"{WITNESS} of {terrain.request.label} needs the controller {walker}, got no file of it"
                raise ValueError(f"{what}: put it into {CERTIFIERS_FOLDER}/ of the run")
            ways = np.tile(witnesses.way[elite.number], (1, terrain.request.replicas, 1, 1))
            steered = replace(terrain.request.terrain, steering=ways)
            requests.append(replace(terrain.request, terrain=steered, policy=policy))
        return requests

    def record(self, device: str, requests: Sequence[CrossingRequest] = ()) -> list[Recording]:
        """The recording of each terrain, or of other crossings. Only missing ones are crossed."""
        return Recordings(self.robot, device=device).record(requests or self.requests())

    def files(self, ending: str, out: Path | None) -> list[Path]:
        """The file of each terrain: in its folder, in a folder ``out``, or ``out``; bad ones are refused at once."""
        files = [self.folder / f"{terrain.stem}{ending}" for terrain in self.terrains]
        if out is not None:
            files = [out / file.name for file in files] if len(files) > 1 or out.is_dir() else [out]
        if files[0].suffix != ending:
            raise ValueError(f"out must be a file named *{ending}, got {out}")
        outputs = {output.resolve() for file in files for output in (file, file.with_suffix(".json"))}
        if outputs & {file.resolve() for file in self.inputs}:
            raise ValueError(f"out {out} would overwrite {self.inputs[0]} or its scale: name another file")
        prepare_output(files[0])
        return files


def source_from_run(
    opened_run: OpenedRun, elite: str = "", minimal: str | None = None, *, policy: str | None = None, **crossing: Any
) -> ReplaySource:
    """Elites of a run or their minimal terrains; ``crossing`` may have ``replicas`` and ``seed``."""
    crossing["policy"] = opened_run.policy(policy)
    suffix = opened_run.suffix(crossing["policy"])

    def describe_terrain(elite: EliteTerrain) -> ReplayTerrain:
        genes = elite.genes if elite.minimal else None
        request = request_elite(opened_run.archive, elite.number, label=elite.label, minimal=genes, **crossing)
        about: dict[str, Any] = {"run": str(opened_run.path), "elite": elite.number, "minimal": elite.minimal}
        if (likelihood := opened_run.log_likelihood(elite.genes)) is not None:
            about["log_likelihood"] = likelihood if np.isfinite(likelihood) else None
        return ReplayTerrain(request=request, stem=f"{elite.stem}{suffix}", about=about, elite=elite)

    return ReplaySource(
        robot=opened_run.robot,
        fitness=opened_run.as_searched()[1],
        folder=output_folder(opened_run.path, opened_run.robot.name),
        terrains=[*map(describe_terrain, opened_run.terrains(elite, minimal))],
        by=suffix[1:],
        opened_run=opened_run,
    )


def source_from_map(
    file: Path, robot: RobotCfg, *, policy: str | None = None, replicas: int = 20, seed: int = 0, **sizes: Any
) -> ReplaySource:
    """A user's height map; ``sizes`` are those that :func:`sim.terrains.maps.heightmap.read_heightmap` takes."""
    heightmap = read_heightmap(file, **sizes)
    print(f"{file}: {fitted(heightmap)}", flush=True)
    heights = as_terrain(heightmap)
    controller = policy or str(robot.policy_file)
    label = crosser_name(robot, controller)
    path = file.resolve()
    base = Path.cwd() if path.is_relative_to(Path.cwd()) else path.anchor
    stem = "-".join(path.relative_to(base).parts)[-_MAX_NAME:]  # maps of one name in two folders differ
    about = {
        "terrain": str(file),
        "terrain_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "map": fitted(heightmap),
        "heights_m": [float(heights.min()), float(heights.max())],
    }
    try:
        scales = read_penalty_scales(robot, policy)
    except ValueError as error:  # they were never measured
        print(f"{error}; penalties are compared as they are, unscaled", flush=True)
        scales = (1.0,) * len(robot.penalties)
    seeds = episode_seeds(seed, 0, 1, stream=Stream.RECORDED_USER_TERRAIN)
    terrain = Terrains(heights=heights[None], seeds=seeds, ground=heightmap.ground)
    request = CrossingRequest(label=file.name, terrain=terrain, policy=controller, replicas=replicas, seed=seed)
    return ReplaySource(
        robot=robot,
        fitness=FitnessCfg(penalties=robot.penalties, scales=scales),
        folder=RUNS / "terrains",
        terrains=[ReplayTerrain(request=request, stem=f"{stem}-{label}", about=about)],
        by=label.removeprefix(robot.name)[1:],
        inputs=(file, file.with_suffix(".json")),
    )


def replay(source: ReplaySource, *, device: str = "cpu", out: Path | None = None) -> list[dict[str, Any]]:
    """Crosses terrains again, prints numbers, writes them and a figure of each; returns the numbers."""
    figures = source.files(".png", out)
    reports = []
    for terrain, recording, figure in zip(source.terrains, source.record(device), figures, strict=True):
        refuse_all_invalid(recording.result())
        policy = ControllerSpec.parse(str(recording.origin["policy"])).label
        reports.append({**recording.origin, "policy": policy, **terrain.about, **compute_numbers(recording)})
        print(describe(source, terrain, recording))
        save(figure.with_suffix(".json"), to_json(reports[-1]), "Numbers")
        save(figure, as_png(draw_crossing(recording, make_title(recording, source.by))), "Figure")
    return reports


def save(file: Path, data: bytes, what: str) -> None:
    """Writes a file, and prints its path and whether it was replaced."""
    replaced = " (replaced)" if file.exists() else ""
    write_atomically(file, data)
    print(f"{what}: {file}{replaced}", flush=True)


def compute_numbers(recording: Recording) -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson), outcomes and raw penalties of the valid episodes on one terrain."""
    outcome = recording.outcome[0]
    valid = outcome != Outcome.INVALID
    result = recording.result()
    rates = count_rates(recording)
    goal, count = rates["goal_rate"]
    counts = {end: int((outcome == end).sum()) for end in Outcome if end}
    hits = {"success": count - rates["collision_rate"].hits, "goal": goal, "fallen": rates["fallen_rate"].hits}
    return {
        "episodes": recording.num_episodes,
        "invalid_episodes": recording.num_episodes - count,
        "invalid_reasons": invalid_reasons(result),
        "rates": {
            name: {"rate": number / count, "hits": number, "interval": list(wilson_interval(number, count))}
            for name, number in hits.items()
        },
        "outcomes": {end.name.lower(): count for end, count in counts.items() if count or end < Outcome.TILT},
        "duration_s": float(recording.duration_s[0, valid].mean()),
        "penalties": {
            name: {"mean": float(column.mean()), "std": float(column.std()), "unit": PENALTIES[name].unit}
            for name, column in zip(recording.penalty_names, result.penalties[0, valid].T, strict=True)
        },
    }


def describe(source: ReplaySource, terrain: ReplayTerrain, recording: Recording) -> str:
    """How robots crossed a terrain and what it cost them; an elite's numbers as found and as corrected beside."""
    run, elite = source.opened_run, terrain.elite
    cells = Cells(len(source.fitness.penalties)) if run is None else run.archive.cells
    now = evaluate_rollout(recording.result(), cells, source.fitness)
    kinds = [PENALTIES[name] for name in source.fitness.penalties]
    rates = rate_labels(asked_of(recording.ground))
    labels = ["", "episodes", *rates.values(), *(kind.label for kind in kinds), *["fitness"] * (run is not None)]
    columns: list[list[str]] = []

    def add_column(label: str, values: Evaluation, row: int) -> None:
        count = int(values.counted[row]) if values.valid[row] else 0
        hits = [round(getattr(values, rate)[row] * count) if count else 0 for rate in rates]
        texts = [format_rate(hit, count, short=True).replace("% to ", "-").replace(" to ", "-") for hit in hits]
        means, stds = (source.fitness.scales * each[row] for each in (values.penalty_mean, values.penalty_std))
        for mean, std, ratio in zip(means, stds, values.ratios[row], strict=True):
            digits = 2 if max(mean, std) < 100 else 0
            texts.append(f"{mean:.{digits}f}±{std:.{digits}f}, {ratio:.0%}")
        texts += [f"{values.fitness[row]:.2f}"] * (run is not None)
        columns.append([label, str(values.episodes[row]), *texts])

    about: dict[str, Any] = {}
    if run is not None and elite is not None:
        archive, number = run.archive, elite.number
        for label, values in {"as found": archive, "fresh": archive.fresh}.items():
            if values is not None:
                add_column("whole, " * bool(elite.minimal) + label, values, number)
        about["parts"] = elite.minimal["words"] if elite.minimal else run.space.describe(elite.genes).splitlines()
        about["same_cell"] = now.valid[0] and cells.are_neighbours(archive.cell[number : number + 1], now.cell)[0]
        about["likelihood"] = run.log_likelihood(elite.genes)
        about["verdicts"] = describe_judgement(archive, number)
    add_column("now", now, 0)
    reasons = invalid_reasons(recording.result())
    about |= {"units": ", ".join(f"{kind.label} [{kind.unit}]" for kind in kinds)}
    about |= {"invalid": sum(reasons.values()), "reasons": format_reasons(reasons)}
    lines = _TEMPLATES.get_template("replay.txt").render(run=run, elite=elite, controller=source.by, **about)
    indent: Any = {"initial_indent": "  ", "subsequent_indent": "    ", "break_on_hyphens": False}
    text = [textwrap.fill(line, 80, **indent) for line in lines.splitlines()]
    left, width = max(map(len, labels)), max(len(cell) for column in columns for cell in column)
    numbers = [
        f"{label:{left}}" + "".join(f"  {cell:>{width}}" for cell in cells)
        for label, *cells in zip(labels, *columns, strict=True)
    ]
    return "\n".join([make_title(recording, source.by), *numbers, *text])
