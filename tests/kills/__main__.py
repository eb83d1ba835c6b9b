"""Kills searches at random moments, goes on with each until it is done, and says whether all came to the same bits.

``python -m tests.kills --kills 100 --real`` does so to ``faultline archive`` with the real simulation on the CPU,
every other time to its main process alone, and writes ``results/<robot>/kills.json``.
"""

import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import run_command
from sim.files.records import provenance
from tests.kills import searches
from tests.kills.campaign import Kill, Killable, RealSearch, kill_and_resume
from tests.kills.children import Child

_ROBOT = "anymal"


@dataclass(frozen=True, kw_only=True)
class KillsCfg:
    """Kill searches at random moments and go on with each until it is done."""

    kills: int = 100
    """How many kills."""
    real: bool = False
    """Kill the real search and its workers, some 10 s a kill; otherwise one over a stand-in for the simulation."""
    iterations: int = 5
    """Iterations of a search; twelve times as many over the stand-in."""
    workers: int = 1
    """Simulation processes of a real search."""
    seed: int = 0
    """Draws the moments."""
    out: Path | None = None
    """Where to write the numbers; results/<robot>/kills.json with --real, else nowhere."""

    def execute(self) -> None:
        """Runs the command."""
        main(self)


def measure(cfg: KillsCfg, folder: Path) -> dict[str, Any]:
    """Everything of ``kills.json``.

    Raises:
        AssertionError: If something was lost or differs.
    """

    def start(path: Path, number: int) -> Killable:
        if cfg.real:
            return RealSearch(path, iterations=cfg.iterations, workers=cfg.workers, whole_group=number % 2 == 1)
        return Child(folder / "log", searches.search, path, iterations=12 * cfg.iterations)

    began = time.monotonic()
    assert start(folder / "whole", 0).wait() == 0
    undisturbed_s = time.monotonic() - began
    print(f"Undisturbed: {undisturbed_s:.1f} s.", flush=True)
    whole = searches.outcome(folder / "whole")

    def report(kill: Kill) -> None:
        print(f"  run {kill.run}: killed at {kill.moment_s:.2f} s, {kill.saved} iterations saved", flush=True)

    longest_s = 0.9 * undisturbed_s if cfg.real else 0.6
    kills = kill_and_resume(
        start, folder, lambda: whole, kills=cfg.kills, longest_s=longest_s, seed=cfg.seed, report=report
    )
    return {
        **provenance("cpu", cfg.seed),
        "simulation": "real" if cfg.real else "stand-in",
        "iterations": len(whole[1]),
        "kills": len(kills),
        "kills_of_the_main_process_alone": sum(k % 2 == 0 for k in range(len(kills))) if cfg.real else len(kills),
        "kills_between_saves": sum(0 < kill.saved < len(whole[1]) for kill in kills),
        "runs": kills[-1].run + 1 if kills else 1,
        "identical": True,  # or kill_and_resume would have raised
        "undisturbed_s": round(undisturbed_s, 2),
        "wall_s": round(time.monotonic() - began, 1),
        "moments": [asdict(kill) for kill in kills],
    }


def main(cfg: KillsCfg) -> None:
    """The command."""
    out = cfg.out or (Path("results") / _ROBOT / "kills.json" if cfg.real else None)
    if out is not None:
        prepare_output(out)
    with tempfile.TemporaryDirectory() as folder:
        report = measure(cfg, Path(folder))
    print(f"{report['kills']} kills in {report['runs']} runs: nothing lost, every archive bit-identical.")
    if out is not None:
        write_atomically(out, to_json(report))
        print(f"written to {out}")


if __name__ == "__main__":
    sys.exit(run_command(KillsCfg, sys.argv[1:], name="kills"))
