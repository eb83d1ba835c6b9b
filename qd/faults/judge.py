"""Judging: which elites of a search are faults of its controller.

An elite is the best of many noisy evaluations and flatters itself; 40 fresh episodes do not. Those that fail by them
are crossed with contact resolved, and by other controllers (:mod:`qd.faults.numbers` says what follows). Which episodes
those are follows from the run's seed and from what names an elite. Crossings are kept in the run, so that a judging
that was stopped finds them when it is run again.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.marks import hash_elites, read_trained_on
from qd.faults.numbers import VARIED_NUMBERS, fault_numbers, found_numbers, fresh_numbers
from qd.faults.searches import check_certifiers, find_certifiers, find_search
from qd.faults.stages import STAGES
from qd.faults.stages.base import Judging, Stage
from qd.faults.stages.fresh import with_families
from qd.search.archive import ARCHIVE_FILE, Archive, write_archive
from qd.search.directory import METRICS_FILE, SUMMARY_FILE, RunDirectory, claimed
from qd.show import figures
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from sim.controllers.spec import ControllerSpec, controller_identity
from sim.files.atomic import read_json, to_json, write_atomically

CROSSINGS_FOLDER = "crossings"
"""Folder of a run that keeps what was crossed to judge it."""
USUAL_STAGES = ("fresh", "resolved", "others")
"""What judging does by default."""


def judge(
    run: Path,
    *,
    compute: Compute,
    stages: Sequence[str] = USUAL_STAGES,
    certifiers: Mapping[str, str] | None = None,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
) -> Archive:
    """Judges the elites of a search in stages, and writes the run's archive, numbers and figures after each.

    ``stages`` are some of :data:`qd.faults.stages.STAGES`, ``certifiers`` other controllers by name, those of
    :func:`qd.faults.searches.find_certifiers` if None; robot, policy and space are as
    :func:`qd.faults.searches.find_search` takes them.
    """
    if unknown := [name for name in stages if name not in STAGES]:
        raise ValueError(f"stages must be some of {', '.join(STAGES)}, got {', '.join(unknown)}")
    chosen = [STAGES[name] for name in stages]
    search = find_search(run, robot=robot, policy=policy, space=space)
    check_policy(search.policy, search.robot, compute.device)
    certifiers = find_certifiers(search) if certifiers is None else certifiers
    if any(stage.with_certifiers for stage in chosen):
        check_certifiers(certifiers, search, compute.device)
    calls = sum(stage.count_crossings(certifiers) for stage in chosen)
    with claimed(run), Crosser(search.robot, compute, cache=run / CROSSINGS_FOLDER, calls=calls) as crosser:
        archive = search.read_archive()
        judging = Judging(search=search, certifiers=certifiers, crosser=crosser)
        _check_stages(chosen, archive, judging)
        if archive.fresh is not None and archive.family is None:
            archive = with_families(archive, search)
        for stage in chosen:
            archive = stage.run(archive, judging)
            origin = compute.origin(search.cfg.seed) | controller_identity(search.robot, search.policy)
            _write(archive, judging, {stage.name: origin})
    return archive


def _check_stages(stages: Sequence[Stage], archive: Archive, judging: Judging) -> None:
    """Refuses stages, before anything is crossed, without those that they need; a stage undoes those that need it."""
    done = {name for name, stage in STAGES.items() if stage.is_done(archive)}
    before: list[str] = []
    for stage in stages:
        if missing := [name for name in stage.needs if name not in done]:
            raise ValueError(
                f"stages must begin with {', '.join(missing)}, got {', '.join(other.name for other in stages)}: "
                f"{judging.search.run} has nothing by which {stage.name} could judge"
            )
        stage.check(archive, judging, before)
        before.append(stage.name)
        done = {name for name in done if stage.name not in STAGES[name].needs} | {stage.name}


def find_seen(archive: Archive, families: NDArray[np.int64], certifiers: Mapping[str, str]) -> NDArray[np.bool_] | None:
    """Whether each certifier of a judged archive has trained on kin of each elite, shape (N, C).

    None if the training record of one of them is not at hand.
    """
    marks, columns = np.array(hash_elites(archive.genes)), []
    for name in archive.certifiers:
        if (policy := certifiers.get(name)) is None:
            return None
        trained_on, files = read_trained_on(policy), ControllerSpec.parse(policy).files
        if not trained_on and not any(file.with_suffix(".train.json").is_file() for file in files):
            return None
        columns.append(np.isin(families, families[np.isin(marks, [*trained_on])]))
    return np.stack(columns, axis=1) if columns else None


def _write(archive: Archive, judging: Judging, origin: dict[str, Any]) -> None:
    """Writes archive, numbers and figures of a run; ``origin`` is what judged it, by stage."""
    run = RunDirectory(judging.search.run)
    assert archive.fresh is not None and archive.family is not None
    seen = find_seen(archive, archive.family, judging.certifiers) if archive.is_judged else None
    file = run.path / SUMMARY_FILE
    numbers = read_json(file) if file.exists() else {}
    numbers = {name: value for name, value in numbers.items() if name not in VARIED_NUMBERS}
    metrics = run.read_metrics() if (run.path / METRICS_FILE).exists() else []
    if len(metrics) >= archive.iterations:  # a search that was stopped has not written its numbers
        numbers |= found_numbers(archive, metrics[: archive.iterations])
    numbers |= fresh_numbers(archive, archive.fresh) | fault_numbers(archive, archive.family, seen)
    numbers["judged_by"] = numbers.get("judged_by", {}) | origin
    write_archive(run.path / ARCHIVE_FILE, archive)
    write_atomically(file, to_json(numbers))
    if metrics:
        figures.write_figures(run.path, archive, metrics)
