"""Searches side by side: against different controllers, what breaks one of them and what is still left of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive, read_archive
from qd.fitness import FAILING_GOAL_RATE
from qd.run.directory import Metrics, RunDirectory
from qd.run.settings import as_settings, differences
from sim.files.command import InSpace, publish
from sim.files.intervals import bootstrap_interval, value_words

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CURVES = ("qd_score", "elites", "batch_goal_rate")
_MAY_DIFFER = ("policy", "policy_sha256", "seed")
_MOST_RUNS = 4  # lines that can be told apart


@dataclass(frozen=True, kw_only=True)
class Beside(InSpace):
    """Lay searches side by side: against different controllers (--runs), or in several terrain spaces (--spaces).

    --runs shows curves, and how the elites end. The searches are finished runs of one robot, with the same settings and
    equally many iterations; only controller and seed may differ. --spaces says what was found in each space and in
    which ways the controller fails there. The searches are of one robot and controller; all else may differ.
    """

    runs: tuple[str, ...] = ()
    """The run directories, each NAME=DIR, the name that of its controller; 2 to 4."""
    spaces: tuple[str, ...] = ()
    """Run directories in different spaces, each NAME=DIR; up to 6."""
    dose: tuple[Path, ...] = ()
    """Files of `faultline dose`, whose rows go with the spaces."""
    out: Path
    """Where to write the numbers; the figure goes beside it as .png."""

    def execute(self) -> dict[str, Any]:
        """Publishes the numbers.

        Raises:
            FileNotFoundError: If there is no run.
            ValueError: If runs cannot be compared, or a file cannot be written.
        """
        from sim.files.figures import as_png
        from sim.files.records import provenance

        if bool(self.runs) == bool(self.spaces) or (self.dose and not self.spaces):
            raise ValueError("name either --runs, or --spaces and to these --dose: NAME=DIR each")
        if self.spaces:
            return self._lay_spaces()
        sides = sides_of(self.runs)
        report = {
            **provenance("cpu", 0),
            **{key: sides[0].settings[key] for key in ("robot", "robot_sha256", "penalty_definition")},
            "iterations": sides[0].archive.iterations,
            "runs": {side.name: numbers_of(side) for side in sides},
        }
        return publish(self.out, lambda: report, _show, draw=lambda _: as_png(draw_beside(sides)))

    def _lay_spaces(self) -> dict[str, Any]:
        from qd.studies.spaces import MOST_SPACES, draw_spaces, joined_dose, print_spaces, searches_of, space_numbers
        from sim.files.figures import as_png
        from sim.files.records import provenance

        searches = searches_of(_named(self.spaces, "spaces", 1, MOST_SPACES), self.space)
        named = next(iter(searches.values())).named
        report = {
            **provenance("cpu", 0),
            **named,
            "spaces": {name: space_numbers(search) for name, search in searches.items()},
            **joined_dose(self.dose, named),
        }
        return publish(self.out, lambda: report, print_spaces, draw=lambda _: as_png(draw_spaces(searches)))


@dataclass(frozen=True, kw_only=True)
class Side:
    """One of the searches."""

    name: str
    archive: Archive
    metrics: Metrics
    settings: dict[str, Any]


def _named(runs: Sequence[str], flag: str, least: int, most: int) -> dict[str, str]:
    """Run directories by name, as the command line has them.

    Raises:
        ValueError: If one has no name, two have the same, or there are too few or too many.
    """
    parts = [run.partition("=") for run in runs]
    named = {name: folder for name, _, folder in parts}
    if not all(name and folder for name, folder in named.items()) or len(named) < len(parts):
        raise ValueError(f"{flag} must be NAME=DIR each, with different names, got {' '.join(runs)}")
    if not least <= len(named) <= most:
        raise ValueError(f"{flag} must be {least} to {most}, got {len(named)}")
    return named


def sides_of(runs: Sequence[str]) -> list[Side]:
    """The searches that a command line names.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If one is damaged, or they cannot be compared.
    """
    sides = []
    for name, folder in _named(runs, "runs", 2, _MOST_RUNS).items():
        run = RunDirectory(Path(folder))
        settings = as_settings(run.read_cfg())
        sides.append(Side(name=name, archive=read_archive(folder), metrics=run.read_metrics(), settings=settings))
    first = sides[0]
    for side in sides:
        if len(side.archive) == 0:
            raise ValueError(f"the search against {side.name} has no elites: let it go on")
        found = differences(first.settings, side.settings)
        if different := [line for line in found if line.split()[0] not in _MAY_DIFFER]:
            raise ValueError(f"searches laid side by side must have the same settings, but: {', '.join(different)}")
        if len(side.metrics) != len(first.metrics) or side.archive.iterations != len(side.metrics):
            raise ValueError(
                f"searches laid side by side must have equally many iterations, got {len(first.metrics)} against "
                f"{first.name} and {side.archive.iterations} against {side.name}: extend the shorter one"
            )
    return sides


def numbers_of(side: Side) -> dict[str, Any]:
    """A search in numbers, its elites as they were found.

    Returns:
        ``elites``, ``qd_score``, the ``curves``; over the elites the mean ``goal_rate`` and ``collision_rate``, and the
        shares ``under_half_cross`` and ``half_collide``, each with its 95 % bootstrap interval; and ``mean_ratios``.
    """
    archive = side.archive
    measured = {
        "goal_rate": archive.goal_rate,
        "collision_rate": archive.collision_rate,
        "under_half_cross": (archive.goal_rate < FAILING_GOAL_RATE).astype(float),
        "half_collide": (archive.collision_rate >= 0.5).astype(float),
    }
    return {
        "controller": {key: side.settings[key] for key in ("policy", "policy_sha256")},
        "seed": side.settings["seed"],
        "elites": len(archive),
        "qd_score": archive.qd_score,
        **{name: float(values.mean()) for name, values in measured.items()},
        "intervals": {name: bootstrap_interval(values, 0) for name, values in measured.items()},
        "mean_ratios": dict(zip(archive.penalties, archive.ratios.mean(axis=0).tolist(), strict=True)),
        "curves": {key: [row[key] for row in side.metrics] for key in _CURVES},
    }


def draw_beside(sides: Sequence[Side]) -> "Figure":
    """Curves of the searches, how often their elites are crossed, and where their penalties lie."""
    from qd.studies.study import LOOKS
    from sim.files.figures import new_figure

    figure = new_figure(13.0, 4.4)
    archive = sides[0].archive
    names = " and ".join(side.name for side in sides)
    figure.suptitle(f"{archive.robot}: searches of {archive.iterations} iterations against {names}")
    axes = figure.subplots(1, 4)
    for side, (color, style) in zip(sides, LOOKS, strict=False):
        label = f"{side.name}: {len(side.archive)} elites"
        iterations = [row["iteration"] for row in side.metrics]
        for panel, key, factor in ((axes[0], "elites", 1.0), (axes[1], "batch_goal_rate", 100.0)):
            values = [factor * row[key] for row in side.metrics]
            panel.plot(iterations, values, color=color, linestyle=style, label=label)
        rates = np.sort(100.0 * side.archive.goal_rate)
        shares = 100.0 * np.arange(1, len(rates) + 1) / len(rates)
        axes[2].step(rates, shares, color=color, linestyle=style, where="post")
        ratios = 100.0 * side.archive.ratios.mean(axis=0)
        axes[3].plot(ratios, range(len(ratios)), color=color, linestyle=style, marker="o")
    _label(axes, archive)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(sides), frameon=False)
    return figure


def _label(axes: "NDArray[Any] | Sequence[Axes]", archive: Archive) -> None:
    from qd.show.figures import look_of

    labels = (
        ("iteration", "elites"),
        ("iteration", "robots that reach the goal,\nof all that are evaluated [%]"),
        ("episodes of an elite that reach the goal [%]", "elites of which no more do [%]"),
        ("mean share of the penalties [%]", ""),
    )
    for panel, (x, y) in zip(axes, labels, strict=True):
        panel.set_xlabel(x)
        panel.set_ylabel(y)
        panel.grid(alpha=0.3)
    axes[0].set_ylim(bottom=0)
    axes[1].set_ylim(0, 102)
    axes[2].set_ylim(0, 102)
    names = [look_of(name).label for name in archive.penalties]
    axes[3].set_xlim(left=0)
    axes[3].set_yticks(range(len(names)), names)


def _show(report: dict[str, Any]) -> None:
    for name, numbers in report["runs"].items():
        share = value_words(numbers["under_half_cross"], numbers["intervals"]["under_half_cross"], ".0%")
        print(
            f"{name}: {numbers['elites']} elites, QD score {numbers['qd_score']:.0f}; under half of the robots cross "
            f"{share} of them; mean goal rate "
            f"{numbers['goal_rate']:.3f}, base collisions {numbers['collision_rate']:.3f}"
        )
