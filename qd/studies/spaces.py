"""Searches in several terrain spaces side by side, and the dose beside them: what breaks a controller on each."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

from qd.archive import Archive, read_archive
from qd.faults import fault_numbers
from qd.fresh import numbers_of
from qd.groups import elites_of, failure_modes
from qd.run.directory import RunDirectory, check_space, named_by
from qd.run.minimal_file import NUMBERS_FILE
from sim.files.atomic import read_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_SPACES = 6
"""Searches that fit into one figure."""
_SAME = ("robot", "robot_sha256", "policy_sha256", "penalty_definition")
_FAULTS = ("failing", "confirmed", "certified", "faults", "panel")
_LINE = 160  # characters of a terrain in words on the terminal
_NAMES = ("element", "parameter", "value", "controller", "at", "resolved")  # of a row of a dose


@dataclass(frozen=True, kw_only=True)
class Searched:
    """A search in a space."""

    path: Path
    archive: Archive
    summary: dict[str, Any]
    """The run in numbers."""
    named: dict[str, Any]
    """Robot, controller and definition of the penalties."""


def searches_of(named: dict[str, str], space: str | None) -> dict[str, Searched]:
    """The searches that a command line names.

    Args:
        named: Run directory by name.
        space: Terrain space of a user's own among them.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If one is damaged or without elites, or they are of different robots or controllers.
    """
    found: dict[str, Searched] = {}
    for name, folder in named.items():
        path = Path(folder)
        archive = read_archive(path)
        check_space(archive, path, space)
        own = Searched(
            path=path, archive=archive, summary=RunDirectory(path).read_summary(), named=named_by(path, archive)
        )
        if len(archive) == 0 or "episodes" not in own.summary:
            raise ValueError(f"{path} must be a search with elites and its numbers, archive.json: let it go on")
        first = next(iter(found.values()), own)
        different = [key for key in _SAME if own.named.get(key) != first.named.get(key)]
        if different:
            raise ValueError(
                f"searches in several spaces must be of one robot and controller, but {name} has another "
                f"{', '.join(different)} than {next(iter(found))}: name others"
            )
        found[name] = own
    return found


def joined_dose(files: Sequence[Path], named: dict[str, Any]) -> dict[str, Any]:
    """The rows of the files of ``faultline dose``, one after the other.

    Args:
        files: The files; none gives None for both keys.
        named: Robot that they must be of.

    Returns:
        ``dose`` and ``half``.

    Raises:
        FileNotFoundError: If there is no file.
        ValueError: If it is none of this robot, or a row comes twice.
    """
    if not files:
        return {"dose": None, "half": None}
    rows, half, seen = [], [], set()
    for file in files:
        content = read_json(file)
        own = content.get("dose")
        if not isinstance(own, list) or not all(isinstance(row, dict) and set(_NAMES) <= row.keys() for row in own):
            raise ValueError(f"{file} must be numbers that `faultline dose` wrote, got something else")
        if any(content.get(key) != named[key] for key in ("robot", "robot_sha256")):
            raise ValueError(f"{file} must be of robot {named['robot']} as it was searched, got {content.get('robot')}")
        for row in own:
            name = str([row.get(key) for key in _NAMES])
            if name in seen:
                raise ValueError(
                    f"{file} has {row['element']} of {row['parameter']} {row['value']} for {row['controller']}, which "
                    "another file has too: leave one out"
                )
            seen.add(name)
        rows += own
        half += [{**one, "resolved": content.get("resolved")} for one in content.get("half", [])]
    return {"dose": rows, "half": half}


def space_numbers(search: Searched) -> dict[str, Any]:
    """A search in numbers and words.

    Returns:
        ``space``, ``episodes``, ``terrains_evaluated``, ``iterations``, ``seed``, ``elites``, ``reachable_coverage``,
        ``corrected_elites``, ``failing``, ``confirmed``, ``certified``, ``faults``, ``panel`` (None of what nobody
        looked at), ``modes``: how many elites fail in which way, with the most typical terrain in words, and
        ``causes``: how many minimal terrains are of which shape, None without any.
    """
    from qd.show.figures import mode_words
    from sim.space import get_space

    archive, summary = search.archive, search.summary
    space = get_space(archive.space, archive.space_sha256)
    fresh = {} if archive.fresh is None else numbers_of(archive.fresh, archive.cells)
    modes = failure_modes(elites_of(archive)).modes
    minimal = search.path / NUMBERS_FILE
    return {
        "space": archive.space,
        **{key: summary.get(key) for key in ("iterations", "terrains_evaluated", "episodes", "seed")},
        "elites": len(archive),
        "reachable_coverage": archive.reachable_coverage,
        "corrected_elites": fresh.get("corrected_elites"),
        **{key: value for key, value in fault_numbers(archive).items() if key in _FAULTS},
        "modes": [
            {
                "words": mode_words(mode),
                "elites": len(mode.members),
                "goal_rate": mode.goal_rate,
                "typical": mode.typical,
                "terrain": space.describe(archive.genes[mode.typical]),
            }
            for mode in modes
        ],
        "causes": read_json(minimal).get("causes") if minimal.exists() else None,
    }


def print_spaces(report: dict[str, Any]) -> None:
    """Prints what was found in each space, and where half of the robots get over each obstacle."""
    for name, numbers in report["spaces"].items():
        counts = [f"{numbers[key]:,} {key}" for key in _FAULTS[:4] if numbers[key] is not None]
        print(
            f"{name} ({numbers['space']}): {numbers['episodes']:,} episodes, {numbers['elites']:,} elites"
            + "".join(f", {words}" for words in counts)
        )
        for mode in numbers["modes"]:
            terrain = shorten(mode["terrain"], _LINE, placeholder=" ...")
            print(f"  {mode['elites']:>5} {mode['words']}, such as elite {mode['typical']}: {terrain}")
        if numbers["causes"]:
            print(f"  causes: {', '.join(f'{kind} {count}' for kind, count in numbers['causes'].items())}")
    for row in report["half"] or ():
        print(f"{row['element']}, {row['controller']}: {row['words']}")


def draw_spaces(searches: dict[str, Searched]) -> "Figure":
    """The elites of each search over one vertical axis a share, coloured by how many robots miss the goal."""
    from qd.show.figures import draw_elites
    from sim.files.figures import new_figure

    first = next(iter(searches.values())).archive
    columns = min(2, len(searches))
    rows = -(-len(searches) // columns)
    figure = new_figure(1.2 + columns * (1.1 * len(first.penalties) + 1.2), 0.6 + 4.2 * rows)
    figure.suptitle(f"{first.robot}: archives of {len(searches)} terrain spaces")
    panels, lines = [], None
    for place, (name, search) in enumerate(searches.items()):
        axes = figure.add_subplot(rows, columns, place + 1)
        elites = elites_of(search.archive)
        missed = 100.0 * (1.0 - elites.goal_rate)
        lines = draw_elites(axes, elites.penalties, elites.ratios, missed, (0.0, 100.0))
        axes.set_title(f"{name}: {len(elites):,} elites, {elites.failing.sum():,} failing", fontsize=10)
        panels.append(axes)
    if lines is not None:
        figure.colorbar(lines, ax=panels, label="robots that miss the goal [%]", pad=0.02, shrink=0.8)
    return figure
