"""The tables on the terminal, with the paper's own numbers beside ours."""

from collections.abc import Iterable
from typing import Any

from train.evaluate.measures import invalid_lines
from train.evaluate.seeds import print_over_seeds

_DIGITS = {"success": 3, "goal": 3, "fallen": 3, "reward": 1}


def published_value(report: dict[str, Any], measure: str, name: str, who: str) -> float | None:
    """The paper's number of a measure, a set and a controller's name; None where it has none."""
    return ((report["paper"] or {}).get(measure, {}).get(name) or {}).get(who)


def print_tables(report: dict[str, Any]) -> None:
    """Print every set with every controller, what became of terrains between controllers, and what nobody crossed.

    Args:
        report: As ``tables.json`` has it.
    """
    wide = 2 + max(12, *(len(who) for row in report["success"].values() for who in row))
    for name in report["success"]:
        _print_set(report, name, wide)
    if report["paper"] is not None:
        print("paper: its success rate and reward, where it has a controller of that name")
    print_over_seeds(report["over_seeds"])
    _print_penalties(report, wide)
    _print_differences(report)
    for name, groups in report["traversable"].items():
        _print_traversable(name, groups, wide)
    ended = {f"{who} on {name}": counts for name, row in report["outcomes"].items() for who, counts in row.items()}
    for line in invalid_lines(ended):
        print(line)


def _print_set(report: dict[str, Any], name: str, wide: int) -> None:
    print(f"\n{name}: {report['terrains'][name]} terrains x {report['episodes']} episodes")
    print(_row("", (*_DIGITS, "paper"), wide, 21))
    for who in report["success"][name]:
        cells = [
            _with_interval(report[measure][name][who], report["intervals"][measure][name][who], digits)
            for measure, digits in _DIGITS.items()
        ]
        paper = [published_value(report, measure, name, who) for measure in ("success", "reward")]
        cells.append("" if None in paper else "{:.3f}, {:.1f}".format(*paper))
        print(_row(who, cells, wide, 21))


def _row(label: str, cells: Iterable[str], wide: int, each: int) -> str:
    return f"{label:<{wide}}" + "".join(f"{cell:>{each}}" for cell in cells)


def _with_interval(value: float | None, limits: list[float] | None, digits: int, sign: str = "") -> str:
    if value is None or limits is None:
        return "-"
    return f"{value:{sign}.{digits}f} [{limits[0]:{sign}.{digits}f} {limits[1]:{sign}.{digits}f}]"


def _print_penalties(report: dict[str, Any], wide: int) -> None:
    rows = report["penalties"]
    names = list(next(iter(next(iter(rows.values())).values())))
    print("\nscaled penalties: 1 is what a common one comes to with the shipped controller on hard-random terrain")
    for name, row in rows.items():
        print(_row(name, names, wide, 15))
        for who, values in row.items():
            cells = ("-" if values[key] is None else f"{values[key]:.2f}" for key in names)
            print(_row(f"  {who}", cells, wide, 15))


def _print_differences(report: dict[str, Any]) -> None:
    if not any(report["differences"].values()):
        return
    print(
        "\nTerrains on which under half of the episodes reach the goal: with the first controller and not the second\n"
        "(mended), with both (still failing), with the second alone (newly broken); in brackets those beyond chance."
    )
    for name, pairs in report["differences"].items():
        print(name)
        for pair, found in pairs.items():
            mended, broken = found["mended"], found["newly_broken"]
            gain = _with_interval(found["gain"]["goal"]["mean"], found["gain"]["goal"]["interval"], 3, "+")
            print(
                f"  {pair}: {mended['count']} mended ({mended['clear']}), {found['still_failing']['count']} still "
                f"failing, {broken['count']} newly broken ({broken['clear']}) of {found['compared']}; goal rate {gain}"
            )


def _print_traversable(name: str, groups: dict[str, Any], wide: int) -> None:
    for key, label in (("crossed", "that some controller crossed"), ("never_crossed", "that none ever crossed")):
        group = groups[key]
        print(f"\n{name}: {group['count']} terrains {label}")
        if group["count"]:
            print(_row("", _DIGITS, wide, 12))
            for who in group["success"]:
                values = ((group[measure][who], digits) for measure, digits in _DIGITS.items())
                cells = ("-" if value is None else f"{value:.{digits}f}" for value, digits in values)
                print(_row(who, cells, wide, 12))
