"""How far test terrains lie from the elites trained on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim.files.command import InSpace, OfRobot, publish
from sim.files.settings import check, setting


@dataclass(frozen=True, kw_only=True)
class Distances(OfRobot, InSpace):
    """Measure how far test terrains lie from the nearest elite trained on: RMS of the heights' differences [m].

    Elites of one archive descend from each other, and a held-out one may be a near copy of one that was trained on.
    Then a rate on held-out elites says little of other terrains.
    """

    archive: Path | None = None
    """Run of a search, or its archive.npz; results/<robot>/archive."""
    independent: Path | None = None
    """Run of another search, or its archive.npz, as in the evaluation: how far its elites lie."""
    split_seed: int = setting(0, least=0)
    """Which elites are held out, as in training and evaluation."""
    terrains: int | None = setting(None, least=1)
    """Terrains a set, as in the evaluation; the paper's 300 (Cassie: 180)."""
    seed: int = setting(0, least=0)
    """Draws the hard-random terrains, as in the evaluation."""
    out: Path | None = None
    """Where to write the numbers; printed alone if left out."""

    def execute(self) -> None:
        """Measures, prints and writes."""
        publish(self.out, lambda: distances(self), _show)


def distances(flags: Distances) -> dict[str, Any]:
    """Distances of every set's terrains to the nearest training elite, of each set median, least and largest [m].

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If it is damaged, of another robot or too small, or a number makes no sense.
    """
    import numpy as np

    from qd.evaluate.sets import (
        INDEPENDENT,
        far_part,
        make_sets,
        nearest_distance,
        paper_terrains,
        read_independent,
        space_of,
        split_elites,
    )
    from qd.run.directory import published_or_newest, read_archive_of
    from sim.files.records import provenance, robot_identity
    from sim.robots.robot import get_robot

    check(flags)
    found = get_robot(flags.robot)
    robot, path = found.name, flags.archive or published_or_newest(found, flag="archive")
    archive = read_archive_of(found, path, flags.space)
    split = split_elites(archive, robot, flags.split_seed, spec=found.spec, run=path)
    count = flags.terrains or paper_terrains(robot)
    space = space_of(archive)
    names, other = ["hard_random", "generated"], None
    if flags.independent is not None:
        names.append(INDEPENDENT)
        other = read_independent(found, flags.independent, archive=archive, archive_path=path, named=flags.space)
    sets = make_sets(names, count, flags.seed, archive=archive, split=split, independent=other, space=space)
    train = archive.genes[split.train]
    nearest = {name: nearest_distance(found.terrains, train, space) for name, found in sets.items()}
    nearest["generated_far"] = nearest["generated"][far_part(nearest["generated"])]
    return {
        **provenance("cpu", flags.seed),
        "robot": robot,
        **robot_identity(found),
        "iterations": archive.iterations,
        "trained_on": len(split.train),
        "nearest_m": {
            name: {
                "terrains": len(row),
                "median": float(np.median(row)),
                "least": float(row.min()),
                "largest": float(row.max()),
            }
            for name, row in nearest.items()
        },
    }


def _show(report: dict[str, Any]) -> None:
    print(f"RMS distance to the nearest of {report['trained_on']} elites trained on [cm]")
    for name, row in report["nearest_m"].items():
        numbers = "  ".join(f"{key} {100 * row[key]:.1f}" for key in ("median", "least", "largest"))
        print(f"{name:<22} {row['terrains']:>4} terrains: {numbers}")
