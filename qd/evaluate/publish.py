"""All published numbers beside the paper's, from results/ alone, into the page of results.

The paper is Esquerre-Pourtere, Kim and Park (arXiv 2506.01362). Its rewards are sums of its own training task's; the
weights of its two added penalties are not published, so that they compare among its controllers, not with ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim.files.atomic import read_json, write_atomically
from sim.files.command import command_line
from sim.files.intervals import value_words
from sim.policy.spec import firsts, kind_of

PAGE = Path("docs/results.md")
"""Where the published numbers stand."""

BEGIN, END = "<!-- numbers: begin -->", "<!-- numbers: end -->"
_NAMES = {"anymal": "ANYmal C", "cassie": "Cassie"}
_SETS = {
    "hand_crafted": "hand-crafted",
    "hard_random": "hard-random",
    "generated": "generated",
    "generated_far": "generated, far from training",
    "generated_independent": "generated, another search",
}
_NONE = "-"

_CONTROLLERS = ("C-HC", "C-HR", "C-G")
_PAPER_SETS = ("hand_crafted", "hard_random", "generated")

_ROWS = {
    "cassie": {
        "success": ((0.997, 0.984, 0.999), (0.928, 0.982, 0.990), (0.743, 0.876, 0.957)),
        "reward": ((32.7, 29.7, 32.9), (31.0, 31.6, 32.3), (25.7, 27.6, 29.9)),
    },
    "anymal": {
        "success": ((0.971, 0.976, 0.980), (0.865, 0.954, 0.976), (0.598, 0.876, 0.914)),
        "reward": ((25.6, 24.8, 25.4), (22.7, 24.9, 25.6), (16.6, 20.1, 23.3)),
    },
}

PAPER_ARCHIVES = {
    "cassie": {"elites": 930, "with_collision": 598, "without_collision": 332, "fitness": 4.7},
    "anymal": {"elites": 1129},
}
"""What the paper says of its archives after 1,000 iterations."""

Published = dict[str, dict[str, dict[str, float]]]
"""Measure -> set -> controller -> value."""


def published(robot: str) -> Published | None:
    """The paper's success rates (fractions) and rewards of a robot by set and controller; None if it has none.

    Source: its four tables, "Average rewards" and "Success rates" with the Cassie and with the ANYmal robot.
    """
    if robot not in _ROWS:
        return None
    return {
        measure: {name: dict(zip(_CONTROLLERS, row, strict=True)) for name, row in zip(_PAPER_SETS, rows, strict=True)}
        for measure, rows in _ROWS[robot].items()
    }


@dataclass(frozen=True, kw_only=True)
class Tables:
    """Write the published numbers of all robots, with the paper's beside them, into the page of results.

    They come from results/<robot>/archive/archive.json, tables.json, distances.json and ablation.json; what is not
    there yet is left out.
    """

    results: Path = Path("results")
    """Where the results are."""
    page: Path = PAGE
    """File with the lines `<!-- numbers: begin -->` and `<!-- numbers: end -->`. The text between them is replaced."""
    check: bool = False
    """Write nothing; fail if the file says something else than the results."""

    def execute(self) -> None:
        """Writes or checks the page.

        Raises:
            ValueError: If results or page are not as they must be, or with ``check`` say different things.
            FileNotFoundError: If there is no page.
        """
        numbers = numbers_of(self.results)
        text = self.page.read_text(encoding="utf-8")
        before, begin, rest = text.partition(BEGIN)
        _, end, after = rest.partition(END)
        if not begin or not end:
            raise ValueError(
                f"{self.page} must hold the lines {BEGIN} and {END}, got none: put them where numbers belong"
            )
        wanted = f"{before}{BEGIN}\n{numbers}\n{END}{after}"
        if self.check:
            if text != wanted:
                raise ValueError(f"{self.page} says something else than {self.results}: run {command_line('tables')}")
            return
        write_atomically(self.page, wanted.encode())
        print(f"{numbers}\n\nwritten to {self.page}")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def numbers_of(results: Path) -> str:
    """The Markdown of everything published in the folders of robots under ``results``.

    Raises:
        ValueError: If there is none, or a file is damaged or lacks a number.
    """
    robots = sorted(folder.name for folder in results.glob("*") if (folder / "archive").is_dir()) if results else []
    if not robots:
        raise ValueError(f"no results of a robot under {results}: expected {results}/<robot>/archive")
    return "\n\n".join(_robot(results / name, name) for name in robots)


def _robot(folder: Path, robot: str) -> str:
    parts = [f"**{_NAMES.get(robot, robot)}**"]
    for file, section in (
        ("archive/archive.json", _archive),
        ("tables.json", _tables),
        ("distances.json", _distances),
        ("ablation.json", _ablation),
    ):
        path = folder / file
        try:
            parts += [section(read_json(path), robot)] if path.exists() else []
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{path} lacks a number ({type(error).__name__}: {error}): make it again") from error
    return "\n\n".join(parts)


def _archive(found: dict[str, Any], robot: str) -> str:
    """The archive beside the paper's, which stands at 1,000 iterations."""
    paper = PAPER_ARCHIVES.get(robot, {})
    rows = [
        ("iterations", f"{found['iterations']:,}", "1,000"),
        ("episodes", f"{found['episodes']:,}", "4,000,000"),
        ("elites", f"{found['elites']:,}", _count(paper.get("elites"))),
        ("... reproduced by fresh episodes", _count(found["elites_reproduced"]), _NONE),
        (
            "coverage of the reachable cells",
            f"{found['reachable_coverage']:.1%}",
            f"{paper['elites'] / found['reachable_cells']:.1%}" if paper else _NONE,
        ),
        (
            "with / without a base collision",
            f"{found['with_collision']:,} / {found['without_collision']:,}",
            f"{paper['with_collision']} / {paper['without_collision']}" if "with_collision" in paper else _NONE,
        ),
        ("mean fitness", f"{found['mean_fitness']:.1f}", f"about {paper['fitness']}" if "fitness" in paper else _NONE),
        ("QD score", f"{found['qd_score']:,.0f}", _NONE),
        ("... corrected by fresh episodes", _count(found["corrected_qd_score"]), _NONE),
        ("search time", f"{found['wall_s'] / 60:.0f} min on {_gpus(found['gpus'])}", "about 8 h on two RTX 3070 Ti"),
    ]
    return table(("archive", "ours", "paper"), rows)


def _count(value: float | None) -> str:
    return _NONE if value is None else f"{value:,.0f}"


def _gpus(count: int) -> str:
    return "one GPU" if count == 1 else f"up to {count} GPUs" if count else "the CPU"


def _tables(found: dict[str, Any], robot: str) -> str:
    """Rates and rewards of every kind of controller, the mean of its seeds where it has several."""
    if found.get("part") == "validation":
        raise ValueError("tables.json is of validation terrains, by which settings are chosen: publish --part test")
    paper = published(robot) or {}
    rows = []
    for name, label in _SETS.items():
        count = found["terrains"].get(name)
        for who in firsts(found["success"].get(name, {})):
            kind = kind_of(who)
            cells = [_rate(found, measure, name, who) for measure in ("goal", "success")]
            reward = _rate(found, "reward", name, who, ".1f")
            theirs = [paper.get(measure, {}).get(name, {}).get(kind) for measure in ("success", "reward")]
            beside = _NONE if None in theirs else f"{theirs[0]:.3f}, {theirs[1]:.1f}"
            rows.append((f"{label} ({count})", kind, *cells, reward, beside))
        rows += _certified_rows(found, name, label)
    header = (
        "terrains",
        "controller",
        "goal (95 %)",
        "no base collision (95 %)",
        "reward (95 %)",
        "paper: success, reward",
    )
    about = found["archive"]
    where = f"; elites of the archive after {about['iterations']:,} iterations" if about else ""
    title = f"In brackets the terrains of a set; {found['episodes']} episodes each{where}."
    return "\n\n".join([f"{title}\n\n{table(header, rows)}", *_about_certified(found), *_resolved(found)])


def _about_certified(found: dict[str, Any]) -> list[str]:
    """What certified terrains are; nothing where none are known."""
    if not any(about["terrains"] for about in found.get("certified", {}).values()):
        return []
    return [
        "Certified terrains are those that the searched controller fails and another one crosses. They were chosen by "
        "that, so the rate of a controller marked (searched) is too low there and that of a (certifier) too high."
    ]


def _certified_rows(found: dict[str, Any], name: str, label: str) -> list[tuple[str, ...]]:
    """Rates on the certified terrains of a set alone; none where none are known."""
    about = found.get("certified", {}).get(name)
    if not about or not about["terrains"]:
        return []
    rows = []
    for who in firsts(found["certified_goal"][name]):
        cells = [_rate(found, measure, name, who) for measure in ("certified_goal", "certified_success")]
        known = kind_of(who) + role_words(about, who)
        rows.append((f"{label}, certified ({about['terrains']})", known, *cells, _NONE, _NONE))
    return rows


def role_words(about: dict[str, Any], who: str) -> str:
    """What a controller has to do with how terrains were certified, in brackets; empty if nothing."""
    role = about["chosen_by"].get(who)
    return f" ({role})" if role else ""


def _resolved(found: dict[str, Any]) -> list[str]:
    """Rates with contact resolved, here and in MuJoCo C, and the bias of those above; nothing without them."""
    rows = []
    for key, how in (("resolved", "here"), ("mujoco_c", "MuJoCo C")):
        for name, row in (found.get(key) or {}).items():
            for who, one in row.items():
                rows.append((f"{_SETS[name]} ({one['terrains']})", who, how, *resolved_cells(one)))
    header = ("contact resolved", "controller", "in", "goal (95 %)", "bias", "no base collision (95 %)", "bias")
    about = "The bias is how far the rates at the search's settings lie above those with contact resolved."
    return [f"{about}\n\n{table(header, rows)}"] if rows else []


def resolved_cells(found: dict[str, Any]) -> list[str]:
    """Goal rate, its bias, no base collision and its bias, with intervals, of what was crossed in another way."""
    cells = []
    for kind in ("goal", "success"):
        cells.append(value_words(found[kind], found["intervals"][kind]))
        cells.append(value_words(found[f"{kind}_bias"], found[f"{kind}_bias_interval"], "+.3f"))
    return cells


def _rate(found: dict[str, Any], measure: str, name: str, who: str, form: str = ".3f") -> str:
    """A mean with its interval over seeds where there are several, else over terrains."""
    several = found["over_seeds"].get(measure, {}).get(name, {}).get(kind_of(who))
    mean, limits = found[measure][name][who], found["intervals"][measure][name][who]
    if several is not None:
        mean, limits = several["mean"], several["interval"]
    seeds = f", {len(several['values'])} seeds" if several is not None and mean is not None else ""
    return value_words(mean, limits, form) + seeds


def _distances(found: dict[str, Any], robot: str) -> str:
    """How near the elites trained on are."""
    each = [f"{_SETS[name]} {100 * row['median']:.1f} cm" for name, row in found["nearest_m"].items()]
    return f"RMS distance of the terrains' heights to the nearest elite trained on, medians: {'; '.join(each)}."


def _ablation(found: dict[str, Any], robot: str) -> str:
    """Mean STD of the elites with and without it in the fitness; the paper shows its curves without numbers."""
    curves = [
        [value_words(*point, ".2f") for point in zip(found["mean_std"][name], found["intervals"][name], strict=True)]
        for name in ("alpha_1", "alpha_0")
    ]
    rows = list(zip(map("{:,}".format, found["iterations"]), *curves, strict=True))
    return table(("iteration", "mean STD, alpha 1 (95 %)", "mean STD, alpha 0 (95 %)"), rows)
