"""The evaluation's tables: what ``tables.json`` says of controllers on sets of terrains.

A controller *fails* a terrain where under half of its valid episodes there reach the goal; an episode with a base
collision does not. Of two controllers, a terrain is then *mended* (the first fails, the second does not), *still
failing* (both), *newly broken* (the second alone) or *fine* with both. A terrain that is a matter of luck to either
falls on one side by chance: *clear* are those changes where the 95 % intervals (Wilson) of the two goal rates do not
overlap.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import msgspec
import numpy as np
from numpy.typing import NDArray

from qd.evaluate.labels import CERTIFIED, MEASURES, RATES
from qd.evaluate.measures import Families, Measured, interval_of, mean_of, of_terrains
from qd.evaluate.paper import Published, published
from qd.evaluate.sets import TerrainSet
from qd.fitness import FAILING_GOAL_RATE
from sim.files.intervals import t_interval, wilson_interval
from sim.files.records import check_robot
from sim.policy.spec import controller_hash, firsts, kind_of
from sim.robots.robot import RobotCfg

Number = float | None
"""None where no terrain is valid."""
Limits = list[float] | None
"""Lower and upper limit of a 95 % interval; None where nothing is known of the spread."""
Values = dict[str, dict[str, Number]]
"""Set -> controller -> mean over the set's terrains."""


class Controller(TypedDict):
    """A controller of the tables."""

    policy: str
    sha256: str | None


class Counted(TypedDict):
    """Some of the terrains that were compared."""

    count: int
    share: Number
    interval: Limits
    """Of the share."""
    terrains: NotRequired[list[int]]
    """Their numbers, ascending; not of the fine ones, which are the most."""
    clear: NotRequired[int]
    """How many of those mended or newly broken are so beyond chance."""


class Gain(TypedDict):
    """Mean difference of a measure, terrain by terrain."""

    mean: Number
    interval: Limits


class Difference(TypedDict):
    """What became of the terrains of a set from one controller to another."""

    compared: int
    """Terrains that are valid for both."""
    mended: Counted
    still_failing: Counted
    newly_broken: Counted
    fine: Counted
    gain: dict[str, Gain]
    """By measure."""


class Certified(TypedDict):
    """Certified terrains of a set, and whose rates on them are biased by how they were chosen."""

    terrains: int
    certifiers: dict[str, int]
    """Name -> how many of them it certifies."""
    chosen_by: dict[str, str]
    """Controller -> ``certifier``, which crossed some of them to certify them, or ``searched``, which failed them all:
    the rate of the first is biased upward, that of the other downward."""


class OverSeeds(TypedDict):
    """Several controllers of a kind."""

    mean: Number
    """None where one of the values is."""
    interval: Limits
    """95 % t interval over them."""
    values: list[Number]


class Tables(TypedDict):
    """What is said of controllers on sets of terrains. Rates are fractions."""

    robot: str
    episodes: int
    """On each terrain."""
    controllers: dict[str, Controller]
    terrains: dict[str, int]
    """How many, by set."""
    goal: Values
    success: Values
    fallen: Values
    reward: Values
    penalties: dict[str, dict[str, dict[str, Number]]]
    """Set -> controller -> penalty -> mean, scaled."""
    certified_goal: Values
    """On certified terrains alone, of sets whose elites have certificates."""
    certified_success: Values
    certified: dict[str, Certified]
    """By set."""
    intervals: dict[str, dict[str, dict[str, Any]]]
    """Measure -> set -> controller -> interval; of ``penalties`` by penalty."""
    over_seeds: dict[str, dict[str, dict[str, OverSeeds]]]
    """Measure -> set -> kind of controller; only kinds of which there are several."""
    outcomes: dict[str, dict[str, dict[str, int]]]
    """Set -> controller -> how many episodes ended so."""
    invalid_terrains: dict[str, dict[str, int]]
    differences: dict[str, dict[str, Difference]]
    """Set -> ``first -> second``, of every two kinds' first controllers."""
    paper: Published | None
    """The paper's numbers, None of a robot it has none of."""
    reward_weights: dict[str, Any]
    part: NotRequired[str]
    """``test``, or ``validation`` of terrains by which settings are chosen."""
    archive: NotRequired[dict[str, Any] | None]
    """Of which the generated terrains are."""
    robot_sha256: NotRequired[str]


Crossed = Mapping[str, Mapping[str, Measured]]
"""Set -> controller -> what it made of the set's terrains."""


def read_tables(file: Path, robot: RobotCfg) -> Tables:
    """The tables of a robot to report; refuses those of validation terrains."""
    if not file.exists():
        raise FileNotFoundError(f"no tables at {file}: `faultline evaluate` writes them")
    try:
        tables = as_tables(msgspec.json.decode(file.read_bytes()))
    except (msgspec.MsgspecError, ValueError) as error:
        raise ValueError(f"{file} must hold the tables of `faultline evaluate`: {error}: give that file") from None
    if tables["robot"] != robot.name:
        raise ValueError(f"{file} must be of robot {robot.name}, got {tables['robot']}: give other tables")
    if tables.get("part") == "validation":
        raise ValueError(f"{file} must be of test terrains, got validation, by which settings are chosen")
    check_robot(tables, robot, file, "make them anew")
    return tables


def as_tables(content: Any) -> Tables:
    """JSON values as tables."""
    tables = msgspec.convert(content, Tables)
    for measure in (*MEASURES, *CERTIFIED):
        rows = [*tables[measure].values(), *tables["intervals"].get(measure, {}).values()]
        if any(row.keys() != tables["controllers"].keys() for row in rows):
            raise ValueError(f"{measure} must have a value of every controller on each set")
    return tables


def make_tables(
    crossed: Crossed,
    sets: Mapping[str, TerrainSet],
    robot: RobotCfg,
    *,
    controllers: dict[str, Controller],
    episodes: int,
    seed: int,
) -> Tables:
    """Everything that the tables say of crossings."""
    means = _statistics(crossed, sets, lambda values, _: mean_of(values))
    return Tables(
        robot=robot.name,
        episodes=episodes,
        controllers=controllers,
        **means,
        certified=_about_certified(sets, controllers),
        over_seeds=over_seeds(means, (*MEASURES, *CERTIFIED)),
        intervals=_statistics(crossed, sets, lambda values, families: interval_of(values, seed, families)),
        terrains={name: len(terrains) for name, terrains in sets.items()},
        outcomes=_each(crossed, lambda measured: measured.outcomes),
        invalid_terrains=_each(crossed, lambda measured: int((~measured.valid).sum())),
        differences={
            name: differences(
                {first: row[first] for first in firsts(row)}, sets[name].numbers, seed, sets[name].families
            )
            for name, row in crossed.items()
        },
        paper=published(robot.name),
        reward_weights={
            **{name: weight for name, weight in asdict(robot.training.rewards).items() if weight},
            "only_positive": robot.training.only_positive,
        },
    )


def _each(crossed: Crossed, of: Callable[[Measured], Any]) -> dict[str, dict[str, Any]]:
    return {name: {controller: of(measured) for controller, measured in row.items()} for name, row in crossed.items()}


def _statistics(
    crossed: Crossed, sets: Mapping[str, TerrainSet], statistic: Callable[[NDArray[np.float64], Families], Any]
) -> dict[str, Any]:
    """Each measure and ``penalties``: set -> controller -> a statistic of the terrains' values and families."""
    tables: dict[str, Any] = {key: {} for key in (*MEASURES, "penalties", *CERTIFIED)}
    for name, row in crossed.items():
        families, certificates = sets[name].families, sets[name].certificates
        for key in MEASURES:
            tables[key][name] = {controller: statistic(row[controller].values[key], families) for controller in row}
        tables["penalties"][name] = {
            controller: {key: statistic(values, families) for key, values in measured.penalties.items()}
            for controller, measured in row.items()
        }
        if certificates is not None:
            member = certificates.certified
            kin = of_terrains(families, member)
            for key, measure in CERTIFIED.items():
                tables[key][name] = {
                    controller: statistic(row[controller].values[measure][member], kin) for controller in row
                }
    return tables


def _about_certified(sets: Mapping[str, TerrainSet], controllers: Mapping[str, Controller]) -> dict[str, Certified]:
    certified = {}
    for name, terrains in sets.items():
        certificates = terrains.certificates
        if certificates is not None:
            counts = dict(zip(certificates.certifiers, certificates.given.sum(axis=0).tolist(), strict=True))
            by_hash = dict(zip(certificates.sha256, certificates.certifiers, strict=True))
            roles = {certificates.searched_sha256: "searched"}
            roles |= {sha256: "certifier" for sha256, certifier in by_hash.items() if counts[certifier]}
            hashes = {controller: about["sha256"] for controller, about in controllers.items()}
            certified[name] = Certified(
                terrains=int(certificates.certified.sum()),
                certifiers=counts,
                chosen_by={
                    controller: roles[sha] for controller, sha in hashes.items() if sha is not None and sha in roles
                },
            )
    return certified


def difference(
    before: Measured, after: Measured, numbers: NDArray[np.int64], seed: int, families: Families = None
) -> Difference:
    """What became of each terrain from one controller to another, and what the second gains in the mean."""
    both = before.valid & after.valid
    kin = of_terrains(families, both)
    fails, then_fails = (both & (rates.values["goal"] < FAILING_GOAL_RATE) for rates in (before, after))
    limits, then_limits = _wilson_limits(before), _wilson_limits(after)
    apart = (limits[:, 1] < then_limits[:, 0]) | (then_limits[:, 1] < limits[:, 0])
    members = {
        "mended": fails & ~then_fails,
        "still_failing": fails & then_fails,
        "newly_broken": ~fails & then_fails,
        "fine": both & ~fails & ~then_fails,
    }
    counts: dict[str, Counted] = {}
    for fate, member in members.items():
        shares = member[both].astype(float)
        counts[fate] = Counted(count=int(member.sum()), share=mean_of(shares), interval=interval_of(shares, seed, kin))
        if fate != "fine":
            counts[fate]["terrains"] = np.sort(numbers[member]).tolist()
        if fate in ("mended", "newly_broken"):
            counts[fate]["clear"] = int((member & apart).sum())
    gains = {name: (after.values[name] - before.values[name])[both] for name in MEASURES}
    return Difference(
        compared=int(both.sum()),
        **counts,  # type: ignore[typeddict-item]
        gain={name: Gain(mean=mean_of(gain), interval=interval_of(gain, seed, kin)) for name, gain in gains.items()},
    )


def differences(
    crossed: dict[str, Measured], numbers: NDArray[np.int64], seed: int, families: Families = None
) -> dict[str, Difference]:
    """:func:`difference` of every two controllers, the earlier named one first, under ``first -> second``."""
    return {
        f"{first} -> {second}": difference(crossed[first], crossed[second], numbers, seed, families)
        for first, second in combinations(crossed, 2)
    }


def _wilson_limits(measured: Measured) -> NDArray[np.float64]:
    """Interval of the goal rate on each terrain, shape (T, 2); anything possible on an invalid one."""
    counts = zip(measured.goals.tolist(), measured.episodes.tolist(), strict=True)
    return np.array([wilson_interval(goals, episodes) for goals, episodes in counts])


def check_seeds(controllers: Mapping[str, str]) -> None:
    """Refuses one training as several: the interval over its "seeds" would be none."""
    known: dict[tuple[str, str], str] = {}
    for name, policy in controllers.items():
        if not re.fullmatch("[^@]+(@[^@]+)?", name):
            raise ValueError(f"a controller must be named KIND or KIND@SEED, as C-G@1, got '{name}'")
        key = (kind_of(name), controller_hash(policy) or policy)
        if key in known:
            raise ValueError(f"{known[key]} and {name} must be different trainings, got the same controller twice")
        known[key] = name


def over_seeds(tables: Mapping[str, Values], measures: Iterable[str]) -> dict[str, dict[str, dict[str, OverSeeds]]]:
    """Mean over the controllers of each kind that has several: measure -> set -> kind."""
    summaries: dict[str, dict[str, dict[str, OverSeeds]]] = {}
    for measure in measures:
        for name, row in tables[measure].items():
            for kind in dict.fromkeys(map(kind_of, row)):
                values = [value for controller, value in row.items() if kind_of(controller) == kind]
                if len(values) > 1:
                    summary = _mean_over_seeds(values, is_rate=measure in RATES)
                    summaries.setdefault(measure, {}).setdefault(name, {})[kind] = summary
    return summaries


def _mean_over_seeds(values: list[Number], *, is_rate: bool) -> OverSeeds:
    numbers = [value for value in values if value is not None]
    if len(numbers) < len(values):
        return OverSeeds(mean=None, interval=None, values=values)
    interval = t_interval(np.array(numbers))
    if interval is not None and is_rate:
        interval = [max(interval[0], 0.0), min(interval[1], 1.0)]
    return OverSeeds(mean=sum(numbers) / len(numbers), interval=interval, values=values)
