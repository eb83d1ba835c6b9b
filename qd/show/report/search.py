"""Data of the page about a search: how the controller fails, on which terrains, and where the numbers come from."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.causes import describe_cause
from qd.faults.families import VERDICTS, Ranking, summarise_search
from qd.faults.numbers import MinimalTerrains, fault_numbers
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

_MAX_BARS = 10
_FAULT = VERDICTS.index("fault")
_MEANS = ("goal", "collision", "fallen")
_MIN_TERRAINS = 10  # fewer have no interval of their mean


def collect_content(opened_run: OpenedRun, ranking: Ranking, policy: str, *, is_searched: bool) -> dict[str, Any]:
    """Values of the template, without the terrains that a controller crossed for the page."""
    archive = opened_run.archive
    minima = opened_run.minima
    search = opened_run.search()
    run = RunDirectory(opened_run.folder)
    space = opened_run.space
    searched, _ = opened_run.as_searched()
    metrics = _read_metrics(run, archive)
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
        "summary": summarise_search(ranking, archive),
        "failing": int(ranking.failing.sum()),
        "certifiers": " or ".join(archive.certifiers),
        "numbers": fault_numbers(archive),
        "fault_families": len(np.unique(ranking.families[ranking.verdict == _FAULT])),
        "means": {name: format_mean(getattr(ranking, f"{name}_rate"), ranking.families) for name in _MEANS},
        "causes": count_causes(ranking),
        "tiles": draw_sheet(archive.genes[ranking.numbers], space),
        "elites": _list_elites(ranking),
        "minimal_tiles": None if minima is None else draw_sheet(np.array([*minima.genes.values()]), space),
        "minimal": None if minima is None else _list_minima(minima),
        "curves": encode_figure(draw_curves(archive, metrics)) if metrics else "",
        "parallel": encode_figure(draw_archive(archive)),
        "origin": origin_rows({} if search is None else run.read_config()),
    }


def _read_metrics(run: RunDirectory, archive: Archive) -> Metrics:
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
    """Mean over terrains, with its interval over families where there are enough terrains."""
    limits = bootstrap_interval(rates, 0, families=families, bounds=RATES) if len(rates) >= _MIN_TERRAINS else None
    return percent(float(rates.mean())) + (f" ({percent(limits[0])} to {percent(limits[1])})" if limits else "")


def count_causes(ranking: Ranking) -> list[dict[str, Any]]:
    """The bars, the longest first; the rarest causes share one.

    Each has a name, its failing elites and faults, percent of the longest bar an elite, and the row of its worst elite.
    """
    groups: list[tuple[str, NDArray[np.int64], int | None]] = [
        (cause, rows, int(rows[0])) for cause, rows in ranking.by_cause().items()
    ]
    if len(groups) > _MAX_BARS:
        rest = groups[_MAX_BARS - 1 :]
        groups = groups[: _MAX_BARS - 1]
        groups.append((f"{len(rest)} other causes", np.concatenate([rows for _, rows, _ in rest]), None))
    longest = max((len(rows) for _, rows, _ in groups), default=1)
    return [
        {
            "name": name,
            "failing": len(rows),
            "faults": int((ranking.verdict[rows] == _FAULT).sum()),
            "share": 100.0 / longest,
            "tile": tile,
        }
        for name, rows, tile in groups
    ]


def _list_elites(ranking: Ranking) -> dict[str, Any]:
    """Every elite, faults first, then what fails most: rows of pictures with cells, and columns not for a phone."""
    rows = []
    for row in ranking.by_severity().tolist():
        cells = {
            "elite": f"{ranking.numbers[row]}",
            "what happens": ranking.name(row),
            "verdict": VERDICTS[int(ranking.verdict[row])],
            "goal [%]": f"{100 * ranking.goal_rate[row]:.0f}",
            "95 % interval": Rate(ranking.hits("goal_rate", row), int(ranking.counted[row])).limits,
            "base collision [%]": f"{100 * ranking.collision_rate[row]:.0f}",
            "fallen [%]": f"{100 * ranking.fallen_rate[row]:.0f}",
            "family": f"{ranking.families[row]}",
            "fitness": f"{ranking.fitness[row]:.1f}",
        }
        rows.append((row, cells))
    return {"rows": rows, "wide": (5, 6, 7, 8, 9)}


def _list_minima(minima: MinimalTerrains) -> dict[str, Any]:
    """Every minimal terrain, as the elites."""
    rows = []
    for index, entry in enumerate(minima.numbers["elites"]):
        cells = {
            "elite": f"{entry['elite']}",
            "cause": describe_cause(entry["cause"]),
            "parts left": f"{len(entry['bumps'])} of {entry['of']}",
            "goal [%]": "-" if entry["goal_rate"] is None else f"{100 * entry['goal_rate']:.0f}",
            "95 % interval": "{:.0f} to {:.0f} %".format(*(100 * limit for limit in entry["goal_interval"])),
            "margin [cm]": "-" if entry["margin_m"] is None else f"{100 * entry['margin_m']:.1f}",
            "verdict": str(entry.get("verdict", "")),
        }
        rows.append((index, cells))
    return {"rows": rows, "wide": (3, 5, 6)}
