"""The published archives: results/<robot>/archive, archive_cma_mae and independent.

The default method, the paper's method, and the default one again with another seed. Each is a search of preset wide.
On the way its elites cross fresh episodes, and curve.json has what they say. A third seed is searched for that alone.
The first two are judged: contact resolved, a specialist trained on what fails, others' crossings, varied conditions.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qd.judge import judge
from qd.run.directory import RunDirectory
from qd.search import search
from results.make.common import ONCE, Script, parse
from sim.files.atomic import to_json, write_atomically
from train.cfg import FinetuneCfg, RunCfg
from train.finetune import train_specialist

SEARCHES: dict[str, tuple[dict[str, Any], int]] = {
    "archive": ({}, 0),
    "archive_cma_mae": ({"method": "cma_mae", **ONCE}, 0),
    "independent": ({}, 1),
    "third": ({}, 2),
}
"""Changes of preset wide, and seed of each."""
CURVE = (6, 12, 31, 62, 125)
"""Iterations after which elites cross fresh episodes, the last those of the preset; the third search has three."""
PUBLISHED = (
    "archive.npz", "archive.json", "config.json", "metrics.jsonl", "curve.json", "*.png", "minimal.*",
    "certifiers/specialist.*",
)  # fmt: skip
"""Files of a run that are published."""
COUNTS = ("episodes", "elites", "elites_same_cell", "corrected_elites", "failing", "families")


def make_archive(script: Script, name: str) -> Path:
    """Searches and judges; returns the run."""
    changes, seed = ({}, 0) if script.small else SEARCHES[name]
    run, points = script.runs / name, CURVE[:3] if name == "third" else CURVE
    so_far = {row["iterations"]: row for row in script.read_so_far(run / "curve.json").get("curve", [])}
    for iterations in points[:1] if script.small else points:
        if iterations not in so_far:
            search(script.search_cfg(iterations, seed=script.seed + seed, **changes), run, script.compute)
            judge(run, stages=("fresh",), compute=script.compute)
            numbers = RunDirectory(run).read_summary()
            so_far[iterations] = {"iterations": iterations, **{count: numbers[count] for count in COUNTS}}
            write_atomically(run / "curve.json", to_json({**script.origin, "curve": [*so_far.values()]}))
    if not script.small and name.startswith("archive"):  # on a CPU a training takes hours
        judge_with_specialist(script, run)
    return run


def judge_with_specialist(script: Script, run: Path) -> dict[str, Any]:
    """Judges a search with its own specialist among the certifiers; returns the content of archive.json."""
    archive = judge(run, stages=("fresh", "resolved"), compute=script.compute)
    if archive.failing.any():
        train_specialist(script.robot, run, FinetuneCfg.specialist(script.robot), RunCfg(device=script.device))
    judge(run, stages=("others", "varied"), compute=script.compute)
    return RunDirectory(run).read_summary()


def main(argv: Sequence[str] | None = None) -> None:
    """Makes the archives and publishes them beside each other."""
    script = parse(__doc__, argv, "archive/archive.json", parts=tuple(SEARCHES))
    for name in script.parts or SEARCHES:
        run = make_archive(script, name)
        files = PUBLISHED if name != "third" else ("curve.json",)
        script.publish(run, script.out.parent.parent / name, files)


if __name__ == "__main__":
    main()
