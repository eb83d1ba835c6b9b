"""One elite again: its numbers beside those of fresh episodes, and its terrain with the robots' paths over it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from qd.archive import Archive
from qd.faults import elite_words
from qd.fitness import Evaluation, evaluation_of
from qd.run.directory import folder_for
from qd.show.elites import Found, find_archive
from qd.show.figures import look_of, save_figure
from qd.workers.evaluator import check_policy, resolve_device
from sim.files.atomic import prepare_output
from sim.files.command import OnDevice, Which, Who
from sim.files.intervals import rate_words
from sim.policy.spec import ControllerSpec

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from qd.minimise import MinimalFound
    from sim.recording.recorder import Recording


@dataclass(frozen=True, kw_only=True)
class ReplayElite(Who, OnDevice, Which):
    """Print one elite of an archive, or its minimal terrain, and draw the terrain with the robots' paths.

    Elites are numbered by falling fitness; after fresh episodes their corrected fitness counts. That is not the order
    in which the controller fails: `faultline view` and `faultline report` list faults first.
    """

    replicas: int = 20
    """Episodes to run."""
    seed: int = 0
    """Seed of the fresh episodes."""
    out: Path | None = None
    """Figure to write, *.png; elite-<number>.png in the run, or of a published one in runs/<robot>-published; with
    another controller or certifier elite-<number>-<its name>.png. Of a minimal terrain minimal-<number>..."""

    def execute(self) -> None:
        """Prints the numbers and writes the figure."""
        done = replay(self)
        print(describe(done))
        save_figure(done.out, draw(done))
        print(f"Figure: {done.out}")


@dataclass(frozen=True, kw_only=True)
class Replay:
    """An elite and what became of it this time."""

    found: Found
    out: Path
    """Figure to write."""
    elite: int
    recording: "Recording"
    """Of its terrain."""
    fresh: Evaluation
    controller: str = ""
    """Who crossed it this time, if that is another controller than the search's."""
    minimal: str = ""
    """What is known of the minimal terrain, if that was crossed instead."""

    @property
    def genes(self) -> "NDArray[np.float32]":
        """Of the terrain that was crossed, shape (num_genes,)."""
        genes = self.recording.genes
        return self.found.archive.genes[self.elite] if genes is None else genes[0]


def replay(cfg: ReplayElite) -> Replay:
    """Crosses an elite's terrain again, or reads the recording of that.

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If there is no such elite, or robot, device or controller are not as they must be.
    """
    found = find_archive(cfg.robot, cfg.run, cfg.policy, space=cfg.space)
    archive, robot = found.archive, found.robot
    minima = None if cfg.minimal is None else found.minima()
    elite = found.one(cfg.elite) if minima is None else _one_of(minima, str(cfg.minimal), found)
    _, fitness = found.as_searched()
    policy = found.policy(cfg.policy)
    suffix = found.suffix(policy)
    name = "elite" if minima is None else "minimal"
    out = cfg.out or folder_for(found.run, robot.name) / f"{name}-{elite}{suffix}.png"
    if out.suffix != ".png":
        raise ValueError(f"out must be a file named *.png, got {out}: name for example {out / 'elite.png'}")
    genes = None if minima is None else minima.genes[elite]
    recording = _crossed(cfg, found, elite, policy, out, genes)
    return Replay(
        found=found,
        out=out,
        elite=elite,
        recording=recording,
        fresh=evaluation_of(recording.result(), archive.cells, fitness),
        controller=policy if suffix else "",
        minimal="" if minima is None else minima.words(elite),
    )


def _one_of(minima: "MinimalFound", text: str, found: Found) -> int:
    numbers = minima.chosen(text, found.run)
    if len(numbers) != 1:
        known = ", ".join(map(str, minima.genes))
        raise ValueError(f"--minimal must name one elite here, got '{text}': give one of {known}")
    return numbers[0]


def _crossed(
    cfg: ReplayElite, found: Found, elite: int, policy: str, out: Path, minimal: "NDArray[np.float32] | None"
) -> "Recording":
    """Crossings by a controller, once all is known to be as it must be."""
    from qd.show.recordings import Recordings, on_elite

    wanted = on_elite(found.archive, elite, policy=policy, replicas=cfg.replicas, seed=cfg.seed, minimal=minimal)
    device = resolve_device(cfg.device)
    check_policy(policy, found.robot, device)
    prepare_output(out)
    (recording,) = Recordings(found.robot, device=device).all_of([wanted])
    return recording


def describe(replay: Replay) -> str:
    """An elite's numbers as they were found, those that 40 fresh episodes corrected, if any did, and those of now."""
    archive, n, fresh = replay.found.archive, replay.elite, replay.fresh
    cells = archive.cells
    near = bool(fresh.valid[0]) and bool(cells.are_neighbours(archive.cell[n : n + 1], fresh.cell)[0])
    columns: list[tuple[str, Archive | Evaluation, int]] = [("found", archive, n), ("now", fresh, 0)]
    if archive.fresh is not None:
        columns.insert(1, ("corrected", archive.fresh, n))
    if replay.minimal:
        columns = [(f"whole elite, {label}", values, k) for label, values, k in columns[:-1]]
        columns.append(("minimal, now", fresh, 0))
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
        counted = [(getattr(values, name)[k], _counted(values, k)) for _, values, k in columns]
        rows[label] = [rate_words(round(rate * count) if count else 0, count) for rate, count in counted]
    again = (
        f"  It {'lands in its cell or a neighbour of it' if near else 'does not land in its cell or beside it'} again."
    )
    if replay.controller:
        again = f"  Now it was crossed with {replay.controller}; all else is of the controller that was searched."
    wide = 44 if replay.minimal else 34
    table = [f"  {label:22}" + "".join(f"{cell:>{wide}}" for cell in row) for label, row in rows.items()]
    which = "minimal terrain of elite" if replay.minimal else "elite"
    known = [f"Of the minimal terrain: {replay.minimal}."] if replay.minimal else [again.strip()]
    known += elite_words(archive, n)
    return "\n".join(
        [
            f"{replay.found.run}, {which} {n} of {len(archive):,} of {archive.robot}, found in iteration "
            f"{archive.iteration[n]}, with ratios in {cells.describe(int(archive.cell[n]))}",
            *table,
            "  Its terrain:",
            *(f"    {line}" for line in replay.found.space.describe(replay.genes).splitlines()),
            "  Rates with their 95 % intervals (Wilson); those as found are of the episodes that made it an elite.",
            *(f"  {line}" for line in known),
        ]
    )


def _penalty(mean: float, std: float, scale: float, ratio: float) -> str:
    return f"{mean * scale:.2f} +- {std * scale:.2f} ({ratio:.0%} of all)"


def _counted(values: Archive | Evaluation, number: int) -> int:
    """Episodes that a terrain's rates are of: none of a terrain that is invalid as a whole."""
    valid = isinstance(values, Archive) or values.valid[number]  # what is found is valid, or it were no elite
    return int(values.episodes[number] - values.invalid_episodes[number]) if valid else 0


def draw(replay: Replay) -> "Figure":
    """The height map of an elite with the robots' paths, and marks where they ended, by how."""
    from qd.show.crossed import crossed_of
    from qd.show.crossing_figures import draw_paths

    archive, n = replay.found.archive, replay.elite
    corrected = "" if archive.fresh is None else f"{archive.fresh.fitness[n]:.2f} corrected, "
    title = (
        f"{archive.robot}, elite {n} of {len(archive):,} after {archive.iterations:,} iterations: fitness "
        f"{archive.fitness[n]:.2f} as found, {corrected}"
        f"{replay.fresh.fitness[0]:.2f} in {replay.fresh.episodes[0]} fresh episodes"
    )
    if replay.minimal:
        title = f"{archive.robot}, minimal terrain of elite {n} of {len(archive):,}:\n{replay.minimal}"
    if replay.controller:
        title += f"\nwith another controller than was searched: {ControllerSpec.parse(replay.controller).label}"
    return draw_paths(crossed_of(replay.recording, archive.penalties, archive.scales), title)
