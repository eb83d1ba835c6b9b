"""What breaks the controller in each terrain space, and which size of an obstacle does: spaces.json."""

from collections.abc import Sequence
from typing import Any

from qd.faults.families import rank
from qd.faults.judge import judge
from qd.search.archive import Archive
from qd.search.directory import RunDirectory
from qd.search.loop import search
from results.make.common import parse
from sim.robots.shipped import ROBOTS
from sim.terrains.spaces.registry import get_space

SPACES = ("super_gaussian", "super_gaussian+friction", "course")
COUNTS = (
    "iterations", "episodes", "elites", "reachable_coverage", "corrected_elites", "families", "failing", "confirmed",
    "certified", "faults", "faults_panel",
)  # fmt: skip


def causes_of(archive: Archive) -> dict[str, int]:
    """How many elites fail by which cause, the commonest first."""
    half_width = ROBOTS[archive.robot].footprint[1]
    ranking = rank(archive, get_space(archive.space, archive.space_sha256), half_width=half_width, judged=True)
    return {cause: len(rows) for cause, rows in ranking.by_cause().items()}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Searches each space as long, and judges what was found."""
    script = parse(__doc__, argv, "spaces.json")
    numbers, dose = {}, script.read_dose(conditions=False)
    for name in SPACES:
        run = script.runs / "spaces" / name
        search(script.search_cfg(13, seed=script.seed, space=name), run, script.compute)
        archive = judge(run, stages=("fresh",) if script.small else ("fresh", "resolved", "others"),
                        compute=script.compute)  # fmt: skip
        summary = RunDirectory(run).read_summary()
        numbers[name] = {**{count: summary.get(count) for count in COUNTS}, "causes": causes_of(archive)}
    return script.write({"spaces": numbers, "dose": dose})


if __name__ == "__main__":
    main()
