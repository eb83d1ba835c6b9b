"""How far test terrains lie from the elites trained on: ``python -m train.evaluate.distances --robot anymal``.

Elites of one archive descend from each other, and a held-out one may be a near copy of one that was trained on. What a
rate on held-out elites says of other terrains depends on that.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from qd.archive import read_archive
from sim.files.command import exit_code_of, publish
from sim.files.provenance import provenance
from train.evaluate.sets import far_part, make_sets, nearest_distance, paper_terrains, split_elites


@dataclass(frozen=True, kw_only=True)
class DistancesCfg:
    """Say how far test terrains lie from the nearest elite trained on: RMS of the heights' differences [m]."""

    robot: str = "anymal"
    """Whose archive and sets."""
    archive: Path | None = None
    """Run of a search, or its archive.npz; results/<robot>/archive."""
    split_seed: int = 0
    """Which elites are held out, as in training and evaluation."""
    terrains: int | None = None
    """Terrains a set, as in the evaluation; the paper's 300 (Cassie: 180)."""
    seed: int = 0
    """Draws the hard-random terrains, as in the evaluation."""
    out: Path | None = None
    """Where to write the numbers; printed alone if left out."""


def distances(cfg: DistancesCfg) -> dict[str, Any]:
    """Distances of every set's terrains to the nearest training elite, of each set median, least and largest [m].

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If it is damaged, of another robot or too small, or a number makes no sense.
    """
    count = paper_terrains(cfg.robot) if cfg.terrains is None else cfg.terrains
    if count < 1 or cfg.seed < 0:
        raise ValueError(f"terrains must be at least 1 and seed at least 0, got {count} and {cfg.seed}")
    archive = read_archive(cfg.archive or Path("results") / cfg.robot / "archive")
    split = split_elites(archive, cfg.robot, cfg.split_seed)
    sets = make_sets(("hard_random", "generated"), count, cfg.seed, archive=archive, split=split)
    nearest = {name: nearest_distance(found.terrains, archive.genes[split.train]) for name, found in sets.items()}
    nearest["generated_far"] = nearest["generated"][far_part(nearest["generated"])]
    return {
        **provenance("cpu", cfg.seed),
        "robot": cfg.robot,
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
        print(f"{name:<14} {row['terrains']:>4} terrains: {numbers}")


def run(cfg: DistancesCfg) -> int:
    """Measure, print and write; returns the exit status."""
    publish(cfg.out, lambda: distances(cfg), _show)
    return 0


def main() -> int:
    """Command line; returns the exit status."""
    cfg = tyro.cli(DistancesCfg, description=DistancesCfg.__doc__)
    return exit_code_of(lambda: run(cfg))


if __name__ == "__main__":
    sys.exit(main())
