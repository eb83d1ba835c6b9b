"""The published archives: results/<robot>/archive, archive_cma_mae and independent.

The default method, the paper's method, and the default one again with another seed. Each is a search of preset wide.
Then it is judged: fresh episodes, contact resolved, a specialist trained on what fails, and others' crossings.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qd.judge import judge
from qd.run.directory import RunDirectory
from qd.search import search
from results.make.common import Script, parse
from train.cfg import FinetuneCfg, RunCfg
from train.finetune import train_specialist

SEARCHES = {"archive": (None, 0), "archive_cma_mae": ("cma_mae", 0), "independent": (None, 1)}
"""Method, or None for the default one, and seed of each."""
PUBLISHED = ("archive.npz", "archive.json", "config.json", "metrics.jsonl", "*.png", "certifiers/specialist.pt")
"""Files of a run that are published."""


def make_archive(script: Script, name: str) -> Path:
    """Searches and judges; returns the run."""
    method, seed = SEARCHES[name]
    changes = {} if method is None else {"method": method}
    run = script.runs / name
    search(script.search_cfg(seed=script.seed + seed, **changes), run, script.compute)
    if not script.small:  # on a CPU judging and a training take hours
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
    """Makes the three archives and publishes them beside each other."""
    script = parse(__doc__, argv, "archive/archive.json", parts=tuple(SEARCHES))
    for name in script.parts or SEARCHES:
        run = make_archive(script, name)
        for pattern in PUBLISHED:
            for file in run.glob(pattern):
                target = script.out.parent.parent / name / file.relative_to(run)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)


if __name__ == "__main__":
    main()
