"""Writes the tables of docs/*.md from the JSON under results/.

A table stands between the lines `<!-- table: NAME ROBOT -->` and `<!-- table: end -->`; NAME is one of TABLES, and
ROBOT is left out where a table is of none. With --check nothing is written: the exit status is 1 if a page says
something else than the files.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from qd.evaluate import paper
from qd.evaluate.labels import CERTIFIED, SETS
from sim.files.intervals import value_words

MARKED = re.compile(r"<!-- table: (?P<name>\w+)(?: (?P<robot>\w+))? -->\n.*?<!-- table: end -->", re.DOTALL)
NONE = "-"

Json = Mapping[str, Any]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows))


def read(folder: Path, file: str) -> Json:
    """A results file."""
    return json.loads((folder / file).read_text(encoding="utf-8"))


def count(value: float | None) -> str:
    """A number without decimals."""
    return NONE if value is None else f"{value:,.0f}"


def with_interval(numbers: Json, name: str, form: str = ".3f") -> str:
    """A value and the interval that stands beside it."""
    return value_words(numbers.get(name), numbers.get(f"{name}_interval"), form)


def archive(folder: Path, robot: str) -> str:
    """The archives beside the paper's, which stands at 1,000 iterations."""
    theirs = paper.ARCHIVES.get(robot, {})
    files = {name: folder / name / "archive.json" for name in ("archive", "archive_cma_mae")}
    ours = [json.loads(file.read_text(encoding="utf-8")) for file in files.values() if file.exists()]
    names = (
        "iterations", "episodes", "elites", "elites_same_cell", "elites_reproduced", "corrected_elites", "families",
        "failing", "confirmed", "certified", "faults", "faults_panel", "faults_unseen", "fault_families",
        "with_collision", "qd_score", "corrected_qd_score",
    )  # fmt: skip
    published = {"iterations": 1000, "episodes": 4_000_000, **theirs}
    rows = [
        (name.replace("_", " "), *(count(row.get(name)) for row in ours), count(published.get(name))) for name in names
    ]
    shares = [f"{row['reachable_coverage']:.1%}" for row in ours]
    share = f"{theirs['elites'] / ours[0]['reachable_cells']:.1%}" if theirs else NONE
    fitness = f"about {theirs['fitness']}" if "fitness" in theirs else NONE
    rows += [
        ("share of the reachable cells", *shares, share),
        ("mean fitness", *(f"{row['mean_fitness']:.1f}" for row in ours), fitness),
        ("minutes", *(f"{row['wall_s'] / 60:.0f}" for row in ours), "about 480, two RTX 3070 Ti"),
    ]
    return table(("archive", *(row.get("method") or "ours" for row in ours), "paper (CMA-MAE)"), rows)


def controllers(folder: Path, robot: str) -> str:
    """Rates and rewards of every kind of controller: the mean of its seeds where it has several."""
    tables = read(folder, "tables.json")
    theirs = paper.published(robot) or {}
    rows = []
    for name, label in SETS.items():
        for controller in tables["goal"].get(name, {}):
            if "@" in controller:
                continue
            cells = [_cell(tables, measure, name, controller) for measure in ("goal", "success", "reward")]
            numbers = [theirs.get(measure, {}).get(name, {}).get(controller) for measure in ("success", "reward")]
            beside = NONE if None in numbers else f"{numbers[0]:.3f}, {numbers[1]:.1f}"
            rows.append((f"{label} ({tables['terrains'][name]})", controller, *cells, beside))
        for controller in tables["certified_goal"].get(name, {}):
            if "@" not in controller:
                about = tables["certified"][name]
                role = about["chosen_by"].get(controller)
                known = f"{controller} ({role})" if role else controller
                cells = [_cell(tables, measure, name, controller) for measure in CERTIFIED]
                rows.append((f"{label}, certified ({about['terrains']})", known, *cells, NONE, NONE))
    header = ("terrains", "controller", "goal (95 %)", "no base collision (95 %)", "reward (95 %)", "paper")
    return table(header, rows)


def _cell(tables: Json, measure: str, name: str, controller: str) -> str:
    """A mean with its interval over seeds where there are several, else over terrains."""
    form = ".1f" if measure == "reward" else ".3f"
    seeds = tables["over_seeds"].get(measure, {}).get(name, {}).get(controller)
    if seeds is not None and seeds["mean"] is not None:
        return f"{value_words(seeds['mean'], seeds['interval'], form)}, {len(seeds['values'])} seeds"
    return value_words(tables[measure][name][controller], tables["intervals"][measure][name][controller], form)


def kind_differences(folder: Path, robot: str) -> str:
    """How much more often one kind of controller reaches the goal than another, over families and seeds."""
    rows = [
        (SETS[name], pair, value_words(row["goal"], row["interval"], "+.3f"))
        for name, pairs in read(folder, "tables.json")["kind_differences"].items()
        for pair, row in pairs.items()
    ]
    return table(("terrains", "controllers", "goal (95 %)"), rows)


def distances(folder: Path, robot: str) -> str:
    """How near the elites trained on are."""
    rows = [
        (SETS[name], f"{row['terrains']}", *(f"{100 * row[key]:.1f} cm" for key in ("median", "least", "largest")))
        for name, row in read(folder, "distances.json")["nearest_m"].items()
    ]
    return table(("terrains", "number", "median", "least", "largest"), rows)


def ablation(folder: Path, robot: str) -> str:
    """Mean STD of the elites with and without it in the fitness."""
    numbers = read(folder, "ablation.json")
    columns = [
        [value_words(*pair, ".2f") for pair in zip(numbers["mean_std"][name], numbers["intervals"][name], strict=True)]
        for name in ("alpha_1", "alpha_0")
    ]
    rows = list(zip(map("{:,}".format, numbers["iterations"]), *columns, strict=True))
    return table(("iteration", "mean STD, alpha 1 (95 %)", "mean STD, alpha 0 (95 %)"), rows)


def search(folder: Path, robot: str) -> str:
    """Methods of search, the one with the most failing elites first."""
    methods = read(folder, "search.json")["methods"]
    ranked = sorted(methods, key=lambda name: -(methods[name]["failing"] or 0.0))
    names = ("elites", "corrected_elites", "failing", "confirmed", "faults_panel")
    rows = [
        (name, f"{methods[name]['seeds']}", count(methods[name]["episodes"]),
         *(with_interval(methods[name], number, ".0f") for number in names))
        for name in ranked
    ]  # fmt: skip
    return table(("method", "seeds", "episodes", *(name.replace("_", " ") for name in names)), rows)


def agreement(folder: Path, robot: str) -> str:
    """How far rates at the search's settings lie above those of other crossings."""
    numbers = read(folder, "agreement.json")
    words = {
        "again": "the same settings again",
        "resolved": "contact resolved",
        "mujoco_c": "MuJoCo C",
        "both_resolved": "contact resolved, against MuJoCo C",
    }
    rows = [
        (f"{name.replace('_', '-')} ({numbers[name][way]['terrains']})", label,
         *(with_interval(numbers[name][way], f"{kind}_bias", "+.3f") for kind in ("goal", "success")))
        for name in ("hard_random", "elites")
        for way, label in words.items()
    ]  # fmt: skip
    return table(("terrains", "crossed", "goal, bias (95 %)", "no base collision, bias (95 %)"), rows)


def speed(folder: Path, robot: str) -> str:
    """The search beside bare physics, and training."""
    numbers = read(folder, "speed.json")
    rows = [
        ("seconds of the paper's iteration, median", f"{numbers['iteration_s_median']:.2f}"),
        ("physics steps a second in it", count(numbers["world_steps_per_s"])),
        ("... of contacts and solver alone, in the same motion", count(numbers["bare_world_steps_per_s"])),
        ("... share", f"{numbers['bare_physics_ratio']:.2f}"),
        ("... of robots that stand", count(numbers["bare_world_steps_per_s_standing"])),
        ("a step on ground with friction and softness, over one without", f"{numbers['ground_step_ratio']:.3f}"),
        ("training, 4,096 robots: environment steps a second", count(numbers["train_env_steps_per_s"])),
        ("training, 8,192 robots", count(numbers["train_env_steps_per_s_8192"])),
        ("training, two GPUs", count(numbers["train_env_steps_per_s_2gpu"])),
        *((f"{row['num_envs']:,} robots: episodes a second", count(row["episodes_per_s"]))
          for row in numbers["envs_curve"]),
    ]  # fmt: skip
    return table((numbers["device"], ""), rows)


def kernels(folder: Path, robot: str) -> str:
    """Kernels against torch and the device's ceiling, by `make bench`; of the first GPU there is a file of."""
    numbers = read(folder, "nvidia-h200.json")
    rows = [
        (row["kernel"], *(NONE if row[name] is None else f"{row[name]:.4f}" for name in
         ("ours_ms", "torch_ms", "torch_compile_ms")), f"{row['speedup']:.0f}x", f"{row['ceiling_share']:.1%}",
         row["bound_by"])
        for row in numbers["rows"] if row["torch_ms"] is not None
    ]  # fmt: skip
    return table(("kernel", "ms", "eager torch", "compiled", "speed-up", "of the ceiling", "bound by"), rows)


def spaces(folder: Path, robot: str) -> str:
    """Searches in different terrain spaces."""
    names = ("episodes", "elites", "corrected_elites", "failing", "confirmed", "certified", "faults_panel")
    rows = [
        (name, *(count(numbers.get(number)) for number in names))
        for name, numbers in read(folder, "spaces.json")["spaces"].items()
    ]
    return table(("space", *(name.replace("_", " ") for name in names)), rows)


def scale(folder: Path, robot: str) -> str:
    """More devices."""
    rows = [
        (f"{row['workers']}", count(row["episodes_per_s"]), f"{row['efficiency']:.3f}",
         f"{row['paper_size_iteration_s']:.2f}", f"{row['speedup_paper_size']:.2f}")
        for row in read(folder, "scale.json")["rows"]
    ]  # fmt: skip
    header = ("GPUs", "episodes a second", "of linear", "seconds of the paper's iteration", "times as fast as one")
    return table(header, rows)


def solver_options(folder: Path, robot: str) -> str:
    """Caps and capacities of the solver."""
    rows = [
        (f"{1e3 * row['physics_dt']:g} ms", f"{row['iterations']}", f"{row['njmax']}", f"{row['nconmax']}",
         f"{row['wall_s']:.1f}", f"{row['goal_rate']:.4f}", f"{row['success_rate']:.4f}", f"{row['invalid']}")
        for row in read(folder, "solver_options.json")["rows"]
    ]  # fmt: skip
    header = ("step", "iterations", "rows", "contacts", "seconds", "goal", "no base collision", "invalid")
    return table(header, rows)


def penalty_ratios(folder: Path, robot: str) -> str:
    """How much more a crossing that misses the goal costs."""
    rows = [
        (name, value_words(row["ratio"], None, ".1f"))
        for name, row in read(folder, "penalty_ratios.json")["penalties"].items()
    ]
    return table(("penalty", "missed the goal, over reached it"), rows)


def rounds(folder: Path, robot: str) -> str:
    """Rounds of hardening, and searches of the last controller beside searches of the base."""
    numbers = read(folder, "rounds.json")
    names = ("episodes", "elites", "corrected_elites", "failing", "faults", "faults_panel")
    searches = [("the last again", row) for row in numbers.get("searches", ())]
    searches += [("base again", row) for row in numbers.get("base_searches", ())]
    rows = [
        (controller, *(count(row.get(name)) for name in names))
        for controller, row in [*((row["controller"], row) for row in numbers["rounds"]), *searches]
    ]
    return table(("controller", *(name.replace("_", " ") for name in names)), rows)


TABLES: dict[str, Callable[[Path, str], str]] = {
    make.__name__: make
    for make in (
        archive, controllers, kind_differences, distances, ablation, search, agreement, speed, kernels, spaces, scale,
        solver_options, penalty_ratios, rounds,
    )
}  # fmt: skip


def with_tables(text: str, results: Path) -> str:
    """A page with its tables made anew."""

    def make(match: re.Match[str]) -> str:
        name, robot = match["name"], match["robot"] or "bench"
        if name not in TABLES:
            raise ValueError(f"a table must be one of {', '.join(TABLES)}, got {name}")
        try:
            made = TABLES[name](results / robot, robot)
        except (KeyError, TypeError) as error:
            raise ValueError(f"table {name} of {robot} lacks a number: {type(error).__name__}: {error}") from error
        return f"{match[0].partition(chr(10))[0]}\n{made}\n<!-- table: end -->"

    return MARKED.sub(make, text)


def main(argv: Sequence[str] | None = None) -> int:
    """Writes or checks all pages; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument("--check", action="store_true", help="write nothing")
    args = parser.parse_args(argv)
    stale = []
    for page in sorted(args.docs.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        made = with_tables(text, args.results)
        if made != text:
            stale.append(page)
            if not args.check:
                page.write_text(made, encoding="utf-8")
    for page in stale:
        print(f"{page} {'says something else than the results' if args.check else 'is written anew'}")
    return int(args.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
