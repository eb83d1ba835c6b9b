"""What breaks the controller in each terrain space, and which size of an obstacle does: spaces.json."""

from collections.abc import Sequence
from typing import Any

from qd.faults.families import rank
from qd.faults.judge import judge
from qd.search.archive import Archive
from qd.search.directory import RunDirectory
from qd.search.loop import search
from qd.search.settings import SearchCfg
from results.make.common import COUNTS, Script, parse
from sim.robots.robot import ROBOTS
from sim.terrains.spaces.registry import get_space

SPACES = ("super_gaussian", "super_gaussian+friction", "course")


def causes_of(archive: Archive) -> dict[str, int]:
    """How many elites fail by which cause, the commonest first."""
    half_width = ROBOTS[archive.robot].footprint[1]
    ranking = rank(archive, get_space(archive.space, archive.space_sha256), half_width=half_width, judged=True)
    return {cause: len(rows) for cause, rows in ranking.by_cause().items()}


def search_space(script: Script, name: str, cfg: SearchCfg) -> tuple[Archive, dict[str, Any]]:
    """The archive of a search in the folder ``name``, judged by all stages but varied conditions, and its numbers."""
    run = script.runs / name
    search(cfg, run, script.compute)
    stages = ("fresh",) if script.small else ("fresh", "resolved", "others")
    archive = judge(run, stages=stages, compute=script.compute)
    summary = RunDirectory(run).read_summary()
    return archive, {
        **{count: summary.get(count) for count in ("iterations", "reachable_coverage", *COUNTS)},
        "causes": causes_of(archive),
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Searches each space as long, and judges what was found."""
    script = parse(__doc__, argv, "spaces.json")
    dose = script.read_dose(conditions=False)
    numbers = {}
    for name in SPACES:
        cfg = script.search_cfg(13, seed=script.seed, space=name)
        _, numbers[name] = search_space(script, f"spaces/{name}", cfg)
    return script.write({"spaces": numbers, "dose": dose})


if __name__ == "__main__":
    main()
