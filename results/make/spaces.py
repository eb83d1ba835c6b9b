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

SPACES = ("super_gaussian", "super_gaussian+friction", "course")


def search_space(script: Script, name: str, cfg: SearchCfg) -> tuple[Archive, dict[str, Any]]:
    """The archive of a search in the folder ``name``, judged, and its numbers; causes are the commonest first."""
    run = script.runs / name
    search(cfg, run, script.compute)
    stages = ("fresh",) if script.small else ("fresh", "resolved", "others")
    archive = judge(run, stages=stages, compute=script.compute)
    summary = RunDirectory(run).read_summary()
    numbers = {count: summary.get(count) for count in ("iterations", "reachable_coverage", *COUNTS)}
    by_cause = rank(archive, archive.terrain_space, half_width=script.robot.half_width, judged=True).by_cause()
    return archive, {**numbers, "causes": {cause: len(rows) for cause, rows in by_cause.items()}}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Searches each space as long, and judges what was found."""
    script = parse(__doc__, argv, "spaces.json")
    dose = script.read_dose(conditions=False)
    numbers = {}
    for name in SPACES:
        _, numbers[name] = search_space(
            script, f"spaces/{name}", script.search_cfg(13, seed=script.seed, crossed=0.0, space=name)
        )
    return script.write({"spaces": numbers, "dose": dose})


if __name__ == "__main__":
    main()
