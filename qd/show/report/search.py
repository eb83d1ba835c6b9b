"""The page about a search, in data: how the controller fails, on which terrains, and where the numbers come from."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.causes import describe_cause
from qd.faults.families import VERDICTS, Ranking, summarise
from qd.faults.minimise.minimise import MinimalTerrains
from qd.faults.numbers import fault_numbers
from qd.search.archive import Archive
from qd.search.directory import METRICS_FILE, Metrics, RunDirectory
from qd.show.crossed import Rate
from qd.show.elites import OpenedRun
from qd.show.figures import draw_archive, draw_curves
from qd.show.report.page import encode_figure, origin_rows, percent
from qd.show.report.pictures import draw_sheet
from sim.controllers.spec import SHIPPED, ControllerSpec, resolve_policy
from sim.files.intervals import RATES, bootstrap_interval
from sim.files.provenance import without_machine

_MOST_BARS = 10
_FAULT = VERDICTS.index("fault")
_MEANS = ("goal", "collision", "fallen")
_MIN_TERRAINS = 10  # that an interval of a mean is resampled from


def collect_content(
    opened_run: OpenedRun, ranking: Ranking, minima: MinimalTerrains | None, policy: str, *, is_searched: bool
) -> dict[str, Any]:
    """What the template takes, beside the terrains that a controller crossed for the page."""
    archive, search, run = opened_run.archive, opened_run.search(), RunDirectory(opened_run.folder)
    space, (searched, _) = opened_run.space, opened_run.as_searched()
    metrics = _metrics_of(run, archive)
    controller = "its own controller" if searched == SHIPPED else ControllerSpec.parse(searched).label
    if search is None and opened_run.suffix(resolve_policy(SHIPPED, opened_run.robot)):
        controller = "a controller that is not at hand"
    return {
        "archive": archive,
        "run": opened_run.command,
        "search": search,
        "metrics": metrics,
        "gpus": run.read_summary().get("gpus"),
        "controller": controller,
        "crosser": "" if is_searched else ControllerSpec.parse(policy).label,
        "place": without_machine(str(opened_run.path)),
        "summary": summarise(ranking, archive),
        "failing": int(ranking.failing.sum()),
        "certifiers": " or ".join(archive.certifiers),
        "numbers": fault_numbers(archive),
        "fault_families": len(np.unique(ranking.families[ranking.verdict == _FAULT])),
        "means": {name: format_mean(getattr(ranking, f"{name}_rate"), ranking.families) for name in _MEANS},
        "causes": causes_of(ranking),
        "tiles": draw_sheet(archive.genes[ranking.numbers], space),
        "elites": _listed_elites(ranking),
        "minimal_tiles": None if minima is None else draw_sheet(np.array([*minima.genes.values()]), space),
        "minimal": None if minima is None else _listed_minima(minima),
        "curves": encode_figure(draw_curves(archive, metrics)) if metrics else "",
        "parallel": encode_figure(draw_archive(archive)),
        "origin": origin_rows({} if search is None else run.read_config()),
    }


def _metrics_of(run: RunDirectory, archive: Archive) -> Metrics:
    """The rows up to the archive's iteration, if there are some; a run that goes on meanwhile may have some more."""
    if not (run.path / METRICS_FILE).exists():
        return []
    rows = run.read_metrics()[: archive.iterations]
    if len(rows) < archive.iterations:
        raise ValueError(
            f"{run.path / METRICS_FILE} must have a row for each of {archive.iterations} iterations, got {len(rows)}: "
            "resume the search, which writes it again"
        )
    return rows


def format_mean(rates: NDArray[np.float64], families: NDArray[np.int64]) -> str:
    """Mean over terrains, with its interval over families where they are not few."""
    limits = bootstrap_interval(rates, 0, families=families, bounds=RATES) if len(rates) >= _MIN_TERRAINS else None
    return percent(float(rates.mean())) + (f" ({percent(limits[0])} to {percent(limits[1])})" if limits else "")


def causes_of(ranking: Ranking) -> list[dict[str, Any]]:
    """The bars, the longest first; the rarest causes share one.

    Each has a name, its failing elites and faults, percent of the longest bar an elite, and the row of its worst elite.
    """
    groups = [*ranking.by_cause().items()]
    count = len(groups) if len(groups) <= _MOST_BARS else _MOST_BARS - 1
    first, rest = groups[:count], groups[count:]
    tiles: list[int | None] = [int(rows[0]) for _, rows in first]
    if rest:
        first = [*first, (f"{len(rest)} other causes", np.concatenate([rows for _, rows in rest]))]
        tiles.append(None)
    longest = max((len(rows) for _, rows in first), default=1)
    return [
        {
            "name": name,
            "failing": len(rows),
            "faults": int((ranking.verdict[rows] == _FAULT).sum()),
            "share": 100.0 / longest,
            "tile": tile,
        }
        for (name, rows), tile in zip(first, tiles, strict=True)
    ]


def _listed_elites(ranking: Ranking) -> dict[str, Any]:
    """Every elite, faults first, then what fails most: places of pictures with words, and columns not for a phone."""
    rows = []
    for row in ranking.by_severity().tolist():
        rates = (ranking.collision_rate[row], ranking.fallen_rate[row])
        rate = Rate(ranking.hits("goal_rate", row), int(ranking.counted[row]))
        cells = [
            f"{ranking.numbers[row]}", ranking.name(row), VERDICTS[int(ranking.verdict[row])],
            f"{100 * ranking.goal_rate[row]:.0f}", rate.limits, *(f"{100 * value:.0f}" for value in rates),
            f"{ranking.families[row]}", f"{ranking.fitness[row]:.1f}",
        ]  # fmt: skip
        rows.append((row, cells))
    head = ["elite", "what happens", "verdict", "goal [%]", "95 % interval", "base collision [%]", "fallen [%]",
            "family", "fitness"]  # fmt: skip
    return {"head": head, "rows": rows, "wide": (5, 6, 7, 8, 9)}


def _listed_minima(minima: MinimalTerrains) -> dict[str, Any]:
    """Every minimal terrain, as the elites."""
    rows = []
    for place, entry in enumerate(minima.numbers["elites"]):
        cells = [
            f"{entry['elite']}",
            describe_cause(entry["cause"]),
            f"{len(entry['bumps'])} of {entry['of']}",
            "-" if entry["goal_rate"] is None else f"{100 * entry['goal_rate']:.0f}",
            "{:.0f} to {:.0f} %".format(*(100 * limit for limit in entry["goal_interval"])),
            "-" if entry["margin_m"] is None else f"{100 * entry['margin_m']:.1f}",
            str(entry.get("verdict", "")),
        ]
        rows.append((place, cells))
    head = ["elite", "cause", "parts left", "goal [%]", "95 % interval", "margin [cm]", "verdict"]
    return {"head": head, "rows": rows, "wide": (3, 5, 6)}
