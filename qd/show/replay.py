"""One elite again: its numbers beside those of fresh episodes, and its terrain with the robots' paths over it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from qd.archive import Archive
from qd.faults import elite_words
from qd.fitness import Evaluation, evaluation_of
from qd.show.crossed import crossed_of, draw_paths
from qd.show.elites import OpenedRun, Terrain
from qd.show.figures import look_of, save_figure
from qd.show.recordings import Recordings, on_elite
from sim.files.atomic import prepare_output
from sim.files.intervals import rate_words
from sim.policy.spec import ControllerSpec
from sim.recording.recorder import Recording


def record_terrains(
    opened_run: OpenedRun, terrains: Sequence[Terrain], *, policy: str, replicas: int, seed: int, device: str
) -> list[Recording]:
    """Crossings of an archive's terrains, which are crossed where no recording of them is stored."""
    wanted = [
        on_elite(
            opened_run.archive, terrain.number, policy=policy, replicas=replicas, seed=seed, label=terrain.label,
            minimal=terrain.genes if terrain.minimal else None,
        )
        for terrain in terrains
    ]  # fmt: skip
    return Recordings(opened_run.robot, device=device).all_of(wanted)


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A terrain and what became of it this time."""

    opened_run: OpenedRun
    terrain: Terrain
    recording: Recording
    """Of the terrain."""
    fresh: Evaluation
    controller: str = ""
    """Who crossed it this time, if that is another controller than the search's."""


def replay(
    opened_run: OpenedRun,
    terrain: Terrain,
    *,
    policy: str | None = None,
    replicas: int = 20,
    seed: int = 0,
    device: str = "cpu",
    out: Path | None = None,
) -> Replay:
    """Crosses a terrain again, prints its numbers, and draws it with the robots' paths."""
    controller = opened_run.policy(policy)
    out = out or Path(f"{opened_run.output(terrain.stem, controller)}.png")
    if out.suffix != ".png":
        raise ValueError(f"out must be a file named *.png, got {out}")
    prepare_output(out)
    (recording,) = record_terrains(
        opened_run, [terrain], policy=controller, replicas=replicas, seed=seed, device=device
    )  # fmt: skip
    _, fitness = opened_run.as_searched()
    replayed = Replay(
        opened_run=opened_run,
        terrain=terrain,
        recording=recording,
        fresh=evaluation_of(recording.result(), opened_run.archive.cells, fitness),
        controller=controller if opened_run.suffix(controller) else "",
    )
    print(describe(replayed))
    save_figure(out, draw(replayed))
    print(f"Figure: {out}")
    return replayed


def describe(replay: Replay) -> str:
    """An elite's numbers as they were found, those that 40 fresh episodes corrected, if any did, and those of now."""
    archive, n, fresh = replay.opened_run.archive, replay.terrain.number, replay.fresh
    cells, minimal = archive.cells, replay.terrain.words
    columns: list[tuple[str, Archive | Evaluation, int]] = [("found", archive, n)]
    if archive.fresh is not None:
        columns.append(("corrected", archive.fresh, n))
    if minimal:
        columns = [(f"whole elite, {label}", values, k) for label, values, k in columns]
    columns.append(("minimal, now" if minimal else "now", fresh, 0))
    rows = {
        "": [f"{label} ({values.episodes[k]} episodes)" for label, values, k in columns],
        "fitness": [f"{values.fitness[k]:.2f}" for _, values, k in columns],
    }
    for p, name in enumerate(archive.penalties):
        rows[f"{name} [{look_of(name).unit}]"] = [
            _penalty(values.penalty_mean[k, p], values.penalty_std[k, p], archive.scales[p], values.ratios[k, p])
            for _, values, k in columns
        ]
    for label, name in (("goal reached", "goal_rate"), ("base collision", "collision_rate"), ("fallen", "fallen_rate")):
        counted = [(getattr(values, name)[k], _valid_episodes(values, k)) for _, values, k in columns]
        rows[label] = [rate_words(round(rate * count) if count else 0, count) for rate, count in counted]
    width = 44 if minimal else 34
    near = bool(fresh.valid[0]) and bool(cells.are_neighbours(archive.cell[n : n + 1], fresh.cell)[0])
    known = (
        f"It {'lands in its cell or a neighbour of it' if near else 'does not land in its cell or beside it'} again."
    )
    if minimal:
        known = f"Of the minimal terrain: {minimal}."
    elif replay.controller:
        known = f"Now it was crossed with {replay.controller}; all else is of the controller that was searched."
    return "\n".join(
        [
            f"{replay.opened_run.path}, {replay.terrain.label}, found in iteration {archive.iteration[n]}, "
            f"with ratios in {cells.describe(int(archive.cell[n]))}",
            *(f"  {label:22}" + "".join(f"{value:>{width}}" for value in row) for label, row in rows.items()),
            "  Its terrain:",
            *(f"    {line}" for line in replay.opened_run.space.describe(replay.terrain.genes).splitlines()),
            "  Rates with their 95 % intervals (Wilson); those as found are of the episodes that made it an elite.",
            *(f"  {line}" for line in [known, *elite_words(archive, n)]),
        ]
    )


def _penalty(mean: float, std: float, scale: float, ratio: float) -> str:
    return f"{mean * scale:.2f} +- {std * scale:.2f} ({ratio:.0%} of all)"


def _valid_episodes(values: Archive | Evaluation, number: int) -> int:
    """Episodes that a terrain's rates are of: none of a terrain that is invalid as a whole."""
    valid = isinstance(values, Archive) or values.valid[number]  # what is found is valid, or it were no elite
    return int(values.episodes[number] - values.invalid_episodes[number]) if valid else 0


def draw(replay: Replay) -> Figure:
    """The height map of a terrain with the robots' paths, and marks where they ended, by how."""
    archive, n = replay.opened_run.archive, replay.terrain.number
    corrected = "" if archive.fresh is None else f"{archive.fresh.fitness[n]:.2f} corrected, "
    title = (
        f"{archive.robot}, elite {n} of {len(archive):,} after {archive.iterations:,} iterations: fitness "
        f"{archive.fitness[n]:.2f} as found, {corrected}"
        f"{replay.fresh.fitness[0]:.2f} in {replay.fresh.episodes[0]} fresh episodes"
    )
    if replay.terrain.words:
        title = f"{replay.terrain.label}:\n{replay.terrain.words}"
    if replay.controller:
        title += f"\nwith another controller than was searched: {ControllerSpec.parse(replay.controller).label}"
    return draw_paths(crossed_of(replay.recording, archive.penalties, archive.scales), title)
