"""Judging: which elites of a search are faults of its controller.

Elites that fail by fresh episodes are crossed with contact resolved and by other controllers: :mod:`qd.faults.numbers`
says what follows. Episodes follow from the run's seed and from what names an elite. Crossings are kept in the run, so
that a judging that was stopped finds them when it is run again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.sets import hash_elites, read_trained_on
from qd.faults.numbers import VARIED_NUMBERS, fault_numbers, found_numbers, fresh_numbers
from qd.faults.searches import find_search
from qd.faults.stages import STAGES, Judging, open_judging, with_families
from qd.search.archive import ARCHIVE_FILE, Archive, write_archive
from qd.search.directory import METRICS_FILE, SUMMARY_FILE, RunDirectory
from qd.show import figures
from qd.workers.compute import Compute
from sim.controllers.spec import ControllerSpec
from sim.files.atomic import read_json, to_json, write_atomically


def judge(
    run: Path,
    *,
    compute: Compute,
    stages: Sequence[str] = ("fresh", "resolved", "others"),
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
    ask = any(STAGES[name].asks_certifiers for name in stages)
    search = find_search(run, robot=robot, policy=policy, space=space)
    with open_judging(search, compute, certifiers, ask=ask) as judging:
        archive = search.read_archive()
        for index, name in enumerate(stages):
            STAGES[name].check(archive, judging, stages[:index])
        if archive.fresh is not None and archive.family is None:
            archive = with_families(archive, search)
        for number, name in enumerate(stages, 1):
            archive = STAGES[name].run(archive, replace(judging, step=f"{number} of {len(stages)}: "))
            _write(archive, judging, name)
    return archive


def find_seen(archive: Archive, families: NDArray[np.int64], certifiers: Mapping[str, str]) -> NDArray[np.bool_] | None:
    """Whether each certifier of a judged archive has trained on kin of each elite, shape (N, C).

    None if the training record of one of them is not at hand.
    """
    marks = np.array(hash_elites(archive.genes))
    columns = []
    for name in archive.certifiers:
        if (policy := certifiers.get(name)) is None:
            return None
        trained_on = read_trained_on(policy)
        records = [file.with_suffix(".train.json") for file in ControllerSpec.parse(policy).files]
        if not trained_on and not any(record.is_file() for record in records):
            return None
        columns.append(np.isin(families, families[np.isin(marks, [*trained_on])]))
    return np.stack(columns, axis=1) if columns else None


def _write(archive: Archive, judging: Judging, stage: str) -> None:
    """Writes archive, numbers and figures of a run after a stage."""
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
    numbers["judged_by"] = numbers.get("judged_by", {}) | {stage: judging.origin}
    write_archive(run.path / ARCHIVE_FILE, archive)
    write_atomically(file, to_json(numbers))
    if metrics:
        figures.write_figures(run.path, archive, metrics)
