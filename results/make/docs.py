"""Writes the tables of README.md and docs/*.md from the JSON files of published numbers.

A table stands between the lines `<!-- table: NAME -->` and `<!-- end -->`. NAME is a function of TABLES, with a robot
behind it if the function takes one. With --check nothing is written: the exit status is 1 if a page says something
else than the files, or if a picture shows another state of them.
"""

import hashlib
import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from qd.evaluate.labels import HELD_OUT, SETS
from qd.evaluate.pack import find_pack
from sim.files.intervals import format_value

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs/pictures"
MADE = "docs/pictures/made.json"
"""What each picture shows: files with their hashes, or ``FILE#KEY/KEY`` for a part of a JSON file."""
ROBOTS = {"anymal": "ANYmal C", "cassie": "Cassie"}
CONTROLLERS = ("base", "C-HC", "C-HR", "C-G", "hardened")
NONE = "-"
BUMPS = 8
"""Parts of a terrain of the paper, behind which its conditions stand."""
MARKED = re.compile(r"<!-- table: (\w+)((?: \w+)?) -->\n.*?<!-- end -->", re.DOTALL)
PAPER = "results/paper.json"
"""Numbers of the paper (Esquerre-Pourtere, Kim and Park, arXiv 2506.01362).

Its archives after 1,000 iterations, and its four tables, "Average rewards" and "Success rates" with the Cassie and with
the ANYmal robot. Its rewards are sums of its own training task's; the weights of its two added penalties are not
published, so that they compare among its controllers, not with ours.
"""
Column = str | Callable[[Any], str]
"""A key of a row's object, or a function from the object to its cell."""


def read(file: str) -> Any:
    """A file of numbers by its path in the project; empty if there is none."""
    path = ROOT / file
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def read_robots(file: str) -> dict[str, Any]:
    """A file of each robot that has one, by the robot's label."""
    return {label: content for robot, label in ROBOTS.items() if (content := read(file.format(robot)))}


def shown(*path: str | int, form: str = ",.0f", factor: float = 1.0) -> Callable[[Any], str]:
    """A cell: a number in nested objects by their keys, with its interval, if there is one; "-" without a number.

    A whole number picks the object with as many robots.
    """

    def cell(row: Any) -> str:
        for key in path[:-1]:
            if isinstance(key, int):
                row = next((numbers for numbers in row if numbers["num_envs"] == key), {})
            else:
                row = row.get(key) or {}
        value, limits = row.get(path[-1]), row.get(f"{path[-1]}_interval")
        return format_value(value and factor * value, limits and [factor * limit for limit in limits], form)

    return cell


def counts(*names: str) -> dict[str, str]:
    """Columns of counts, by their labels."""
    return {name.replace("_panel", " by the panel").replace("_", " "): name for name in names}


def table(rows: Mapping[str, Any], columns: Mapping[str, Column], *, upright: bool = False) -> str:
    """A Markdown table, an object a row, or a column if it is upright; a column without any number is left out."""
    cells = {name: shown(column) if isinstance(column, str) else column for name, column in columns.items()}
    lines = [[name, *(cell(row) for cell in cells.values())] for name, row in rows.items()]
    used = [k for k in range(len(cells) + 1) if any(line[k] != NONE for line in lines)]
    lines = [[line[k] for k in used] for line in (["", *cells], *lines)]
    if upright and used:
        lines = [list(line) for line in zip(*lines, strict=True)]
    head, *body = ("| " + " | ".join(line) + " |" for line in lines)
    return "\n".join([head, "|---" * len(lines[0]) + "|", *body])


def rate(row: tuple[str, str, str], controller: str, *, short: bool = False, file: str = "tables") -> str:
    """A mean over seeds, if there are several, else over terrains, with its interval unless ``short``.

    ``row`` names the robot, the measure and the set of terrains.
    """
    robot, measure, terrains = row
    tables = read(f"results/{robot}/{file}.json")
    seeds = tables["over_seeds"].get(measure, {}).get(terrains, {}).get(controller, {})
    value = seeds.get("mean", tables[measure].get(terrains, {}).get(controller))
    limits = seeds.get("interval", tables["intervals"][measure].get(terrains, {}).get(controller))
    return format_value(value, None if short else limits, ".1f" if measure == "reward" else ".3f")


def rate_table(rows: Mapping[str, tuple[str, str, str]], *, short: bool = False) -> str:
    """A table of rates of every controller."""
    return table(rows, {name: partial(rate, controller=name, short=short) for name in CONTROLLERS})


def read_archives(robot: str) -> dict[str, dict[str, Any]]:
    """Counts of a robot's published archives by their labels: by the default method, and by the paper's."""
    names = {"archive": "", "archive_cma_mae": ", CMA-MAE"}
    files = {f"{ROBOTS[robot]}{words}": read(f"results/{robot}/{name}/archive.json") for name, words in names.items()}
    return {label: numbers for label, numbers in files.items() if numbers}


def first() -> str:
    """What searches find, in a few rows, with the paper's elites."""
    paper = read(PAPER)
    rows: dict[str, dict[str, Any]] = {}
    for robot, label in ROBOTS.items():
        numbers, of_method = (read(f"results/{robot}/{name}/archive.json") for name in ("archive", "archive_cma_mae"))
        rows[label] = numbers | {"minutes": numbers["wall_s"] / 60, "paper": paper[robot]["archive"]["elites"]}
        rows[label]["of_method"] = of_method.get("elites")
    columns: dict[str, Column] = {
        "elites as found, in the paper": "paper",
        "... by the paper's method, here": "of_method",
        "... by the default method": "elites",
        "minutes that this search took": shown("minutes", form=".0f"),
        "... of these elites distinct ones that it fails in fresh episodes": "failing_distinct",
        "... and distinct *faults*: confirmed with finer physics, and crossed by another controller": "faults_distinct",
    }
    return table(rows, columns, upright=True)


def archives() -> str:
    """Counts of the published searches."""

    def holding(row: Mapping[str, Any]) -> str:
        crossed = row.get("faults_mujoco_c")
        some = {"": crossed, "strong: ": crossed["strong"]} if crossed else {}
        return "; ".join(f"{label}{held['hold']} of {held['tried']}" for label, held in some.items()) or NONE

    columns: dict[str, Column] = {
        "episodes": "episodes",
        "*elites*: terrains, each the hardest of its kind": "elites",
        "... that are in their cell again, in fresh episodes": "elites_same_cell",
        "*corrected elites*: cells that fresh episodes alone would fill": "corrected_elites",
        "*families* of like terrains": "families",
        "*failing*: under half of the robots cross it in fresh episodes": "failing",
        "... in families": "failing_families",
        "... *distinct* ones": "failing_distinct",
        "*confirmed*: failing, also with finer physics": "confirmed",
        "*faults by controllers*: confirmed, and one of the panel crosses it": "faults_panel",
        "... or one that was trained on these very terrains": "faults_controllers",
        "... that are no luck": "faults_fdr",
        "... that are *strong*: crossed in under a fifth, by another controller in over four fifths": "strong",
        "... that are *robust*: faults under varied conditions, too": "robust",
        "*faults by a witness*: confirmed, and a controller crosses only steered, on the line": "faults_witness",
        "all *faults*, of both kinds": "faults",
        "... that hold in MuJoCo C, of some": holding,
        "families of all faults": "fault_families",
        "*distinct* faults": "faults_distinct",
    }
    rows = {label: numbers for robot in ROBOTS for label, numbers in read_archives(robot).items()}
    return table(rows, columns, upright=True)


def paper_archives() -> str:
    """The paper's archives, and those of its method here."""
    rows = {}
    for robot, label in ROBOTS.items():
        numbers = read(f"results/{robot}/archive_cma_mae/archive.json")
        rows[f"{label}, here"] = {**numbers, "hours": numbers["wall_s"] / 3600}
        rows[f"{label}, the paper"] = read(PAPER)[robot]["archive"]
    columns: dict[str, Column] = {
        "elites": "elites",
        "... with a base collision": "with_collision",
        "... without": "without_collision",
        "mean fitness": shown("mean_fitness", form=".1f"),
        "QD score": "qd_score",
        "hours": shown("hours", form=".1f"),
    }
    return table(rows, columns, upright=True)


def witnesses() -> str:
    """Witnesses of the published archives, and how many plain crossings find by luck."""
    rows: dict[str, dict[str, Any]] = {}
    for robot, label in ROBOTS.items():
        for name, judged in read_archives(robot).items():
            if found := judged.get("witnesses"):
                rows[name] = judged | found | judged["judged_by"]["steered"]
        if numbers := read(f"results/{robot}/witness.json"):
            rows[f"{label}, plain crossings in their place"] = numbers["control"]
    columns: dict[str, Column] = {
        "tried": "tried",
        "witnesses on the line": "line",
        "... of the searched controller": "own_line",
        "beside it": "beside",
        "around": "around",
        "faults by controllers": "faults_controllers",
        "faults by a witness alone": "faults_witness",
        "families of faults by controllers": "fault_families_controllers",
        "... of all faults": "fault_families",
        "distinct faults": "faults_distinct",
        "minutes": shown("wall_s", form=".1f", factor=1 / 60),
    }
    return table(rows, columns)


def witness_curve() -> str:
    """Shares of some terrains that are crossed where a search for ways spends so many episodes on each."""
    rows: dict[str, dict[str, Any]] = {}
    columns: dict[str, Column] = {}
    for label, numbers in read_robots("results/{}/witness.json").items():
        for point in numbers["curve"]:
            sought, goal = ("anywhere", "around") if point["limit_m"] is None else ("on the line", "line")
            rows.setdefault(f"{point['episodes']} episodes", {})[name := f"{label}, {sought}"] = point[goal]
            columns[name] = shown(name, form=".2f")
    return table(rows, columns)


def crossed() -> str:
    """Searches in which what nobody crosses earns less, and not: means over seeds, and differences."""
    rows = {}
    for label, numbers in read_robots("results/{}/crossed.json").items():
        rows[f"{label}, without"] = numbers["weights"]["0"]
        rows[f"{label}, with it"] = numbers["weights"][f"{numbers['chosen']:g}"]
        rows[f"{label}, difference"] = numbers["difference"] | {"sign": "+"}
    return table(rows, crossed_columns())


def crossed_weights() -> str:
    """The searches by which the weight on what nobody crosses was chosen, one each."""
    rows = {}
    for label, numbers in read_robots("results/{}/crossed.json").items():
        for search in numbers["searches"]:  # those that choose stand first
            rows.setdefault(f"{label}, weight {search['weight']:g}", search)
    return table(rows, crossed_columns())


def crossed_columns() -> dict[str, Column]:
    """Columns of searches of crossed.json; numbers of a row with a ``sign`` have one."""

    def cell(row: Any, name: str) -> str:
        return shown(name, form=row.get("sign", "") + (".3f" if name == "uncrossed_share" else ",.0f"))(row)

    columns = {"failing": "failing", "distinct failing": "failing_distinct", "faults by the panel": "faults_panel"}
    columns |= {"distinct faults": "faults_distinct", "fault families": "fault_families", "strong faults": "strong"}
    columns["share of the failing that nobody crosses"] = "uncrossed_share"
    return {label: partial(cell, name=name) for label, name in columns.items()}


def training(measure: str = "goal") -> str:
    """Rates of every controller, on the set of another search first; goal rates have intervals."""
    sets = [name for name in reversed(SETS) if name != HELD_OUT[1]]
    rows = {f"{label}, {SETS[name]}": (robot, measure, name) for robot, label in ROBOTS.items() for name in sets}
    return rate_table(rows, short=measure != "goal")


def goals(robot: str) -> str:
    """Goal rates of every controller with 95 % intervals, and on the certified held-out terrains alone."""
    tables = read(f"results/{robot}/tables.json")
    rows = {f"{SETS[name]} ({tables['terrains'][name]})": (robot, "goal", name) for name in reversed(SETS)}
    certified = tables["certified"][HELD_OUT[0]]["terrains"]
    rows[f"{SETS[HELD_OUT[0]]}, certified ({certified})"] = (robot, "certified_goal", HELD_OUT[0])
    return rate_table(rows)


def differences() -> str:
    """Difference of goal rates between kinds of controllers, over terrains and seeds."""
    rows = {
        f"{label}, {SETS[name]}": pairs
        for label, tables in read_robots("results/{}/tables.json").items()
        for name, pairs in tables["differences"].items()
        if name in SETS and name not in HELD_OUT
    }

    def difference(row: Any, pair: str) -> str:
        return format_value(row[pair]["goal"], row[pair]["interval"], "+.3f") if row.get(pair) else NONE

    pairs = ("C-G - C-HR", "C-G - C-HC", "hardened - C-G")
    return table(rows, {pair: partial(difference, pair=pair) for pair in pairs})


def beside_paper() -> str:
    """No base collision and reward at the paper's sizes, with the paper's own numbers in brackets."""
    names = ("hand_crafted", "hard_random", "generated")
    controllers = CONTROLLERS[1:4]
    rows = {f"{label}, {SETS[name]}": (robot, name) for robot, label in ROBOTS.items() for name in names}

    def compare(row: tuple[str, str], measure: str, controller: str) -> str:
        robot, name = row
        paper = read(PAPER)[robot][measure][name][controller]
        ours = rate((robot, measure, name), controller, short=True, file="tables_paper_sizes")
        return f"{ours} ({paper:{'.1f' if measure == 'reward' else '.3f'}})"

    labels = {"success": "no base collision", "reward": "reward"}
    columns: dict[str, Column] = {}
    for measure, name in product(labels, controllers):
        columns[f"{labels[measure]}, {name}"] = partial(compare, measure=measure, controller=name)
    return table(rows, columns)


def methods(robot: str) -> str:
    """Methods of search by failing elites: means over seeds with least and largest value."""
    numbers = read(f"results/{robot}/search.json")
    columns = counts("elites", "corrected_elites", "failing", "faults_panel", "fault_families")
    rows = {}
    for method, means in sorted(numbers["methods"].items(), key=lambda item: -item[1]["failing"]):
        searches = [search for search in numbers["searches"] if search["method"] == method]
        rows[method] = dict(means)
        for key in columns.values():
            rows[method][f"{key}_interval"] = [end(row[key] for row in searches) for end in (min, max)]
    return table(rows, columns)


def conditions() -> str:
    """First searches of terrains with conditions and of routes, and which of their failing elites need a condition."""
    rows = {}
    for (robot, label), name in product(ROBOTS.items(), ("conditions", "route")):
        if search := first_search(robot, name):
            rows[f"{label}{', routes' * (name == 'route')}"] = search["needed"] | search
    columns = counts("episodes", "elites", "corrected_elites", "confirmed", "faults_panel", "failing")
    columns["... again, from other starts"] = "failing_again"
    columns["... and crossed under nominal conditions"] = "nominal_passes"
    columns["... and faults by the panel"] = "faults_and_nominal_passes"
    columns |= {f"... with nominal {kind}": kind for row in rows.values() for kind in row["needed"]}
    columns["... with none of these alone"] = "needs_no_single_one"
    return table(rows, columns, upright=True)


def first_search(robot: str, name: str) -> dict[str, Any]:
    """Numbers of the published search of terrains with ``conditions``, or of the ``route``; empty if there is none."""
    numbers = read(f"results/{robot}/conditions.json")
    if name == "conditions" and numbers:
        return numbers["archive"] | numbers["conditions"]
    return next(iter(numbers.get("searches", {}).get(name, ())), {})


def condition_searches() -> str:
    """Counts of searches of terrains with conditions and of routes: means over their seeds."""
    rows = {
        f"{label}, {name} ({means['seeds']})": means
        for label, numbers in read_robots("results/{}/conditions.json").items()
        for name, means in numbers.get("means", {}).items()
    }
    names = ("episodes", "elites", "corrected_elites", "failing", "failing_distinct", "confirmed", "faults_panel")
    return table(rows, counts(*names, "faults_distinct"), upright=True)


def least_minimum(robot: str, kind: str, name: str) -> dict[str, Any] | None:
    """The minimal terrain with fewest parts that has a condition, among elites that need this condition alone."""
    search = first_search(robot, name)
    numbers = {example["elite"] for example in search.get("examples", ()) if example["needs"] == kind}
    minima = read(f"results/{robot}/{name}/minimal.json").get("elites", ())
    part = BUMPS + list(search["needed"]).index(kind)
    minima = [minimum for minimum in minima if minimum["elite"] in numbers and part in minimum["bumps"]]
    return min(minima, key=lambda minimum: len(minimum["bumps"]), default=None)


def condition_examples(name: str = "conditions") -> str:
    """ANYmal C's smallest failing terrain that has the condition that its elite needs, for each of a search."""
    lines = ["| needs | what is left | under | reach the goal | verdict |", "|---" * 5 + "|"]
    for kind in first_search("anymal", name).get("needed", ()):
        if (least := least_minimum("anymal", kind, name)) is not None:
            bumps = sum(part < BUMPS for part in least["bumps"])
            ground = f"{bumps} bump{'s' * (bumps > 1)}" if bumps else "level ground"
            left = "; ".join(least["words"][bumps:])
            rate_and_verdict = f"{least['goal_rate']:.2f} | {least['verdict']}"
            lines.append(f"| {kind} | {ground} | {left} | {rate_and_verdict} |")
    return "\n".join(lines)


def map_training() -> str:
    """C-G trained with errors of the height map and without, beside the base: what each fails under them."""
    rows: dict[str, Any] = {}
    for label, numbers in read_robots("results/{}/map_training.json").items():
        rows[f"{label}: base"] = numbers["controllers"]["base"] | {
            "held_out": numbers["crossings"]["terrains"]["held_out"]
        }
        for kind, means in numbers["means"].items():
            rows[f"{label}: C-G {kind} errors of the map ({means['seeds']})"] = means
    sets = {"held_out": "held out", "hard_random_map": "hard-random with errors", "hard_random": "hard-random"}
    sets["hand_crafted"] = "hand-crafted"
    columns: dict[str, Column] = {"failing elites held out": "held_out"}
    columns["... failing again"] = shown("failing", "held_out", form=".1f")
    columns |= {f"goal, {label}": shown("goal", name, form=".3f") for name, label in sets.items()}
    names = ("elites", "failing", "failing_distinct", "confirmed", "faults_panel", "faults_distinct")
    columns |= {f"searched anew: {label}": shown("search", name) for label, name in counts(*names).items()}
    return table(rows, columns, upright=True)


def hardening() -> str:
    """Rounds of hardening: counts of the search against each controller, and its goal rates."""
    rows = {}
    for label, numbers in read_robots("results/{}/rounds.json").items():
        for row in numbers["rounds"]:
            goal = {name: rates.get(row["controller"]) for name, rates in numbers["tables"]["goal"].items()}
            rows[f"{label}: {row['controller']}"] = {**row, **goal}
    sets = {"hand_crafted": "hand-crafted", "hard_random": "hard-random", "search-0": "first archive"}
    goals = {f"goal, {label}": shown(name, form=".3f") for name, label in sets.items()}
    return table(rows, counts("elites", "corrected_elites", "failing", "faults", "faults_panel") | goals)


def searched_again() -> str:
    """Least and largest counts of further searches against several controllers."""
    controllers = {
        "base_searches": "base",
        "searches": "hardened",
        "at_once_searches": "at once",
    }
    rows = {}
    for label, numbers in read_robots("results/{}/rounds.json").items():
        for key, controller in controllers.items():
            if searches := numbers.get(key):
                rows[f"{label}: {controller} ({len(searches)})"] = searches

    def spread(searches: Any, key: str) -> str:
        return " to ".join(f"{end(row[key] for row in searches):,}" for end in (min, max))

    columns = counts("elites", "corrected_elites", "failing", "faults", "faults_panel", "fault_families")
    return table(rows, {label: partial(spread, key=key) for label, key in columns.items()})


def spaces() -> str:
    """Searches in different terrain spaces."""
    rows = {
        f"{label}, {name}": counts
        for label, numbers in read_robots("results/{}/spaces.json").items()
        for name, counts in numbers["spaces"].items()
    }
    names = ("elites", "corrected_elites", "failing", "confirmed", "certified", "faults", "faults_panel")
    return table(rows, counts(*names))


def sizes(robot: str) -> str:
    """The size of an obstacle that half of the robots cross, with contact resolved, or an interval if it is wide.

    In brackets stands the last size tried, if over half cross that. Obstacles that stop no controller are left out.
    """
    numbers = read(f"results/{robot}/dose-resolved.json")
    rows: dict[str, dict[str, str]] = {}
    for half in numbers.get("half", ()):
        element = half["element"].replace("_", " ")
        measure = f"{half['parameter']} {half['unit']}".strip()
        obstacle = measure if element == half["parameter"] else f"{element}, {measure}"
        if "_" in half["element"] and half["element"] == half["parameter"]:  # a condition of several words
            obstacle = f"{numbers['titles'][half['element']]} [{half['unit']}]"
        rows.setdefault(obstacle, {})[half["controller"]] = format_size(half, numbers["dose"])
    stopping = {name: row for name, row in rows.items() if not all(size.startswith("(") for size in row.values())}
    columns = dict.fromkeys(half["controller"] for half in numbers.get("half", ()))
    return table(stopping, {name: lambda row, name=name: row.get(name, NONE) for name in columns})


def format_size(half: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """A size that half cross: a number if its interval is within a tenth, its 95 % interval, or a bound.

    If half cross a harder size again, the interval reaches to that.
    """
    alike = [row for row in rows if all(row[key] == half[key] for key in ("element", "controller"))]
    tried = [row["value"] for row in alike]
    value = half["value"]
    low, high = half["interval"]
    form = ".3f" if half["unit"] == "s" else ".2f"
    if value is None:
        way = "over" if tried[0] > tried[-1] else "under"
        return {"first": f"{way} {tried[0]:g}", "last": f"({tried[-1]:g})"}.get(half.get("beyond", "last"), NONE)
    side = 1 if tried[0] < tried[-1] else -1
    again = [row["value"] for row in alike if side * (row["value"] - value) > 0 and (row["goal_rate"] or 0.0) >= 0.5]
    if again:
        low = low if low is None else min(low, again[-1])
        high = high if high is None else max(high, again[-1])
    elif low is not None and high is not None and high - low <= 0.2 * value:
        return f"{value:{form}}"
    return " to ".join("..." if limit is None else f"{limit:{form}}" for limit in (low, high))


def agreement() -> str:
    """Rates at the search's settings minus those of other crossings of the same terrains."""
    engines = {
        "again": "the same settings again",
        "resolved": "finer physics",
        "mujoco_c": "MuJoCo C, finer",
        "both_resolved": "both finer",
    }
    rows = {
        f"{label}, {name.replace('_', '-')}: {engine}": numbers[name][key]
        for label, numbers in read_robots("results/{}/agreement.json").items()
        for name in ("hard_random", "elites", "routes", "pushes")
        for key, engine in engines.items()
        if name in numbers
    }
    return table(rows, {"terrains": "terrains", "goal rate": shown("goal_bias", form="+.3f")})


def minimal() -> str:
    """Minimal terrains of the published archives."""
    columns: dict[str, Column] = {"taken apart": "minimal", "bumps that a failure takes, median": "bumps_median"}
    columns["margin [cm], median"] = shown("margin_m_median", form=".1f", factor=100)
    columns |= {"fail with finer physics too": "confirmed", "faults": "faults"}
    columns["causes"] = list_causes(6)
    return table(read_robots("results/{}/archive/minimal.json"), columns, upright=True)


def list_causes(count: int) -> Callable[[Any], str]:
    """A cell: the most frequent causes."""
    return lambda row: ", ".join(f"{cause} {number}" for cause, number in [*row["causes"].items()][:count])


def packs() -> str:
    """Controllers on the published packs: goal rate, and failed terrains."""
    files = {label: read(f"{find_pack(robot)}/pack.json") for robot, label in ROBOTS.items()}

    def cell(rates: Mapping[str, Any]) -> Callable[[Any], str]:
        def result(name: str) -> str:
            if (row := rates.get(name)) is None:
                return NONE
            return f"{format_value(row['goal_rate'], row['goal_interval'])}; {row['failing']} of {row['terrains']}"

        return result

    names = dict.fromkeys(name for pack in files.values() for name in pack["rates"])
    return table({name: name for name in names}, {label: cell(pack["rates"]) for label, pack in files.items()})


def league() -> str:
    """Public controllers of others: how they walk on level ground, and what breaks them."""

    def half(name: str) -> Callable[[Any], str]:
        """A cell: the size of an obstacle that half of the robots cross."""
        return lambda row: next((format_size(h, row["dose"]) for h in row["half"] if h["element"] == name), NONE)

    def at_heights(*keys: str, form: str = ".2f") -> Callable[[Any], str]:
        """A cell: a number at each of the common heights."""
        heights = ("0.05", "0.1", "0.2")
        return lambda row: " / ".join(shown(*keys, form=form)(row.get("rates", {}).get(h, {})) for h in heights)

    ends = ("", "_mujoco_c", "_publisher")
    columns: dict[str, Column] = {
        "licence": lambda row: row["licence"],
        "level ground [m/s]": lambda row: " / ".join(shown("check", f"flat_speed{e}", form=".3f")(row) for e in ends),
        "time [s]": shown("max_duration_s", form=".1f"),
        "hand-crafted": at_heights("hand_crafted", "goal_rate"),
        "hard-random": at_heights("hard_random", "goal_rate"),
        "kerb": half("step_up"),
        "stairs": half("stairs_up"),
        "payload": half("payload"),
        "delay": half("delay"),
        "failing families": at_heights("search", "failing_families", form=".0f"),
        "height [m]": shown("height", form=".2f"),
        "failing": shown("archive", "failing"),
        "families of these": "failing_families",
        "faults by a witness": "faults_witness",
        "commonest cause": list_causes(1),
    }
    return table(read("results/public.json").get("controllers", {}), columns)


def league_routes() -> str:
    """Searches of routes against public controllers."""
    columns: dict[str, Column] = {
        "space": lambda row: row["space"],
        "strays beyond [m]": shown("stray_m", form=".2f"),
    }
    names = ("episodes", "elites", "failing", "failing_distinct", "failing_families", "confirmed")
    columns |= {label: shown("archive", name) for label, name in counts(*names).items()}
    columns["commonest causes"] = list_causes(3)
    return table(read("results/public_route.json").get("controllers", {}), columns)


def drives() -> str:
    """What stops ANYmal C with gains and with an actuator network, and which of both crosses it with which drive."""
    labels, drives = {"pd": "gains", "net": "network"}, read("results/anymal/drive.json").get("drives", {})
    crossed: dict[str, Column] = {}
    for drive, name in product(labels, repeat=2):
        label = f"crossed with the {labels[drive]} by the controller of the {labels[name]}"
        crossed[label] = shown("crossed", drive, name, "terrains")
    rows = {f"search with the {labels[drive]}": {**row["archive"], **row} for drive, row in drives.items()}
    columns = counts("elites", "corrected_elites", "failing", "confirmed")
    return table(rows, {**columns, **crossed}, upright=True)


def films() -> str:
    """A minimal failure of each public controller that has a film."""
    names = [name for name in read("results/public.json")["controllers"] if (PICTURES / f"{name}.gif").exists()]
    cells = [f"![{name}](pictures/{name}.gif)" for name in names]
    rows = [["", ""], ["---", "---"], *(cells[k : k + 2] for k in range(0, len(cells), 2))]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def speed() -> str:
    """Quoted speeds by robot, with the devices and commits of the numbers."""
    rows = {}
    for robot, label in ROBOTS.items():
        numbers = read(f"results/{robot}/speed.json")
        scale = read(f"results/{robot}/scale.json")
        parts = (*(numbers.get("measured") or {"": numbers}).values(), *(numbers.get("training") or ()), scale)
        origins = [part for part in parts if part.get("device")]
        kernel_shares = Counter[str]()
        for kernel in numbers.get("kernels") or ():
            plain_name = kernel["name"].rpartition("__")[2].removesuffix("_kernel").strip("_")
            kernel_shares["matrix products" if "gemm" in kernel["name"] else plain_name] += kernel["share"]
        largest = [f"{name} {share:.0%}" for name, share in kernel_shares.most_common() if share >= 0.04]
        ray = [f"{row['workers']}: {row['episodes_per_s']:,.0f}" for row in scale.get("rows", ())]
        rows[label] = numbers | {
            "devices": ", ".join(dict.fromkeys(str(origin["device"])[:28] for origin in origins)),
            "commits": ", ".join(dict.fromkeys(str(origin["commit"])[:7] for origin in origins)),
            "ray": "; ".join(ray) or NONE,
            "largest_kernels": ", ".join(largest) or NONE,
        }
    mixed = "cma_mae+map_elites"
    million = {"form": ".1f", "factor": 1e-6}
    columns: dict[str, Column] = {
        **{f"episodes/s of {count:,} robots": shown("envs_curve", count, "episodes_per_s")
           for count in (1024, 4096, 32768)},
        "episodes/s by Ray, 4,096 robots a GPU with one each, by number of GPUs": lambda row: row["ray"],
        "an iteration of preset paper [s]": shown("iteration_s_median", form=".2f"),
        "its physics steps/s [million]": shown("world_steps_per_s", **million),
        "... as a share of contacts and solver alone": shown("bare_physics_ratio", form=".2f"),
        "... time of its step with all conditions, over that without": shown("all_conditions_step_ratio", form=".3f"),
        "... with a route": shown("route_step_ratio", form=".3f"),
        "... robot steps/s without them, over those of the commit before": shown("against", "ratio", form=".3f"),
        "an iteration of preset wide [s]": shown("wide", "surrogate", "iteration_s_median", form=".1f"),
        "... minutes for the paper's episodes at that pace":
            shown("wide", "surrogate", "minutes_per_4m_episodes", form=".1f"),
        f"... by `{mixed}` [s]": shown("wide", mixed, "iteration_s_median", form=".1f"),
        f"... minutes by `{mixed}`": shown("wide", mixed, "minutes_per_4m_episodes", form=".1f"),
        **{f"{count:,} robots standing: {alone}physics steps/s [million]":
           shown("flat", count, f"world_steps_per_s{key}", **million)
           for count in (4096, 32768) for alone, key in (("", ""), ("mujoco_warp's ", "_mujoco_warp"))},
        "training: environment steps/s of 4,096 robots": trained("train_env_steps_per_s"),
        "... of 8,192 robots": trained("train_env_steps_per_s_8192"),
        "... of 8,192 on each of two GPUs": trained("train_env_steps_per_s_2gpu"),
        "... of mjlab's 4,096 Unitree Go1": trained("train_env_steps_per_s_mjlab"),
        "largest kernels of a control step": lambda row: row["largest_kernels"],
        "device": lambda row: row["devices"],
        "commit": lambda row: row["commits"],
    }  # fmt: skip
    return table(rows, columns, upright=True)


def trained(key: str) -> Callable[[Any], str]:
    """A cell: a rate of training, with its packages if its row in ``training`` names them."""

    def cell(row: Any) -> str:
        for training in row.get("training") or ():
            if training["train_env_steps_per_s"] == row.get(key):
                packages = [f"{name} {version}" for name, version in training.get("versions", {}).items()]
                return f"{row[key]:,.0f}" + (f" ({', '.join(packages)})" if packages else "")
        return NONE

    return cell


def kernels() -> str:
    """Kernels against torch, by the newest file of a GPU."""
    files = sorted(str(file.relative_to(ROOT)) for file in ROOT.glob("results/bench/nvidia-*.json"))
    numbers = max(map(read, files), key=lambda content: content["date"])
    rows = {row["kernel"].replace("_", " "): row for row in numbers["rows"] if row["torch_ms"]}
    columns: dict[str, Column] = {
        "here [ms]": shown("ours_ms", form=".4f"),
        "torch [ms]": shown("torch_ms", form=".4f"),
        "`torch.compile` [ms]": shown("torch_compile_ms", form=".4f"),
        "of the ceiling": shown("ceiling_share", form=".1%"),
        "bound by": lambda row: row["bound_by"],
    }
    label = f"{numbers['num_envs']:,} robots, {numbers['device']}, commit {numbers['commit'][:7]}"
    return table(rows, columns).replace("|  |", f"| {label} |", 1)


TABLES: dict[str, Callable[..., str]] = {
    make.__name__: make
    for make in (
        *(first, archives, paper_archives, beside_paper, training, goals, differences, methods, hardening),
        *(searched_again, spaces, sizes, agreement, minimal, packs, league, league_routes, films, drives, speed),
        *(kernels, conditions, condition_examples, condition_searches, map_training, witnesses, witness_curve),
        *(crossed, crossed_weights),
    )
}


def with_tables(text: str) -> str:
    """A page with its tables made anew."""

    def make(match: re.Match[str]) -> str:
        name, robot = match[1], match[2].split()
        if name not in TABLES:
            raise ValueError(f"a table must be one of {', '.join(TABLES)}, got {name}")
        return f"{match[0].partition(chr(10))[0]}\n{TABLES[name](*robot)}\n<!-- end -->"

    return MARKED.sub(make, text)


def note_picture(name: str, *sources: str) -> None:
    """Keeps of which files a picture of docs/pictures was made just now."""
    made = read(MADE) | {name: {source: _hash(source) for source in sources}}
    if missing := [source for source, known in made[name].items() if not known]:
        raise FileNotFoundError(f"{name} is made of {', '.join(missing)}, which is not there")
    made = {name: known for name, known in made.items() if (ROOT / MADE).with_name(name).exists()}
    (ROOT / MADE).write_text(json.dumps(dict(sorted(made.items())), indent=1) + "\n", encoding="utf-8")


def find_old_pictures() -> dict[str, str]:
    """Pictures that show another state of a file than today's, each with the file; or nobody knows what they show."""
    made = read(MADE)
    names = [file.name for file in sorted((ROOT / MADE).parent.glob("*")) if file.suffix in (".gif", ".jpg", ".png")]
    old = {name: source for name in names for source, known in made.get(name, {}).items() if _hash(source) != known}
    return old | {name: MADE for name in names if name not in made}


def _hash(source: str) -> str:
    """SHA-256 of a file, or of a part of one; empty if there is none."""
    file, _, keys = source.partition("#")
    if not keys:
        return hashlib.sha256((ROOT / file).read_bytes()).hexdigest() if (ROOT / file).exists() else ""
    part = read(file)
    for key in keys.split("/"):
        part = part.get(key)
        if part is None:
            return ""
    return hashlib.sha256(json.dumps(part, sort_keys=True).encode()).hexdigest()


def main(argv: Sequence[str]) -> int:
    """Writes or checks all pages; returns the exit status."""
    check = "--check" in argv
    status = 0
    for name, source in find_old_pictures().items() if check else ():
        status = 1
        print(f"{name} shows another {source}")
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text(encoding="utf-8")
        if (updated := with_tables(text)) != text:
            status = int(check)
            print(f"{page.name} {'says something else than the results' if check else 'is written anew'}")
            if not check:
                page.write_text(updated, encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
