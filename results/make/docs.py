"""Writes the tables of README.md and docs/*.md from the JSON files of published numbers.

A table stands between the lines `<!-- table: NAME -->` and `<!-- end -->`. NAME is a function of TABLES, with a robot
behind it if the function takes one. With --check nothing is written: the exit status is 1 if a page says something
else than the files.
"""

import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from qd.evaluate.labels import HELD_OUT, SETS
from sim.files.intervals import format_value

ROOT = Path(__file__).parents[2]
ROBOTS = {"anymal": "ANYmal C", "cassie": "Cassie"}
CONTROLLERS = ("base", "C-HC", "C-HR", "C-G", "hardened")
NONE = "-"
BUMPS = 8
"""Parts of a terrain of the paper, behind which its conditions stand."""
MARKED = re.compile(r"<!-- table: (\w+)((?: \w+)?) -->\n.*?<!-- end -->", re.DOTALL)
PAPER_ARCHIVES = {
    "cassie": {"elites": 930, "with_collision": 598, "without_collision": 332, "fitness": 4.7},
    "anymal": {"elites": 1129},
}
"""What the paper (Esquerre-Pourtere, Kim and Park, arXiv 2506.01362) says of its archives after 1,000 iterations."""
PAPER = {
    "cassie": {
        "success": ((0.997, 0.984, 0.999), (0.928, 0.982, 0.990), (0.743, 0.876, 0.957)),
        "reward": ((32.7, 29.7, 32.9), (31.0, 31.6, 32.3), (25.7, 27.6, 29.9)),
    },
    "anymal": {
        "success": ((0.971, 0.976, 0.980), (0.865, 0.954, 0.976), (0.598, 0.876, 0.914)),
        "reward": ((25.6, 24.8, 25.4), (22.7, 24.9, 25.6), (16.6, 20.1, 23.3)),
    },
}
"""Its success rates (fractions) and rewards of C-HC, C-HR and C-G on hand-crafted, hard-random and generated terrains.

Source: its four tables, "Average rewards" and "Success rates" with the Cassie and with the ANYmal robot. Its rewards
are sums of its own training task's; the weights of its two added penalties are not published, so that they compare
among its controllers, not with ours.
"""
Column = str | Callable[[Any], str]
"""A key of a row's object, or what makes a cell of the object."""


def read(file: str) -> Any:
    """A file of numbers by its path in the project; empty where there is none."""
    path = ROOT / file
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def of_robots(file: str) -> dict[str, Any]:
    """A file of the robots that have one, by their names in words."""
    return {words: content for robot, words in ROBOTS.items() if (content := read(file.format(robot)))}


def shown(key: str, form: str = ",.0f", factor: float = 1.0) -> Callable[[Any], str]:
    """A cell: the number of a key, with its interval if that stands beside it; "-" where there is none."""

    def cell(row: Any) -> str:
        value, limits = row.get(key), row.get(f"{key}_interval")
        return format_value(value and factor * value, limits and [factor * limit for limit in limits], form)

    return cell


def in_words(count: str) -> str:
    """A count's name as the head of a column."""
    return count.replace("_panel", " by the panel").replace("_", " ")


def table(rows: Mapping[str, Any], columns: Mapping[str, Column], *, upright: bool = False) -> str:
    """A Markdown table, an object a row, or a column if it is upright; a column without any number is left out."""
    made = {name: shown(column) if isinstance(column, str) else column for name, column in columns.items()}
    lines = [[name, *(cell(row) for cell in made.values())] for name, row in rows.items()]
    used = [k for k in range(len(made) + 1) if any(line[k] != NONE for line in lines)]
    lines = [[line[k] for k in used] for line in (["", *made], *lines)]
    if upright:
        lines = [list(line) for line in zip(*lines, strict=True)]
    head, *body = ("| " + " | ".join(line) + " |" for line in lines)
    return "\n".join([head, "|---" * len(lines[0]) + "|", *body])


def rate(robot: str, measure: str, terrains: str, controller: str, *, short: bool = False, file: str = "tables") -> str:
    """A mean over seeds where there are several, else over terrains, with its interval unless it shall be short."""
    tables = read(f"results/{robot}/{file}.json")
    seeds = tables["over_seeds"].get(measure, {}).get(terrains, {}).get(controller, {})
    value = seeds.get("mean", tables[measure].get(terrains, {}).get(controller))
    limits = seeds.get("interval", tables["intervals"][measure].get(terrains, {}).get(controller))
    return format_value(value, None if short else limits, ".1f" if measure == "reward" else ".3f")


def archives() -> str:
    """What the published searches found, beside the paper."""
    found = {f"{words}{', CMA-MAE' * name.endswith('mae')}": read(f"results/{robot}/{name}/archive.json")
             for robot, words in ROBOTS.items() for name in ("archive", "archive_cma_mae")}  # fmt: skip
    found |= {f"{words}, the paper": {"episodes": 4e6, **PAPER_ARCHIVES[robot]} for robot, words in ROBOTS.items()}
    columns = {
        "episodes": "episodes",
        "*elites*: terrains, each the hardest of its kind": "elites",
        "... that are in their cell again, in fresh episodes": "elites_same_cell",
        "*corrected elites*: cells that fresh episodes alone would fill": "corrected_elites",
        "*families* of like terrains": "families",
        "*failing*: under half of the robots cross it in fresh episodes": "failing",
        "*confirmed*: failing, also with finer physics": "confirmed",
        "*faults*: confirmed, and a controller of the panel crosses it": "faults_panel",
        "... or one that was trained on these very terrains": "faults",
        "... by controllers that trained on no such terrain": "faults_unseen",
        "families of all faults": "fault_families",
        "*robust*: faults under varied conditions, too": "robust",
    }
    return table({name: numbers for name, numbers in found.items() if numbers}, columns, upright=True)


def training(measure: str = "goal") -> str:
    """Rates of every controller, the set that is none of its own first; of the goal with intervals."""
    rows = {f"{words}, {SETS[name]}": (robot, name)
            for robot, words in ROBOTS.items() for name in reversed(SETS) if name != HELD_OUT[1]}  # fmt: skip
    short = measure != "goal"
    return table(
        rows, {one: lambda row, one=one: rate(row[0], measure, row[1], one, short=short) for one in CONTROLLERS}
    )


def goals(robot: str) -> str:
    """Goal rates of every controller with 95 % intervals, and on the certified held-out terrains alone."""
    tables = read(f"results/{robot}/tables.json")
    rows = {f"{SETS[name]} ({tables['terrains'][name]})": ("goal", name) for name in reversed(SETS)}
    certified = tables["certified"][HELD_OUT[0]]["terrains"]
    rows[f"{SETS[HELD_OUT[0]]}, certified ({certified})"] = ("certified_goal", HELD_OUT[0])
    return table(rows, {one: lambda row, one=one: rate(robot, row[0], row[1], one) for one in CONTROLLERS})


def differences() -> str:
    """How much more often one kind of controller reaches the goal than another, over terrains and seeds."""
    rows = {f"{words}, {SETS[name]}": of_set for words, tables in of_robots("results/{}/tables.json").items()
            for name, of_set in tables["differences"].items() if name in SETS and name not in HELD_OUT}  # fmt: skip

    def cell(pair: str) -> Callable[[Any], str]:
        return lambda row: format_value(row[pair]["goal"], row[pair]["interval"], "+.3f") if row.get(pair) else NONE

    pairs = ("C-G - C-HR", "C-G - C-HC", "hardened - C-G")
    return table(rows, {pair: cell(pair) for pair in pairs})


def beside_paper() -> str:
    """No base collision and reward at the paper's sizes, and in brackets what the paper says of its controllers."""
    names, controllers = ("hand_crafted", "hard_random", "generated"), CONTROLLERS[1:4]
    rows = {f"{words}, {SETS[name]}": (robot, name) for robot, words in ROBOTS.items() for name in names}

    def cell(measure: str, controller: str, form: str) -> Callable[[Any], str]:
        def words(row: tuple[str, str]) -> str:
            of_paper = PAPER[row[0]][measure][names.index(row[1])][controllers.index(controller)]
            of_ours = rate(row[0], measure, row[1], controller, short=True, file="tables_paper_sizes")
            return f"{of_ours} ({of_paper:{form}})"

        return words

    kinds = {"no base collision": ("success", ".3f"), "reward": ("reward", ".1f")}
    return table(rows, {f"{words}, {one}": cell(key, one, form)
                        for words, (key, form) in kinds.items() for one in controllers})  # fmt: skip


def methods(robot: str) -> str:
    """Methods of search, means over seeds with the least and the most, the one with most failing elites first."""
    numbers = read(f"results/{robot}/search.json")
    rows = {name: {**means, "seeds": [one for one in numbers["searches"] if one["method"] == name]}
            for name, means in sorted(numbers["methods"].items(), key=lambda row: -row[1]["failing"])}  # fmt: skip

    def cell(count: str) -> Callable[[Any], str]:
        ends = (min, max)
        return lambda row: format_value(row[count], [end(one[count] for one in row["seeds"]) for end in ends], ",.0f")

    names = ("elites", "corrected_elites", "failing", "faults_panel", "fault_families")
    return table(rows, {in_words(name): cell(name) for name in names})


def noise() -> str:
    """Designs of a search under noise: means over their seeds."""
    rows = {
        f"{words}, {name}": mean_of(rows)
        for robot, words in ROBOTS.items()
        for name, rows in searches_of(robot).items()
    }
    names = ("episodes", "elites", "corrected_elites", "failing", "families")
    columns: dict[str, Column] = {in_words(name): name for name in names}
    columns["again in their cell"] = lambda row: f"{row['elites_same_cell'] / row['elites']:.2f}"
    columns["two fresh lots"] = shown("two_lots_agree", ".2f")
    return table(rows, columns)


def searches_of(robot: str) -> dict[str, list[Any]]:
    """Rows of searches under noise by design, without the long ones."""
    searches = dict[str, list[Any]]()
    for row in read(f"results/{robot}/search_noise.json").get("rows", ()):
        if row["search"] == f"{row['design']}, seed {row['seed']}":
            searches.setdefault(row["design"], []).append(row)
    return searches


def mean_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The mean of each number that all rows have."""
    names = [name for name, value in rows[0].items() if isinstance(value, int | float)]
    return {name: sum(row[name] for row in rows) / len(rows) for name in names}


def conditions() -> str:
    """Searches of terrains and conditions, and which of their failing elites need a condition."""
    rows = {words: {**numbers["archive"], **numbers["conditions"]["needed"], **numbers["conditions"]}
            for words, numbers in of_robots("results/{}/conditions.json").items()}  # fmt: skip
    names = ("episodes", "elites", "corrected_elites", "confirmed", "faults_panel", "failing")
    columns: dict[str, Column] = {in_words(name): name for name in names}
    columns["... again, from other starts"] = "failing_again"
    columns["... and crossed under nominal conditions"] = "nominal_passes"
    columns["... and faults by the panel"] = "faults_and_nominal_passes"
    columns |= {f"... with nominal {kind}": kind for kind in condition_names()}
    columns["... with none of these alone"] = "needs_no_single_one"
    return table(rows, columns, upright=True)


def condition_names() -> tuple[str, ...]:
    """The conditions of the published searches."""
    return tuple(read("results/anymal/conditions.json")["conditions"]["needed"])


def least_minimum(robot: str, kind: str) -> dict[str, Any] | None:
    """The minimal terrain of fewest parts that keeps a kind of condition, of the elites that need that kind alone."""
    needs = read(f"results/{robot}/conditions.json").get("conditions", {})
    numbers = {one["elite"] for one in needs.get("examples", ()) if one["needs"] == kind}
    minima = read(f"results/{robot}/conditions/minimal.json").get("elites", ())
    part = BUMPS + condition_names().index(kind)
    kept = [one for one in minima if one["elite"] in numbers and part in one["bumps"]]
    return min(kept, key=lambda one: len(one["bumps"]), default=None)


def condition_examples() -> str:
    """The smallest failing terrains that keep the condition that their elites need; of each kind the least."""
    lines = ["| needs | what is left | under | reach the goal | verdict |", "|---" * 5 + "|"]
    for (robot, words), kind in product(ROBOTS.items(), condition_names()):
        if (least := least_minimum(robot, kind)) is not None:
            bumps = sum(part < BUMPS for part in least["bumps"])
            ground = f"{bumps} bump{'s' * (bumps > 1)}" if bumps else "level ground"
            left, verdict = "; ".join(least["words"][bumps:]), least["verdict"]
            lines.append(f"| {words}: {kind} | {ground} | {left} | {least['goal_rate']:.2f} | {verdict} |")
    return "\n".join(lines)


def hardening() -> str:
    """Rounds of hardening: what a search finds of each controller, and its goal rates."""
    rows = {}
    for words, numbers in of_robots("results/{}/rounds.json").items():
        for one in numbers["rounds"]:
            goal = {name: rates.get(one["controller"]) for name, rates in numbers["tables"]["goal"].items()}
            rows[f"{words}: {one['controller']}"] = {**one, **goal}
    counts = ("elites", "corrected_elites", "failing", "faults", "faults_panel")
    columns: dict[str, Column] = {in_words(name): name for name in counts}
    sets = {"hand_crafted": "hand-crafted", "hard_random": "hard-random", "search-0": "first archive"}
    columns |= {f"goal, {words}": shown(name, ".3f") for name, words in sets.items()}
    return table(rows, columns)


def searched_again() -> str:
    """What further searches find of the base, the hardened controller and one of as many steps: least to most."""
    rows = {}
    for words, numbers in of_robots("results/{}/rounds.json").items():
        for name, label in {"base_searches": "base", "searches": "hardened", "at_once_searches": "at once",
                            "again_searches": "hardened again"}.items():  # fmt: skip
            found = numbers.get(name) or ()
            rows |= {f"{words}: {label} ({len(found)})": found} if found else {}

    def spread(count: str) -> Callable[[Any], str]:
        return lambda found: " to ".join(f"{end(row[count] for row in found):,}" for end in (min, max))

    counts = ("elites", "corrected_elites", "failing", "faults", "faults_panel", "fault_families")
    return table(rows, {in_words(count): spread(count) for count in counts})


def spaces() -> str:
    """Searches in different terrain spaces."""
    rows = {f"{words}, {name}": one for words, numbers in of_robots("results/{}/spaces.json").items()
            for name, one in numbers["spaces"].items()}  # fmt: skip
    names = ("elites", "corrected_elites", "failing", "confirmed", "certified", "faults", "faults_panel")
    return table(rows, {in_words(name): name for name in names})


def sizes(robot: str) -> str:
    """The size of an obstacle that half of the robots get over, with contact resolved; a range where it is not sharp.

    In brackets stands the last size tried, if over half get over that. Obstacles that stop nobody so are left out.
    """
    numbers, rows = read(f"results/{robot}/dose-resolved.json"), dict[str, dict[str, str]]()
    for half in numbers.get("half", ()):
        named, measure = half["element"].replace("_", " "), f"{half['parameter']} {half['unit']}".strip()
        obstacle = measure if named == half["parameter"] else f"{named}, {measure}"
        rows.setdefault(obstacle, {})[half["controller"]] = size_words(half, numbers["dose"])
    stopping = {name: row for name, row in rows.items() if not all(size.startswith("(") for size in row.values())}
    columns = dict.fromkeys(half["controller"] for half in numbers.get("half", ()))
    return table(stopping, {name: lambda row, name=name: row.get(name, NONE) for name in columns})


def size_words(half: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """A size that half get over: sharp to a tenth of it, or its 95 % interval, or that it lies beyond those in rows.

    Where half get over a harder one again, the interval reaches to that.
    """
    obstacle = ("element", "controller")
    of_half = [row for row in rows if all(row[key] == half[key] for key in obstacle)]
    tried = [row["value"] for row in of_half]
    value, (low, high), form = half["value"], half["interval"], ".3f" if half["unit"] == "s" else ".2f"
    if value is None:
        way = "over" if tried[0] > tried[-1] else "under"
        return {"first": f"{way} {tried[0]:g}", "last": f"({tried[-1]:g})"}.get(half.get("beyond", "last"), NONE)
    side = 1 if tried[0] < tried[-1] else -1
    again = [row["value"] for row in of_half if side * (row["value"] - value) > 0 and (row["goal_rate"] or 0.0) >= 0.5]
    if again:
        low = low if low is None else min(low, again[-1])
        high = high if high is None else max(high, again[-1])
    elif low is not None and high is not None and high - low <= 0.2 * value:
        return f"{value:{form}}"
    return " to ".join("..." if limit is None else f"{limit:{form}}" for limit in (low, high))


def agreement() -> str:
    """How far rates at the search's settings lie above those of other crossings of the same terrains."""
    ways = {"again": "the same settings again", "resolved": "finer physics", "mujoco_c": "MuJoCo C, finer",
            "both_resolved": "both finer"}  # fmt: skip
    rows = {f"{words}, {name.replace('_', '-')}: {label}": numbers[name][way]
            for words, numbers in of_robots("results/{}/agreement.json").items()
            for name in ("hard_random", "elites") for way, label in ways.items()}  # fmt: skip
    return table(rows, {"terrains": "terrains", "goal rate": shown("goal_bias", "+.3f")})


def minimal() -> str:
    """Minimal terrains of the published archives."""
    columns: dict[str, Column] = {"taken apart": "minimal", "bumps that a failure takes, median": "bumps_median"}
    columns["margin [cm], median"] = shown("margin_m_median", ".1f", 100)
    columns |= {"fail with finer physics too": "confirmed", "faults": "faults"}
    columns["causes"] = lambda one: ", ".join(f"{cause} {count}" for cause, count in [*one["causes"].items()][:6])
    return table(of_robots("results/{}/archive/minimal.json"), columns, upright=True)


def packs() -> str:
    """Controllers on the published packs: goal rate, and failed terrains."""
    files = of_robots("sim/robots/{}/pack/pack.json")

    def cell(rates: Mapping[str, Any]) -> Callable[[Any], str]:
        return lambda name: NONE if name not in rates else "{}; {} of {}".format(
            format_value(rates[name]["goal_rate"], rates[name]["goal_interval"]), rates[name]["failing"],
            rates[name]["terrains"])  # fmt: skip

    names = dict.fromkeys(name for pack in files.values() for name in pack["rates"])
    return table({name: name for name in names}, {words: cell(pack["rates"]) for words, pack in files.items()})


def public_controllers() -> str:
    """Published controllers of others: how they walk, and what breaks them."""
    named = {"go2-robot-lab": "Go2, robot_lab", "go2-himloco": "Go2, HIMLoco", "go1-playground": "Go1, Playground",
             "g1-unitree": "G1, unitree_rl_gym"}  # fmt: skip
    content = read("results/public.json")
    numbers = content.get("controllers", {})

    def both(key: str, form: str) -> Callable[[Any], str]:
        return lambda one: " / ".join(format(one["check"][f"flat_{key}{way}"], form) for way in ("", "_mujoco_c"))

    def half(name: str) -> Callable[[Any], str]:
        """Up to which size half of the robots get over an obstacle."""

        def words(one: Any) -> str:
            sizes = [size_words(row, one["dose"]) for row in one.get("half", ()) if row["element"] == name]
            return sizes[0] if sizes else NONE

        return words

    ways, found = ("searched", "resolved", "mujoco_c"), ("episodes", "elites", "corrected_elites", "failing",
                                                         "confirmed", "faults")  # fmt: skip
    columns: dict[str, Column] = {
        "level ground: speed [m/s], here / in MuJoCo C": both("speed", ".3f"),
        "level ground: share that reaches the goal": both("goal", ".2f"),
        "heights up to [m]": shown("height", "g"),
        "hand-crafted: reach the goal": inside("hand_crafted", "goal_rate", form=".2f"),
        "hard-random: reach the goal, here / finer / MuJoCo C, finer":
            lambda one: " / ".join(f"{one['agreement'][way]:.2f}" for way in ways),
        "half get over a kerb of [m]": half("step_up"),
        "... stairs of [m]": half("stairs_up"),
        f"episodes/s of 32,768 robots on {content.get('device', NONE)}": "episodes_per_s_32768",
        **{in_words(name): inside("archive", name) for name in found},
        "causes": lambda one: ", ".join(f"{cause} {count}" for cause, count in [*one["causes"].items()][:4]),
    }  # fmt: skip
    return table({words: numbers[name] for name, words in named.items() if name in numbers}, columns, upright=True)


def inside(*path: str | int, form: str = ",.0f", factor: float = 1.0) -> Callable[[Any], str]:
    """A cell: a number in objects within a row's, by keys; one that is a number picks the object of so many robots."""

    def cell(row: Any) -> str:
        for key in path[:-1]:
            picked = (one for one in row if one["num_envs"] == key) if isinstance(key, int) else iter([row.get(key)])
            row = next(picked, None) or {}
        return shown(str(path[-1]), form, factor)(row)

    return cell


def speed() -> str:
    """What is quoted of speed, by robot, and the devices and commits that the numbers are of."""
    rows = {}
    for robot, words in ROBOTS.items():
        numbers, scale = (read(f"results/{robot}/{name}.json") for name in ("speed", "scale"))
        made = (*(numbers.get("measured") or {"": numbers}).values(), *(numbers.get("training") or ()), scale)
        origins = [one for one in made if one.get("device")]
        named = {
            key: ", ".join(dict.fromkeys(str(one[key])[: 28 if key == "device" else 7] for one in origins))
            for key in ("device", "commit")
        }
        by_ray = "; ".join(f"{one['workers']}: {one['episodes_per_s']:,.0f}" for one in scale.get("rows", ()))
        kernel_shares = Counter[str]()
        for one in numbers.get("kernels") or ():
            kernel_shares[kernel_words(one["name"])] += one["share"]
        shares = ", ".join(f"{name} {share:.0%}" for name, share in kernel_shares.most_common() if share >= 0.04)
        of_others = {"ray": by_ray, "kernels": shares}
        rows[words] = {**numbers, "named": {**named, **{key: text or NONE for key, text in of_others.items()}}}
    mixed, million, minutes = "cma_mae+map_elites", {"form": ".1f", "factor": 1e-6}, {"form": ".1f", "factor": 1 / 60}
    columns: dict[str, Column] = {
        **{f"episodes/s of {count:,} robots": inside("envs_curve", count, "episodes_per_s")
           for count in (1024, 4096, 32768)},
        "episodes/s by Ray, 4,096 robots a GPU with one each, by number of GPUs": lambda row: row["named"]["ray"],
        "an iteration of preset paper [s]": shown("iteration_s_median", ".2f"),
        "its physics steps/s [million]": shown("world_steps_per_s", **million),
        "... as a share of contacts and solver alone": shown("bare_physics_ratio", ".2f"),
        "an iteration of preset wide [s]": inside("wide", "surrogate", "iteration_s_median", form=".1f"),
        "... its crossings alone [s]": inside("wide", "surrogate", "crossings_s_median", form=".1f"),
        "... minutes for the paper's episodes at that pace":
            inside("wide", "surrogate", "minutes_per_4m_episodes", form=".1f"),
        f"... by `{mixed}` [s]": inside("wide", mixed, "iteration_s_median", form=".1f"),
        f"... minutes by `{mixed}`": inside("wide", mixed, "minutes_per_4m_episodes", form=".1f"),
        "preset small on a CPU [minutes]": inside("cpu", "archive_wall_s", **minutes),
        **{f"{count:,} robots standing: {alone}physics steps/s [million]":
           inside("flat", count, f"world_steps_per_s{key}", **million)
           for count in (4096, 32768) for alone, key in (("", ""), ("mujoco_warp's ", "_mujoco_warp"))},
        "training: environment steps/s of 4,096 robots": trained("train_env_steps_per_s"),
        "... of 8,192 robots": trained("train_env_steps_per_s_8192"),
        "... of 8,192 on each of two GPUs": trained("train_env_steps_per_s_2gpu"),
        "... of mjlab's 4,096 Unitree Go1": trained("train_env_steps_per_s_mjlab"),
        "largest kernels of a control step": lambda row: row["named"]["kernels"],
        "device": lambda row: row["named"]["device"],
        "commit": lambda row: row["named"]["commit"],
    }  # fmt: skip
    return table(rows, columns, upright=True)


def trained(key: str) -> Callable[[Any], str]:
    """A cell: a rate of training, with packages if its row in ``training`` has others."""

    def cell(row: Any) -> str:
        rate, rows = row.get(key), row.get("training") or ()
        one = next((one for one in rows if one["train_env_steps_per_s"] == rate), None)
        if one is None:
            return NONE
        packages = [f"{name} {version}" for name, version in one.get("versions", {}).items()]
        return f"{rate:,.0f}" + (f" ({', '.join(packages)})" if packages else "")

    return cell


def kernel_words(name: str) -> str:
    """A kernel's name without what compilers add."""
    return "matrix products" if "gemm" in name else name.rpartition("__")[2].removesuffix("_kernel").strip("_")


def kernels() -> str:
    """Kernels against torch, by the newest file of a GPU."""
    numbers = max(map(read, sorted(str(file.relative_to(ROOT)) for file in ROOT.glob("results/bench/nvidia-*.json"))),
                  key=lambda one: one["date"])  # fmt: skip
    rows = {one["kernel"].replace("_", " "): one for one in numbers["rows"] if one["torch_ms"]}
    columns: dict[str, Column] = {f"{words} [ms]": shown(key, ".4f") for words, key in (
        ("here", "ours_ms"), ("torch", "torch_ms"), ("`torch.compile`", "torch_compile_ms"))}  # fmt: skip
    columns |= {"of the ceiling": shown("ceiling_share", ".1%"), "bound by": lambda one: one["bound_by"]}
    words = f"{numbers['num_envs']:,} robots, {numbers['device']}, commit {numbers['commit'][:7]}"
    return table(rows, columns).replace("|  |", f"| {words} |", 1)


TABLES: dict[str, Callable[..., str]] = {make.__name__: make for make in (
    archives, training, goals, beside_paper, methods, hardening, searched_again, spaces, sizes, agreement,
    minimal, packs, public_controllers, speed, kernels, noise, conditions,
    condition_examples, differences)}  # fmt: skip


def with_tables(text: str) -> str:
    """A page with its tables made anew."""

    def make(match: re.Match[str]) -> str:
        name, robot = match[1], match[2].split()
        if name not in TABLES:
            raise ValueError(f"a table must be one of {', '.join(TABLES)}, got {name}")
        return f"{match[0].partition(chr(10))[0]}\n{TABLES[name](*robot)}\n<!-- end -->"

    return MARKED.sub(make, text)


def main(argv: Sequence[str]) -> int:
    """Writes or checks all pages; returns the exit status."""
    stale = []
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text(encoding="utf-8")
        made = with_tables(text)
        if made != text:
            stale.append(page.name)
            if "--check" not in argv:
                page.write_text(made, encoding="utf-8")
    for name in stale:
        print(f"{name} {'says something else than the results' if '--check' in argv else 'is written anew'}")
    return int("--check" in argv and bool(stale))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
