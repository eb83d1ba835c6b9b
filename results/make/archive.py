"""The published archives: results/<robot>/archive, archive_cma_mae and independent.

The default method and the paper's method, and the default one again with another seed, to a million episodes. Each is
a search of preset wide. On the way its elites cross fresh episodes, and curve.json has what they say. A third seed is
searched for that alone.
The first two are judged: contact resolved, a specialist trained on what fails, others' crossings, varied conditions;
witness.py goes on.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qd.faults.judge import judge
from qd.search.directory import RunDirectory
from results.make.common import ARCHIVE_FILES, CURVE_FILE, FRESH_COUNTS, PAPER_SIZE, Script, follow_search, parse
from sim.files.atomic import to_json, write_atomically
from train.cfg import FinetuneCfg, RunCfg
from train.finetune import train_specialist

SEARCHES: dict[str, tuple[dict[str, Any], int]] = {
    "archive": ({}, 0),
    "archive_cma_mae": ({"method": "cma_mae", **PAPER_SIZE}, 0),
    "independent": ({}, 1),
    "third": ({}, 2),
}
"""Changes of preset wide, and seed of each."""
STAGES = ("fresh", "resolved", "others", "varied")
CURVE = (192_000, 384_000, 992_000, 1_984_000, 4_000_000)
"""Episodes after which elites cross fresh ones; searches with other seeds end at the third."""
PUBLISHED = (*ARCHIVE_FILES, "*.png", "minimal.*", "certifiers/specialist.*", CURVE_FILE)
"""Files of a run that are published, the one last by which all.sh knows that it is done."""


def make_archive(script: Script, name: str) -> Path:
    """Searches and judges; returns the run."""
    changes, seed = ({}, 0) if script.small else SEARCHES[name]
    run, cfg = script.runs / name, script.search_cfg(seed=script.seed + seed, **changes)
    points = script.count_iterations(cfg, *(CURVE if name.startswith("archive") else CURVE[:3]))
    follow_search(script, run, cfg, points, FRESH_COUNTS)
    if not script.small and name.startswith("archive"):  # on a CPU a training takes hours
        judge_with_specialist(script, run)
    summary = RunDirectory(run).read_summary()
    write_atomically(run / "archive.json", to_json({**summary, "method": cfg.scheduler.method}))
    return run


def judge_with_specialist(script: Script, run: Path) -> dict[str, Any]:
    """Judges a search with its own specialist among the certifiers; returns the content of archive.json.

    What today's sources have judged in these stages is read.
    """
    numbers = RunDirectory(run).read_summary()
    judged_by = [numbers.get("judged_by", {}).get(stage, {}) for stage in STAGES]
    if all(origin.get("sources_sha256") == script.origin["sources_sha256"] for origin in judged_by):
        return numbers
    archive = judge(run, stages=STAGES[:2], compute=script.compute)
    if archive.failing.any():
        train_specialist(script.robot, run, FinetuneCfg.specialist(script.robot), RunCfg(device=script.device))
    judge(run, stages=STAGES[2:], compute=script.compute)
    return RunDirectory(run).read_summary()


def main(argv: Sequence[str] | None = None) -> None:
    """Makes the archives and publishes them beside each other."""
    script = parse(__doc__, argv, "archive/archive.json", parts=tuple(SEARCHES))
    for name in script.parts or SEARCHES:
        run = make_archive(script, name)
        files = {"third": (CURVE_FILE,), "archive": ("metrics.jsonl", *PUBLISHED)}.get(name, PUBLISHED)
        script.publish(run, script.out.parent.parent / name, files)


if __name__ == "__main__":
    main()
